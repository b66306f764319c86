"""Parts of plotly.js figures: lines, bands, stacked time panels, categories, as plain dictionaries.

Traces carry the ``meta`` that `testbed.report.charts` explains. Each number is rounded to five significant figures of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from testbed.report.labels import DASHES
from testbed.scoring.quantities import axis_title

INK = -1
"""Colour of what is true or bounds, in place of an estimator's number."""
Figure = dict[str, Any]
Spans = Sequence[tuple[float, float]]
Phases = Sequence[tuple[str, float, float]]


def tag(label: str, colours: Mapping[str, int], band: str = "") -> dict[str, Any]:
    meta: dict[str, Any] = {"estimator": label, "colour": colours.get(label, 0)}
    return meta | {"band": band} if band else meta


def trace_line(
    x: Any, y: Any, name: str, meta: Mapping[str, Any], axis: Mapping[str, str] | None = None, **more: Any
) -> Figure:
    return {
        "type": "scatter",
        "mode": "lines",
        "x": rounded(x),
        "y": rounded(y),
        "name": name,
        "meta": meta,
        **(axis or {}),
        **more,
    }


def trace_space(x: Any, y: Any, z: Any, name: str, meta: Mapping[str, Any], width: float) -> Figure:
    return {"type": "scatter3d", "mode": "lines", "x": rounded(x), "y": rounded(y), "z": rounded(z)} | {
        "name": name,
        "meta": meta,
        "line": {"width": width},
        "hoverinfo": "x+y+z+name",
    }


def trace_band(t: Any, low: Any, high: Any, name: str, meta: Mapping[str, Any], axis: Mapping[str, str]) -> Figure:
    """A filled polygon between two lines, one per stretch without missing values."""
    t, low, high = (np.asarray(v, dtype=float) for v in (t, low, high))
    known = np.isfinite(low) & np.isfinite(high)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    x, y = [], []
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        x += [t[start:end], t[start:end][::-1], [np.nan]]
        y += [low[start:end], high[start:end][::-1], [np.nan]]
    outline = np.concatenate(x or [[]]), np.concatenate(y or [[]])
    return trace_line(
        *outline, name, {**meta, "fill": 0.16, "edge": True}, axis, fill="toself", hoverinfo="skip", line={"width": 0}
    )


def stacked_panels(
    names: Sequence[str], outages: Spans, phases: Phases, ranges: Sequence[Any], height: int = 170
) -> Figure:
    """Panels over one time axis; outages and phases are shaded behind them (the page colours the shapes)."""
    count, gap = len(names), 0.035
    tall = (1 + gap) / count
    layout: Figure = {"height": 75 + height * count, "hovermode": "x unified" if count < 4 else "closest"}
    layout["xaxis"] = {"title": {"text": "Time, s"}, "anchor": panel_axis(count - 1)["yaxis"]}
    for row, name in enumerate(names):
        top = 1 - row * tall
        y = {
            "domain": [max(0.0, top - tall + gap), top],
            "title": {"text": axis_title(name), "standoff": 4},
            "anchor": "x",
        }
        layout["yaxis" + panel_axis(row)["yaxis"][1:]] = y | ({"range": ranges[row]} if ranges[row] else {})
    whole = {"type": "rect", "yref": "paper", "y0": 0, "y1": 1, "layer": "below", "line": {"width": 0}}
    layout["shapes"] = [whole | {"x0": a, "x1": b, "name": "phase"} for _, a, b in list(phases)[1::2]]
    layout["shapes"] += [whole | {"x0": a, "x1": b, "name": "outage"} for a, b in outages]
    span = phases[-1][2] - phases[0][1] if phases else 1.0
    words = {"yref": "paper", "y": 1, "yanchor": "bottom", "showarrow": False}
    layout["annotations"] = [
        words | {"x": (a + b) / 2, "text": name.replace("_", " "), "hovertext": f"{name}, {a:g} to {b:g} s"}
        for name, a, b in phases
        if (b - a) / span > 0.012 * len(name)
    ]
    return layout


def category_rows(names: Sequence[str], x: Figure, row_height: int = 62) -> Figure:
    count = len(names)
    y = {
        "tickvals": list(range(count)),
        "ticktext": list(reversed(names)),
        "range": [-0.6, count - 0.4],
        "zeroline": False,
    }
    return {"height": 90 + row_height * count, "hovermode": "closest", "xaxis": x, "yaxis": y | {"automargin": True}}


def panel_axis(row: int) -> dict[str, str]:
    return {"xaxis": "x", "yaxis": f"y{row + 1}" if row else "y"}


def dash_of(index: int) -> str:
    """Each line has another one than its neighbours, so that the lower of two that run together shows in the gaps."""
    return DASHES[index % len(DASHES)]


def rounded(values: Any) -> list[float | None]:
    """Five significant figures of each number, and of the spread of all where they share a large offset; null for no number.

    Of each, since of the largest a small one on a logarithmic axis would come in steps.
    """
    x = np.asarray(values, dtype=float)
    finite = np.isfinite(x)
    spread = np.ptp(x[finite]) if finite.any() else 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        finest = 4.0 - np.floor(np.log10(np.minimum(np.abs(x), spread if spread > 0.0 else np.inf)))
    scale = 10.0 ** np.clip(np.where(np.isfinite(finest), finest, 0.0), 0.0, 12.0)
    out: list[float | None] = (np.round(np.where(finite, x, 0.0) * scale) / scale).tolist()
    for k in np.flatnonzero(~finite):
        out[k] = None
    return out
