"""Whole flights: parked on the turning Earth, line-up, take-off, circuit, approach, landing, and what is refused of them."""

from __future__ import annotations

import numpy as np
import pytest
from closure import strapdown_errors
from consistency import chance, interval, mean_nees
from flights import circuit, flight, straight, whole_flight

from testbed import pipeline
from testbed.base.errors import FlightError, InputError
from testbed.base.schema import validate
from testbed.data.registry import make_estimator
from testbed.flight import driver, fly_flight
from testbed.flight.aircraft import load_aircraft
from testbed.flight.config import FlightConfig
from testbed.flight.simulator import IN_THE_AIR, ON_WHEELS, Simulator
from testbed.physics import earth
from testbed.physics.rotations import attitude_error, quats_to_eulers, quats_to_matrices
from testbed.sensors import sense_flight
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SensorsConfig

AIRCRAFT = ("trainer", "transport")
RUNS = 8


def rows_of(truth, name):
    """First and last row of a phase; the last one of that name."""
    phase = [phase for phase in truth.phases if phase.name == name][-1]
    return round(phase.start / truth.dt), min(round(phase.end / truth.dt), len(truth.t) - 1)


def touch_down(truth):
    """The row at which the wheels touch: height is back at that of the parked aircraft, to a gear's travel."""
    start, stop = rows_of(truth, "land")
    return start + int(np.argmax(truth.h[start:stop] < truth.h[0] + 0.05))


@pytest.mark.parametrize("aircraft", AIRCRAFT)
def test_a_parked_aircraft_feels_gravity_and_the_turning_earth(aircraft):
    """Before the flight and after it: 1e-5 m/s² of Somigliana's gravity and 0.01 deg/h of Earth rate, axis by axis."""
    truth = whole_flight(aircraft)
    for first, last in ((0, round(69.0 / truth.dt)), (len(truth.t) - round(3.0 / truth.dt), len(truth.t))):
        down = np.array([0.0, 0.0, earth.gravity(truth.lat[first], truth.h[first])])
        to_b = quats_to_matrices(truth.q_nb[first : first + 1])[0].T
        assert np.abs(truth.f_b[first:last] + to_b @ down).max() < 1e-5
        turning = to_b @ np.array(earth.earth_rate_n(truth.lat[first]))
        assert np.degrees(np.abs(truth.w_ib_b[first:last] - turning).max()) * 3600.0 < 0.01


@pytest.mark.parametrize(("aircraft", "lift_off", "final"), [("trainer", 28.0, 33.0), ("transport", 72.0, 102.0)])
def test_a_whole_flight_is_flown(aircraft, lift_off, final):
    truth = whole_flight(aircraft)
    names = ["park", "line_up", "take_off", "climb", "waypoints", "approach", "land", "park"]
    assert [phase.name for phase in truth.phases] == names
    yaw = np.degrees(quats_to_eulers(truth.q_nb)[:, 2])
    speed = np.linalg.norm(truth.v_n, axis=1)
    # lined up to half a degree; the aircraft leaves the ground above its speed of rotation
    start, stop = rows_of(truth, "take_off")
    assert abs(yaw[start] - 70.0) < 0.6 and speed[start] < 0.1
    airborne = start + int(np.argmax(truth.h[start:stop] > truth.h[0] + 1.0))
    assert lift_off < speed[airborne] < 1.4 * lift_off
    along = np.array([np.cos(np.radians(yaw[start])), np.sin(np.radians(yaw[start]))])
    place = np.array(earth.position_difference(truth.lat, truth.lon, truth.h, truth.lat[start], truth.lon[start], truth.h[0]))  # fmt: skip
    ahead, right = along @ place[:2], -along[1] * place[0] + along[0] * place[1]
    assert np.abs(right[start:airborne]).max() < 5.0
    # the glide path of 3 degrees to a point 300 m beyond the threshold, half a minute before it ends
    _, flare = rows_of(truth, "approach")
    k = flare - round(30.0 / truth.dt)
    assert np.degrees(np.arctan2(-place[2][k], 300.0 - ahead[k])) == pytest.approx(3.0, abs=0.2)
    assert truth.extra["airspeed_mps"][k] == pytest.approx(final, rel=0.03)
    # down on the centreline within the touch-down zone (900 m), slower than the gear stands (CS 25.473: 3.05 m/s)
    wheels = touch_down(truth)
    assert 300.0 < ahead[wheels] < 900.0 and np.abs(right[wheels:]).max() < 5.0
    assert 0.0 < truth.v_n[wheels - 5, 2] < 3.05
    # stands again, on the same level ground: what two ways to integrate the height leave in a quarter of an hour
    assert speed[-1] < 1e-6 and truth.h[-1] == pytest.approx(truth.h[0], abs=0.02)


@pytest.mark.parametrize("aircraft", AIRCRAFT)
def test_growth_of_the_error_on_the_ground_and_at_touch_down(aircraft):
    """Parked, a step rounds the place to 2^-53 of a radian, 0.7 nm: 14,000 steps are at most 10 µm. In the two seconds about
    touch-down the force changes by 80 m/s² within a few samples: less than a millimetre."""
    truth = whole_flight(aircraft)
    error = strapdown_errors(truth)
    _, stop = rows_of(truth, "line_up")
    parked = round(70.0 / truth.dt)
    assert np.abs(error[:, :parked]).max() < 1e-5
    assert np.abs(error[:, :stop]).max() < 1e-3
    wheels, second = touch_down(truth), round(1.0 / truth.dt)
    assert np.abs(error[:, wheels + second] - error[:, wheels - second]).max() < 1e-3


