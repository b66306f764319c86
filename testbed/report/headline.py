"""The sentence at the top of a report: which method won, by how much, and how sure that is.

Paired over the seeds: every estimator saw the same recordings. Interval and p-value: `testbed.scoring.effects`.
Percent; the metric's own unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pandas as pd

from testbed.report.labels import number, percent, window_label
from testbed.report.results import Result
from testbed.scoring.effects import Effect, effect, runaways
from testbed.scoring.quantities import RANKED, metric_label, unit

NONE = Effect(math.nan, math.nan, math.nan, math.nan, 0)


@dataclass(frozen=True)
class Headline:
    """``sentences`` in plain words, and the winner's ``gain`` over the next best."""

    metric: str
    window: str
    winner: str
    sentences: list[str]
    gain: Effect = NONE


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
    measure = f"{_lower(metric_label(metric))} {_where(window)}"
    if len(order) == 1:
        return Headline(metric, window, winner, [f"{winner}: {measure} {value}.", *_losses(result)])
    runs = result.per_run([metric], window).pivot_table(index="run", columns="estimator", values="value")
    gains = {rival: _improvement(result, runs, winner, rival) for rival in order[1:]}
    sentences = _ranking(winner, f"the lowest {measure}: {value}", gains)
    sentences += _runaways(runs, {row for row in (winner, order[1], result.estimators[0]) if row in order})
    baseline = result.estimators[0]
    if baseline in gains and not any(baseline in sentence for sentence in sentences):
        sentences.append(f"Against {baseline}, the first listed, it is {_difference(gains[baseline])}.")
    return Headline(metric, window, winner, [*sentences, *_losses(result)], gains[order[1]])


def _ranking(winner: str, what: str, gains: dict[str, Effect]) -> list[str]:
    """How firmly the winner leads. ``gains`` are its leads, from the next best to the last."""
    first = f"{winner} has {what}"
    rival, lead = next(iter(gains.items()))
    if not any(gain.n for gain in gains.values()):
        return [f"{first}; next is {rival}."]
    if not any(math.isfinite(gain.low) for gain in gains.values()):
        return [f"{first}, {percent(lead.percent)} % below {rival}, the next best (one run: no interval)."]
    level = [rival for rival, gain in gains.items() if gain.low <= 0.0]
    clear = [rival for rival, gain in gains.items() if gain.low > 0.0]
    if not level:
        return [
            f"{first}, {percent(gains[clear[0]].percent)} % below {clear[0]}, the next best ({_sureness(gains[clear[0]])})."
        ]
    lead = gains[level[0]]
    doubt = f"lead of {winner} over {level[0]}: {percent(lead.percent)} %, {_sureness(lead)}"
    sentences = [f"{first}, but the runs do not tell it apart from {_listed(level)} ({doubt})."]
    if clear:
        gain = gains[clear[0]]
        sentences.append(f"{winner} is {percent(gain.percent)} % below {clear[0]}, the next ({_sureness(gain)}).")
    return sentences


def _runaways(runs: pd.DataFrame, labels: set[str]) -> list[str]:
    """The runs that lie far above all others of their method, and so carry its mean."""
    found = []
    for label in runs.columns.intersection(sorted(labels)):
        values = runs[label].to_numpy(dtype=float)
        far = runs.index[runaways(values)]
        if len(far):
            worst = float(np.nanmax(values) / np.nanmedian(values))
            found.append(
                f"run{'s' * (len(far) > 1)} {_listed([str(run) for run in far])} of {label} (up to {worst:.3g} times its median)"
            )
    return [f"Runaways that carry a mean: {'; '.join(found)}."] if found else []


def _losses(result: Result) -> list[str]:
    counts = result.runs.loc[result.runs["status"] != "ok"].groupby("estimator", sort=False).size()
    lost = ", ".join(f"{label} {n} of {result.run_count}" for label, n in counts.items())
    return [f"Runs lost: {lost}."] if lost else []


def _where(window: str) -> str:
    if window == "all":
        return "over the whole flight"
    return "during the GNSS outages" if window == "outages" else f"in the window “{window_label(window)}”"


def _lower(words: str) -> str:
    return words[0].lower() + words[1:] if words[1:2].islower() else words


def main_measure(result: Result) -> tuple[str, str]:
    """Metric and window of the first claim that was scored; else 3-D position (or attitude), in outages if there are any."""
    scored = set(zip(result.summary["metric"], result.summary["window"], strict=True))
    for claim in result.scenario.get("claims", []):
        if (key := (str(claim.get("metric")), str(claim.get("window", "all")))) in scored:
            return key
    usable = result.summary.dropna(subset=["mean"])
    for metric in RANKED:
        for window in ("outages", "all"):
            if len(usable[(usable["metric"] == metric) & (usable["window"] == window)]):
                return metric, window
    return RANKED[0], "all"


def _improvement(result: Result, runs: pd.DataFrame, better: str, than: str) -> Effect:
    if not {better, than} <= set(runs.columns):
        return NONE
    seed = int(result.scenario.get("monte_carlo", {}).get("seed", 0))
    return effect(runs[better].to_numpy(dtype=float), runs[than].to_numpy(dtype=float), seed) or NONE


def _listed(names: list[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _difference(gain: Effect) -> str:
    if not math.isfinite(gain.percent):
        return "not comparable (no paired runs)"
    return f"{percent(abs(gain.percent))} % {'lower' if gain.percent >= 0 else 'higher'} ({_sureness(gain)})"


def _sureness(gain: Effect) -> str:
    """Interval, runs and p-value."""
    runs = f"{gain.n} paired run{'s' if gain.n != 1 else ''}"
    low, high = percent(gain.low), percent(gain.high)
    if not math.isfinite(gain.low):
        return f"{runs}, too few for an interval"
    interval = f"95 % interval {low} to {high} %, " if low != high else ""
    return f"{interval}{runs}, p {'< 0.001' if gain.p_value < 0.001 else f'= {number(gain.p_value, 2)}'}"
