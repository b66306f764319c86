"""Adaptive policies: noise variances that follow the innovations (Sage-Husa), and a fading covariance (strong tracking).

Sage & Husa, *Joint Automatic Control Conference* (1969), with exponential forgetting; Zhou & Frank, *Int. J. Control* 65
(1996) by `estimators.core.strong_tracking`.
"""

from __future__ import annotations

import numpy as np

from estimators.core.strong_tracking import fading_factor, smooth_innovations
from estimators.policies import Array, Policy, add_policy, fraction

COUNT, FORGETTING, FIRST = 0, 1, 2
LEAST_SHARE = 0.01
"""Of the stated variance: an estimate of R is a difference of two numbers and may be negative; a tenth of the stated sigma is
better than any receiver states by mistake."""


def sage_husa_memory(rows: int, forgetting: float = 0.98) -> Array:
    """``forgetting`` b per sample: memory 1 / (1 - b) samples, 50 at the default, whose variance is known to 20 %.

    The stated variance stands for one such memory of samples before the first: of a single innovation R would be a number with
    one degree of freedom, and the first fixes, at which a filter learns most, would be weighed by chance.
    """
    return np.concatenate([[0.0, fraction("sage-husa forgetting", forgetting)], np.zeros(rows)])


def sage_husa(memory, residual, s, r, h, p):
    """R of each channel from its innovations, with exponential forgetting; at least `LEAST_SHARE` of what is stated."""
    weight = 1.0 - memory[FORGETTING]
    for i in range(residual.shape[0]):
        stated, predicted = r[i], s[i, i] - r[i]
        if memory[COUNT] == 0.0:
            memory[FIRST + i] = stated
        seen = residual[i] * residual[i] - predicted
        memory[FIRST + i] += weight * (seen - memory[FIRST + i])
        r[i] = max(memory[FIRST + i], LEAST_SHARE * stated)
    memory[COUNT] += 1.0
    return 1.0


def strong_tracking_memory(rows: int, forgetting: float = 0.95) -> Array:
    """``forgetting`` rho of the innovations' mean square, 0.95 as Zhou and Frank advise."""
    return np.concatenate([[0.0, fraction("strong-tracking forgetting", forgetting)], np.zeros(rows)])


def strong_tracking(memory, residual, s, r, h, p):
    """The factor by which P is multiplied so that the innovations' mean square is what it should be."""
    mean_square = memory[FIRST : FIRST + residual.shape[0]]
    smooth_innovations(mean_square, residual, memory[FORGETTING], memory[COUNT] == 0.0)
    memory[COUNT] += 1.0
    return fading_factor(mean_square, s, r, False)


add_policy(
    Policy("sage-husa", sage_husa, sage_husa_memory, "R estimated from the innovations with exponential forgetting")
)
add_policy(Policy("strong-tracking", strong_tracking, strong_tracking_memory, "P multiplied by a fading factor"))
