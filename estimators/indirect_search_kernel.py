"""One candidate of a search over the settings of `indirect-kf`: filter a log, then score it; releases Python's lock.

Kernels only. Root mean square errors against truth; the likelihood is Gaussian. SI units and radians.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.error_model import N_STATES
from estimators.indirect_kernel import MEASUREMENTS, filter_log
from testbed import earth
from testbed.rotations import quat_to_euler, wrap


@njit(cache=True, nogil=True)
def score_candidate(
    t_start,
    t,
    gyro,
    accel,
    lever,
    fix_t,
    fix_lla,
    fix_v,
    fix_variance,
    start,
    covariance_start,
    q,
    decay,
    bias_mean,
    stride,
    truth,
    rmse,
):
    """Write ``rmse`` (9,) against ``truth`` (K,9) and return -2 log likelihood per fix; arguments as `filter_log`."""
    rows, fixes = truth.shape[0], fix_t.shape[0]
    lla, velocity, quaternion = np.empty((rows, 3)), np.empty((rows, 3)), np.empty((rows, 4))
    bias, std, snapshots = np.empty((rows, 6)), np.empty((rows, N_STATES)), np.empty((0, N_STATES, N_STATES))
    innovation = np.full((fixes, MEASUREMENTS), np.nan)
    innovation_covariance = np.empty((fixes, MEASUREMENTS, MEASUREMENTS))
    filter_log(
        t_start,
        t,
        gyro,
        accel,
        lever,
        fix_t,
        fix_lla,
        fix_v,
        fix_variance,
        start,
        covariance_start,
        q,
        decay,
        bias_mean,
        stride,
        lla,
        velocity,
        quaternion,
        bias,
        std,
        t.shape[0] + 1,
        snapshots,
        innovation,
        innovation_covariance,
    )
    rmse[:] = root_mean_square(lla, velocity, quaternion, truth)
    used = (fix_t >= t_start) & (fix_t <= t[-1])
    return mean_deviance(innovation, innovation_covariance, used)


@njit(cache=True, nogil=True)
def mean_deviance(innovation, covariance, used):
    """Mean of log det S + nu' S^-1 nu over the used fixes; infinite where an S is not positive definite."""
    fixes, n = innovation.shape
    total, count = 0.0, 0
    factor, solved = np.zeros((n, n)), np.zeros(n)
    for k in range(fixes):
        if not used[k]:
            continue
        for i in range(n):
            for j in range(i + 1):
                value = covariance[k, i, j]
                for m in range(j):
                    value -= factor[i, m] * factor[j, m]
                if i == j:
                    if not value > 0.0:
                        return np.inf
                    factor[i, i] = np.sqrt(value)
                else:
                    factor[i, j] = value / factor[j, j]
            residual = innovation[k, i]
            for m in range(i):
                residual -= factor[i, m] * solved[m]
            solved[i] = residual / factor[i, i]
            total += 2.0 * np.log(factor[i, i]) + solved[i] * solved[i]
        count += 1
    return total / count if count > 0 else np.inf


@njit(cache=True)
def root_mean_square(lla, velocity, quaternion, truth):
    """(9,) RMSE against ``truth`` (K,9), lat, lon, h, v_n, roll, pitch, yaw: m N, E, D; m/s; rad."""
    total = np.zeros(9)
    for k in range(truth.shape[0]):
        row = truth[k]
        north, east, down = earth.position_difference(lla[k, 0], lla[k, 1], lla[k, 2], row[0], row[1], row[2])
        euler = quat_to_euler(quaternion[k])
        total[0] += north * north
        total[1] += east * east
        total[2] += down * down
        for i in range(3):
            total[3 + i] += (velocity[k, i] - row[3 + i]) ** 2
            total[6 + i] += wrap(euler[i] - row[6 + i]) ** 2
    return np.sqrt(total / truth.shape[0])
