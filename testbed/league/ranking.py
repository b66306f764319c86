"""From the runs of the cells to places: means with intervals, pairwise tests, ranks with ties, and the mark of honesty.

The figure of a row is the geometric mean of its runs' errors: errors of runs scatter by factors, and a ratio of geometric means
is what the paired t test of the logarithms tests. A run that is lost counts with the error at which a run is lost (`limit_of`):
it is at least as wrong. A row of fewer runs is set off against the reference on the runs that both have (`_figure`): the first ten
draws are easier or harder than a hundred, for all rows alike. Pairs of one table are corrected for their number (Holm 1979). Places follow the order of the figures, and
a row shares the place of the one above it unless it is significantly worse than one of that place. NEES over its degrees of freedom:
Bar-Shalom, Li & Kirubarajan, 5.4; the mean over runs of the time averages, with a 99 % t interval. Of a few runs that scatter this
interval reaches from nothing to anything, so the mean is also held against what chance makes of right sigmas at the very most
(`chance`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from scipy.special import chdtri, stdtrit

from testbed.data.records import Array
from testbed.league.suite import REFERENCE, Track
from testbed.scoring.statistics import LEVEL, difference_p, holm

SMALLEST = 1e-6
"""An error below a micrometre, or a millionth of a degree, is none that a bench can tell from zero."""
SAME = 1e-9
"""Logarithms closer than rounding are equal: copies of one method differ by less, methods by more."""
HALF_TURN_DEG = 180.0
HONEST = (0.7, 1.4)
"""NEES over its degrees of freedom of a filter on raw units: sigmas that are right within 18 %."""
NEES_LEVEL = 0.99

OVER, UNDER, SILENT, LOST, FAIR = "over-confident", "over-cautious", "no sigmas", "no run finished", ""


@dataclass
class Standing:
    """A row of one track's table. ``error`` with its interval ``low`` to ``high`` in the unit of the track's metric."""

    entry: str
    runs: int
    error: float
    low: float | None
    high: float | None
    lost: int
    mark: str
    nees: dict[str, float]
    rank: int = 0
    tied: list[str] = field(default_factory=list)
    """Rows that no test tells from it."""
    reason: str = ""
    """Of the first run that it lost."""
    wins: bool = False


def limit_of(track: Track) -> float:
    """The error with which a lost run counts: half a turn, or where a position counts as lost."""
    return HALF_TURN_DEG if track.table.filters == "attitude" else track.scenario.monte_carlo.divergence_position_m


def table(track: Track, rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Standing]:
    """The standings of a track, best first. ``rows``: of each entry its runs, as cells hold them."""
    limit = limit_of(track)
    logs = {name: _logarithms(runs, limit) for name, runs in rows.items()}
    reference = logs.get(REFERENCE[track.table.filters])
    standings = {name: _standing(name, rows[name], _figure(logs[name], reference, math.log(limit))) for name in rows}
    worse = _significant(logs)
    for a, b in combinations(rows, 2):
        if (a, b) not in worse and (b, a) not in worse:
            standings[a].tied.append(b)
            standings[b].tied.append(a)
    ordered = sorted(standings.values(), key=lambda s: (s.error, s.entry))
    place: list[Standing] = []
    for number, standing in enumerate(ordered, 1):
        if not place or any((standing.entry, other.entry) in worse for other in place):
            place = []
        place.append(standing)
        standing.rank = number if len(place) == 1 else place[0].rank
    honest = [s.rank for s in ordered if s.mark == FAIR]
    for standing in ordered:
        standing.wins = standing.mark == FAIR and standing.rank == min(honest)
    return ordered


def _significant(logs: Mapping[str, Array]) -> set[tuple[str, str]]:
    """Pairs (a, b) of rows of which a is significantly worse than b."""
    pairs = list(combinations(logs, 2))
    p_values = np.array([_p_value(logs[a], logs[b]) for a, b in pairs])
    certain = [pair for pair, p in zip(pairs, holm(p_values).tolist(), strict=True) if p < 1.0 - LEVEL]
    return {(a, b) if _common_mean(logs[a], logs[b]) > 0.0 else (b, a) for a, b in certain}


def _logarithms(runs: Sequence[Mapping[str, Any]], limit: float) -> Array:
    """(n,) logarithms of the errors of the runs."""
    errors = [limit if run["error"] is None else min(max(run["error"], SMALLEST), limit) for run in runs]
    return np.log(np.array(errors))


def _standing(name: str, runs: Sequence[Mapping[str, Any]], figure: tuple[float, float, float]) -> Standing:
    nees, mark = honesty(runs)
    lost = [run for run in runs if run["error"] is None]
    mean, *ends = figure
    low, high = (None if math.isnan(end) else math.exp(end) for end in ends)
    reason = lost[0]["reason"] if lost else ""
    return Standing(name, len(runs), math.exp(mean), low, high, len(lost), mark, nees, reason=reason)


def _figure(logs: Array, reference: Array | None, limit: float) -> tuple[float, float, float]:
    """Mean logarithm of a row's errors with its interval, NaN where nothing varied that it depends on.

    Of a row of fewer runs than the reference: the reference's mean plus the mean difference on common runs, at most ``limit``; the
    halves of the two intervals add as independent.
    """
    mean = float(logs.mean())
    if np.ptp(logs) < SAME:
        return mean, math.nan, math.nan
    if reference is None or len(reference) <= len(logs):
        return mean, *_interval(logs, LEVEL)
    difference = logs - reference[: len(logs)]
    half = math.hypot(_half(difference, LEVEL), _half(reference, LEVEL))
    mean = min(float(reference.mean() + difference.mean()), limit)
    return mean, mean - half, mean + half


def honesty(runs: Sequence[Mapping[str, Any]]) -> tuple[dict[str, float], str]:
    """Mean normalised NEES of each group, and the mark: one that lies outside of `HONEST` with its interval, or beyond chance."""
    told = [run["nees"] for run in runs if run.get("nees")]
    means, over, under = {}, False, False
    for group in dict.fromkeys(group for nees in told for group in nees):
        values = np.array([nees[group] for nees in told if nees.get(group) is not None])
        if not len(values):
            over = True  # sigmas of zero, or none that is a number
            continue
        means[group] = float(values.mean())
        low, high = _interval(values, NEES_LEVEL)
        least, most = chance(len(values))
        over = over or low > HONEST[1] or means[group] > most * HONEST[1]
        under = under or high < HONEST[0] or means[group] < least * HONEST[0]
    if not told:
        return {}, SILENT if any(run["error"] is not None for run in runs) else LOST
    return means, OVER if over else UNDER if under else FAIR


def chance(runs: int) -> tuple[float, float]:
    """Between what the mean of so many runs lies, in 99 of 100 leagues, of a filter whose sigmas are right.

    Each run counts as one draw of one degree of freedom, as if its error never changed: chi-square over its degrees.
    """
    tail = 0.5 * (1.0 - NEES_LEVEL)
    return float(chdtri(runs, 1.0 - tail) / runs), float(chdtri(runs, tail) / runs)


def _interval(values: Array, level: float) -> tuple[float, float]:
    """Student's interval of the mean; NaN below two values."""
    half = _half(values, level)
    return float(values.mean() - half), float(values.mean() + half)


def _half(values: Array, level: float) -> float:
    """Half of Student's interval of the mean; NaN below two values."""
    n = len(values)
    return float(stdtrit(n - 1.0, 0.5 + 0.5 * level) * values.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan


def _p_value(a: Array, b: Array) -> float:
    """Two-sided, of equal geometric means, over the runs that both have; NaN below two."""
    n = min(len(a), len(b))
    difference = a[:n] - b[:n]
    if n < 2:
        return math.nan
    difference[np.abs(difference) < SAME] = 0.0
    return difference_p(difference, np.zeros(n), paired=True)


def _common_mean(a: Array, b: Array) -> float:
    """Mean logarithm of the ratio over the runs that both have."""
    n = min(len(a), len(b))
    return float((a[:n] - b[:n]).mean())


def overall(tracks: Mapping[str, Sequence[Standing]], entry: str) -> tuple[float, float]:
    """Of a row its mean place over tracks, and the geometric mean of its errors over the least of each track."""
    found = [
        (s.rank, math.log(s.error / standings[0].error))
        for standings in tracks.values()
        for s in standings
        if s.entry == entry
    ]
    places, ratios = np.array(found).T
    return float(places.mean()), float(np.exp(ratios.mean()))
