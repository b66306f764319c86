"""Places and directions in e, the Earth-centred frame that turns with the Earth (x to 0°E on the equator, z to the north pole).

Groves, 2nd ed., eq. 2.112 and 2.150, appendix C.2. Kernels on floats or lanes, three-vectors as tuples; below them the same
for arrays. SI units and radians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.kernels import njit
from testbed.physics.earth import E2, A, F, principal_radii

Array = NDArray[np.float64]


@njit(cache=True)
def geodetic_to_ecef(lat, lon, h):
    """Earth-fixed coordinates (m). Groves eq. 2.112."""
    _, rn = principal_radii(lat)
    level = (rn + h) * np.cos(lat)
    return level * np.cos(lon), level * np.sin(lon), ((1.0 - E2) * rn + h) * np.sin(lat)


@njit(cache=True)
def ecef_to_geodetic(x, y, z):
    """Latitude, longitude (rad) and height (m), floats: Bowring's formula, iterated to 1e-12 rad (Groves, appendix C.2)."""
    p = np.sqrt(x * x + y * y)
    lat = np.arctan2(z, p * (1.0 - E2))
    for _ in range(6):
        # the parametric latitude of the point below makes the next latitude
        beta = np.arctan2((1.0 - F) * np.sin(lat), np.cos(lat))
        new = np.arctan2(
            z + E2 / (1.0 - E2) * (1.0 - F) * A * np.sin(beta) ** 3,
            p - E2 * A * np.cos(beta) ** 3,
        )
        done = np.abs(new - lat) < 1e-13
        lat = new
        if done:
            break
    _, rn = principal_radii(lat)
    sine, cosine = np.sin(lat), np.cos(lat)
    # along the normal, which stays exact at the poles
    h = p * cosine + z * sine - A * A / rn
    return lat, np.arctan2(y, x), h


@njit(cache=True)
def north_east_down(lat, lon):
    """The axes of n as rows in e: a matrix that maps e to n (Groves eq. 2.150)."""
    sp, cp, sl, cl = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    return (-sp * cl, -sp * sl, cp), (-sl, cl, 0.0 * sl), (-cp * cl, -cp * sl, -sp)


def to_ecef(lat: Array, lon: Array, h: Array) -> Array:
    """(N,3) of latitude, longitude (rad) and height above the ellipsoid (m)."""
    return np.column_stack(geodetic_to_ecef(lat, lon, h))


def to_geodetic(place: Array) -> tuple[Array, Array, Array]:
    """Latitude, longitude (rad), height (m) of (N,3)."""
    lat, lon, h = _each_to_geodetic(np.ascontiguousarray(place)).T
    return lat, lon, h


@njit(cache=True)
def _each_to_geodetic(place):
    out = np.empty_like(place)
    for k in range(len(place)):
        out[k, 0], out[k, 1], out[k, 2] = ecef_to_geodetic(place[k, 0], place[k, 1], place[k, 2])
    return out


def directions(lat: Array, lon: Array) -> Array:
    """C_ne (N,3,3), which maps e to n: rows are north, east and down."""
    return np.stack([np.stack(row, axis=-1) for row in north_east_down(lat, lon)], axis=-2)
