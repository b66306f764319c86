"""Innovation gate: a measurement whose normalised innovation squared is too large to be chance is not used.

Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to Tracking and Navigation*, section 5.4.
"""

from __future__ import annotations

import numpy as np

from estimators.core.update import whiten
from estimators.policies import Array, Policy, add_policy, fraction
from testbed.kernels import njit


def threshold(rows: int, gate: float = 0.999) -> Array:
    """The chi-square quantile ``gate`` of ``rows`` degrees of freedom.

    At the default one good fix in a thousand is lost, about one in 200 s at 5 Hz, which costs nothing, and a fix off by six
    sigma in one channel of six is refused (quantile 22.5).
    """
    from scipy.special import gammaincinv

    return np.array([2.0 * gammaincinv(0.5 * rows, fraction("gate", gate))])


@njit(cache=True, nogil=True)
def normalised_square(residual, s):
    """v' S^-1 v."""
    m = residual.shape[0]
    if m == 1:  # of a single satellite, thousands a second: no factor, no memory for it
        return residual[0] * residual[0] / s[0, 0] if s[0, 0] > 0.0 else np.nan
    return whiten(s, residual, np.zeros((m, m)), np.zeros(m))


def judge(memory, residual, s, r, h, p):
    """1 where the normalised square of the innovation passes its chi-square bound, else 0."""
    return 1.0 if normalised_square(residual, s) < memory[0] else 0.0


add_policy(
    Policy(
        "gate", judge, threshold, "chi-square test of the whole innovation; gate: probability that a good one passes"
    )
)


LOCKED_OUT, MEMORY = 0.5, 0.05
"""Share of refusals, a moving average over some 20 measurements, from which on the filter is taken to be wrong itself."""


def threshold_and_share(rows: int, one: float = 0.9999) -> Array:
    """The quantile, and the share of late that was refused.

    At the default one in 10,000 good measurements is lost, of ten satellites at 5 Hz one in 200 s.
    """
    from scipy.special import gammaincinv

    return np.array([2.0 * gammaincinv(0.5 * rows, fraction("gate-each", one)), 0.0])


def judge_each(memory, residual, s, r, h, p):
    """The same for a single satellite, with a way back where most are refused."""
    square = normalised_square(residual, s)
    refused = square >= memory[0]
    memory[1] += MEMORY * ((1.0 if refused else 0.0) - memory[1])
    if not refused:
        return 1.0
    if memory[1] <= LOCKED_OUT:
        return 0.0
    for i in range(residual.shape[0]):
        r[i] += (square / memory[0] - 1.0) * s[i, i]
    return 1.0


add_policy(
    Policy(
        "gate-each",
        judge_each,
        threshold_and_share,
        "the same for measurements of single satellites: where most are refused, the filter is at fault, and they count with"
        " as much noise as explains them; one: probability that a good one passes",
    )
)
