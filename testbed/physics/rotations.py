"""Rotations: quaternions, matrices, Euler angles and rotation vectors, in one convention.

Quaternions are body-to-nav and scalar first; ``matrix`` of ``q_nb`` is ``C_nb`` and maps b to n; Euler angles are ZYX
(roll, pitch, yaw) in radians. Groves, 2nd ed., section 2.2; Sola, *Quaternion kinematics* (arXiv:1711.02508).

The single-sample kernels take anything that can be indexed (array row or tuple) and return tuples, so that a loop
allocates nothing. The plural names do the same for whole logs: arrays of N rows in, arrays of N rows out.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit
from testbed.kernels.lane_functions import half_turn
from testbed.kernels.lanes import select

EULER_POLE = 1e-12
"""cos(pitch) / 2 below which roll and yaw are not told apart: rounding (1e-16) would leave them fewer than four digits."""


@njit(cache=True)
def wrap(angle):
    """Angle (rad, float or array) into [-pi, pi)."""
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


@njit(cache=True)
def quat_multiply(p, q):
    """Hamilton product p ⊗ q: first q, then p."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@njit(cache=True)
def quat_conjugate(q):
    """Inverse of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


@njit(cache=True)
def quat_normalize(q):
    """Unit quaternion along q."""
    n = 1.0 / np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] * n, q[1] * n, q[2] * n, q[3] * n)


@njit(cache=True)
def rotvec_to_quat(v):
    """Unit quaternion of a rotation vector (rad)."""
    c, s = half_turn(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return (c, s * v[0], s * v[1], s * v[2])


@njit(cache=True)
def quat_to_rotvec(q):
    """Rotation vector (rad, at most pi long) of a unit quaternion."""
    sign = 1.0 if q[0] >= 0.0 else -1.0
    s2 = q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    s = np.sqrt(s2)
    k = 2.0 * sign if s < 1e-10 else 2.0 * sign * np.arctan2(s, sign * q[0]) / s
    return (k * q[1], k * q[2], k * q[3])


@njit(cache=True)
def quat_to_matrix(q):
    """C_nb as nested tuples, ``m[row][column]``."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        (w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )


@njit(cache=True)
def quat_rotate(q, v):
    """Vector v mapped by q: b to n for q_nb."""
    m = quat_to_matrix(q)
    return matrix_rotate(m, v)


@njit(cache=True)
def quat_rotate_inverse(q, v):
    """Vector v mapped by the inverse of q: n to b for q_nb."""
    m = quat_to_matrix(q)
    return matrix_rotate_inverse(m, v)


@njit(cache=True)
def matrix_rotate(m, v):
    """m v for a matrix of nested tuples."""
    return (
        m[0][0] * v[0] + m[0][1] * v[1] + m[0][2] * v[2],
        m[1][0] * v[0] + m[1][1] * v[1] + m[1][2] * v[2],
        m[2][0] * v[0] + m[2][1] * v[1] + m[2][2] * v[2],
    )


@njit(cache=True)
def matrix_rotate_inverse(m, v):
    """mᵀ v for a matrix of nested tuples."""
    return (
        m[0][0] * v[0] + m[1][0] * v[1] + m[2][0] * v[2],
        m[0][1] * v[0] + m[1][1] * v[1] + m[2][1] * v[2],
        m[0][2] * v[0] + m[1][2] * v[1] + m[2][2] * v[2],
    )


