"""Drives: the motion does what the script says, smoothly, along its own track, and its perfect IMU closes."""

import numpy as np
import pytest
from closure import strapdown_errors
from roads import TOWN, made

from estimators.core.strapdown import integrate
from testbed import pipeline
from testbed.base.errors import FlightError, InputError
from testbed.base.schema import validate
from testbed.flight.drive import DriveConfig, plan
from testbed.physics import earth
from testbed.physics.rotations import quats_to_eulers, quats_to_matrices
from testbed.scenario import load_scenario
from testbed.sensors.draws import Draws
from testbed.sensors.odometer import OdometerConfig, sense_odometer


@pytest.fixture(scope="module")
def town():
    return made(*TOWN)


def test_the_perfect_imu_closes(town):
    """Strapdown over the true increments returns to the end within 1 mm: splines and strapdown are both of third order, and
    at 100 Hz and 3 m/s² each step of 0.01 s leaves far below a nanometre."""
    lla, v, q = (np.empty((len(town.t) - 1, n)) for n in (3, 3, 4))
    start = town.lat[0], town.lon[0], town.h[0], town.v_n[0], town.q_nb[0]
    integrate(town.t[0], town.t[1:], town.w_ib_b[1:], town.f_b[1:], *start, np.zeros(3), np.zeros(3), lla, v, q)
    ned = earth.position_difference(*lla.T, town.lat[1:], town.lon[1:], town.h[1:])
    assert np.abs(ned).max() < 1e-3


def test_it_neither_slips_nor_jumps(town):
    """Velocity lies along the forward axis; standing, the IMU feels nothing but gravity and the turning Earth."""
    v_b = np.einsum("kji,kj->ki", quats_to_matrices(town.q_nb), town.v_n)
    assert np.abs(v_b[:, 1:]).max() < 1e-9
    np.testing.assert_allclose(v_b[:, 0], town.extra["speed_mps"], atol=1e-9)
    (stop,) = [phase for phase in town.phases if phase.name == "stop"]
    standing = (town.t > stop.end - 5.0) & (town.t < stop.end - 1.0)
    assert np.abs(town.v_n[standing]).max() < 1e-9
    size = np.linalg.norm(town.f_b[standing], axis=1)
    np.testing.assert_allclose(size, earth.gravity(town.lat[standing][0], town.h[standing][0]), rtol=1e-7)
    assert np.linalg.norm(town.w_ib_b[standing], axis=1) == pytest.approx(earth.RATE, rel=1e-3)
    jerk = np.diff(town.f_b, axis=0) / town.dt
    assert np.abs(jerk).max() < 60.0  # 14 m/s through a bend of 12 m: 16 m/s² sideways, built up and gone within 2.7 s


def test_the_script_is_kept(town):
    """Largest acceleration as asked, tightest radius v² / r sideways, headings by the angles, a hill of 8 %."""
    forward = np.gradient(town.extra["speed_mps"], town.dt)
    assert forward.max() == pytest.approx(3.0, rel=1e-3)
    bend = town.t <= town.phases[1].end
    assert np.abs(town.f_b[bend, 1]).max() == pytest.approx(14.0**2 / 12.0, rel=1e-3)
    roll, pitch, yaw = quats_to_eulers(town.q_nb).T
    assert np.abs(roll).max() < 1e-9
    assert np.degrees(yaw[-1]) == pytest.approx(90.0 - 135.0, abs=1e-6)
    assert np.tan(pitch.max()) == pytest.approx(0.08, rel=1e-6)
    hill = town.phases[2]
    # over the hill the slope's mean is 1 - HILL_EDGE of its top, the sine of 8 % is 0.07975: rounding of edges cancels
    rise = np.interp([hill.start, hill.end], town.t, town.h)
    assert rise[1] - rise[0] == pytest.approx(14.0 * 20.0 * 0.8 * 0.07975, rel=2e-3)
    assert [phase.name for phase in town.phases] == [part["type"] for part in TOWN]


