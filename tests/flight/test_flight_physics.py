"""Flights move as their models say, whatever the rate of the truth: control lags, gusts, places, and the f16's ailerons."""

from __future__ import annotations

import numpy as np
import pytest
from closure import strapdown_errors
from flights import flight, straight, turn

from testbed.base.errors import InputError
from testbed.flight import driver, fly_flight, models, truth
from testbed.flight.aircraft import load_aircraft
from testbed.flight.models import Correction
from testbed.flight.simulator import Simulator
from testbed.physics import earth


def simulator_of(name: str, speed: float) -> Simulator:
    aircraft, folder = load_aircraft(name)
    return Simulator(flight(name, speed, straight(1.0)), aircraft, folder, 1.0 / driver.STEP_HZ, 0)


def test_the_control_system_runs_at_the_step_of_the_flight():
    """The aerosonde's ailerons lag by 1/30 s: 63 % of a step after 33 ms, one or two steps of 2.5 ms later by Tustin's rule.
    A model loaded before the step is set takes JSBSim's 1/120 s: at 200 Hz the lag is 23 ms, at 400 Hz 11 ms."""
    simulator = simulator_of("aerosonde", 30.0)
    for _ in range(400):
        simulator.run()
    position = simulator.air[0]
    before = position()
    simulator.surfaces[0](0.5)
    moved = []
    for _ in range(200):
        simulator.run()
        moved.append(abs(position() - before))
    reached = 1 + int(np.argmax(np.array(moved) > (1.0 - np.exp(-1.0)) * moved[-1]))
    assert reached / driver.STEP_HZ == pytest.approx(1.0 / 30.0, abs=0.005)


def test_a_seed_is_one_flight_whatever_the_rate_of_the_truth():
    """Gusts are drawn per step of JSBSim: rows at the same times agree to the rounding of the splines, at rates that divide
    the step's, exceed it, or do neither."""
    wind = {"turbulence": "moderate"}
    rates = {rate: fly_flight(flight("aerosonde", 30.0, straight(4.0), wind=wind, rate_hz=rate), 5, False) for rate in (
        50.0, 160.0, 400.0, 1000.0)}  # fmt: skip
    fine = rates[400.0]
    for rate, step, step_fine in ((50.0, 1, 8), (160.0, 2, 5), (1000.0, 5, 2)):
        rows = slice(0, len(rates[rate].t) // step * step, step)
        same = slice(0, len(rates[rate].t[rows]) * step_fine, step_fine)
        np.testing.assert_allclose(rates[rate].t[rows], fine.t[same], atol=1e-12)
        np.testing.assert_allclose(rates[rate].v_n[rows], fine.v_n[same], atol=1e-9)
        np.testing.assert_allclose(rates[rate].q_nb[rows], fine.q_nb[same], atol=1e-9)
    for rate, flown in rates.items():
        # an IMU of each rate closes by itself, to a millimetre over so short a flight
        assert np.abs(strapdown_errors(flown)).max() < 1e-3, rate


@pytest.mark.parametrize(("name", "speed", "bearing"), [("transport", 170.0, 60.0), ("agile", 220.0, 200.0)])
def test_waypoints_in_degrees_are_reached_where_they_lie(name, speed, bearing):
    """The aircraft settles for kilometres before time begins; the points count from where the truth begins all the same."""
    initial = {"lat_deg": 45.0, "lon_deg": 179.95, "alt_m": 3000.0, "speed_mps": speed, "heading_deg": bearing}
    north, east = earth.metres_per_radian(np.radians(45.0), 3000.0)
    away = np.array([np.cos(np.radians(bearing)), np.sin(np.radians(bearing))]) * 9000.0
    lat, lon = np.radians(45.0) + away[0] / north, np.radians(179.95) + away[1] / east
    point = {"lat_deg": float(np.degrees(lat)), "lon_deg": float((np.degrees(lon) + 180.0) % 360.0 - 180.0)}
    script = {"type": "waypoints", "radius_m": 50.0, "points": [point]}
    made = fly_flight(flight(name, speed, script, initial=initial), use_cache=False)
    miss = earth.position_difference(lat, lon, 3000.0, made.lat[-1], made.lon[-1], made.h[-1])
    # guidance looks every 0.1 s
    assert np.hypot(miss[0], miss[1]) == pytest.approx(50.0, abs=0.1 * speed + 1.0)


def test_ailerons_of_the_agile_aircraft_make_no_lift():
    """Rolling into a level turn of 60 degrees the load factor goes from 1 to 2, and back. As the jsbsim package ships the
    model, the aileron adds to the lift: -1.8 and 4.8 g."""
    made = fly_flight(flight("agile", 220.0, straight(3.0), turn(60.0, 12.0), turn(-60.0, 12.0), alt=3000.0), 0, False)
    assert made.extra["load_factor"].min() > 0.4 and made.extra["load_factor"].max() < 2.4


def test_a_turn_of_the_agile_aircraft_does_not_hang_on_the_step(monkeypatch):
    """20 s of a level turn at 60 degrees, at half the step: metres at most. As the jsbsim package ships the model, its yaw
    damper overwrites the rudder's position, whose actuator gets away from it by one step's worth: 11 m."""
    aircraft, folder = load_aircraft("agile")
    config = flight("agile", 220.0, straight(2.0), turn(60.0, 20.0), alt=3000.0, rate_hz=50.0)
    ends = []
    for factor in (1, 2):
        monkeypatch.setattr(driver, "STEP_HZ", 400.0 * factor)
        flown = driver.fly_script(config, aircraft, folder, 0)
        made = truth.make_trajectory(flown.v_n, flown.q_nb, 50.0, flown.start)
        ends.append((made.lat[-1], made.lon[-1], made.h[-1]))
    assert np.linalg.norm(earth.position_difference(*ends[0], *ends[1])) < 0.5


def test_a_correction_that_finds_nothing_is_told():
    wrong = Correction(component="fcs/flaperon-summer", input="fcs/no-such-input", becomes="x", why="for a test")
    with (
        pytest.raises(InputError, match=r"f16.xml of this version of jsbsim has 0 inputs .*for a test"),
        models.clean_copy("f16", [wrong]),
    ):
        pass


def test_nothing_of_the_corrected_model_stays(tmp_path, monkeypatch):
    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path))
    aircraft, _ = load_aircraft("agile")
    with models.clean_copy("f16", aircraft.model.corrections) as paths:
        text = (paths.model / "f16.xml").read_text()
        assert paths.model.is_relative_to(tmp_path) and "<input>-fcs/left-flaperon-norm</input>" in text
    assert not list((tmp_path / "models").iterdir())
