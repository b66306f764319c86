"""Yardsticks from kept libraries behind the same interface: CMA-ES (package cma) and differential evolution (scipy).

Hansen, *The CMA Evolution Strategy: A Tutorial* (2016); Storn & Price, J. Global Optimization 11 (1997). The same number of
evaluations as every other algorithm: where CMA-ES ends by itself it starts again from a new place.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np

from testbed.base.errors import MissingExtra
from testbed.data.records import Array
from testbed.tuning.search import Bounds, Steps

CMA_ES = "cma-es"
WIDEST_STEP = 1.0 / 3.0
"""Most of the box that 1 sigma takes: the package's own limit, which it fails to apply to a single coordinate (version 4.5)."""
NEEDS_CMA = f"algorithm '{CMA_ES}' needs the package cma: pip install 'navigation-testbed[tuning]'"


def cma_es(bounds: Bounds, population: int, iterations: int, rng: np.random.Generator, sigma: float = 0.3) -> Steps:
    """CMA-ES on the unit cube from a random place; ``sigma`` is relative to the width of the box."""
    try:
        import cma
    except ImportError:
        raise MissingExtra(NEEDS_CMA) from None
    width = bounds.high - bounds.low
    options: dict[str, Any] = {
        "popsize": population,
        "bounds": [0.0, 1.0],
        "verbose": -9,
        "seed": np.nan,
        "randn": lambda *shape: rng.standard_normal(shape),
    }
    if single := len(width) == 1:
        options["maxstd"], sigma = np.inf, min(sigma, WIDEST_STEP)
    left = iterations
    while left > 0:
        strategy = cma.CMAEvolutionStrategy(rng.random(len(width)), sigma, options)
        while left > 0 and not strategy.stop():
            asked = strategy.ask()
            f = yield bounds.clip(bounds.low + width * np.asarray(asked))
            strategy.tell(asked, list(f))
            if single:
                strategy.sigma *= min(1.0, WIDEST_STEP / float(strategy.stds[0]))
            left -= 1


def differential_evolution(
    bounds: Bounds,
    population: int,
    iterations: int,
    rng: np.random.Generator,
    strategy: str = "best1bin",
    mutation: float = 0.7,
    recombination: float = 0.7,
) -> Steps:
    """scipy's differential evolution, a generation at a time; ``mutation`` is F, ``recombination`` CR."""
    from scipy import optimize

    def work(evaluate: Callable[[Array], Array]) -> None:
        optimize.differential_evolution(
            lambda columns: evaluate(np.ascontiguousarray(columns.T)),
            list(zip(bounds.low, bounds.high, strict=True)),
            strategy=strategy,
            maxiter=iterations - 1,
            init=bounds.draw(rng, population),
            mutation=mutation,
            recombination=recombination,
            rng=rng,
            tol=-1.0,
            polish=False,
            vectorized=True,
            updating="deferred",
        )

    return inverted(work)


class _Closed(Exception):
    """The search was stopped while the library waited for values."""


def inverted(work: Callable[[Callable[[Array], Array]], None]) -> Steps:
    """A library that calls an objective, turned into a generator that hands out candidates; it runs in a thread."""
    questions: SimpleQueue[Array | BaseException | None] = SimpleQueue()
    answers: SimpleQueue[Array | None] = SimpleQueue()

    def evaluate(x: Array) -> Array:
        questions.put(np.atleast_2d(x))
        f = answers.get()
        if f is None:
            raise _Closed
        return f

    def body() -> None:
        try:
            work(evaluate)
            questions.put(None)
        except _Closed:
            pass
        except BaseException as error:
            questions.put(error)

    threading.Thread(target=body, daemon=True).start()
    try:
        while (x := questions.get()) is not None:
            if isinstance(x, BaseException):
                raise x
            f = yield x
            answers.put(f)
    finally:
        answers.put(None)
