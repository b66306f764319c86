"""Rotations against scipy's, and the conventions of the bench."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from testbed.physics import rotations

RNG = np.random.default_rng(7)


def random_quaternions(n: int) -> np.ndarray:
    q = RNG.standard_normal((n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


@pytest.mark.parametrize("q", random_quaternions(20))
def test_matrix_euler_and_rotation_vector_agree_with_scipy(q):
    reference = Rotation.from_quat(q, scalar_first=True)
    np.testing.assert_allclose(rotations.quat_to_matrix(q), reference.as_matrix(), atol=1e-14)
    yaw, pitch, roll = reference.as_euler("ZYX")
    np.testing.assert_allclose(rotations.quat_to_euler(q), (roll, pitch, yaw), atol=1e-12)
    np.testing.assert_allclose(rotations.quat_to_rotvec(q), reference.as_rotvec(), atol=1e-12)
    back = rotations.euler_to_quat(roll, pitch, yaw)
    assert abs(np.dot(back, q)) == pytest.approx(1.0, abs=1e-14)


def test_product_is_first_right_then_left():
    p, q = random_quaternions(2)
    product = np.array(rotations.quat_to_matrix(rotations.quat_multiply(p, q)))
    separate = np.array(rotations.quat_to_matrix(p)) @ np.array(rotations.quat_to_matrix(q))
    np.testing.assert_allclose(product, separate, atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-9, 9.9e-5, 1.01e-4, 0.3, 3.1])
def test_rotation_vector_and_back(size):
    """Also across the switch between series and closed form: round-off only."""
    v = size * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(rotations.quat_to_rotvec(rotations.rotvec_to_quat(v)), v, rtol=1e-12, atol=1e-20)


def test_bank_to_the_right_lifts_the_left_wing():
    """Positive roll tips the body's right axis (y) down: its down component is sin(roll)."""
    q = rotations.euler_to_quat(np.radians(30.0), 0.0, 0.0)
    assert rotations.quat_rotate(q, (0.0, 1.0, 0.0))[2] == pytest.approx(0.5)


def test_attitude_error_is_small_rotation_in_the_navigation_frame():
    truth = random_quaternions(1)[0]
    phi = np.array([1e-3, -2e-3, 3e-3])
    estimate = rotations.quat_multiply(rotations.rotvec_to_quat(phi), truth)
    np.testing.assert_allclose(rotations.attitude_error(estimate, truth), phi, atol=1e-14)


def test_euler_error_matrix_is_the_derivative_of_the_attitude_error():
    """Central difference with step 1e-6: error of second order, 1e-12 relative to one, plus round-off 1e-10."""
    euler, step = np.array([0.4, -0.3, 2.0]), 1e-6
    numerical = np.empty((3, 3))
    for j in range(3):
        d = step * np.eye(3)[j]
        plus, minus = rotations.euler_to_quat(*(euler + d)), rotations.euler_to_quat(*(euler - d))
        numerical[:, j] = np.array(rotations.attitude_error(plus, minus)) / (2 * step)
    np.testing.assert_allclose(rotations.euler_error_matrix(*euler), numerical, atol=1e-9)


def test_wrap_stays_inside_half_a_turn():
    angles = np.linspace(-20, 20, 1001)
    wrapped = rotations.wrap(angles)
    assert wrapped.min() >= -np.pi
    assert wrapped.max() < np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-13)


def test_batch_versions_equal_the_single_ones():
    q = random_quaternions(5)
    euler = rotations.quats_to_eulers(q)
    for k in range(5):
        assert tuple(euler[k]) == rotations.quat_to_euler(q[k])
        np.testing.assert_array_equal(rotations.quats_to_matrices(q)[k], rotations.quat_to_matrix(q[k]))
    np.testing.assert_allclose(np.abs(np.sum(rotations.eulers_to_quats(euler) * q, axis=1)), 1.0, atol=1e-13)


@pytest.mark.parametrize("yaw_deg", [30.0, 10.0, 123.0, -179.0])
@pytest.mark.parametrize("pitch_deg", [90.0, -90.0, 89.999_999_999_99, -89.999_999_9, 89.999_9, 89.0])
def test_euler_angles_at_and_near_the_pole_give_the_attitude_back(pitch_deg, yaw_deg):
    """Rounding only: 1e-15 rad outside the pole, sqrt(8) x 1e-12 inside; at the pole roll is zero by definition."""
    euler = np.radians([0.0, pitch_deg, yaw_deg])
    q = rotations.euler_to_quat(*euler)
    again = rotations.quat_to_euler(q)
    error = Rotation.from_quat(rotations.euler_to_quat(*again), scalar_first=True) * (
        Rotation.from_euler("ZYX", euler[::-1]).inv()
    )
    assert error.magnitude() < 3e-12
    # sin and cos of half the angles carry 1e-16: over cos(pitch) / 2 that is what roll and yaw can be told to.
    np.testing.assert_allclose(again, euler, atol=1e-14 + 4e-16 / max(np.cos(euler[1]), 4e-12))


def test_any_attitude_at_the_pole_comes_back():
    """Roll and yaw together, of which only the difference is defined: the attitude, not the angles, is what returns."""
    for roll, yaw, sign in ((0.4, 1.1, 1.0), (-2.0, 2.5, 1.0), (3.0, -3.0, -1.0)):
        q = np.array(rotations.euler_to_quat(roll, sign * np.pi / 2, yaw))
        again = rotations.quat_to_euler(q)
        assert again[0] == 0.0
        assert again[2] == pytest.approx(rotations.wrap(yaw - sign * roll), abs=1e-14)
        assert rotations.quat_to_rotvec(
            rotations.quat_multiply(rotations.euler_to_quat(*again), q * [1, -1, -1, -1])
        ) == (pytest.approx((0.0, 0.0, 0.0), abs=3e-12))
