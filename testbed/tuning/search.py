"""The ask/tell interface of every search algorithm, and the table of algorithms by name.

An algorithm is a generator: it yields candidates (n,d) and is sent their objective values (n,). Everything is minimised,
inside a box of coordinates without units.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Generator
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from testbed.base.errors import InputError, nearest
from testbed.base.streams import stream
from testbed.data.records import Array

Steps = Generator[Array, Array, None]
"""Candidates (n,d) out, objective values (n,) in."""

ALGORITHMS = {
    "ga": "testbed.tuning.ga:ga",
    "pso": "testbed.tuning.pso:pso",
    "ipo": "testbed.tuning.ipo:ipo",
    "mipo": "testbed.tuning.ipo:mipo",
    "sipo": "testbed.tuning.sipo:sipo",
    "iipo": "testbed.tuning.sipo:iipo",
    "cma-es": "testbed.tuning.library:cma_es",
    "de": "testbed.tuning.library:differential_evolution",
}
"""Name to module and function; the first six are the paper's, in its order."""
PAPER = tuple(ALGORITHMS)[:6]
ONE_BY_ONE = ("sipo", "iipo")
"""These ask for one candidate at a time: such searches run abreast, so that their candidates can share a pass."""
LEAST_POPULATION = {"de": 5}
"""Scipy takes no smaller one; every other algorithm needs 2."""


class Bounds(NamedTuple):
    """A box: ``low`` and ``high`` (d,)."""

    low: Array
    high: Array

    def clip(self, x: Array) -> Array:
        """The nearest point of the box."""
        return np.clip(x, self.low, self.high)

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """(count,d) uniform points."""
        return rng.uniform(self.low, self.high, (count, len(self.low)))


class Best:
    """The best candidate so far: ``x`` (d,) and ``f``."""

    def __init__(self) -> None:
        self.x: Array = np.empty(0)
        self.f = np.inf

    def update(self, x: Array, f: Array) -> None:
        """Take the best of candidates (n,d) with values (n,), if it is better."""
        k = int(np.argmin(f))
        if f[k] < self.f or not len(self.x):
            self.x, self.f = x[k].copy(), float(f[k])


class Search:
    """One run of an algorithm: `ask` for candidates, `tell` their values, until `done`."""

    def __init__(self, steps: Steps) -> None:
        self._steps = steps
        self._asked: Array | None = next(steps, None)

    @property
    def done(self) -> bool:
        """Whether the algorithm has used up its iterations."""
        return self._asked is None

    def ask(self) -> Array:
        """(n,d) candidates to evaluate next; the same ones until `tell`. SIPO and IIPO ask for one at a time."""
        if self._asked is None:
            raise RuntimeError("the search is done")
        return self._asked.copy()

    def tell(self, f: Array) -> None:
        """Hand over the (n,) values of the candidates of `ask`; they must be finite."""
        if self._asked is None or np.shape(f) != (len(self._asked),) or not np.isfinite(f).all():
            raise ValueError("tell needs one finite value for each candidate that ask gave")
        try:
            self._asked = self._steps.send(np.asarray(f, dtype=np.float64))
        except StopIteration:
            self._asked = None

    def close(self) -> None:
        """Stop early; a library that waits for values in a thread is let go."""
        self._steps.close()
        self._asked = None


def make_search(
    name: str, bounds: Bounds, population: int, iterations: int, seed: int, settings: dict[str, Any] | None = None
) -> Search:
    """A run of the algorithm ``name``: ``iterations`` times ``population`` evaluations, reproducible by ``seed``.

    ``settings`` are the further keywords of its function. Raises InputError for an unknown name or setting.
    """
    function = algorithm(name)
    known = list(inspect.signature(function).parameters)[4:]
    for key in settings or {}:
        if key not in known:
            raise InputError(f"algorithm '{name}' has no setting '{key}'; {nearest(key, known)}")
    if population < (least := least_population(name)) or iterations < 1:
        raise InputError(
            f"a search by {name} needs a population of at least {least} and 1 iteration, not {population} and {iterations}"
        )
    return Search(function(bounds, population, iterations, stream(seed, 0, f"tuning.{name}"), **(settings or {})))


def least_population(name: str) -> int:
    """The fewest candidates per iteration that an algorithm works with."""
    return LEAST_POPULATION.get(name, 2)


def algorithm(name: str) -> Callable[..., Steps]:
    """The generator function behind a name. Raises InputError with the nearest name."""
    if name not in ALGORITHMS:
        raise InputError(f"unknown algorithm '{name}'; {nearest(name, ALGORITHMS)}")
    module, function = ALGORITHMS[name].split(":")
    found: Callable[..., Steps] = getattr(import_module(module), function)
    return found
