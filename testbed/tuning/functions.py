"""The benchmark functions that search algorithms are measured on, and their table.

Sphere, Rosenbrock, Rastrigin and Ackley with their usual boxes (Yao, Liu & Lin, IEEE TEC 3, 1999); all have the minimum 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from testbed.data.records import Array
from testbed.tuning.search import ALGORITHMS, Bounds, make_search

if TYPE_CHECKING:
    import pandas as pd


def sphere(x: Array) -> Array:
    """(n,d) to (n,)."""
    out: Array = (x**2).sum(axis=1)
    return out


def rosenbrock(x: Array) -> Array:
    """Minimum at (1, ..., 1)."""
    out: Array = (100.0 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1.0 - x[:, :-1]) ** 2).sum(axis=1)
    return out


def rastrigin(x: Array) -> Array:
    """A lattice of local minima."""
    out: Array = (x**2 - 10.0 * np.cos(2.0 * np.pi * x) + 10.0).sum(axis=1)
    return out


def ackley(x: Array) -> Array:
    """A funnel with ripples."""
    root = np.sqrt((x**2).mean(axis=1))
    ripple = np.cos(2.0 * np.pi * x).mean(axis=1)
    out: Array = 20.0 + math.e - 20.0 * np.exp(-0.2 * root) - np.exp(ripple)
    return out


FUNCTIONS: dict[str, tuple[Callable[[Array], Array], float, Array | float]] = {
    "sphere": (sphere, 100.0, 0.0),
    "rosenbrock": (rosenbrock, 30.0, 1.0),
    "rastrigin": (rastrigin, 5.12, 0.0),
    "ackley": (ackley, 32.0, 0.0),
}
"""Function, half width of its box, place of the minimum."""


def minimise(
    algorithm: str,
    function: str,
    seed: int,
    dimensions: int = 18,
    population: int = 50,
    iterations: int = 200,
    shift: float = 0.0,
) -> float:
    """Best value of one search. ``shift`` moves the minimum, as a part of the half width, away from the box's centre."""
    evaluate, half, _ = FUNCTIONS[function]
    bounds = Bounds(np.full(dimensions, -half), np.full(dimensions, half))
    search = make_search(algorithm, bounds, population, iterations, seed)
    best = np.inf
    while not search.done:
        f = evaluate(search.ask() - shift * half)
        best = min(best, float(f.min()))
        search.tell(f)
    return best


def benchmark_table(
    algorithms: Sequence[str] = tuple(ALGORITHMS),
    seeds: int = 20,
    population: int = 50,
    iterations: int = 200,
    dimensions: int = 18,
    shift: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
) -> pd.DataFrame:
    """Columns function, algorithm, median, mean, best, worst over the seeds."""
    import pandas as pd

    rows = []
    for function in FUNCTIONS:
        for name in algorithms:
            values = [
                minimise(name, function, seed, dimensions, population, iterations, shift) for seed in range(seeds)
            ]
            rows.append((function, name, np.median(values), np.mean(values), np.min(values), np.max(values)))
            if progress is not None:
                progress(len(rows), len(FUNCTIONS) * len(algorithms))
    return pd.DataFrame(rows, columns=["function", "algorithm", "median", "mean", "best", "worst"])
