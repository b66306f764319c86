"""Strapdown mechanization in the local navigation frame: attitude, velocity and position from IMU means.

Savage, *Strapdown Inertial Navigation Integration Algorithm Design*, parts 1 and 2 (JGCD 1998); Groves, 2nd ed.,
section 5.4. Kernels only. Frames: n north-east-down, b body; SI units and radians; quaternions body-to-nav.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit
from testbed.physics import earth
from testbed.physics.rotations import cross, quat_multiply, quat_rotate, rotvec_to_quat


@njit(cache=True)
def coning_sculling(angle, velocity, angle_before, velocity_before):
    """Two-sample corrections (Savage part 1 eq. 47, part 2 eq. 56) of increments whose predecessors are ``_before``.

    Angle increments (rad) and velocity increments (m/s) in b, as triples. Returns the coning part of the rotation
    vector and the sculling part of the velocity change (rotation compensation is left to `advance`). Exact where rate
    and specific force are linear in time over both intervals; zero predecessors give no correction.
    """
    coning = cross(angle_before, angle)
    first = cross(angle_before, velocity)
    second = cross(velocity_before, angle)
    return (
        (coning[0] / 12.0, coning[1] / 12.0, coning[2] / 12.0),
        ((first[0] + second[0]) / 12.0, (first[1] + second[1]) / 12.0, (first[2] + second[2]) / 12.0),
    )


@njit(cache=True)
def compensate(angle, velocity, coning, sculling):
    """Rotation vector (rad) and velocity change in the b of the step's start, from increments and their corrections.

    Rotation compensation to second order (Savage part 2, eq. 19): at 1 rad/s, 40 m/s² and 100 Hz the second-order term
    is 1 mm/s per second, which a flight would notice.
    """
    turn = cross(angle, velocity)
    twice = cross(angle, turn)
    return (
        (angle[0] + coning[0], angle[1] + coning[1], angle[2] + coning[2]),
        (
            velocity[0] + 0.5 * turn[0] + twice[0] / 6.0 + sculling[0],
            velocity[1] + 0.5 * turn[1] + twice[1] / 6.0 + sculling[1],
            velocity[2] + 0.5 * turn[2] + twice[2] / 6.0 + sculling[2],
        ),
    )


@njit(cache=True)
def advance(lat, lon, h, v_n, q_nb, rotation, change_b, dt):
    """One step of ``dt`` (s): returns lat, lon, h, v_n, q_nb at its end and the mean specific force in n.

    ``rotation`` and ``change_b`` are the rotation vector and velocity change of `compensate`. Earth and transport rate,
    Coriolis and gravity are taken at the middle of the step, position by the trapezoid rule.
    """
    change = quat_rotate(q_nb, change_b)
    half = 0.5 * dt

    # Middle of the step, first order: enough for rates of 1e-4 rad/s.
    rm, rn = earth.principal_radii(lat)
    gravity = earth.gravity(lat, h - half * v_n[2])
    mid_n = v_n[0] + 0.5 * change[0]
    mid_e = v_n[1] + 0.5 * change[1]
    mid_d = v_n[2] + 0.5 * (change[2] + gravity * dt)
    mid_h = h - half * v_n[2]
    mid_lat = lat + half * v_n[0] / (rm + mid_h)
    sine, cosine = np.sin(mid_lat), np.cos(mid_lat)
    tangent = sine / cosine
    earth_n, earth_d = earth.RATE * cosine, -earth.RATE * sine
    rate_n = mid_e / (rn + mid_h)
    rate_e = -mid_n / (rm + mid_h)
    rate_d = -rate_n * tangent
    spin = (earth_n + rate_n, rate_e, earth_d + rate_d)

    # The frame n turns under the accelerometers during the step (Savage part 2, eq. 25).
    frame = cross(spin, change)
    force = (change[0] - half * frame[0], change[1] - half * frame[1], change[2] - half * frame[2])
    coriolis = cross((spin[0] + earth_n, spin[1], spin[2] + earth_d), (mid_n, mid_e, mid_d))
    v_end = (
        v_n[0] + force[0] - coriolis[0] * dt,
        v_n[1] + force[1] - coriolis[1] * dt,
        v_n[2] + force[2] + (gravity - coriolis[2]) * dt,
    )

    mean_n, mean_e, mean_d = 0.5 * (v_n[0] + v_end[0]), 0.5 * (v_n[1] + v_end[1]), 0.5 * (v_n[2] + v_end[2])
    lat_end = lat + dt * mean_n / (rm + mid_h)
    lon_end = lon + dt * mean_e / ((rn + mid_h) * cosine)
    h_end = h - dt * mean_d

    body_turn = rotvec_to_quat(rotation)
    frame_turn = rotvec_to_quat((-spin[0] * dt, -spin[1] * dt, -spin[2] * dt))
    q = quat_multiply(frame_turn, quat_multiply(q_nb, body_turn))
    # One Newton step keeps the norm: rounding is all that it has to remove.
    scale = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    q_end = (q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale)
    return lat_end, lon_end, h_end, v_end, q_end, (force[0] / dt, force[1] / dt, force[2] / dt)


@njit(cache=True)
def integrate(t_start, t, gyro, accel, lat, lon, h, v_n, q_nb, accel_bias, gyro_bias, lla, velocity, quaternion):
    """Free integration of IMU means (N,3) that end at ``t`` from a state at ``t_start``; biases are subtracted.

    Writes row k of ``lla`` (N,3), ``velocity`` (N,3) and ``quaternion`` (N,4) for t[k].
    """
    v = (v_n[0], v_n[1], v_n[2])
    q = (q_nb[0], q_nb[1], q_nb[2], q_nb[3])
    angle_before = (0.0, 0.0, 0.0)
    velocity_before = (0.0, 0.0, 0.0)
    now = t_start
    for k in range(t.shape[0]):
        dt = t[k] - now
        angle, dv = increments(gyro[k], accel[k], gyro_bias, accel_bias, dt)
        coning, sculling = coning_sculling(angle, dv, angle_before, velocity_before)
        rotation, change = compensate(angle, dv, coning, sculling)
        lat, lon, h, v, q, _ = advance(lat, lon, h, v, q, rotation, change, dt)
        angle_before, velocity_before = angle, dv
        now = t[k]
        lla[k, 0], lla[k, 1], lla[k, 2] = lat, lon, h
        for i in range(3):
            velocity[k, i] = v[i]
        for i in range(4):
            quaternion[k, i] = q[i]


@njit(cache=True)
def increments(gyro, accel, gyro_bias, accel_bias, dt):
    """Angle (rad) and velocity (m/s) increments over ``dt`` from means and bias estimates, as triples in b."""
    angle = ((gyro[0] - gyro_bias[0]) * dt, (gyro[1] - gyro_bias[1]) * dt, (gyro[2] - gyro_bias[2]) * dt)
    velocity = ((accel[0] - accel_bias[0]) * dt, (accel[1] - accel_bias[1]) * dt, (accel[2] - accel_bias[2]) * dt)
    return angle, velocity
