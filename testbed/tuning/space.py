"""The box that a search sees, and the parameters that its points stand for.

A parameter (a number, or a row of ``size`` numbers) has an axis: linear, or log (the coordinate is the decimal logarithm).
With ``squared`` the coordinate and its limits are those of the parameter's square: a variance where it is a deviation.
A dotted name is an entry of a table: ``noise_scale.accel``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field

from testbed.base.errors import InputError, nearest
from testbed.base.schema import Table
from testbed.data.records import Array
from testbed.data.registry import estimator_class, parameter_names
from testbed.tuning.search import Bounds


class AxisConfig(Table):
    """``[[extra.tune.space]]``: one parameter; what is left out comes from the estimator's ``parameter_space``."""

    name: str
    """The parameter."""
    size: int | None = Field(default=None, ge=1)
    """How many numbers it has, where it is a list."""
    low: float | None = None
    """Least value that is searched."""
    high: float | None = None
    """Greatest value that is searched."""
    axis: Literal["linear", "log"] | None = None
    """Whether the search steps by differences or by ratios."""
    squared: bool = False
    """Whether the limits are those of the parameter's square, a variance."""


@dataclass(frozen=True)
class Axis:
    """One parameter; limits are those of the parameter, or of its square."""

    name: str
    size: int | None
    low: float
    high: float
    log: bool
    squared: bool

    def to_coordinate(self, value: Any) -> Array:
        """(size,) coordinates of a parameter's value; one number stands for all of a row."""
        y = np.broadcast_to(np.asarray(value, dtype=float), self.size or 1)
        y = y**2 if self.squared else y
        return np.log10(y) if self.log else np.array(y)

    def to_value(self, x: Array) -> float | list[float]:
        """The parameter's value at coordinates (size,)."""
        y = 10.0**x if self.log else x
        y = np.sqrt(y) if self.squared else y
        return float(y[0]) if self.size is None else [float(v) for v in y]


@dataclass(frozen=True)
class Space:
    """The axes of a search."""

    axes: tuple[Axis, ...]

    @property
    def bounds(self) -> Bounds:
        """The box in coordinates."""
        low, high = [], []
        for axis in self.axes:
            limits = np.array([axis.low, axis.high])
            limits = np.log10(limits) if axis.log else limits
            low += [limits[0]] * (axis.size or 1)
            high += [limits[1]] * (axis.size or 1)
        return Bounds(np.array(low), np.array(high))

    @property
    def names(self) -> list[str]:
        """A name per coordinate, such as ``accel_noise_scale[0]``."""
        return [a.name if a.size is None else f"{a.name}[{k}]" for a in self.axes for k in range(a.size or 1)]

    def decode(self, x: Array) -> dict[str, Any]:
        """Parameters at a point (d,), dotted names as they are."""
        out: dict[str, Any] = {}
        start = 0
        for axis in self.axes:
            stop = start + (axis.size or 1)
            out[axis.name] = axis.to_value(x[start:stop])
            start = stop
        return out

    def over(self, fixed: Mapping[str, Any], x: Array) -> dict[str, Any]:
        """Parameters at a point (d,) over those that stay ``fixed``. Raises InputError for an entry of what is no table."""
        out = dict(fixed)
        for name, value in self.decode(x).items():
            *tables, key = name.split(".")
            place = out
            for table in tables:
                inner = place.get(table, {})
                if not isinstance(inner, Mapping):
                    raise InputError(f"[[extra.tune.space]] {name}: '{table}' is {inner!r} and not a table")
                place[table] = place = dict(inner)
            place[key] = value
        return out

    def encode(self, params: Mapping[str, Any]) -> Array:
        """The point (d,) of parameters, inside the box or not."""
        return np.concatenate([axis.to_coordinate(params[axis.name]) for axis in self.axes])


def make_space(estimator: str, configs: Sequence[AxisConfig], source: str = "") -> Space:
    """The space of an estimator: what ``configs`` say over what the class declares as ``parameter_space``.

    Without any it takes all that the class declares. Raises InputError where limits are missing or make no sense.
    """
    kind = estimator_class(estimator)
    declared: Mapping[str, tuple[float, float, str]] = getattr(kind, "parameter_space", {})
    chosen = list(configs) or [AxisConfig(name=name) for name in declared]
    if not chosen:
        raise InputError(
            f"{source}: estimator '{estimator}' declares no parameter_space; name the parameters in [[extra.tune.space]]"
        )
    known = parameter_names(kind)
    axes = []
    for config in chosen:
        if known is not None and config.name.split(".")[0] not in known:
            hint = nearest(config.name, known)
            raise InputError(
                f"{source}: [[extra.tune.space]]: estimator '{estimator}' has no parameter '{config.name}'; {hint}"
            )
        axes.append(_axis(config, declared.get(config.name), source))
    return Space(tuple(axes))


def _axis(config: AxisConfig, declared: tuple[float, float, str] | None, source: str) -> Axis:
    low, high, scale = declared or (None, None, "linear")
    if config.squared and declared:
        low, high = declared[0] ** 2, declared[1] ** 2
    low = low if config.low is None else config.low
    high = high if config.high is None else config.high
    log = (config.axis or scale) == "log"
    where = f"{source}: [[extra.tune.space]] {config.name}"
    if low is None or high is None:
        raise InputError(f"{where}: give low and high, as the estimator declares no limits for it")
    if not low < high:
        raise InputError(f"{where}: low = {low:g} must be below high = {high:g}")
    if (log and low <= 0.0) or (config.squared and low < 0.0):
        raise InputError(
            f"{where}: low = {low:g} must be {'positive on a log axis' if log else 'at least 0 with squared'}"
        )
    return Axis(config.name, config.size, low, high, log, config.squared)
