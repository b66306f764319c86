"""Ranges to satellites: geodetic and Earth-fixed coordinates, lines of sight, and how a range changes.

Groves, 2nd ed., sections 2.4.3 and 8.5; IS-GPS-200, section 20.3.3.4.3. Kernels on floats or lanes; three-vectors are
tuples in e unless said otherwise; m, m/s, rad.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from testbed.physics.earth import E2, A, F, principal_radii

C = 299792458.0
"""Speed of light, m/s."""
OMEGA = 7.2921151467e-5
"""Earth's rotation as broadcast ephemerides define it, rad/s (IS-GPS-200)."""
L1 = 1575.42e6
"""Carrier of GPS L1 and Galileo E1, Hz."""


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


@njit(cache=True)
def sight(x, r):
    """Distance (m) from ``r`` to a satellite at ``x``, and the unit vector towards it; both at the time of reception."""
    dx, dy, dz = x[0] - r[0], x[1] - r[1], x[2] - r[2]
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    inverse = 1.0 / distance
    return distance, (dx * inverse, dy * inverse, dz * inverse)


@njit(cache=True)
def range_rate(u, x, v, v_a):
    """Time derivative of the range (m/s): exact, with the light time's own change.

    ``u`` unit vector to the satellite, ``x`` and ``v`` its position and velocity at transmission in the e of reception,
    ``v_a`` the antenna's velocity over ground. The light time tau = range / c delays the satellite by tau and turns e by
    OMEGA tau, hence the denominator.
    """
    a = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
    b = OMEGA * (u[0] * x[1] - u[1] * x[0])
    own = u[0] * v_a[0] + u[1] * v_a[1] + u[2] * v_a[2]
    return (a - own) / (1.0 + (a - b) / C)
