"""A flight in closed form: truth whose IMU means are exact to round-off, for tests of navigation.

Latitude, longitude, height and Euler angles are sums of sines; rates and specific forces follow by differentiation
(Groves, 2nd ed., section 5.4 solved for f) and their means by Gauss-Legendre quadrature. NED; SI units and radians.
"""

from __future__ import annotations

import numpy as np

from testbed.data.records import Trajectory
from testbed.physics import earth
from testbed.physics.rotations import eulers_to_quats

# Amplitudes and angular rates (rad/s): 4 g and 1 rad/s at their worst.
NORTH = ((260.0, 0.31, 0.0), (60.0, 0.73, 1.0))
EAST = ((300.0, 0.27, 2.0), (50.0, 0.81, 0.5))
UP = ((40.0, 0.37, 0.3), (15.0, 0.9, 1.3))
ROLL = ((0.9, 0.53, 0.0), (0.15, 1.7, 0.4))
PITCH = ((0.4, 0.41, 1.1), (0.1, 1.9, 0.2))
YAW = ((1.5, 0.23, 0.7), (0.2, 1.3, 0.9))


def _series(terms, t):
    """Value, first and second derivative of a sum of sines."""
    value = sum(a * np.sin(w * t + p) for a, w, p in terms)
    first = sum(a * w * np.cos(w * t + p) for a, w, p in terms)
    second = sum(-a * w * w * np.sin(w * t + p) for a, w, p in terms)
    return value, first, second


def _state(t, lat0, lon0, h0, vigour):
    """lat, lon, h, v_n, euler, f_b, w_ib_b at times t."""
    metres = earth.A
    scale = (1.0 / metres, 1.0 / (metres * np.cos(lat0)), 1.0)
    (dlat, lat1, lat2), (dlon, lon1, lon2), (dh, h1, h2) = (
        tuple(vigour * s * x for x in _series(terms, t)) for terms, s in zip((NORTH, EAST, UP), scale, strict=True)
    )
    (roll, roll1, _), (pitch, pitch1, _), (yaw, yaw1, _) = (
        tuple(vigour * x for x in _series(terms, t)) for terms in (ROLL, PITCH, YAW)
    )
    lat, lon, h = lat0 + dlat, lon0 + dlon, h0 + dh
    sine, cosine = np.sin(lat), np.cos(lat)
    rm, rn = earth.principal_radii(lat)
    w2 = 1.0 - earth.E2 * sine**2
    rm1 = 3.0 * rm * earth.E2 * sine * cosine / w2 * lat1
    rn1 = rn * earth.E2 * sine * cosine / w2 * lat1
    v_n = np.column_stack([(rm + h) * lat1, (rn + h) * cosine * lon1, -h1])
    v_n1 = np.column_stack(
        [
            (rm + h) * lat2 + (rm1 + h1) * lat1,
            (rn + h) * (cosine * lon2 - sine * lat1 * lon1) + (rn1 + h1) * cosine * lon1,
            -h2,
        ]
    )
    w_ie = np.column_stack([earth.RATE * cosine, 0.0 * t, -earth.RATE * sine])
    w_en = np.column_stack([lon1 * cosine, -lat1, -lon1 * sine])
    euler = np.column_stack([roll, pitch, yaw])
    c_nb = _matrices(euler)
    gravity = np.column_stack([0.0 * t, 0.0 * t, earth.gravity(lat, h)])
    f_b = np.einsum("kij,ki->kj", c_nb, v_n1 + np.cross(2.0 * w_ie + w_en, v_n) - gravity)
    w_nb = np.column_stack(
        [
            roll1 - yaw1 * np.sin(pitch),
            pitch1 * np.cos(roll) + yaw1 * np.cos(pitch) * np.sin(roll),
            -pitch1 * np.sin(roll) + yaw1 * np.cos(pitch) * np.cos(roll),
        ]
    )
    return lat, lon, h, v_n, euler, f_b, w_nb + np.einsum("kij,ki->kj", c_nb, w_ie + w_en)


def _matrices(euler):
    from testbed.physics.rotations import quats_to_matrices

    return quats_to_matrices(eulers_to_quats(euler))


def analytic_flight(
    duration_s=300.0, rate_hz=100.0, lat_deg=45.0, lon_deg=10.0, alt_m=1000.0, vigour=1.0
) -> Trajectory:
    """The flight as truth at ``rate_hz``; ``vigour`` scales every motion, 1 is the hardest."""
    place = (np.radians(lat_deg), np.radians(lon_deg), alt_m, vigour)
    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    lat, lon, h, v_n, euler, _, _ = _state(t, *place)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    f_b, w_ib = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for node, weight in zip(nodes, weights, strict=True):
        *_, f, w = _state(t[1:] + (node - 1.0) / (2.0 * rate_hz), *place)
        f_b[1:] += 0.5 * weight * f
        w_ib[1:] += 0.5 * weight * w
    f_b[0], w_ib[0] = f_b[1], w_ib[1]
    return Trajectory(t, lat, lon, h, v_n, eulers_to_quats(euler), f_b, w_ib, name="analytic")
