"""Places and directions in e, the Earth-centred frame that turns with the Earth (x to 0°E on the equator, z to the north pole).

Groves, 2nd ed., eq. 2.112, 2.113 (with Bowring's start, which is exact to 1e-9 m within 100 km of the ellipsoid after one
repetition) and 2.150. Arrays of N rows in, arrays of N rows out; SI units and radians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.physics.earth import E2, A, F

Array = NDArray[np.float64]
_B = A * (1.0 - F)


def to_ecef(lat: Array, lon: Array, h: Array) -> Array:
    """(N,3) of latitude, longitude (rad) and height above the ellipsoid (m)."""
    radius = A / np.sqrt(1.0 - E2 * np.sin(lat) ** 2)
    level = (radius + h) * np.cos(lat)
    return np.column_stack([level * np.cos(lon), level * np.sin(lon), ((1.0 - E2) * radius + h) * np.sin(lat)])


def to_geodetic(place: Array) -> tuple[Array, Array, Array]:
    """Latitude, longitude (rad), height (m) of (N,3)."""
    x, y, z = place.T
    level = np.hypot(x, y)
    reduced = np.arctan2(z * A, level * _B)
    for _ in range(2):
        top = z + E2 / (1.0 - E2) * _B * np.sin(reduced) ** 3
        lat = np.arctan2(top, level - E2 * A * np.cos(reduced) ** 3)
        reduced = np.arctan2((1.0 - F) * np.sin(lat), np.cos(lat))
    radius = A / np.sqrt(1.0 - E2 * np.sin(lat) ** 2)
    # along the normal: good at the poles as well, where level / cos(lat) is not
    h = level * np.cos(lat) + z * np.sin(lat) - radius * (1.0 - E2 * np.sin(lat) ** 2)
    return lat, np.arctan2(y, x), h


def directions(lat: Array, lon: Array) -> Array:
    """C_ne (N,3,3), which maps e to n: rows are north, east and down."""
    sa, ca, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    zero = np.zeros_like(lat)
    north, east, down = (-sa * co, -sa * so, ca), (-so, co, zero), (-ca * co, -ca * so, -sa)
    return np.stack([np.stack(row, axis=-1) for row in (north, east, down)], axis=-2)
