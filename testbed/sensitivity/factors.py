"""The figures whose influence is asked for: a scenario's key and the range over which it moves, in the key's own unit."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.scenario import Scenario, set_key

SECTIONS = ("sensors", "initial", "estimators")
"""What a point of the plan may change: the flight is flown once, so that all points are scored on the same motion."""
_RANGE = re.compile(r"(?P<low>.+?)\.\.(?P<high>[^:]+)(?::(?P<axis>\w+))?")
_INSIDE = 0.381966
"""A place within a range that no list of round figures holds (the golden section), where a range is tried."""


@dataclass(frozen=True)
class Factor:
    """A dotted key that moves from ``low`` to ``high``, evenly or (``log``) evenly in its logarithm."""

    key: str
    low: float
    high: float
    log: bool = False

    def value(self, u: float) -> float:
        """The figure at a share ``u`` (0 to 1) of the range."""
        if self.log:
            return math.exp(math.log(self.low) + u * (math.log(self.high) - math.log(self.low)))
        return self.low + u * (self.high - self.low)

    def __str__(self) -> str:
        return f"{self.key}={self.low:g}..{self.high:g}{':log' if self.log else ''}"


def parse_factor(text: str) -> Factor:
    """``KEY=LOW..HIGH`` or ``KEY=LOW..HIGH:log`` of ``--over``. Raises InputError."""
    key, _, words = (part.strip() for part in text.partition("="))
    match = _RANGE.fullmatch(words)
    numbers = [_number(match[part]) for part in ("low", "high")] if match else []
    if not key or not match or None in numbers:
        raise InputError(
            f"--over {text}: expected KEY=LOW..HIGH, for example sensors.imu.gyro_arw_dpsqrth=0.1..3 (or 0.1..3:log)"
        )
    low, high = (float(n) for n in numbers if n is not None)
    if match["axis"] not in (None, "log", "linear"):
        raise InputError(f"--over {text}: '{match['axis']}' is no axis; valid: linear, log")
    log = match["axis"] == "log"
    if not low < high:
        raise InputError(f"--over {text}: {low:g} must be below {high:g}")
    if log and low <= 0.0:
        raise InputError(f"--over {text}: a range with log must begin above 0")
    return Factor(key, low, high, log)


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def check_factors(factors: Sequence[Factor], scenario: Scenario) -> None:
    """Raise InputError for a key twice, one of another section, or a range that the scenario does not take."""
    if not factors:
        raise InputError("sensitivity: name at least one figure with --over KEY=LOW..HIGH")
    for k, factor in enumerate(factors):
        if factor.key in [other.key for other in factors[:k]]:
            raise InputError(f"--over {factor}: '{factor.key}' has a range already")
        if factor.key.split(".")[0] not in SECTIONS:
            raise InputError(
                f"--over {factor}: takes keys of {', '.join(SECTIONS)}; the flight is flown once"
                " (testbed run --sweep compares flights)"
            )
        for u in (0.0, _INSIDE, 1.0):
            at(scenario, {factor.key: factor.value(u)}, f"--over {factor}")


def at(scenario: Scenario, settings: Mapping[str, Any], source: str) -> Scenario:
    """The scenario with figures changed. Raises InputError that begins with ``source``."""
    data = scenario.to_data()
    rows = len(data["estimators"])
    for key, value in settings.items():
        set_key(data, key, value, source)
    if len(data["estimators"]) > rows:
        known = ", ".join(entry.row for entry in scenario.estimators)
        raise InputError(f"{source}: no such row of [[estimators]]; there are: {known}")
    made = validate(Scenario, data, source, scenario.folder)
    made._source = scenario.source_path
    return made