def test_a_filter_aligned_before_take_off_knows_how_well():
    """Aligned for 60 s with the magnetometer, then through the whole flight: errors of the start and NEES in bounds."""
    truth = fly_flight(circuit("trainer"), 1)
    imu = {"model": "ADIS16448", "disable": ["misalignment", "nonlinearity", "g_sensitivity"]}
    keys = {"imu": imu, "mag": {"model": "ADIS16448"}, "gnss": {"model": "Garmin16x"}}
    sensors = validate(SensorsConfig, keys, "sensors")
    initial = {"position_m": 3.0, "align_at_rest_s": 60.0, "align_heading": "mag"}
    aligning = validate(InitialConfig, initial, "initial")
    ratios, nees = [], []
    for run in range(RUNS):
        log, drawn = sense_flight(sensors, aligning, truth, 4, run)
        start = log.initial
        phi = attitude_error(start.q_nb, truth.q_nb[int(np.argmin(np.abs(truth.t - start.t)))])
        ratios += list(phi / start.std[6:9])
        # levelled by what the accelerometers err: 1 mg of bias is 1 mrad
        level = np.array([-drawn.accel_bias[0, 1], drawn.accel_bias[0, 0]]) / earth.gravity(truth.lat[0], truth.h[0])
        c, s = (f(quats_to_eulers(truth.q_nb[:1])[0, 2]) for f in (np.cos, np.sin))
        # the wander within the minute, five sigma of 0.38 mg, and the scale of what gravity shows along a nose 2.4° up
        np.testing.assert_allclose(phi[:2], [c * level[0] - s * level[1], s * level[0] + c * level[1]], atol=2.5e-3)
        nees.append(mean_nees(make_estimator("indirect-kf").run(log), pipeline.truth_at_imu(truth, log), drawn))
    assert 0.4 < np.mean(np.square(ratios)) < 2.0  # chi-square of 24 degrees of freedom over 24: 99.8 %
    low, high = interval(nees)
    least, most = chance(RUNS)
    assert (low < 1.0).all() and (high > 1.0).all()
    assert (np.mean(nees, axis=0) > least).all() and (np.mean(nees, axis=0) < most).all()


def test_wheels_are_integrated_as_they_need_it(monkeypatch):
    """JSBSim's friction wants its own rule; in the air it is Adams-Bashforth. A change at lift-off, none before."""
    changes = []
    real = Simulator.integrate
    monkeypatch.setattr(Simulator, "integrate", lambda self, rules: (changes.append(rules), real(self, rules))[1])
    config = circuit("trainer")
    short = config.model_copy(update={"manoeuvres": [config.manoeuvres[0].model_copy(update={"duration_s": 1.0}), config.manoeuvres[2]]})  # fmt: skip
    fly_flight(short, 0, use_cache=False)
    assert changes == [ON_WHEELS, IN_THE_AIR]


def script(*manoeuvres, aircraft="trainer", wind=None, **initial):
    start = {"parked": True, "lat_deg": 47.0, "lon_deg": 11.0, "alt_m": 500.0} | initial
    data = {"aircraft": aircraft, "initial": start, "manoeuvres": list(manoeuvres), "wind": wind or {}}
    return validate(FlightConfig, data, "flight")


PARK, UP = {"type": "park", "duration_s": 5.0}, {"type": "take_off"}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: script(straight(5.0)), r"manoeuvre 1 of 1 \(straight\): it begins in the air, but here 'trainer' is on the ground"),
        (lambda: script(UP, PARK), r"manoeuvre 2 of 2 \(park\): it begins on the ground, .* in the air"),
        (lambda: script(UP, {"type": "land"}), r"\(land\): it begins on final approach, .* in the air"),
        (lambda: script(UP, {"type": "approach"}, PARK), r"\(park\): it begins on the ground, .* on final approach"),
        (lambda: flight("trainer", 45.0, {"type": "approach"}), r"\(approach\): only a flight that began parked"),
        (lambda: script(PARK, aircraft="aerosonde"), r"'aerosonde' does not stand on a runway: .* no \[ground\]"),
        (lambda: script(PARK, {"type": "take_off", "speed_mps": 90.0}), "flies 30 to 60 m/s"),
        (lambda: script(PARK, speed_mps=3.0), "a parked aircraft has no speed_mps"),
        (lambda: script(PARK, parked=False), "needs speed_mps above 0; on the ground say parked = true"),
        (lambda: script(PARK | {"speed_mps": 3.0}), "speed_mps has no meaning here"),
        (lambda: script(UP, {"type": "approach", "heading_deg": 10.0}), "needs both heading_deg and point"),
        # JSBSim's tables of a light aircraft end at an incidence of 180 degrees: it sits down on its tail
        (lambda: script(PARK, UP, wind={"north_mps": 9.0}), r"manoeuvre 2 of 2 \(take_off\) .*is the wind from behind"),
        (lambda: script(PARK, UP, aircraft="transport", wind={"east_mps": 15.0}), r"\(take_off\) .*left the runway: 2[34] m beside"),
    ],
)  # fmt: skip
def test_what_cannot_follow_or_be_flown_is_refused(make, words):
    with pytest.raises((FlightError, InputError), match=words):
        fly_flight(make(), 0, use_cache=False)


def test_a_longer_flight_stays_parked_after_landing():
    """Where ``duration_s`` outlasts the script, the aircraft does not fly on through the ground."""
    aircraft, folder = load_aircraft("trainer")
    config = script(PARK, {"type": "line_up", "to_heading_deg": 20.0}, PARK).model_copy(update={"duration_s": 60.0})
    flown = driver.fly_script(config, aircraft, folder, 0)
    assert flown.phases[-1].name == "park" and flown.phases[-1].end == pytest.approx(60.0, abs=0.02)
    assert np.linalg.norm(flown.v_n[-1]) < 1e-6
