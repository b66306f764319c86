"""Robust weights: the noise variance of a channel grows with how far its innovation lies outside of what is expected.

Huber, *Robust Statistics*; IGG-III: Yang, Song & Xu, *Journal of Geodesy* 75 (2001) and 76 (2002). Channel by channel, with
``t = |innovation|`` / its standard deviation.
"""

from __future__ import annotations

import numpy as np

from estimators.policies import Array, Policy, add_policy, positive
from testbed.base.errors import InputError


def huber_memory(rows: int, k: float = 1.345) -> Array:
    """``k``: where weights begin to fall, in sigmas; at the default 95 % of the efficiency on Gaussian noise is left."""
    return np.array([positive("huber k", k)])


def huber(memory, residual, s, r, h, p):
    """R grows where an innovation passes k sigmas, so that its weight falls as k over its size."""
    for i in range(residual.shape[0]):
        t = np.abs(residual[i]) / np.sqrt(s[i, i])
        if t > memory[0]:
            r[i] *= t / memory[0]
    return 1.0


def igg3_memory(rows: int, k0: float = 1.5, k1: float = 6.0) -> Array:
    """Full weight below ``k0`` sigmas, none above ``k1``: the middle of the ranges that the authors name (1 to 1.5 or 2, 2.5 to 8)."""
    if positive("igg-iii k1", k1) <= positive("igg-iii k0", k0):
        raise InputError(f"igg-iii: k1 = {k1} must be above k0 = {k0}")
    return np.array([float(k0), float(k1)])


def igg3(memory, residual, s, r, h, p):
    """Full weight to k0 sigmas, less to k1, none beyond."""
    k0, k1 = memory[0], memory[1]
    for i in range(residual.shape[0]):
        t = np.abs(residual[i]) / np.sqrt(s[i, i])
        if t >= k1:
            r[i] *= 1e8  # as good as unused, and still a number
        elif t > k0:
            rest = (k1 - t) / (k1 - k0)
            r[i] *= min(1e8, t / (k0 * rest * rest))
    return 1.0


add_policy(Policy("huber", huber, huber_memory, "weights fall as k / t beyond k sigmas"))
add_policy(Policy("igg-iii", igg3, igg3_memory, "full weight to k0 sigmas, none beyond k1"))
