"""Real-coded genetic algorithm: roulette wheel, single-point crossover, uniform mutation.

Goldberg, *Genetic Algorithms in Search, Optimization and Machine Learning* (1989). The wheel's slots are proportional to the
linear rank (Baker 1985), so that a diverged candidate does not flatten them; the best of all generations survives.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.data.records import Array
from testbed.tuning.search import Bounds, Steps


def ga(
    bounds: Bounds,
    population: int,
    iterations: int,
    rng: np.random.Generator,
    crossover_rate: float = 0.95,
    mutation_rate: float = 0.05,
) -> Steps:
    """Each pair of parents is crossed with ``crossover_rate``; each gene is drawn anew with ``mutation_rate``."""
    x = bounds.draw(rng, population)
    f = yield x
    for _ in range(iterations - 1):
        elite, elite_f = x[np.argmin(f)].copy(), f.min()
        parents = x[roulette(f, population + population % 2, rng)]
        children = crossover(parents, crossover_rate, rng)[:population]
        mutate = rng.random(children.shape) < mutation_rate
        x = np.where(mutate, bounds.draw(rng, population), children)
        f = (yield x).copy()
        worst = np.argmax(f)
        if f.min() > elite_f:
            x[worst], f[worst] = elite, elite_f


def roulette(f: Array, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of ``count`` parents; the k-th best of N has the weight N - k."""
    rank = np.empty(len(f))
    rank[np.argsort(f, kind="stable")] = np.arange(len(f))
    weight = len(f) - rank
    return rng.choice(len(f), count, p=weight / weight.sum())


def crossover(parents: Array, rate: float, rng: np.random.Generator) -> Array:
    """Neighbours exchange all genes from a random place on."""
    children = parents.copy()
    size = parents.shape[1]
    for k in range(0, len(parents) - 1, 2):
        if rng.random() < rate and size > 1:
            point = int(rng.integers(1, size))
            children[k, point:], children[k + 1, point:] = parents[k + 1, point:], parents[k, point:]
    return children
