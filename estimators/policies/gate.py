"""Innovation gate: a measurement whose normalised innovation squared is too large to be chance is not used.

Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to Tracking and Navigation*, section 5.4.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.core.update import whiten
from estimators.policies import Array, Policy, add_policy, fraction


def threshold(rows: int, gate: float = 0.999) -> Array:
    """The chi-square quantile ``gate`` of ``rows`` degrees of freedom.

    At the default one good fix in a thousand is lost, about one in 200 s at 5 Hz, which costs nothing, and a fix off by six
    sigma in one channel of six is refused (quantile 22.5).
    """
    from scipy.stats import chi2

    return np.array([chi2.ppf(fraction("gate", gate), rows)])


@njit(cache=True, nogil=True)
def normalised_square(residual, s):
    """v' S^-1 v."""
    m = residual.shape[0]
    return whiten(s, residual, np.zeros((m, m)), np.zeros(m))[0]


def judge(memory, residual, s, r, h, p):
    return 1.0 if normalised_square(residual, s) < memory[0] else 0.0


add_policy(
    Policy(
        "gate", judge, threshold, "chi-square test of the whole innovation; gate: probability that a good one passes"
    )
)
