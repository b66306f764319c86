"""`tight-kf`: tightly coupled INS/GNSS, an error-state filter on pseudoranges and range rates of single satellites.

Groves, 2nd ed., section 14.3.2: the composition of accelerometer bias, gyro bias, receiver clock (and the clock of a second
system) with range rates, then pseudoranges, gated one by one. NED frame, SI units and radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from estimators.aiding.ranges import SLOW_ERRORS
from estimators.blocks.satellites import lasting_noise, observations
from estimators.core.composition import Composition, Prepared, prepare
from estimators.core.heading_bank import likeliest_start, run_or_search
from estimators.core.smoother import smooth
from estimators.core.stepwise import Stepwise
from estimators.policies import fraction
from testbed.base.errors import InputError
from testbed.data.records import NavSolution, SensorLog

GATE_RANGE, GATE_RATE = 0.9999, 0.999
"""Chance that a good measurement passes: of ten pseudoranges at 5 Hz one is lost in 200 s, of rates one in 20 s."""


@dataclass(frozen=True)
class TightKf:
    """Error-state filter with a measurement per satellite.

    ``slow_errors``: how errors that last (orbits, atmosphere, multipath) are counted: "states" estimates them, a state per
    satellite and four for the atmosphere, so that the filter's sigma is honest; "consider" counts the same states and never
    corrects them (Schmidt). Both have two further states per satellite, which are estimated: multipath and the noise of the
    code loop outlast an epoch. "inflate" takes larger noise for all of this, which is twice as fast; "white" leaves it out.
    ``gate``: false for a filter that takes every measurement.
    ``range_gate``, ``rate_gate``: chance that a good one passes. ``smooth``: states given the whole log.
    """

    slow_errors: str = "states"
    gate: bool = True
    range_gate: float = GATE_RANGE
    rate_gate: float = GATE_RATE
    smooth: bool = False

    name: ClassVar[str] = "tight-kf"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss_raw")

    def __post_init__(self) -> None:
        if self.slow_errors not in SLOW_ERRORS:
            raise InputError(
                f"{self.name}: slow_errors = {self.slow_errors!r}, must be one of {', '.join(SLOW_ERRORS)}"
            )
        if self.smooth and self.slow_errors == "consider":
            raise InputError(
                f"{self.name}: smooth = true needs states that are estimated, not slow_errors = 'consider'"
            )
        fraction(f"{self.name}: range_gate", self.range_gate)
        fraction(f"{self.name}: rate_gate", self.rate_gate)

    def composition(self, log: SensorLog) -> Composition:
        """The parts, which follow the systems that the log has."""
        states, raw = ["accel-bias", "gyro-bias", "gnss-clock"], observations(log, f"estimator '{self.name}'")
        if len(np.unique(raw.systems())) > 1:
            states.append("gnss-isb")
        slow: tuple[str, ...] = ()
        if self.slow_errors in ("states", "consider"):
            slow = ("gnss-delays", "gnss-ranges")
            states += lasting_noise(raw)
        policy: Mapping[str, Any] = {
            "doppler": {"gate-each": {"one": self.rate_gate}} if self.gate else "plain",
            "pseudorange": {"gate-each": {"one": self.range_gate}} if self.gate else "plain",
        }
        options = {"pseudorange": {"slow_errors": self.slow_errors}}
        considered = slow if self.slow_errors == "consider" else ()
        return Composition((*states, *slow), ("doppler", "pseudorange"), policy, "phi", options, considered)

    def prepared(self, log: SensorLog) -> Prepared:
        """What a run on this log starts from. Raises InputError when it has no pseudoranges."""
        return prepare(self.composition(log), log)

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError when it has no pseudoranges."""
        prepared = self.prepared(log)
        return smooth(likeliest_start(prepared)) if self.smooth else run_or_search(prepared)

    def start(self, log: SensorLog) -> Stepwise:
        """The filter at the start of a log, to be led step by step. Raises InputError when it has no pseudoranges."""
        if self.smooth:
            raise InputError(f"{self.name}: smooth = true needs the whole log; start a filter without it")
        return Stepwise(self.prepared(log))