@njit(cache=True)
def cross(a, b):
    """Cross product a × b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit(cache=True)
def euler_to_quat(roll, pitch, yaw):
    """q_nb of Euler angles ZYX (rad)."""
    cr, sr = np.cos(0.5 * roll), np.sin(0.5 * roll)
    cp, sp = np.cos(0.5 * pitch), np.sin(0.5 * pitch)
    cy, sy = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@njit(cache=True)
def quat_to_euler(q):
    """Roll, pitch, yaw (rad) of q_nb; pitch in [-pi/2, pi/2], roll and yaw in [-pi, pi].

    From half sum and half difference of roll and yaw, which keep their digits near pitch = ±pi/2 where their parts do not
    (Bernardes and Viollet 2022, doi:10.1371/journal.pone.0276302). At the pole itself only one of them is defined: roll
    is zero there and yaw carries the whole turn, so that `euler_to_quat` returns the attitude to ``EULER_POLE``.
    """
    up_cos, up_sin = q[0] - q[2], q[1] + q[3]
    down_cos, down_sin = q[0] + q[2], q[1] - q[3]
    up, down = np.hypot(up_cos, up_sin), np.hypot(down_cos, down_sin)
    pitch = np.arctan2(2.0 * (q[0] * q[2] - q[1] * q[3]), up * down)
    half_sum, half_difference = np.arctan2(up_sin, up_cos), np.arctan2(down_sin, down_cos)
    half_sum = select(up < EULER_POLE * down, -half_difference, half_sum)
    half_difference = select(down < EULER_POLE * up, -half_sum, half_difference)
    return _half_turn(half_sum + half_difference), pitch, _half_turn(half_sum - half_difference)


@njit(cache=True)
def _half_turn(angle):
    """An angle within (-2 pi, 2 pi] into [-pi, pi]; one that is inside keeps its bits."""
    return select(angle > np.pi, angle - 2.0 * np.pi, select(angle < -np.pi, angle + 2.0 * np.pi, angle))


@njit(cache=True)
def attitude_error(q_estimate, q_truth):
    """Rotation vector phi in n (rad) with C_estimate = exp([phi×]) C_truth: the attitude error of the whole bench."""
    return quat_to_rotvec(quat_multiply(q_estimate, quat_conjugate(q_truth)))


@njit(cache=True)
def euler_error_matrix(roll, pitch, yaw):
    """J (nested tuples) with phi_n = J @ (d roll, d pitch, d yaw): Euler-angle errors to the rotation vector in n."""
    cp, sp, cy, sy = np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    zero = 0.0 * cp  # of the kind that the others are
    return ((cp * cy, -sy, zero), (cp * sy, cy, zero), (-sp, zero, zero + 1.0))


@njit(cache=True)
def quats_to_eulers(q):
    """(N,4) quaternions to (N,3) roll, pitch, yaw (rad)."""
    out = np.empty((q.shape[0], 3))
    for k in range(q.shape[0]):
        out[k, 0], out[k, 1], out[k, 2] = quat_to_euler(q[k])
    return out


@njit(cache=True)
def eulers_to_quats(euler):
    """(N,3) roll, pitch, yaw (rad) to (N,4) quaternions, continuous in sign."""
    out = np.empty((euler.shape[0], 4))
    for k in range(euler.shape[0]):
        q = euler_to_quat(euler[k, 0], euler[k, 1], euler[k, 2])
        sign = 1.0
        if k > 0 and q[0] * out[k - 1, 0] + q[1] * out[k - 1, 1] + q[2] * out[k - 1, 2] + q[3] * out[k - 1, 3] < 0.0:
            sign = -1.0
        for i in range(4):
            out[k, i] = sign * q[i]
    return out


@njit(cache=True)
def quats_to_matrices(q):
    """(N,4) quaternions to (N,3,3) C_nb."""
    out = np.empty((q.shape[0], 3, 3))
    for k in range(q.shape[0]):
        m = quat_to_matrix(q[k])
        for i in range(3):
            for j in range(3):
                out[k, i, j] = m[i][j]
    return out


@njit(cache=True)
def attitude_errors(q_estimate, q_truth):
    """(N,4), (N,4) to (N,3) rotation vectors phi in n (rad); see ``attitude_error``."""
    out = np.empty((q_truth.shape[0], 3))
    for k in range(q_truth.shape[0]):
        out[k, 0], out[k, 1], out[k, 2] = attitude_error(q_estimate[k], q_truth[k])
    return out
