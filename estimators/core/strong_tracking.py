"""Strong tracking: a fading factor that reopens a filter whose innovations outgrow its covariance. Kernels only.

Zhou & Frank, *Int. J. Control* 65 (1996), as the IMM-RSTEKF paper (2023) states it, with its refinement: fade only when
a chi-square test of the innovation fails. Channels (m and m/s) are made comparable by dividing each by its noise
variance R before traces are taken; the paper adds them as they are (``raw``), which lets metres drown velocities.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit
from testbed.kernels.lanes import select

EKF, STEKF, RSTEKF = 0, 1, 2
CEILING = (1e4, 1e3, np.pi, 10.0, 1.0)
"""Position (m), velocity (m/s), attitude (rad), accelerometer (m/s²) and gyro bias (rad/s): a standard deviation of this
size says that nothing is known. One factor fades all states alike, so whatever the fixes do not observe (yaw in straight
flight, accelerometer biases in a model that does not use them) would grow without end until arithmetic fails."""
FILTERS = {"ekf": EKF, "stekf": STEKF, "rstekf": RSTEKF}


@njit(cache=True, nogil=True, _nrt=False)
def smooth_innovations(mean_square, residual, forgetting, first):
    """``mean_square`` (m,) = diagonal of Y_k = (rho Y_{k-1} + v v') / (1 + rho), in place; Y_1 = v v'."""
    for i in range(mean_square.shape[0]):
        square = residual[i] * residual[i]
        mean_square[i] = select(first, square, (forgetting * mean_square[i] + square) / (1.0 + forgetting))


@njit(cache=True, nogil=True, _nrt=False)
def fading_factor(mean_square, covariance, r, raw):
    """L = max(1, tr(N (Y - R)) / tr(N H P H')), N = R^-1, of the common channels; ``covariance`` = H P H' + R.

    ``raw``: N = 1, the traces as Zhou & Frank and the paper print them.
    """
    excess, predicted = 0.0 * r[0], 0.0 * r[0]
    for i in range(mean_square.shape[0]):
        if raw:
            excess += mean_square[i] - r[i]
            predicted += covariance[i, i] - r[i]
        else:
            excess += mean_square[i] / r[i] - 1.0
            predicted += covariance[i, i] / r[i] - 1.0
    known = select(predicted > 0.0, predicted, 1.0)
    return select((predicted > 0.0) & (excess > predicted), excess / known, 1.0)


@njit(cache=True, nogil=True, _nrt=False)
def fade(p, factor, roots, scale):
    """P = L P in place for a covariance (15,15) in the order of the states, short of ``scale`` `CEILING`. ``roots`` (15,) scratch.

    A state at its ceiling keeps its variance; rows and columns are scaled together, so P stays positive.
    """
    for i in range(15):
        std = scale * CEILING[i // 3]
        ceiling = std * std
        full = p[i, i] > ceiling
        room = select(full, 1.0, ceiling / select(p[i, i] > 0.0, p[i, i], 1.0))
        roots[i] = np.sqrt(select((p[i, i] > 0.0) & (room < factor), room, factor))
    for i in range(15):
        for j in range(15):
            p[i, j] *= roots[i] * roots[j]
