"""Ranges to satellites: lines of sight, and how a range changes.

Groves, 2nd ed., section 8.5; IS-GPS-200, section 20.3.3.4.3. Kernels on floats or lanes; three-vectors are
tuples in e unless said otherwise; m, m/s, rad.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit

C = 299792458.0
"""Speed of light, m/s."""
OMEGA = 7.2921151467e-5
"""Earth's rotation as broadcast ephemerides define it, rad/s (IS-GPS-200)."""
L1 = 1575.42e6
"""Carrier of GPS L1 and Galileo E1, Hz."""


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
