"""Interactive plots of the satellites of run 0, as `testbed.report.charts` makes them: sky, and what there was over time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from testbed.report.results import thin
from testbed.report.satellites import EXCLUDED, epochs, step_of, system_of, with_gaps
from testbed.report.traces import INK, Figure, Phases, Spans, panel_axis, stacked_panels, trace_line

POINTS = 300
"""Per satellite, of which there may be thirty."""
GPS, OTHER, WRONG = 0, 2, 1
"""Colours, as numbers of the palette."""


def _each(frame: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Each satellite's rows, thinned, with a gap wherever it was lost."""
    step = step_of(frame)
    for name, own in frame.groupby("satellite"):
        few = thin(own, POINTS)
        yield str(name), with_gaps(few, max(step, step * len(own) / len(few)))


def _level(frame: pd.DataFrame) -> tuple[Any, Any]:
    """East and north of a point of the sky, degrees from the zenith."""
    azimuth, away = np.radians(frame["azimuth_deg"]), 90.0 - frame["elevation_deg"]
    return away * np.sin(azimuth), away * np.cos(azimuth)


def sky(frame: pd.DataFrame) -> Figure:
    """Tracks around the zenith, north up and east to the right; circles at 0, 30 and 60 degrees of elevation."""
    traces = []
    around = np.linspace(0.0, 2.0 * np.pi, 121)
    for elevation in (0, 30, 60):
        circle = (90.0 - elevation) * np.sin(around), (90.0 - elevation) * np.cos(around)
        look: Figure = {"line": {"width": 1, "dash": "dot"}, "hoverinfo": "skip"}
        traces.append(trace_line(*circle, f"{elevation}°", {"colour": "outage"}, **look))
    seen = set[str]()
    for name, own in _each(frame):
        system = system_of(name)
        meta = {"colour": GPS if system == "GPS" else OTHER, "shown": system not in seen}
        seen.add(system)
        told = np.column_stack([own["azimuth_deg"], own["elevation_deg"], own["cn0_dbhz"], own["time_s"]]).round(1)
        numbers = [[value if np.isfinite(value) else None for value in row] for row in told.tolist()]
        hover = (
            f"{name}<br>azimuth %{{customdata[0]}}°, elevation %{{customdata[1]}}°<br>%{{customdata[2]}} dB-Hz,"
            " %{customdata[3]} s<extra></extra>"
        )
        line: Figure = {"line": {"width": 2.2}, "customdata": numbers, "hovertemplate": hover}
        traces.append(trace_line(*_level(own), system, meta, **line))
        last = own.dropna(subset=["azimuth_deg"]).iloc[-1:]
        label: Figure = {"mode": "markers+text", "text": [name], "textposition": "top right", "marker": {"size": 6}}
        traces.append(trace_line(*_level(last), name, meta | {"shown": False}, hoverinfo="skip", **label))
    wrong = frame[frame["used"] == EXCLUDED]
    if len(wrong):
        crosses: Figure = {"mode": "markers", "marker": {"size": 7, "symbol": "x"}, "hoverinfo": "skip"}
        traces.append(trace_line(*_level(wrong), "excluded", {"colour": WRONG, "shown": True}, **crosses))
    square = {
        "range": [-105, 105],
        "showgrid": False,
        "zeroline": False,
        "showticklabels": False,
        "constrain": "domain",
    }
    layout: Figure = {"height": 520, "showlegend": True, "xaxis": dict(square), "yaxis": square | {"scaleanchor": "x"}}
    points = (("N", 0, 97), ("E", 97, 0), ("S", 0, -97), ("W", -97, 0))
    layout["annotations"] = [{"text": text, "x": x, "y": y, "showarrow": False} for text, x, y in points]
    return {"data": traces, "layout": layout}


def over_time(frame: pd.DataFrame, outages: Spans, phases: Phases) -> Figure:
    """How many, dilution, C/N0 and residuals of each; crosses are exclusions."""
    many, traces = thin(epochs(frame), 2 * POINTS), []
    counts = (
        ("received", "tracked", INK, 0),
        ("used", "used", GPS, 0),
        ("HDOP", "hdop", GPS, 1),
        ("VDOP", "vdop", OTHER, 1),
    )
    for name, column, colour, row in counts:
        look: Figure = {"line": {"width": 1.4, "shape": "hv" if row == 0 else "linear"}}
        traces.append(
            trace_line(many["time_s"], many[column], name, {"colour": colour, "shown": True}, panel_axis(row), **look)
        )
    for k, (name, own) in enumerate(_each(frame)):
        meta, hover = (
            {"colour": k, "shown": False},
            {"hovertemplate": f"{name}: %{{y}}<extra></extra>", "line": {"width": 1.1}},
        )
        traces.append(trace_line(own["time_s"], own["cn0_dbhz"], name, meta, panel_axis(2), **hover))
        fitted = own["residual_m"].where(own["used"] != EXCLUDED)
        traces.append(trace_line(own["time_s"], fitted, name, meta, panel_axis(3), **hover))
    wrong = frame[frame["used"] == EXCLUDED]
    if len(wrong):
        crosses: Figure = {"mode": "markers", "marker": {"size": 7, "symbol": "x"}, "text": list(wrong["satellite"])}
        shown = {"colour": WRONG, "shown": True}
        hover = {"hovertemplate": "%{text} excluded: %{y} m<extra></extra>"}
        traces.append(
            trace_line(wrong["time_s"], wrong["residual_m"], "excluded", shown, panel_axis(3), **crosses, **hover)
        )
    worst = float(np.nanpercentile(many["vdop"], 98)) if many["vdop"].notna().any() else 1.0
    names = ["satellites", "dilution", "C/N0, dB-Hz", "residual, m"]
    layout = stacked_panels(names, outages, phases, [None, [0.0, 1.3 * worst], None, None], height=150)
    return {"data": traces, "layout": layout | {"showlegend": True}}