def test_a_straight_road_has_its_length():
    """20 m/s for 100 s northward: 2 km of the meridian ellipse, whose radius is nearly linear in latitude over them: the
    middle one serves to (1 km / R)² / 24, 1e-9."""
    truth = made({"type": "straight", "duration_s": 100.0}, initial={"speed_mps": 20.0, "lat_deg": 30.0})
    radius, _ = earth.principal_radii(0.5 * (truth.lat[0] + truth.lat[-1]))
    assert (truth.lat[-1] - truth.lat[0]) * (radius + 200.0) == pytest.approx(2000.0, rel=1e-8)
    assert np.ptp(truth.lon) < 1e-15 and np.ptp(truth.h) < 1e-9


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (
            {"type": "turn", "radius_m": 5.0, "heading_change_deg": 90.0},
            r"manoeuvre 1 of 1 \(turn\): a vehicle that stands",
        ),
        ({"type": "straight", "duration_s": 5.0, "grade_pct": 3.0}, "grade_pct needs a moving vehicle"),
        ({"type": "stop", "duration_s": 0.0}, "does nothing"),
        ({"type": "accelerate", "to_speed_mps": 1e-3, "acceleration_mps2": 20.0}, "too short"),
    ],
)
def test_what_cannot_be_driven_is_refused(part, message):
    with pytest.raises(FlightError, match=message):
        made(part)


SCENARIO = """
[scenario]
name = "town"
[flight]
type = "drive"
manoeuvres = [{ type = "accelerate", to_speed_mps = 10.0 }, { type = "turn", radius_m = 20.0, heading_change_deg = 90.0 }]
[sensors.odometer]
model = "car"
[[estimators]]
name = "ins"
[monte_carlo]
vary = ["manoeuvres"]
disperse = { "manoeuvres.0.to_speed_mps" = { uniform = [5.0, 15.0] } }
"""


def test_a_scenario_drives(tmp_path):
    path = tmp_path / "town.toml"
    path.write_text(SCENARIO)
    scenario = load_scenario(path)
    again = tmp_path / "again.toml"
    again.write_text(scenario.to_toml())
    assert load_scenario(again).flight == scenario.flight
    speeds = [pipeline.fly(scenario, run).extra["speed_mps"][-1] for run in (0, 1)]
    assert speeds[0] != speeds[1] and all(5.0 < speed < 15.0 for speed in speeds)
    log, _ = pipeline.sense(scenario, pipeline.fly(scenario))
    assert log.odometer.speed[-1] == pytest.approx(speeds[0], rel=0.05) and log.airspeed is None
    path.write_text(SCENARIO.replace("radius_m", "radius"))
    with pytest.raises(InputError, match="radius_m"):
        load_scenario(path)
    path.write_text(SCENARIO.replace('"drive"', '"drvie"'))
    with pytest.raises(InputError, match="unknown type 'drvie'; did you mean 'drive'"):
        load_scenario(path)
    path.write_text(SCENARIO.replace('model = "car"', 'model = "car"\n[sensors.airspeed]'))
    with pytest.raises(InputError, match=r"\[sensors.airspeed\] 'car' has no air data"):
        pipeline.sense(load_scenario(path), pipeline.fly(scenario))


def test_legs_take_the_time_that_their_limits_need():
    """2 dv / a for a change of speed, 2 r dpsi / v for a bend: the smooth step's mean is half of its top."""
    legs = plan(validate(DriveConfig, {"type": "drive", "manoeuvres": TOWN[:2]}, "drive"))
    assert [leg.duration for leg in legs] == pytest.approx([2 * 14.0 / 3.0, 2 * 12.0 * np.pi / 2 / 14.0])


def closes(truth, most_m):
    """Whether the strapdown over the true increments stays within this distance (m) of the truth."""
    return np.abs(strapdown_errors(truth)).max() < most_m


@pytest.mark.parametrize("name", ["car-drive", "rover", "pedestrian"])
def test_shipped_drives_close(name):
    """One lap each returns within 1 cm over perfect increments."""
    truth = pipeline.fly(load_scenario(name, overrides={"flight.laps": 1}))
    assert closes(truth, 0.01)
    whole = load_scenario(name).flight
    assert sum(leg.duration for leg in plan(whole)) == pytest.approx(whole.laps * truth.t[-1], abs=8.0), (
        "and the braking between laps"
    )


def test_the_car_of_the_shipped_drive_takes_4375_s_and_nine_outages():
    scenario = load_scenario("car-drive")
    assert sum(leg.duration for leg in plan(scenario.flight)) == pytest.approx(4375.0, abs=0.02)
    assert len(scenario.sensors.gnss.outages) == 9


