"""Simplified inclined planes optimisation (SIPO, 2017) and its iteration-based form (IIPO, 2022).

a_i = F (T/t) m_i - x_i with m_i the mean of x_i and of all better agents; x_i += k1 U a_i + k2 U (x_best - x_i);
k1 = (1/t)^beta, k2 = c/(1 + exp(-(t - m_ratio T))). Agents move one after the other and the best is refreshed at once.
"""

from __future__ import annotations

import numpy as np

from testbed.tuning.ipo import logistic
from testbed.tuning.search import Best, Bounds, Steps


def sipo(
    bounds: Bounds,
    population: int,
    iterations: int,
    rng: np.random.Generator,
    factor: float = 1.0,
    beta: float = 1.0,
    c: float = 2.0,
    m_ratio: float = 0.1,
) -> Steps:
    """The first iteration evaluates the drawn agents; t = 1 to T - 1 move each of them once.

    ``F`` is the keyword ``factor``. The equations contain T/t times a place, so they depend on the origin of x.
    """
    x = bounds.draw(rng, population)
    f = (yield x).copy()
    best = Best()
    best.update(x, f)
    for t in range(1, iterations):
        k1, k2 = t**-beta, c * logistic(t - m_ratio * iterations)
        for i in range(population):
            group = f < f[i]
            group[i] = True
            a = factor * (iterations / t) * x[group].mean(axis=0) - x[i]
            draws = rng.random((2, x.shape[1]))
            x[i] = bounds.clip(x[i] + k1 * draws[0] * a + k2 * draws[1] * (best.x - x[i]))
            f[i] = (yield x[i : i + 1])[0]
            best.update(x[i : i + 1], f[i : i + 1])


def iipo(
    bounds: Bounds,
    population: int,
    iterations: int,
    rng: np.random.Generator,
    factor: float = 1.0,
    beta: float = 2.0,
    c: float = 1.75,
    m_ratio: float = 0.0,
) -> Steps:
    """SIPO's update with the settings of the iteration-based form."""
    return sipo(bounds, population, iterations, rng, factor, beta, c, m_ratio)
