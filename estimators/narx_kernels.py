"""The free copy of the NARX schemes: the direct filters' mechanization without a covariance. Kernels only.

State, models and ``place`` as in `motion_models`; the arithmetic is that of `direct_kernels.predict`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.direct_kernels import imu_corrections
from estimators.motion_models import ACCELERATED, N_STATES, advance


@njit(cache=True)
def coast(start, t, imu, first, x, setting, states):
    """States (rows,15) after IMU rows ``first`` on, without fixes; ``x`` starts them at time ``start`` and is overwritten."""
    corrections, held = np.zeros(6), np.zeros(3)
    now = start
    for i in range(states.shape[0]):
        k = first + i
        imu_corrections(imu, k, t[k] - now, x, corrections)
        advance(ACCELERATED, x, imu[k], corrections, t[k] - now, setting, held, states[i])
        for j in range(N_STATES):
            x[j] = states[i, j]
        now = t[k]
