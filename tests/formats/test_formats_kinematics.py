"""The IMU that a recorded motion implies: against what is known in closed form, and against python-ins."""

import numpy as np
import pytest
from pyins import sim

from testbed.formats.kinematics import implied_imu
from testbed.physics.rotations import eulers_to_quats, quats_to_matrices

EARTH_RATE = 7.292115e-5


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, -135.0])
def test_at_rest_it_is_earth_rate_and_gravity(yaw_deg):
    """47 degrees north, level: the Earth turns by (4.97e-5, 0, -5.33e-5) rad/s about north, east, down; ground pushes up."""
    t, lat = np.arange(6) * 0.1, np.radians(47.0)
    q = eulers_to_quats(np.tile([0.0, 0.0, np.radians(yaw_deg)], (6, 1)))
    f_b, w_b = implied_imu(t, np.full(6, lat), np.full(6, 300.0), np.zeros((6, 3)), q)
    c = quats_to_matrices(q)
    expected = EARTH_RATE * np.array([np.cos(lat), 0.0, -np.sin(lat)])
    np.testing.assert_allclose(np.einsum("kij,kj->ki", c, w_b), np.tile(expected, (6, 1)), atol=1e-13)  # rounding / dt
    # Somigliana at 47 degrees: 9.8080 m/s2; free air takes 3.086e-6 per metre.
    np.testing.assert_allclose(np.einsum("kij,kj->ki", c, f_b)[:, 2], -(9.80802 - 300 * 3.086e-6), atol=2e-4)


def test_eastward_cruise_turns_with_the_ground_below():
    """At the equator, flying east at v: the local level turns by v / (R + h) about north, besides the Earth."""
    n, v, h, radius = 11, 250.0, 10_000.0, 6378137.0
    t = np.arange(n) * 0.01
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    _, w_b = implied_imu(t, np.zeros(n), np.full(n, h), np.tile([0.0, v, 0.0], (n, 1)), q)
    np.testing.assert_allclose(w_b, np.tile([EARTH_RATE + v / (radius + h), 0.0, 0.0], (n, 1)), atol=1e-13)


def test_a_weaving_climb_agrees_with_python_ins():
    """Mean rates against increments of its splines in the inertial frame, 100 Hz.

    The mean of a rate whose direction turns by w dt between samples is known to (w dt)^2/12: 1e-6 of 0.5 rad/s and of
    12 m/s2; spline ends are left out. Earth rate, which had the wrong sign, is a hundred times the allowance.
    """
    t = np.arange(2001) * 0.01
    speed, climb = 40.0, 2.0
    yaw, pitch, roll = 0.6 + 0.5 * np.sin(0.3 * t), 0.05 + 0.03 * np.sin(0.7 * t), 0.4 * np.sin(0.5 * t)
    v_n = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw), np.full_like(t, -climb)])
    rph = np.degrees(np.column_stack([roll, pitch, yaw]))
    trajectory, imu = sim.generate_imu(t, [47.0, 8.5, 500.0], rph, v_n, sensor_type="increment")
    q = eulers_to_quats(np.radians(rph))
    f_b, w_b = implied_imu(t, np.radians(trajectory.lat.to_numpy()), trajectory.alt.to_numpy(), v_n, q)
    increments = imu.to_numpy() / 0.01
    inner = slice(100, -100)
    assert np.abs(w_b - increments[:, :3])[inner].max() < 5e-7
    assert np.abs(f_b - increments[:, 3:])[inner].max() < 1e-4