def test_a_rover_turns_on_the_spot_and_its_wheels_slip():
    """The spin moves nothing and turns by its angle at its rate; 3 % per m/s² at 0.5 m/s² is 1.5 % of the wheel's speed, and
    the steering angle of a bend is that of the wheelbase over its radius (Ackermann)."""
    parts = (
        {"type": "accelerate", "to_speed_mps": 2.0, "acceleration_mps2": 0.5},
        {"type": "turn", "radius_m": 4.0, "heading_change_deg": 90.0},
        {"type": "stop", "duration_s": 2.0, "acceleration_mps2": 0.5},
        {"type": "spin", "heading_change_deg": 120.0, "rate_dps": 30.0, "direction": "left"},
    )
    truth = made(*parts, slip_pct=3.0, wheelbase_m=0.5)
    spin = truth.t > truth.phases[-1].start + 0.1
    assert truth.phases[-1].name == "spin" and np.abs(truth.v_n[spin]).max() < 1e-9
    yaw = np.degrees(np.unwrap(quats_to_eulers(truth.q_nb)[:, 2]))
    assert yaw[-1] == pytest.approx(90.0 - 120.0, abs=1e-3)
    assert np.degrees(np.abs(truth.w_ib_b[spin, 2]).max()) == pytest.approx(30.0, rel=1e-3)
    assert truth.extra["wheel_slip"].max() == pytest.approx(0.015, rel=1e-3)
    assert truth.extra["steering_deg"].max() == pytest.approx(np.degrees(np.arctan(0.5 / 4.0)), rel=1e-3)
    with pytest.raises(FlightError, match=r"manoeuvre 2 of 2 \(spin\): a spin begins"):
        made(parts[0], parts[3])
    with pytest.raises(FlightError, match=r"manoeuvre 1 of 2 \(spin\) in lap 2"):
        made(parts[3], parts[0], laps=2)


def test_the_odometer_counts_the_slipping_wheel():
    """Up to speed and through a long stretch: the odometer's way is the wheel's, longer than the road by the integral of the
    slip times the speed, 3 % of v²/2 = 6 cm at 2 m/s."""
    way = {}
    for slip in (0.0, 3.0):
        truth = made({"type": "accelerate", "to_speed_mps": 2.0, "acceleration_mps2": 0.5}, slip_pct=slip)
        config = validate(OdometerConfig, {"model": "car", "pulse_mm": 0.0, "noise_mps": 0.0, "scale_factor_pct": 0.0, "misalignment_deg": 0.0, "latency_s": 0.0}, "x")  # fmt: skip
        samples, _ = sense_odometer(config, truth, Draws(1), (0.0, 0.0, 0.0))
        way[slip] = samples.speed.sum() / samples.spec.rate_hz
    assert way[3.0] - way[0.0] == pytest.approx(0.03 * 2.0, rel=0.02)


def test_a_walker_bounces_about_its_way():
    """At 1.4 m/s the trunk moves by bounce (2 pi f)² = 2.85 m/s² up and down with the steps and by sway (pi f)² = 0.71 m/s² to
    the sides with every other; standing it is still, and the way is that of the script."""
    parts = (
        {"type": "stop", "duration_s": 5.0},
        {"type": "accelerate", "to_speed_mps": 1.4, "acceleration_mps2": 1.0},
        {"type": "straight", "duration_s": 20.0},
    )
    gait = {"step_rate_hz": 1.9, "bounce_m": 0.02, "sway_m": 0.02, "pitch_deg": 0.0, "roll_deg": 0.0}
    truth, wheeled = made(*parts, gait=gait), made(*parts)
    walking = slice(-1500, -100)
    force = truth.f_b[walking] - wheeled.f_b[walking]
    step = 2.0 * np.pi * 1.9
    assert np.abs(force[:, 2]).max() == pytest.approx(0.02 * step**2, rel=0.01)
    assert np.abs(force[:, 1]).max() == pytest.approx(0.02 * step**2 / 4.0, rel=0.01)
    peak = np.fft.rfftfreq(1400, 0.01)[np.argmax(np.abs(np.fft.rfft(force[:, 2])))]
    assert peak == pytest.approx(1.9, abs=0.08)
    standing = truth.t < 4.9
    assert np.abs(truth.v_n[standing]).max() < 1e-9
    miss = earth.position_difference(truth.lat, truth.lon, truth.h, wheeled.lat, wheeled.lon, wheeled.h)
    assert np.abs(miss).max() < 0.06, "the amplitudes, and what they build up with"
