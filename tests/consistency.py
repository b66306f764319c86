"""Normalised estimation errors squared by group, and what their means over seeds must keep."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2, t

from testbed.data.records import ACCEL_BIAS_STATES, GYRO_BIAS_STATES
from testbed.physics import earth
from testbed.physics.rotations import attitude_errors

GROUPS = {"position": 3, "velocity": 3, "attitude": 3, "bias": 6}
"""Degrees of freedom."""


def errors_of(solution, truth, drawn):
    """Errors (K,15) at the covariance snapshots: m, m/s, rad, m/s², rad/s."""
    t_s = solution.covariance_t
    rows = np.searchsorted(solution.t, t_s - 1e-6)
    k, d = np.searchsorted(truth.t, t_s - 1e-6), np.searchsorted(drawn.t, t_s - 1e-6)
    here = solution.lat[rows], solution.lon[rows], solution.h[rows]
    return np.hstack(
        [
            np.column_stack(earth.position_difference(*here, truth.lat[k], truth.lon[k], truth.h[k])),
            solution.v_n[rows] - truth.v_n[k],
            attitude_errors(solution.q_nb[rows], truth.q_nb[k]),
            solution.accel_bias[rows] - drawn.accel_bias[d],
            solution.gyro_bias[rows] - drawn.gyro_bias[d],
        ]
    )


def mean_nees(solution, truth, drawn):
    """Time average of NEES / degrees of freedom (4,), one per group."""
    states = solution.states
    biases = [states.index(name) for name in (*ACCEL_BIAS_STATES, *GYRO_BIAS_STATES)]
    order, errors, out, first = np.array([*range(9), *biases]), errors_of(solution, truth, drawn), [], 0
    for size in GROUPS.values():
        part = order[first : first + size]
        covariance, e = solution.covariance[:, part][:, :, part], errors[:, first : first + size]
        white = np.linalg.solve(covariance, e[..., None])[..., 0]
        out.append(np.einsum("ki,ki->k", e, white).mean() / size)
        first += size
    return np.array(out)


def interval(means):
    """99 % t-interval of the mean over runs: lower and upper ends (4,)."""
    half = t.ppf(0.995, len(means) - 1) * np.std(means, axis=0, ddof=1) / np.sqrt(len(means))
    return np.mean(means, axis=0) - half, np.mean(means, axis=0) + half


def chance(runs, probability=0.001):
    """Ends (4,) that the mean of ``runs`` consistent runs leaves with this probability on either side.

    A time average spreads at most like a single moment, chi-square over its degrees of freedom: an error that does not
    change within a run, as that of attitude with a fixed misalignment, reaches that.
    """
    dof = runs * np.array(list(GROUPS.values()))
    return chi2.ppf(probability, dof) / dof, chi2.ppf(1.0 - probability, dof) / dof
