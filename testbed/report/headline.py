"""The sentence at the top of a report: which method won, by how much, and how sure that is.

Paired over the seeds: every estimator saw the same recordings. Interval and p-value: `testbed.statistics.improvement`.
Percent; the metric's own unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import pandas as pd

from testbed.report.labels import metric_label, number, percent, unit, window_label
from testbed.report.results import Result
from testbed.statistics import Improvement, improvement

PREFERRED = ("rmse_position_3d_m", "rmse_attitude_deg", "rmse_roll_deg", "rmse_velocity_3d_mps")

NONE = Improvement(math.nan, math.nan, math.nan, math.nan, 0)


@dataclass(frozen=True)
class Headline:
    """``sentences`` in plain words, and the winner's ``gain`` over the next best."""

    metric: str
    window: str
    winner: str
    sentences: list[str]
    gain: Improvement = NONE


@lru_cache(maxsize=4)
def headline(result: Result) -> Headline:
    """Rank the estimators by the scenario's main measure and say how firm the first place is."""
    metric, window = main_measure(result)
    table = result.summary
    means = table[(table["metric"] == metric) & (table["window"] == window)].set_index("estimator")["mean"].dropna()
    if means.empty:
        return Headline(metric, window, "", ["No estimator produced a score."])
    order = list(means.sort_values().index)
    winner = order[0]
    value = f"{number(means[winner])} {unit(metric)}".strip()
    where = "over the whole flight" if window == "all" else f"in the window “{window_label(window)}”"
    if window == "outages":
        where = "during the GNSS outages"
    words = metric_label(metric)
    first = (
        f"{winner} has the lowest {words[0].lower() + words[1:] if not words[0].isdigit() else words} {where}: {value}"
    )
    if len(order) == 1:
        return Headline(metric, window, winner, [f"{winner}: {words} {where} {value}."])
    runs = result.per_run([metric], window).pivot_table(index="run", columns="estimator", values="value")
    runner_up, baseline = order[1], result.estimators[0]
    gains = {rival: _improvement(result, runs, winner, rival) for rival in order[1:]}
    level = [rival for rival in order[1:] if not gains[rival].low > 0.0]
    clear = [rival for rival in order[1:] if gains[rival].low > 0.0]
    runner_up = order[1]
    if not level:
        sentences = [
            f"{first}, {percent(gains[runner_up].percent)} % below {runner_up}, the next best ({_sureness(gains[runner_up])})."
        ]
    else:
        sentences = [
            f"{first}. The runs do not tell it apart from {_listed(level)} (lead over {level[0]}: {_difference(gains[level[0]])})."
        ]
        if clear:
            sentences.append(
                f"It is better than {clear[0]} by {percent(gains[clear[0]].percent)} % ({_sureness(gains[clear[0]])})."
            )
    baseline = result.estimators[0]
    if baseline not in (winner, runner_up, *clear[: bool(level)]):
        sentences.append(
            f"Against {baseline}, the first listed, it is {_difference(gains[baseline])}." if baseline in gains else ""
        )
    bad = result.runs[result.runs["status"] != "ok"]
    if len(bad):
        counts = bad.groupby("estimator", sort=False).size()
        sentences.append("Runs lost: " + ", ".join(f"{e} {n} of {result.run_count}" for e, n in counts.items()) + ".")
    return Headline(metric, window, winner, [s for s in sentences if s], gains[runner_up])


def main_measure(result: Result) -> tuple[str, str]:
    """Metric and window of the first claim that was scored; else 3-D position (or attitude), in outages if there are any."""
    scored = set(zip(result.summary["metric"], result.summary["window"], strict=True))
    for claim in result.scenario.get("claims", []):
        if (key := (str(claim.get("metric")), str(claim.get("window", "all")))) in scored:
            return key
    usable = result.summary.dropna(subset=["mean"])
    for metric in PREFERRED:
        for window in ("outages", "all"):
            if len(usable[(usable["metric"] == metric) & (usable["window"] == window)]):
                return metric, window
    return PREFERRED[0], "all"


def _improvement(result: Result, runs: pd.DataFrame, better: str, than: str) -> Improvement:
    if not {better, than} <= set(runs.columns):
        return NONE
    seed = int(result.scenario.get("monte_carlo", {}).get("seed", 0))
    return improvement(runs[better].to_numpy(dtype=float), runs[than].to_numpy(dtype=float), seed) or NONE


def _listed(names: list[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _difference(gain: Improvement) -> str:
    if not math.isfinite(gain.percent):
        return "not comparable (no paired runs)"
    return f"{percent(abs(gain.percent))} % {'lower' if gain.percent >= 0 else 'higher'} ({_sureness(gain)})"


def _sureness(gain: Improvement) -> str:
    runs = f"{gain.n} paired run{'s' if gain.n != 1 else ''}"
    if not math.isfinite(gain.low):
        return f"{runs}, too few for an interval"
    p = (
        ""
        if not math.isfinite(gain.p_value)
        else ", p < 0.001"
        if gain.p_value < 0.001
        else f", p = {number(gain.p_value, 2)}"
    )
    return f"95 % interval {percent(gain.low)} to {percent(gain.high)} %, {runs}{p}"
