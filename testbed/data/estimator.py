"""What the bench asks of an estimator: `Estimator`, and what one may offer beside it.

Nothing is inherited from: a class that has the names below has what they stand for.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import Any, ClassVar, Protocol

from testbed.data.records import NavSolution, SensorLog, Trajectory


class Estimator(Protocol):
    """What the bench asks of a method under test.

    It may declare the sensors that it uses as a class attribute, ``sensors = ("imu", "gnss")``: then a run tells of those
    in the log that no estimator uses. ``timed = False`` says that its seconds are no computation time, and leaves them out.
    """

    name: str

    def run(self, log: SensorLog) -> NavSolution:
        """The navigation solution that this method makes of a log."""
        ...


class Learner(Estimator, Protocol):
    """An estimator that learns before it runs, from flights whose truth is known."""

    def fit(self, flights: Iterable[tuple[SensorLog, Trajectory | None]]) -> None:
        """Learn from these flights."""
        ...

    def learn(self, lessons: Any) -> None:
        """Be handed the scenario's ``[extra.training]`` (``digest``, and ``fly()`` for the flights) before the first run."""
        ...


class Tunable(Estimator, Protocol):
    """An estimator whose parameters `testbed tune` may search without being told which, and how fast it scores them."""

    parameter_space: ClassVar[Mapping[str, tuple[float, float, str]]]
    """Least, greatest and scale (``"log"`` or ``"linear"``) of each parameter."""

    @staticmethod
    def searcher(log: SensorLog, reference: Trajectory, stride: int) -> Callable[[list[Any]], Any]:
        """An option: scores many settings on one log at once, in place of ``run`` (see `fast_path`)."""
        ...


class Readied(Estimator, Protocol):
    """An estimator that loads what its runs will share before the first of them."""

    def prepare(self, scenario: Any) -> None:
        """Load it, or raise InputError that says what is missing."""
        ...


class Described(Estimator, Protocol):
    """An estimator made of parts, for ``testbed list estimators NAME``."""

    @staticmethod
    def describe() -> Mapping[str, list[tuple[str, str]]]:
        """Name and summary of every part that a parameter may name, by parameter."""
        ...


def fast_path(kind: type, name: str) -> Callable[..., Any] | None:
    """The option ``name`` of an estimator class (``searcher`` ...), which stands in for its ``run``; None where it must not.

    It stands in for the ``run`` of the class that defines it. A class further down that has a ``run`` of its own, or another
    version of any method that this ``run`` may call, is another filter: there it needs its own fast path.
    """
    family = kind.__mro__
    owner = next((k for k, part in enumerate(family) if name in vars(part)), None)
    if owner is None or getattr(kind, name) is None:
        return None
    methods = {key for part in family[owner:] for key, value in vars(part).items() if _is_method(key, value)}
    changed = (key for part in family[:owner] for key in vars(part) if key in methods)
    if next(changed, None) is not None:
        return None
    found: Callable[..., Any] = getattr(kind, name)
    return found


def _is_method(key: str, value: object) -> bool:
    code = inspect.isfunction(value) or isinstance(value, staticmethod | classmethod | property | cached_property)
    return code and not (key.startswith("__") and key.endswith("__"))
