"""What the cells of the benchmarks' page are made of: timings from measured files, numbers and tables as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

Data = dict[str, Any]
NOT_MEASURED = "not measured: `python reports/studies/benchmarks.py --only {}`"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """A Markdown table, the first ``left`` columns aligned to the left."""
    lines = ["| " + " | ".join(head) + " |"]
    lines.append("|" + "".join(" :--- |" if k < left else " ---: |" for k in range(len(head))))
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def number(value: float, digits: int = 3) -> str:
    """Three significant digits without an exponent."""
    if value == 0.0 or not math.isfinite(value):
        return f"{value:g}"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:,.{places}f}"


@dataclass(frozen=True)
class Timing:
    """Seconds of one unit of a benchmark: a sample, a step, a second of flight, or a call."""

    least: float
    median: float

    @classmethod
    def of(cls, paths: Data, name: str, unit: str = "samples") -> Timing | None:
        """None where the benchmark was not run."""
        entry = paths.get(name)
        if entry is None:
            return None
        count = entry["extra"].get(unit)
        if count is None and "us_per_sample" in entry["extra"] and unit == "samples":
            count = 1e6 * entry["median_s"] / entry["extra"]["us_per_sample"]
        if unit == "evaluations":
            count = entry["min_s"] / entry["extra"]["seconds_per_evaluation"]
        count = 1.0 if unit == "calls" else count
        return None if count is None else cls(entry["min_s"] / count, entry["median_s"] / count)


def ratio(over: Timing | None, under: Timing | None, factor: float = 1.0) -> float | None:
    """Of the least times of one unit; None where one was not measured."""
    return None if over is None or under is None else over.least / (factor * under.least)
