"""What the arm from the IMU to an antenna adds to position and velocity. Kernels only, on floats or lanes.

Groves, 2nd ed., eq. 14.110 and 14.111; SI units, b and n. The velocity is that over ground.
"""

from __future__ import annotations

from testbed.kernels import njit
from testbed.physics import earth
from testbed.physics.rotations import cross, matrix_rotate


@njit(cache=True, nogil=True, _nrt=False)
def lever_arm(m, lever, rate, lat):
    """The arm (m), how it sweeps as the body turns (m/s), and what the Earth turns under it (m/s), triples in n.

    ``m`` = C_nb, ``lever`` the arm in b (m), ``rate`` the body's angular rate w_ib_b (rad/s). The antenna moves by sweep minus
    drag against the IMU.
    """
    arm = matrix_rotate(m, lever)
    sweep = matrix_rotate(m, cross(rate, lever))
    earth_n, _, earth_d = earth.earth_rate_n(lat)
    return arm, sweep, cross((earth_n, 0.0, earth_d), arm)
