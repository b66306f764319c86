"""Particle swarm optimisation with a damped inertia weight.

Kennedy & Eberhart (1995), Shi & Eberhart (1998): v = w v + c1 U (own best - x) + c2 U (best - x), w damped by 0.99 per
iteration. With c1 = c2 = 2 a swarm needs a speed limit, which no setting of the paper names: a tenth of the box here.
"""

from __future__ import annotations

import numpy as np

from testbed.tuning.search import Best, Bounds, Steps


def pso(
    bounds: Bounds,
    population: int,
    iterations: int,
    rng: np.random.Generator,
    c1: float = 2.0,
    c2: float = 2.0,
    inertia: float = 1.0,
    damping: float = 0.99,
    speed_limit: float = 0.1,
) -> Steps:
    """``speed_limit`` is relative to the width of the box; at its walls a particle bounces."""
    x = bounds.draw(rng, population)
    v = np.zeros_like(x)
    limit = speed_limit * (bounds.high - bounds.low)
    own, own_f = x.copy(), np.full(population, np.inf)
    best = Best()
    for _ in range(iterations):
        f = yield x
        better = f < own_f
        own[better], own_f[better] = x[better], f[better]
        best.update(x, f)
        pull = c1 * rng.random(x.shape) * (own - x) + c2 * rng.random(x.shape) * (best.x - x)
        v = np.clip(inertia * v + pull, -limit, limit)
        moved = x + v
        x = bounds.clip(moved)
        v = np.where(moved == x, v, -v)
        inertia *= damping
