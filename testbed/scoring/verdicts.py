"""Verdicts on claims: the measured effect, its 95 % interval and its p-value against what the source says, in per cent.

Two kinds of claims. ``lower``: a method has a lower value of a metric than another, by so many per cent where the source gives
a figure. ``equal``: the two differ by no more than a stated margin, which takes two one-sided tests (Schuirmann 1987): that no
difference was found is no sign of equality. Effects: `testbed.scoring.effects`. The p-values of a page's claims are
corrected for their number (Holm 1979); a verdict that says something needs the interval and the corrected p-value.

- ``reproduced``            lower: the interval is above 0 and reaches the source's figure; equal: it is inside of the margin
- ``direction reproduced``  lower: the interval is above 0, but the source's figure is higher
- ``not reproduced``        lower: the interval contains 0, or prints as 0.0 to 0.0, or the corrected p-value is 0.05 or more;
                            equal: it is outside of the margin
- ``reversed``              lower: the interval is below 0
- ``undecided``             equal: the interval reaches across the border of the margin
- ``depends on runaways``   the verdict is another without the runs that lie far above all others, or ratio of means and
                            median of ratios have different signs and one of them is no chance
- ``not tested``            fewer than two runs that differ from one another and that both estimators finished
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.data.records import Array
from testbed.scoring.effects import Effect, effect
from testbed.scoring.quantities import TIME_METRIC
from testbed.scoring.statistics import LEVEL, holm

if TYPE_CHECKING:
    from testbed.scoring.claims import ClaimConfig

COLUMNS = (
    "id text paper_pct measured_pct ci_low ci_high verdict p_value n better than metric window "
    "origin kind margin_pct p_holm median_pct median_low median_high lost_better lost_than runaways trimmed_pct"
).split()
"""Of ``claims.csv``. ``median_pct``: of the paired ratios; ``lost_``: runs without a value; ``runaways``: their numbers, and
``trimmed_pct`` the effect without them."""
ALPHA = 1.0 - LEVEL
AS_PRINTED_PCT = 0.05
"""An effect below this prints as 0.0 % and is none, however certain."""
FEW_RUNS = 6
"""Fewer do not give the median a 95 % interval, and Student's t then asks for 2.8 (five runs) to 12.7 (two) standard errors."""
NOT_TESTED, RUNAWAYS, UNDECIDED = "not tested", "depends on runaways", "undecided"
REPRODUCED, LESS, NOT_REPRODUCED, REVERSED = "reproduced", "direction reproduced", "not reproduced", "reversed"

Values = Callable[[str, str, str], Array | None]
"""Per-run values of (estimator, window, metric); None where no run has them."""


def check_claims(
    claims: Sequence[ClaimConfig], values: Values, seed: int, runs: Sequence[int] = ()
) -> list[dict[str, Any]]:
    """One row of `COLUMNS` per claim. ``runs`` are the numbers of the runs in ``values``, from 0 where they are not given.

    Claims on computation time are corrected among themselves: they depend on the machine, and the others must not.
    """
    effects = [measure(claim, values, seed) for claim in claims]
    timed = [claim.metric == TIME_METRIC for claim in claims]
    rows: list[dict[str, Any]] = [{} for _ in claims]
    for family in (True, False):
        members = [k for k, kind in enumerate(timed) if kind is family]
        judged = judge([claims[k] for k in members], [effects[k] for k in members])
        for k, (verdict, p_value, p_holm) in zip(members, judged, strict=True):
            rows[k] = _row(claims[k], str(k + 1), effects[k], runs)
            rows[k] |= {"verdict": verdict, "p_value": p_value, "p_holm": p_holm}
    return rows


def few_runs_notes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A sentence on the claims (rows of `COLUMNS`) whose interval leaves 0 out, and which fewer than `FEW_RUNS` do not settle.

    Claims on computation time are not looked at: the notes of a result must not depend on the machine.
    """
    unsettled = [
        row
        for row in rows
        if row["kind"] == "lower"
        and row["metric"] != TIME_METRIC
        and row["verdict"] == NOT_REPRODUCED
        and row["n"] < FEW_RUNS
        and row["p_holm"] >= ALPHA
        and (row["ci_low"] >= AS_PRINTED_PCT or row["ci_high"] <= -AS_PRINTED_PCT)
    ]
    if not unsettled:
        return []
    named = ", ".join(str(row["id"]) for row in unsettled)
    return [
        f"not reproduced says little of so few runs: the interval leaves 0 out, but p, corrected for the number of claims, is not "
        f"below {ALPHA:.2g}, which a verdict needs as well ({named}); more runs settle it"
    ]


def measure(claim: ClaimConfig, values: Values, seed: int) -> Effect | None:
    """The effect that a claim speaks of, or None where no run has both values."""
    better, than = (values(row, claim.window, claim.metric) for row in (claim.better, claim.than))
    return None if better is None or than is None else effect(better, than, seed)


def judge(claims: Sequence[ClaimConfig], effects: Sequence[Effect | None]) -> list[tuple[str, float, float]]:
    """Verdict, p-value and Holm's corrected p-value of each claim of a page."""
    whole = _verdicts(claims, effects)
    trimmed = _verdicts(claims, [e.trimmed or e if e is not None else None for e in effects])
    out = []
    for claim, measured, (verdict, p_value, p_holm), (other, _, _) in zip(claims, effects, whole, trimmed, strict=True):
        carried = measured is not None and (verdict != other or _median_objects(measured, verdict, claim.margin_pct))
        out.append((RUNAWAYS if carried and verdict != NOT_TESTED else verdict, p_value, p_holm))
    return out


