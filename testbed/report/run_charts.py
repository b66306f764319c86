"""Interactive plots of the first run beside its errors: their distribution, NEES and biases over time, as `charts` makes others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from testbed.report import over_time
from testbed.report.results import Result, thin
from testbed.report.traces import (
    INK,
    Figure,
    Phases,
    Spans,
    dash_of,
    panel_axis,
    stacked_panels,
    tag,
    trace_band,
    trace_line,
)
from testbed.scoring.quantities import quantity_label, unit

POINTS = 500
SHOWN = ("position_2d_m", "position_3d_m", "velocity_3d_mps")


def charts(result: Result, colours: Mapping[str, int], first: str) -> dict[str, dict[str, Any]]:
    """Those that the result has data for; the estimator ``first`` comes before the others."""
    spans, phases = result.outages, result.phases
    found: dict[str, dict[str, Any]] = {}
    views = {quantity_label(q): chart for q in SHOWN if (chart := error_cdf(result.errors, q, colours)) is not None}
    if views:
        found["cdf"] = {"views": views}
    if result.nees:
        quantities = list(dict.fromkeys(q for table in result.nees.values() for q in table["quantity"]))
        found["nees"] = {"views": {"": nees(result.nees, quantities, colours, spans, phases)}}
    if result.biases:
        order = sorted(result.biases, key=lambda label: label != first)
        found["biases"] = {
            "views": {e: biases(result.biases[e], e, colours, spans, phases) for e in order if e in colours}
        }
    return found


def error_cdf(errors: Mapping[str, pd.DataFrame], quantity: str, colours: Mapping[str, int]) -> Figure | None:
    """Share of the time below an error, a line per estimator."""
    found = {label: over_time.sizes(frame, quantity) for label, frame in errors.items()}
    found = {label: values for label, values in found.items() if len(values)}
    if not found:
        return None
    traces = []
    shares = np.linspace(0.0, 1.0, POINTS)
    for label, values in found.items():
        half, most = (np.quantile(values, share) for share in over_time.SHARES)
        hover = (
            f"{label}: %{{y:.0%}} below %{{x:.3g}} {unit(quantity)} (half {half:.3g}, 95 % {most:.3g})<extra></extra>"
        )
        look: Figure = {"line": {"dash": dash_of(colours[label]), "width": 1.5}, "hovertemplate": hover}
        traces.append(trace_line(np.quantile(values, shares), shares, label, tag(label, colours), **look))
    scale = {"type": "log"} if over_time.spans_decades(found) else {"rangemode": "tozero"}
    x = {"title": {"text": f"{quantity_label(quantity)} error, {unit(quantity)}"}} | scale
    line = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "line": {"width": 1, "dash": "dot"}, "layer": "below"}
    layout: Figure = {"height": 380, "hovermode": "closest", "xaxis": x}
    layout["yaxis"] = {"title": {"text": "share of the time"}, "range": [0, 1]}
    layout["shapes"] = [line | {"y0": share, "y1": share, "name": "outage"} for share in over_time.SHARES]
    return {"data": traces, "layout": layout}


def nees(
    tables: Mapping[str, pd.DataFrame],
    quantities: list[str],
    colours: Mapping[str, int],
    outages: Spans,
    phases: Phases,
) -> Figure:
    """NEES divided by its degrees of freedom, logarithmic, with the 95 % bounds of one run."""
    traces = []
    for row, quantity in enumerate(quantities):
        axis, dof, last = panel_axis(row), 3.0, 0.0
        for label, table in tables.items():
            rows = thin(table[table["quantity"] == quantity], POINTS)
            if rows.empty or label not in colours:
                continue
            dof, last = float(rows["dof"].iloc[0]), max(last, float(rows["time_s"].iloc[-1]))
            look = {"line": {"dash": dash_of(colours[label]), "width": 1.2}}
            traces.append(trace_line(rows["time_s"], rows["value"] / dof, label, tag(label, colours), axis, **look))
        low, high = over_time.bounds(dof)
        ends = np.array([0.0, last])
        traces.append(trace_band(ends, np.full(2, low), np.full(2, high), "95 % bounds", {"colour": INK}, axis))
    layout = stacked_panels(quantities, outages, phases, [None] * len(quantities), height=140)
    for row, quantity in enumerate(quantities):
        words = quantity_label(quantity).replace("NEES ", "NEES/n, ")
        layout["yaxis" + panel_axis(row)["yaxis"][1:]] |= {"type": "log", "title": {"text": words, "standoff": 4}}
    return {"data": traces, "layout": layout}


def biases(frame: pd.DataFrame, label: str, colours: Mapping[str, int], outages: Spans, phases: Phases) -> Figure:
    """Estimated biases with three sigma, and the true ones in ink."""
    frame = thin(frame, POINTS)
    names = over_time.bias_names(frame)
    traces, ranges = [], []
    for row, name in enumerate(names):
        _, factor = over_time.bias_label(name)
        axis, value = panel_axis(row), factor * frame[name].to_numpy()
        spread = 3.0 * factor * frame[f"sigma_{name}"].to_numpy() if f"sigma_{name}" in frame else 0.0 * value
        meta: dict[str, Any] = {"colour": colours[label]}
        traces.append(trace_band(frame["time_s"], value - spread, value + spread, "±3σ", meta, axis))
        traces.append(trace_line(frame["time_s"], value, "estimate", meta | {"shown": row == 0}, axis))
        if f"true_{name}" in frame:
            true = factor * frame[f"true_{name}"]
            traces.append(trace_line(frame["time_s"], true, "truth", {"colour": INK, "shown": row == 0}, axis))
        limits = over_time.bias_range(value, spread)
        ranges.append(list(limits) if limits else None)
    layout = stacked_panels(names, outages, phases, ranges, height=110)
    for row, name in enumerate(names):
        layout["yaxis" + panel_axis(row)["yaxis"][1:]] |= {
            "title": {"text": over_time.bias_label(name)[0], "standoff": 4}
        }
    return {"data": traces, "layout": layout | {"showlegend": True}}
