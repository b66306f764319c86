"""Inverse strapdown: the specific force and angular rate that a sampled position, velocity and attitude imply.

Equations: Savage, *Strapdown Inertial Navigation Integration Algorithm Design*, J. Guidance 21(1)-(2), 1998, solved for
the increments. Frames: n north-east-down, b forward-right-down; SI units, radians.
"""

from __future__ import annotations

import numpy as np

from testbed.data.records import Array
from testbed.physics import earth
from testbed.physics.rotations import quats_to_matrices


def implied_imu(t: Array, lat: Array, h: Array, v_n: Array, q_nb: Array) -> tuple[Array, Array]:
    """Means over (t[k-1], t[k]] of specific force and angular rate in b, (N,3) each; row 0 repeats row 1.

    Exact to second order in the sample interval: an integrator with mid-point gravity, Earth and transport rates
    returns from row k-1 to row k. Sampling noise of the input is amplified by 1/dt.
    """
    dt = np.diff(t)[:, None]
    middle_lat, middle_h = _middle(lat), _middle(h)
    middle_v = _middle(v_n)
    w_ie = np.column_stack(earth.earth_rate_n(middle_lat))
    w_en = np.column_stack(earth.transport_rate_n(middle_lat, middle_h, middle_v[:, 0], middle_v[:, 1]))
    frame_turn = (w_ie + w_en) * dt
    q_from_old_n = multiply(from_rotvec(frame_turn), q_nb[1:])
    angle = to_rotvec(multiply(conjugate(q_nb[:-1]), q_from_old_n))
    gravity = np.zeros_like(middle_v)
    gravity[:, 2] = earth.gravity(middle_lat, middle_h)
    velocity_gain = np.diff(v_n, axis=0) - (gravity - np.cross(2.0 * w_ie + w_en, middle_v)) * dt
    c_half = quats_to_matrices(multiply(from_rotvec(-0.5 * frame_turn), q_nb[:-1]))
    rotated = np.einsum("kji,kj->ki", c_half, velocity_gain)
    increment = np.linalg.solve(np.eye(3) + 0.5 * _skew(angle), rotated[..., None])[..., 0]
    f_b, w_ib_b = increment / dt, angle / dt
    return np.vstack([f_b[:1], f_b]), np.vstack([w_ib_b[:1], w_ib_b])


def multiply(p: Array, q: Array) -> Array:
    """Hamilton products of (N,4) quaternions, row by row."""
    w = p[:, 0] * q[:, 0] - np.einsum("ki,ki->k", p[:, 1:], q[:, 1:])
    v = p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + np.cross(p[:, 1:], q[:, 1:])
    return np.column_stack([w, v])


def accumulated(turns: Array) -> Array:
    """(N+1,4): the products of none, of the first, of the first two, ... of N quaternions (N,4)."""
    out = np.vstack([[1.0, 0.0, 0.0, 0.0], turns])
    reach = 1  # each round doubles how many neighbours a row is the product of (Hillis and Steele, CACM 29(12), 1986)
    while reach < len(out):
        out = np.vstack([out[:reach], multiply(out[:-reach], out[reach:])])
        reach *= 2
    return out


def conjugate(q: Array) -> Array:
    """Inverses of unit quaternions (N,4)."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def from_rotvec(v: Array) -> Array:
    """Unit quaternions (N,4) of rotation vectors (N,3), rad."""
    half = 0.5 * np.linalg.norm(v, axis=1)
    return np.column_stack([np.cos(half), 0.5 * np.sinc(half / np.pi)[:, None] * v])


def to_rotvec(q: Array) -> Array:
    """Rotation vectors (N,3), at most pi long, of unit quaternions (N,4)."""
    q = np.where(q[:, :1] < 0.0, -q, q)
    length = np.linalg.norm(q[:, 1:], axis=1)
    gain = np.full_like(length, 2.0)
    turning = length > 1e-12
    gain[turning] = 2.0 * np.arctan2(length[turning], q[turning, 0]) / length[turning]
    return gain[:, None] * q[:, 1:]


def _middle(values: Array) -> Array:
    return 0.5 * (values[1:] + values[:-1])


def _skew(v: Array) -> Array:
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2] = -v[:, 2], v[:, 1]
    out[:, 1, 0], out[:, 1, 2] = v[:, 2], -v[:, 0]
    out[:, 2, 0], out[:, 2, 1] = -v[:, 1], v[:, 0]
    return out
