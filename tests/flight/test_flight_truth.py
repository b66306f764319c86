"""The truth of a flight is kinematically exact: its increments, velocities and positions are one motion."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from closure import strapdown_errors
from flights import flight, hard, straight, transport, turn

from testbed.flight import driver, fly_flight, truth
from testbed.flight.aircraft import load_aircraft
from testbed.flight.simulator import Simulator
from testbed.flight.truth_kernels import spline_slopes
from testbed.physics import earth
from testbed.physics.interpolate import state_at
from testbed.physics.rotations import attitude_errors


@functools.cache
def hard_flight():
    return fly_flight(hard(), use_cache=False)


def test_perfect_imu_closes_after_300_s_of_hard_manoeuvres():
    """The bench's accuracy promise, on the hardest flight that it ships: 0.1 m and 0.5 m after 300 s at 100 Hz."""
    trajectory = hard_flight()
    assert trajectory.extra["load_factor"].max() > 4.0
    north, east, down = np.abs(strapdown_errors(trajectory)).max(axis=1)
    assert np.hypot(north, east) < 0.1 and down < 0.5


@pytest.mark.parametrize("bank", [15.0, 30.0, 45.0])
def test_perfect_imu_closes_after_the_transport_flight(bank):
    assert np.abs(strapdown_errors(fly_flight(transport(bank), use_cache=False))).max() < 1.0


def test_spline_slopes_equal_scipy():
    from scipy.interpolate import CubicSpline

    y = np.random.default_rng(0).standard_normal((60, 3))
    expected = CubicSpline(np.arange(60) * 0.01, y).derivative()(np.arange(60) * 0.01)
    assert np.allclose(spline_slopes(y, 0.01), expected, rtol=1e-10, atol=1e-8)


def test_velocity_is_the_rate_of_position():
    """Displacement between rows over their distance in time is the mean of the velocity's cubic spline.

    Metres are taken with the radii at the start of each interval: 2.5 m away the parallel differs by 4e-7, 1e-4 m/s.
    """
    from scipy.interpolate import CubicSpline

    trajectory = hard_flight()
    moved = earth.position_difference(
        trajectory.lat[1:],
        trajectory.lon[1:],
        trajectory.h[1:],
        trajectory.lat[:-1],
        trajectory.lon[:-1],
        trajectory.h[:-1],
    )
    path = CubicSpline(trajectory.t, trajectory.v_n).antiderivative()(trajectory.t)
    assert np.abs(np.column_stack(moved) - np.diff(path, axis=0)).max() / trajectory.dt < 1e-4


def test_truth_stays_with_jsbsim():
    """JSBSim integrates its own position over its own ellipsoid; both end within a metre after 200 s of turns."""
    config = flight("aerosonde", 30.0, turn(40.0, 60.0), turn(-40.0, 60.0), straight(80.0), alt=500.0)
    aircraft, folder = load_aircraft("aerosonde")
    simulator = Simulator(config, aircraft, folder, 1.0 / driver.STEP_HZ, 0)
    pilot = driver.Pilot(config, aircraft, simulator)
    pilot.settle(config)
    before = [read() for read in simulator.place[:2]]
    flown = pilot.fly(config)
    made = truth.make_trajectory(flown.v_n, flown.q_nb, 100.0, flown.start)
    after = [read() for read in simulator.place[:2]]
    north, east = earth.metres_per_radian(made.lat[0], made.h[0])
    assert (made.lat[-1] - made.lat[0]) * north == pytest.approx((after[0] - before[0]) * north, abs=1.0)
    assert (made.lon[-1] - made.lon[0]) * east == pytest.approx((after[1] - before[1]) * east, abs=1.0)
    assert made.h[-1] == pytest.approx(simulator.motion[6]() * 0.3048, abs=1.0)


def test_state_between_rows_meets_the_finer_flight():
    """Every second row left out and interpolated again: at 50 Hz the Hermite cubic must give the row to 1 mm."""
    fine = hard_flight()
    even = slice(0, len(fine.t) - (len(fine.t) + 1) % 2, 2)
    arrays = {name: getattr(fine, name)[even] for name in ("t", "lat", "lon", "h", "v_n", "q_nb", "f_b", "w_ib_b")}
    coarse = type(fine)(**arrays)
    odd = slice(1, len(coarse.t) * 2 - 2, 2)
    lat, lon, h, v_n, q_nb = state_at(coarse, fine.t[odd])
    miss = earth.position_difference(lat, lon, h, fine.lat[odd], fine.lon[odd], fine.h[odd])
    assert np.abs(miss).max() < 1e-3
    assert np.sqrt(np.mean((v_n - fine.v_n[odd]) ** 2)) < 0.01
    assert np.sqrt(np.mean(attitude_errors(q_nb, fine.q_nb[odd]) ** 2)) < 1e-3


def test_state_at_a_row_is_the_row_and_outside_is_refused():
    trajectory = fly_flight(transport(), use_cache=False)
    rows = np.array([0, 17, len(trajectory.t) - 1])
    lat, _, _, v_n, q_nb = state_at(trajectory, trajectory.t[rows])
    assert np.allclose(lat, trajectory.lat[rows], rtol=0, atol=1e-15)
    assert np.allclose(v_n, trajectory.v_n[rows], rtol=0, atol=1e-12)
    assert np.allclose(q_nb, trajectory.q_nb[rows], rtol=0, atol=1e-12)
    with pytest.raises(Exception, match="outside"):
        state_at(trajectory, 1e6)
