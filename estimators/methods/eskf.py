"""`eskf`: an error-state filter composed in the scenario, of blocks of states, aidings and policies by name.

``params = { states = ["accel-bias", "gyro-bias", "accel-scale"], aiding = ["gnss", "baro"], policy = { gnss = { gate = 0.999 } } }``.
Groves, 2nd ed., chapter 14; parts: `estimators.blocks`, `estimators.aiding`, `estimators.policies`. NED, SI units and radians.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.aiding import AIDINGS
from estimators.blocks import BLOCKS
from estimators.core.composition import Composition, Prepared, prepare
from estimators.core.heading_bank import likeliest_start, run_or_search
from estimators.core.side_by_side import run_side_by_side
from estimators.core.smoother import smooth
from estimators.core.stepwise import Stepwise
from estimators.policies import POLICIES, positive
from testbed.base.errors import InputError, nearest
from testbed.data.records import NavSolution, SensorLog

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Eskf:
    """Error-state filter from parts.

    ``states``: blocks beside position, velocity and attitude. ``aiding``: what corrects it. ``policy``: one for all aidings,
    or a table with one per aiding. ``error``: "phi" or "invariant". ``options``: those of aidings, by their names.
    ``noise_scale``: factors on root spectral densities of "accel" and "gyro" noise, and of what drives a block, by name;
    ``std_scale``: factors on the standard deviations of an aiding's measurements, by name. 1 is the data sheet.
    ``smooth``: states and deviations given the whole log; innovations stay those of the filter. ``consider``: those of
    ``states`` that are never corrected, but whose uncertainty counts (Schmidt-Kalman).
    """

    states: tuple[str, ...] = ("accel-bias", "gyro-bias")
    aiding: tuple[str, ...] = ("gnss",)
    policy: Any = "plain"
    error: str = "phi"
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    noise_scale: Mapping[str, float] = field(default_factory=dict)
    std_scale: Mapping[str, float] = field(default_factory=dict)
    smooth: bool = False
    consider: tuple[str, ...] = ()

    name = "eskf"
    parameter_space = dict.fromkeys(("noise_scale.accel", "noise_scale.gyro"), (1e-3, 1e3, "log"))
    """What a tuner may search in every composition; a block's noise or an aiding's deviations by name, with limits."""

    @staticmethod
    def describe() -> dict[str, list[tuple[str, str]]]:
        """What can stand in ``states``, ``aiding`` and ``policy``: name, and summary with options."""
        return {
            "states": [(name, block.summary) for name, block in sorted(BLOCKS.items())],
            "aiding": [(name, _with_options(a.summary, a.samples, 2)) for name, a in sorted(AIDINGS.items())],
            "policy": [(name, _with_options(p.summary, p.memory, 1)) for name, p in sorted(POLICIES.items())],
        }

    def __post_init__(self) -> None:
        for key in ("states", "aiding", "consider"):
            value = getattr(self, key)
            if isinstance(value, str) or not all(isinstance(name, str) for name in value):
                raise InputError(f"{self.name}: {key} = {value!r}, must be a list of names")
        try:
            composition = self.composition
            composition.blocks()
            for aiding in composition.aidings():
                composition.policy_memory(aiding)
            composition.error_code()
            composition.check_considered()
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from None
        if self.smooth and self.consider:
            raise InputError(f"{self.name}: smooth = true needs states that are estimated; leave out consider")
        for key, known in (("noise_scale", ("accel", "gyro", *self.states)), ("std_scale", tuple(self.aiding))):
            for name, factor in getattr(self, key).items():
                if name not in known:
                    raise InputError(f"{self.name}: {key}: no '{name}' in this filter; {nearest(name, known)}")
                positive(f"{self.name}: {key}.{name}", factor)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the samples of a log that it uses."""
        return ("imu", *dict.fromkeys(aiding.sensor for aiding in self.composition.aidings() if aiding.sensor != "imu"))

    @property
    def composition(self) -> Composition:
        """The parts by name."""
        return Composition(
            tuple(self.states), tuple(self.aiding), self.policy, self.error, self.options, tuple(self.consider)
        )

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError when it lacks what a part needs."""
        prepared = self.prepared(log)
        return smooth(likeliest_start(prepared)) if self.smooth else run_or_search(prepared)

    def run_many(self, logs: Sequence[SensorLog]) -> list[NavSolution]:
        """`run` on each of some logs with the same times, side by side where the composition lets them."""
        if self.smooth:
            return [self.run(log) for log in logs]
        return run_side_by_side([self.prepared(log) for log in logs])

    def start(self, log: SensorLog) -> Stepwise:
        """The filter at the start of a log, to be led step by step. Raises InputError as `run` does, and with ``smooth``."""
        if self.smooth:
            raise InputError(f"{self.name}: smooth = true needs the whole log; start a filter without it")
        return Stepwise(self.prepared(log))

    def prepared(self, log: SensorLog) -> Prepared:
        """What a run on this log starts from."""
        try:
            prepared = prepare(self.composition, log)
        except InputError as error:
            raise InputError(f"{self.name}: {error}") from None
        white, drive, r = self.noise(prepared)
        return replace(prepared, white=white, drive=drive, r=r)

    def noise(self, prepared: Prepared) -> tuple[Array, Array, Array]:
        """Spectral densities (6,) of the IMU and (k,) of what drives the states; noise variances (E,m) of the events."""
        scale = self.noise_scale
        white = prepared.white * np.repeat([scale.get("accel", 1.0) ** 2, scale.get("gyro", 1.0) ** 2], 3)
        factors = [np.full(len(b.states), scale.get(b.name, 1.0) ** 2) for b in prepared.blocks]
        drive = prepared.drive * np.concatenate([np.zeros(0), *factors])
        of_aiding = np.array([self.std_scale.get(a.name, 1.0) ** 2 for a in prepared.aidings])
        return white, drive, prepared.r * of_aiding[prepared.events[:, :1]] if len(of_aiding) else prepared.r


def _with_options(summary: str, function: Callable[..., Any], given: int) -> str:
    """A part's summary and the options that a scenario may set: arguments of a function behind the first ``given``."""
    options = list(inspect.signature(function).parameters.values())[given:]
    told = [f"{o.name} = {o.default}" for o in options if isinstance(o.default, int | float | str | tuple)]
    return summary + (f" ({', '.join(told)})" if told else "")
