"""Is an update what its filter expects? The largest normalised innovation of each update over time, with a threshold and the gaps.

Of the m channels of an update the largest |nu| / sqrt(S_ii). Normal variables of whatever correlation stay below c all together
with at least the probability of independent ones (Sidak 1967, J. Am. Stat. Assoc. 62), so that an honest filter passes
c = Phi^-1((1 + P^(1/m)) / 2) in at most the share 1 - P of its updates. Dimensionless; times in s.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtri

from testbed.report.labels import percent
from testbed.report.results import Result, thin
from testbed.report.traces import (
    INK,
    Figure,
    Phases,
    Spans,
    panel_axis,
    stacked_panels,
    trace_line,
)

POINTS = 900
PASSED = 0.999
"""Share of honest updates below the threshold: of a few hundred fixes of a flight none or one lies above it."""
GAP = 5.0
"""Times the usual interval between updates: a longer one is a gap."""


def threshold(channels: int, passed: float = PASSED) -> float:
    """Size in sigmas below which the largest of ``channels`` innovations lies with at least the probability ``passed``."""
    return float(ndtri(0.5 * (1.0 + passed ** (1.0 / channels))))


def largest(frame: pd.DataFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Of each update with a number: time (n,), largest normalised innovation (n,), whether it was rejected (n,); and the number
    of channels (columns ``time_s``, ``nu_k``, ``s_k``, ``rejected``)."""
    names = [str(c).removeprefix("nu_") for c in frame if str(c).startswith("nu_")]
    with np.errstate(divide="ignore", invalid="ignore"):
        sizes = np.abs(np.column_stack([frame[f"nu_{k}"] / frame[f"s_{k}"] for k in names]).astype(float))
    sizes[~np.isfinite(sizes)] = np.nan
    known = np.isfinite(sizes).any(axis=1)
    refused = frame["rejected"].to_numpy(dtype=bool) if "rejected" in frame else np.zeros(len(frame), dtype=bool)
    return frame["time_s"].to_numpy(dtype=float)[known], np.nanmax(sizes[known], axis=1), refused[known], len(names)


def gaps(t: np.ndarray) -> list[tuple[float, float]]:
    """Stretches without an update: longer than `GAP` usual intervals."""
    step = np.diff(t)
    if not len(step):
        return []
    longer = np.flatnonzero(step > GAP * np.median(step))
    return [(float(t[k]), float(t[k + 1])) for k in longer]


def chart(label: str, tables: Mapping[str, pd.DataFrame], colour: int, outages: Spans, phases: Phases) -> Figure | None:
    """A panel per aiding of a filter: the statistic of each update, its threshold, gaps as bars at the bottom."""
    rows: list[str] = []
    traces: list[Figure] = []
    for aiding, frame in tables.items():
        t, size, refused, channels = largest(frame)
        if not len(t):
            continue
        axis, limit, meta = panel_axis(len(rows)), threshold(channels), {"colour": colour}
        floor = 0.1 * limit
        taken = thin(pd.DataFrame({"t": t[~refused], "size": np.maximum(size[~refused], floor)}), POINTS)
        dots: Figure = {"mode": "markers", "marker": {"size": 4}}
        traces.append(trace_line(taken["t"], taken["size"], "taken", meta | {"shown": not rows}, axis, **dots))
        if refused.any():  # each of them: a fault of three samples must not be thinned away
            crosses: Figure = {"mode": "markers", "marker": {"size": 7, "symbol": "x"}}
            traces.append(trace_line(t[refused], size[refused], "rejected", meta | {"shown": True}, axis, **crosses))
        ends = np.array([t[0], t[-1]])
        dash: dict[str, Any] = {"line": {"dash": "dash", "width": 1.2}}
        words = f"threshold {limit:.2f}"
        traces.append(trace_line(ends, np.full(2, limit), words, {"colour": INK}, axis, **dash))
        for k, (a, b) in enumerate(gaps(t)):
            bar: Figure = {"line": {"width": 7}, "hovertemplate": f"no update, {a:.1f} to {b:.1f} s<extra></extra>"}
            shown_once = {"colour": "outage", "shown": k == 0 and not rows}
            traces.append(trace_line(np.array([a, b]), np.full(2, floor), "no update", shown_once, axis, **bar))
        rows.append(f"{aiding}, largest |ν| / √S")
    if not rows:
        return None
    layout = stacked_panels(rows, outages, phases, [None] * len(rows), height=190)
    for k, row in enumerate(rows):
        layout["yaxis" + panel_axis(k)["yaxis"][1:]] |= {"type": "log", "title": {"text": row, "standoff": 4}}
    return {"data": traces, "layout": layout | {"showlegend": True, "hovermode": "closest"}}


def told(result: Result) -> str:
    """A sentence for each filter: what part of its updates passes the threshold, and how long its gaps are."""
    parts = []
    for label, tables in result.innovations.items():
        for aiding, frame in tables.items():
            t, size, _, channels = largest(frame)
            if not len(t):
                continue
            over = percent(100.0 * float(np.mean(size > threshold(channels))))
            lost = sum(b - a for a, b in gaps(t))
            parts.append(f"{label}, {aiding}: {over} %" + (f", {lost:.1f} s without an update" if lost else ""))
    return "; ".join(parts)
