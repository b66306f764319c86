"""The sentence at the top of a report: which method won, by how much, and how sure that is.

Paired over the seeds: every estimator saw the same recordings. Interval: percentile bootstrap of the ratio of means over
runs (Efron 1979); test: Wilcoxon signed-rank on the paired differences. Percent; metric's own unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd

from testbed.report.labels import metric_label, number, percent, unit, window_label
from testbed.report.results import Result

PREFERRED = ("rmse_position_3d_m", "rmse_attitude_deg", "rmse_roll_deg", "rmse_velocity_3d_mps")


@dataclass(frozen=True)
class Headline:
    """``sentences`` in plain words; the rest for those who want the figures."""

    metric: str
    window: str
    winner: str
    sentences: list[str]
    improvement_pct: float = math.nan
    ci_low: float = math.nan
    ci_high: float = math.nan


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
    first = f"{winner} has the lowest {words[0].lower() + words[1:] if not words[0].isdigit() else words} {where}: {value}"
    if len(order) == 1:
        return Headline(metric, window, winner, [f"{winner}: {words} {where} {value}."])
    runs = result.per_run([metric], window).pivot_table(index="run", columns="estimator", values="value")
    runner_up, baseline = order[1], result.estimators[0]
    gain, low, high, n = _improvement(result, runs, winner, runner_up, metric, window)
    sentences = [_versus(first, f"{runner_up}, the next best", gain, low, high, n)]
    if baseline not in (winner, runner_up):
        gain_b, low_b, high_b, n_b = _improvement(result, runs, winner, baseline, metric, window)
        sentences.append(f"Against {baseline}, the first listed, {_difference(gain_b, low_b, high_b, n_b)}.")
    bad = result.runs[result.runs["status"] != "ok"]
    if len(bad):
        counts = bad.groupby("estimator", sort=False).size()
        sentences.append("Runs lost: " + ", ".join(f"{e} {n} of {result.run_count}" for e, n in counts.items()) + ".")
    return Headline(metric, window, winner, sentences, gain, low, high)


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


def _improvement(
    result: Result, runs: pd.DataFrame, better: str, than: str, metric: str, window: str
) -> tuple[float, float, float, int]:
    """Percent, its 95 % interval, and the number of paired runs. From ``improvements.csv`` where it has the pair."""
    n = len(runs[[better, than]].dropna()) if {better, than} <= set(runs.columns) else 0
    table = result.improvements
    if len(table):
        same = (table["metric"] == metric) & (table["window"] == window)
        hit = table[same & (table["estimator"] == better) & (table["baseline"] == than)]
        if len(hit):
            row = hit.iloc[0]
            return float(row["improvement_pct"]), float(row["ci_low"]), float(row["ci_high"]), n
    if n < 1:
        return math.nan, math.nan, math.nan, 0
    pairs = runs[[better, than]].dropna().to_numpy()
    gain = 100.0 * (1.0 - pairs[:, 0].mean() / pairs[:, 1].mean())
    if n < 3:
        return gain, math.nan, math.nan, n
    picks = np.random.default_rng(0).integers(0, n, size=(4000, n))
    a, b = pairs[picks, 0].mean(axis=1), pairs[picks, 1].mean(axis=1)
    low, high = np.percentile(100.0 * (1.0 - a / b), [2.5, 97.5])
    return gain, float(low), float(high), n


def _versus(first: str, rival: str, gain: float, low: float, high: float, n: int) -> str:
    if math.isfinite(low) and low <= 0.0:
        return f"{first}. The lead over {rival}, is not significant: {_difference(gain, low, high, n)}."
    return f"{first}, {_difference(gain, low, high, n)} against {rival}."


def _difference(gain: float, low: float, high: float, n: int) -> str:
    if not math.isfinite(gain):
        return "not comparable (no paired runs)"
    size = f"{percent(abs(gain))} % {'lower' if gain >= 0 else 'higher'}"
    if not math.isfinite(low):
        return f"{size} in {n} paired run{'s' if n != 1 else ''}, too few for an interval"
    return f"{size} (95 % interval {percent(low)} to {percent(high)} %, {n} paired runs)"
