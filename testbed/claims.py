"""Verdicts on a paper's claims: measured improvement and its 95 % interval against the paper's figure, in per cent.

A claim says that one estimator has a lower value of a metric than another. With the paired interval of the measured
improvement (`testbed.statistics.improvement`):

- ``reproduced``            the interval is above 0, and the paper's figure lies inside or below it
- ``direction reproduced``  the interval is above 0, but the paper's figure is higher than the interval
- ``not reproduced``        the interval contains 0
- ``reversed``              the interval is below 0
- ``not tested``            fewer than two runs that both estimators finished

A claim of 0 % says "the same": it is reproduced where the interval contains 0 or lies above it. A claim without a figure
is one of direction. The metric ``us_per_sample`` is the computation time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

from testbed.records import Array
from testbed.scenario import ClaimConfig
from testbed.statistics import Improvement, improvement

COLUMNS = "id text paper_pct measured_pct ci_low ci_high verdict p_value n better than metric window".split()

Values = Callable[[str, str, str], Array | None]
"""Per-run values of (estimator, window, metric); None where no run has them."""


def verdict(measured: Improvement | None, paper_pct: float | None) -> str:
    """The verdict on a measured improvement."""
    if measured is None or not math.isfinite(measured.low):
        return "not tested"
    if measured.high < 0.0:
        return "reversed"
    if measured.low <= 0.0:
        return "reproduced" if paper_pct == 0.0 else "not reproduced"
    return "reproduced" if paper_pct is None or paper_pct <= measured.high else "direction reproduced"


def check_claims(claims: Iterable[ClaimConfig], values: Values, seed: int) -> list[dict[str, Any]]:
    """One row of `COLUMNS` per claim."""
    rows = []
    for k, claim in enumerate(claims, 1):
        measured = measure(claim, values, seed)
        numbers = (measured.percent, measured.low, measured.high) if measured else (math.nan,) * 3
        rows.append(
            dict(zip(("measured_pct", "ci_low", "ci_high"), numbers, strict=True))
            | {
                "id": claim.id or str(k),
                "text": claim.text or describe_claim(claim),
                "paper_pct": claim.paper_improvement_pct,
            }
            | {"verdict": verdict(measured, claim.paper_improvement_pct)}
            | {"p_value": measured.p_value if measured else math.nan, "n": measured.n if measured else 0}
            | {"better": claim.better, "than": claim.than, "metric": claim.metric, "window": claim.window}
        )
    return rows


def measure(claim: ClaimConfig, values: Values, seed: int) -> Improvement | None:
    """The measured improvement that a claim speaks of, or None where no run has both values."""
    better, than = (values(row, claim.window, claim.metric) for row in (claim.better, claim.than))
    return None if better is None or than is None else improvement(better, than, seed)


def describe_claim(claim: ClaimConfig) -> str:
    """A sentence for a claim that has no text."""
    by = f" by {claim.paper_improvement_pct:g} %" if claim.paper_improvement_pct is not None else ""
    return f"{claim.better} has a lower {claim.metric} than {claim.than}{by} ({claim.window})"