def _verdicts(claims: Sequence[ClaimConfig], effects: Sequence[Effect | None]) -> list[tuple[str, float, float]]:
    margins = [claim.margin_pct if claim.kind == "equal" else None for claim in claims]
    pairs = list(zip(effects, margins, strict=True))
    known = [math.nan if e is None else e.p_value if m is None else e.equality_p(m) for e, m in pairs]
    unequal = holm(np.array([math.nan if e is None or m is None else e.inequality_p(m) for e, m in pairs]))
    out = []
    for k, corrected in enumerate(holm(np.array(known)).tolist()):
        measured, margin = pairs[k]
        if measured is None or not math.isfinite(measured.low):
            verdict = NOT_TESTED
        elif margin is not None:
            verdict = REPRODUCED if corrected < ALPHA else NOT_REPRODUCED if unequal[k] < ALPHA else UNDECIDED
        else:
            verdict = _direction(measured, corrected < ALPHA, claims[k].paper_improvement_pct)
        out.append((verdict, known[k], corrected))
    return out


def _direction(measured: Effect, certain: bool, paper_pct: float | None) -> str:
    none = max(abs(measured.low), abs(measured.high)) < AS_PRINTED_PCT
    if none or not certain or measured.low <= 0.0 <= measured.high:
        return NOT_REPRODUCED
    if measured.high < 0.0:
        return REVERSED
    return REPRODUCED if paper_pct is None or paper_pct <= measured.high else LESS


def _median_objects(measured: Effect, verdict: str, margin: float | None) -> bool:
    """Whether mean and median point to different sides, and at least one of them by more than chance.

    Of an equality claim the sides are inside and outside of the margin.
    """
    low, high = sorted((measured.median_low, measured.median_high))
    if margin is not None:
        inside, outside = max(-low, high) < margin, low > margin or high < -margin
        return outside if verdict == REPRODUCED else inside and verdict == NOT_REPRODUCED
    if measured.percent * measured.median >= 0.0 or abs(measured.percent - measured.median) < 2.0 * AS_PRINTED_PCT:
        return False
    return not measured.low <= 0.0 <= measured.high or low > 0.0 or high < 0.0


def _row(claim: ClaimConfig, number: str, measured: Effect | None, runs: Sequence[int]) -> dict[str, Any]:
    """What a table tells of a claim, but for its verdict."""
    found = measured or Effect(math.nan, math.nan, math.nan, math.nan, 0)
    far = [runs[k] if len(runs) else k for k in found.runaways]
    return {
        "id": claim.id or number,
        "text": claim.text or describe_claim(claim),
        "paper_pct": claim.paper_improvement_pct,
        "measured_pct": found.percent,
        "ci_low": found.low,
        "ci_high": found.high,
        "n": found.n,
        "better": claim.better,
        "than": claim.than,
        "metric": claim.metric,
        "window": claim.window,
        "origin": claim.origin,
        "kind": claim.kind,
        "margin_pct": claim.margin_pct,
        "median_pct": found.median,
        "median_low": found.median_low,
        "median_high": found.median_high,
        "lost_better": found.lost[0],
        "lost_than": found.lost[1],
        "runaways": " ".join(map(str, far)),
        "trimmed_pct": found.trimmed.percent if found.trimmed else math.nan,
    }


def describe_claim(claim: ClaimConfig) -> str:
    """A sentence for a claim that has no text."""
    if claim.kind == "equal":
        return f"{claim.better} and {claim.than} have the same {claim.metric} within {claim.margin_pct:g} % ({claim.window})"
    by = f" by {claim.paper_improvement_pct:g} %" if claim.paper_improvement_pct is not None else ""
    return f"{claim.better} has a lower {claim.metric} than {claim.than}{by} ({claim.window})"
