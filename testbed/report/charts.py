"""Interactive plots as plotly.js figures (plain dictionaries): functions on data frames, and `charts` that gathers them.

A trace carries ``meta``: ``estimator`` (what the page's switches hide), ``colour`` (index into `labels.COLOURS`, −1 for ink;
the page turns it into a colour for light or dark), ``band`` (drawn only for the estimator whose band is asked for).
Metres from the start, m/s, degrees, seconds. Traces are thinned; four significant figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from testbed.report import chosen_runs, geometry, normalised, run_charts, sky_charts
from testbed.report.headline import Headline
from testbed.report.labels import DASHES, component_label
from testbed.report.results import Result, thin
from testbed.report.traces import (
    INK,
    Figure,
    Phases,
    Spans,
    category_rows,
    dash_of,
    panel_axis,
    stacked_panels,
    tag,
    trace_band,
    trace_line,
    trace_space,
)
from testbed.scoring.quantities import GROUPS, MAIN, axis_title, metric_label, quantity_label

POINTS = 900  # per line


def ground_track(
    truth: pd.DataFrame,
    estimates: Mapping[str, pd.DataFrame],
    colours: Mapping[str, int],
    outages: Spans,
    fixes: pd.DataFrame,
) -> Figure:
    """North over east from the start, equal axes; fixes as dots, so that outliers stand apart."""
    truth = thin(truth, POINTS)
    east, north, _ = geometry.local(truth, truth)
    traces = []
    for k, (a, b) in enumerate(outages):
        inside = truth["time_s"].between(a, b).to_numpy()
        meta = {"colour": "outage", "shown": k == 0}
        look = {"width": 11}
        traces.append(trace_line(east[inside], north[inside], "no GNSS", meta, line=look, hoverinfo="skip"))
    if len(fixes):
        e, n, _ = geometry.local(thin(fixes, POINTS), truth)
        dots: Figure = {"mode": "markers", "marker": {"size": 3}, "opacity": 0.5, "hoverinfo": "skip"}
        traces.append(trace_line(e, n, "fixes", {"colour": "outage", "shown": True}, **dots))
    for label, frame in estimates.items():
        e, n, _ = geometry.local(thin(frame, POINTS), truth)
        traces.append(
            trace_line(e, n, label, tag(label, colours), line={"dash": dash_of(colours[label]), "width": 1.6})
        )
    where = np.column_stack([truth["lat_deg"], truth["lon_deg"], truth["alt_m"], truth["time_s"]]).round(6).tolist()
    hover = "%{customdata[0]:.5f}°, %{customdata[1]:.5f}°<br>%{customdata[2]:.0f} m, %{customdata[3]:.1f} s<extra>truth</extra>"
    traces.append(
        trace_line(east, north, "truth", {"colour": INK}, line={"width": 1.4}, customdata=where, hovertemplate=hover)
    )
    start = {"size": 9, "symbol": "circle"}
    traces.append(
        trace_line(east[:1], north[:1], "start", {"colour": INK}, mode="markers", marker=start, hoverinfo="skip")
    )
    (x0, x1), (y0, y1) = geometry.map_limits(east, north)
    layout = {"height": 520, "dragmode": "pan", "showlegend": True}
    layout |= {"xaxis": {"title": {"text": "East, m"}, "range": [x0, x1], "constrain": "domain"}}
    layout |= {"yaxis": {"title": {"text": "North, m"}, "range": [y0, y1], "scaleanchor": "x", "constrain": "domain"}}
    return {"data": traces, "layout": layout}


def path_3d(
    truth: pd.DataFrame, estimates: Mapping[str, pd.DataFrame], colours: Mapping[str, int], outages: Spans
) -> Figure:
    """The flight in space, to be turned by hand; height is stretched where the flight is flat."""
    truth = thin(truth, 500)
    east, north, up = geometry.local(truth, truth)
    (x0, x1), (y0, y1) = geometry.map_limits(east, north)
    z0, z1 = geometry.height_limits(up)
    traces = []
    for label, frame in estimates.items():
        e, n, u = geometry.local(thin(frame, 500), truth)
        e = np.where((e < x0) | (e > x1) | (n < y0) | (n > y1) | (u < z0) | (u > z1), np.nan, e)
        traces.append(trace_space(e, n, u, label, tag(label, colours), 3))
    for k, (a, b) in enumerate(outages):
        inside = truth["time_s"].between(a, b).to_numpy()
        meta = {"colour": "outage", "shown": k == 0}
        traces.append(trace_space(east[inside], north[inside], up[inside], "no GNSS", meta, 10))
    traces.append(trace_space(east, north, up, "truth", {"colour": INK}, 4))
    span = max(x1 - x0, y1 - y0)
    shape = {"x": (x1 - x0) / span, "y": (y1 - y0) / span, "z": max(0.3, (z1 - z0) / span)}
    scene = {
        "aspectmode": "manual",
        "aspectratio": shape,
        "camera": {"eye": {"x": -0.75, "y": -0.95, "z": 0.6}, "center": {"x": 0, "y": 0, "z": -0.12}},
    }
    scene |= {
        "xaxis": {"title": {"text": "East, m"}, "range": [x0, x1]},
        "yaxis": {"title": {"text": "North, m"}, "range": [y0, y1]},
    }
    scene |= {"zaxis": {"title": {"text": "Height, m"}, "range": [z0, z1]}}
    return {
        "data": traces,
        "layout": {"height": 520, "scene": scene, "showlegend": True, "margin": {"l": 0, "r": 0, "t": 10, "b": 0}},
    }


def error_traces(
    errors: Mapping[str, pd.DataFrame],
    quantities: Sequence[str],
    colours: Mapping[str, int],
    outages: Spans,
    phases: Phases,
) -> Figure:
    """Error over time, one panel per quantity, with every estimator's three-sigma band (the page shows one at a time)."""
    traces = []
    for label, frame in errors.items():
        lines, coarse = thin(frame, POINTS), thin(frame, 300)
        for row, quantity in enumerate(quantities):
            axis = panel_axis(row)
            if f"sigma_{quantity}" in frame and coarse[f"sigma_{quantity}"].notna().any():
                s = 3.0 * coarse[f"sigma_{quantity}"].to_numpy()
                traces.append(
                    trace_band(coarse["time_s"], -s, s, f"±3σ {label}", tag(label, colours, band=label), axis)
                )
            dash = {"dash": dash_of(colours[label]), "width": 1.3}
            traces.append(trace_line(lines["time_s"], lines[quantity], label, tag(label, colours), axis, line=dash))
    return {"data": traces, "layout": stacked_panels(quantities, outages, phases, _ranges(errors, quantities))}


def envelopes(
    table: pd.DataFrame, quantities: Sequence[str], colours: Mapping[str, int], outages: Spans, phases: Phases
) -> Figure:
    """Over the runs: 5 and 95 % of the errors and their mean; band: ±1.645 sigma, what the filter expects of those lines."""
    traces = []
    parts = dict(iter(table.groupby(["estimator", "quantity"], sort=False)))
    for label in dict.fromkeys(table["estimator"]):
        for row, quantity in enumerate(quantities):
            if (label, quantity) not in parts:
                continue
            group, axis = thin(parts[label, quantity], 300), panel_axis(row)
            t, meta = group["time_s"], tag(str(label), colours)
            if group["sigma"].notna().any():
                s = 1.645 * group["sigma"]
                traces.append(trace_band(t, -s, s, f"±1.645σ {label}", meta | {"band": label}, axis))
            for column, name, dash in (("p05", "5 %", "solid"), ("p95", "95 %", "solid"), ("mean", "mean", "dot")):
                traces.append(
                    trace_line(t, group[column], f"{label}, {name}", meta, axis, line={"width": 1.3, "dash": dash})
                )
    wide = {str(e): f.pivot(index="time_s", columns="quantity", values="rms") for e, f in table.groupby("estimator")}
    ranges = _ranges({e: frame.reindex(columns=list(quantities)) for e, frame in wide.items()}, quantities)
    return {"data": traces, "layout": stacked_panels(quantities, outages, phases, ranges)}


def spread(per_run: pd.DataFrame, metric: str, estimators: Sequence[str], colours: Mapping[str, int]) -> Figure:
    """Box plot over the runs (quartiles, median, whiskers at 5 and 95 %) with every run as a point."""
    traces, ticks = [], []
    shake = np.random.default_rng(0)
    everything = per_run.loc[per_run["metric"] == metric, "value"].dropna()
    for k, label in enumerate(estimators):
        chosen = per_run[(per_run["metric"] == metric) & (per_run["estimator"] == label)].dropna(subset=["value"])
        values = chosen["value"].to_numpy()
        ticks.append(label)
        if not len(values):
            continue
        y, meta = len(estimators) - 1 - k, tag(label, colours)
        p5, q1, median, q3, p95 = np.percentile(values, [5, 25, 50, 75, 95])
        hover = f"{label}<br>median {median:.3g}, quartiles {q1:.3g} to {q3:.3g}<br>5 to 95 %: {p5:.3g} to {p95:.3g}<extra></extra>"
        corners = ([q1, q3, q3, q1, q1], [y - 0.3, y - 0.3, y + 0.3, y + 0.3, y - 0.3])
        box: Figure = {"fill": "toself", "hovertemplate": hover, "line": {"width": 1.3}}
        traces.append(trace_line(*corners, label, meta | {"fill": 0.28}, **box))
        traces.append(trace_line([median] * 2, [y - 0.3, y + 0.3], label, meta, line={"width": 3}, hovertemplate=hover))
        for end, edge in ((p5, q1), (p95, q3)):
            traces.append(trace_line([edge, end], [y, y], label, meta, line={"width": 1.3}, hoverinfo="skip"))
        shown = chosen.head(400)
        height = y + shake.uniform(-0.18, 0.18, len(shown))
        dots: Figure = {"mode": "markers", "marker": {"size": 4, "opacity": 0.55}, "customdata": shown["run"].tolist()}
        traces.append(
            trace_line(
                shown["value"], height, label, meta, hovertemplate="run %{customdata}: %{x:.4g}<extra></extra>", **dots
            )
        )
    logarithmic = len(everything) > 0 and everything.min() > 0 and everything.max() > 30 * everything.min()
    x = {"title": {"text": axis_title(metric)}, "type": "log" if logarithmic else "linear"}
    return {"data": traces, "layout": category_rows(ticks, x)}


def consistency(table: pd.DataFrame, estimators: Sequence[str], colours: Mapping[str, int]) -> Figure:
    """Mean NEES and NIS divided by the expected value, over the 95 % chi-square bounds."""
    quantities = list(dict.fromkeys(table["quantity"]))
    traces: list[Figure] = []
    step = 0.7 / max(1, len(estimators))
    for row, quantity in enumerate(quantities):
        group = table[table["quantity"] == quantity].set_index("estimator")
        y, dof = len(quantities) - 1 - row, float(group["dof"].iloc[0])
        low, high = group["lower"].iloc[0] / dof, group["upper"].iloc[0] / dof
        corners = ([low, high, high, low, low], [y - 0.42, y - 0.42, y + 0.42, y + 0.42, y - 0.42])
        traces.append(
            trace_line(
                *corners, "95 % bounds", {"colour": "outage"}, fill="toself", line={"width": 0}, hoverinfo="skip"
            )
        )
        for k, label in enumerate(estimators):
            if label not in group.index:
                continue
            value = float(group.loc[label, "mean"])
            height = y - (k - (len(estimators) - 1) / 2) * step
            hover = f"{label}: {quantity_label(quantity)} {value:.3g}, expected {dof:.3g}<extra></extra>"
            point: Figure = {"mode": "markers", "marker": {"size": 9, "symbol": k % 8}, "hovertemplate": hover}
            traces.append(trace_line([value / dof], [height], label, tag(label, colours), **point))
    x = {"title": {"text": "mean divided by its expected value (1 = consistent)"}, "type": "log"}
    layout = category_rows([quantity_label(q) for q in quantities], x, 46 + 9 * len(estimators))
    line = {"type": "line", "x0": 1, "x1": 1, "y0": 0, "y1": 1, "yref": "paper", "line": {"width": 1}}
    return {"data": traces, "layout": layout | {"shapes": [line]}}


def timings(table: pd.DataFrame, estimators: Sequence[str], colours: Mapping[str, int]) -> Figure:
    """Time per IMU sample, one bar each."""
    traces = []
    rows = table.set_index("estimator")["median_us"].dropna()
    logarithmic = len(rows) > 0 and rows.max() > 30 * rows.min() > 0
    start = 0.5 * rows.min() if logarithmic else 0.0
    for k, label in enumerate(estimators):
        if label in rows.index:
            y, value = len(estimators) - 1 - k, float(rows[label])
            hover = f"{label}: {value:.3g} µs per sample<extra></extra>"
            bar: Figure = {"line": {"width": 12}, "hovertemplate": hover}
            traces.append(trace_line([start, value], [y, y], label, tag(label, colours), **bar))
    x: Figure = {"title": {"text": "time per IMU sample, µs"}, "type": "log" if logarithmic else "linear"}
    return {"data": traces, "layout": category_rows(list(estimators), x, 34)}


def innovations(
    frame: pd.DataFrame, label: str, colours: Mapping[str, int], names: Sequence[str], spans: Spans, phases: Phases
) -> Figure:
    """Innovations with their ±2 sqrt(S) band over time, and their histogram, one row per measurement channel.

    Crosses are updates that the filter's policy rejected.
    """
    channels = [str(c).removeprefix("nu_") for c in frame if str(c).startswith("nu_")][:9]
    frame = _open_gaps(thin(frame, 700))
    traces = []
    for row, channel in enumerate(channels):
        nu, s, meta = frame[f"nu_{channel}"].to_numpy(), frame[f"s_{channel}"].to_numpy(), {"colour": colours[label]}
        axis = panel_axis(row)
        traces.append(trace_band(frame["time_s"], -2 * s, 2 * s, "±2√S", meta, axis))
        dots: Figure = {"mode": "markers", "marker": {"size": 3}}
        refused = (
            frame["rejected"].to_numpy(dtype=float) > 0.5 if "rejected" in frame else np.zeros(len(nu), dtype=bool)
        )
        traces.append(trace_line(frame["time_s"], np.where(refused, np.nan, nu), names[row], meta, axis, **dots))
        if refused.any():
            crosses: Figure = {"mode": "markers", "marker": {"size": 6, "symbol": "x"}}
            traces.append(trace_line(frame["time_s"][refused], nu[refused], "rejected", meta, axis, **crosses))
        if np.isfinite(nu).any():
            counts, edges = np.histogram(nu[np.isfinite(nu)], bins=25)
            side = {"xaxis": f"x{20 + row}", "yaxis": axis["yaxis"]}
            steps: Figure = {"fill": "tozerox", "line": {"shape": "vh", "width": 1}, "hoverinfo": "skip"}
            traces.append(
                trace_line(counts, (edges[1:] + edges[:-1]) / 2, "histogram", meta | {"fill": 0.28}, side, **steps)
            )
    layout = stacked_panels(list(names[: len(channels)]), spans, phases, [None] * len(channels), height=105)
    layout["xaxis"] |= {"domain": [0, 0.82], "range": [float(frame["time_s"].min()), float(frame["time_s"].max())]}
    for row in range(len(channels)):
        layout[f"xaxis{20 + row}"] = {
            "domain": [0.85, 1],
            "anchor": panel_axis(row)["yaxis"],
            "showticklabels": False,
            "showgrid": False,
        }
    return {"data": traces, "layout": layout}


def extras(frame: pd.DataFrame, outages: Spans, phases: Phases, components: Mapping[str, Sequence[str]]) -> Figure:
    """What an estimator reports beside its state, one panel per name, one line per component (named where names are given)."""
    names = list(dict.fromkeys(frame["name"]))[:6]
    traces, shown = [], set[str]()
    for row, name in enumerate(names):
        for k, (component, group) in enumerate(frame[frame["name"] == name].groupby("component", sort=False)):
            group, label = thin(group, POINTS), component_label(component, k, components.get(name, ()))
            look = {"dash": DASHES[k % len(DASHES)], "width": 1.5}
            alone = (frame.loc[frame["name"] == name, "component"] == component).all()
            meta = {"colour": k, "shown": label not in shown and not alone}
            shown.add(label)
            traces.append(trace_line(group["time_s"], group["value"], label, meta, panel_axis(row), line=look))
    layout = stacked_panels([n.replace("_", " ") for n in names], outages, phases, [None] * len(names), height=210)
    return {"data": traces, "layout": layout | {"showlegend": True}}


def charts(result: Result, lead: Headline) -> dict[str, dict[str, Any]]:
    """Every chart that the result has data for: key -> {``views``: name -> figure, ``band``: whose band is shown first}."""
    colours = {label: k for k, label in enumerate(result.estimators)}
    runs = {label: result.errors[label] for label in result.estimators if label in result.errors}
    spans, phases = result.outages, result.phases
    found: dict[str, dict[str, Any]] = {}
    if len(result.truth) and runs:
        found["track"] = {"views": {"": ground_track(result.truth, runs, colours, spans, result.gnss)}}
        found["path"] = {"views": {"": path_3d(result.truth, runs, colours, spans)}}
    groups = {g: q for g, q in GROUPS.items() if any(f[q].notna().any(axis=None) for f in runs.values())}
    if groups:
        views = {g: error_traces(runs, q, colours, spans, phases) for g, q in groups.items()}
        found["errors"] = {"views": views, "band": lead.winner, "bands": list(runs)}
    metrics = [lead.metric, *(m for q in MAIN if (m := f"rmse_{q}") != lead.metric)]
    per_run = result.per_run(metrics, lead.window).dropna(subset=["value"])
    if len(per_run):
        shown = [m for m in metrics if (per_run["metric"] == m).any()]
        views = {metric_label(m): spread(per_run, m, result.estimators, colours) for m in shown}
        found["spread"] = {"views": views}
    table = result.envelopes.dropna(subset=["rms"])
    if len(table):
        views = {
            g: envelopes(table, q, colours, spans, phases) for g, q in GROUPS.items() if table["quantity"].isin(q).any()
        }
        found["envelopes"] = {"views": views, "band": lead.winner, "bands": list(dict.fromkeys(table["estimator"]))}
    if len(table := result.consistency.dropna(subset=["mean"])):
        found["consistency"] = {"views": {"": consistency(table, result.estimators, colours)}}
    if result.innovations:
        order = sorted(result.innovations, key=lambda label: label != lead.winner)
        views = {
            e if aiding == "gnss" else f"{e}, {aiding}": innovations(
                f, e, colours, result.channels(e, aiding), spans, phases
            )
            for e in order
            for aiding, f in result.innovations[e].items()
            if len(f) and e in colours
        }
        found["innovations"] = {"views": views}
        tests = {
            e: normalised.chart(e, result.innovations[e], colours[e], spans, phases) for e in order if e in colours
        }
        if tests := {e: drawn for e, drawn in tests.items() if drawn is not None}:
            found["normalised"] = {"views": tests}
    found |= run_charts.charts(result, colours, lead.winner)
    if views := _single_runs(result, lead, colours):
        found["runs"] = {"views": views, "band": lead.winner, "bands": list(runs)}
    if len(result.satellites):
        found["sky"] = {"views": {"": sky_charts.sky(result.satellites)}}
        found["satellites"] = {"views": {"": sky_charts.over_time(result.satellites, spans, phases)}}
    if result.extras:
        found["extras"] = {
            "views": {e: extras(f, spans, phases, result.components(e)) for e, f in result.extras.items()}
        }
    if len(result.timings):
        found["timings"] = {"views": {"": timings(result.timings, result.estimators, colours)}}
    return found


def _single_runs(result: Result, lead: Headline, colours: Mapping[str, int]) -> dict[str, Figure]:
    """Errors of other runs than the first, in the first group of quantities that anybody has."""
    found: dict[str, Figure] = {}
    same = not result.flights_vary and "random_outages" not in result.scenario.get("sensors", {}).get("gnss", {})
    spans, phases = (result.outages, result.phases) if same else ((), ())
    for name, frames in chosen_runs.views(result, lead).items():
        columns = set().union(*frames.values())
        quantities = next((group for group in GROUPS.values() if set(group) & columns), None)
        if quantities is not None:
            full = {label: f.reindex(columns=list(dict.fromkeys([*f, *quantities]))) for label, f in frames.items()}
            found[name] = error_traces(full, quantities, colours, spans, phases)
    return found


def _open_gaps(frame: pd.DataFrame) -> pd.DataFrame:
    """An empty row in every gap of more than five sample intervals, so that bands do not run across."""
    t = frame["time_s"].to_numpy()
    if len(t) < 3:
        return frame
    gaps = np.flatnonzero(np.diff(t) > 5 * np.median(np.diff(t)))
    empty = pd.DataFrame({"time_s": t[gaps] + 1e-3}).reindex(columns=frame.columns)
    return pd.concat([frame, empty]).sort_values("time_s") if len(gaps) else frame


def _ranges(errors: Mapping[str, pd.DataFrame], quantities: Sequence[str]) -> list[list[float] | None]:
    """A first view for each panel as `geometry.first_view` says; None: fit all."""
    found: list[list[float] | None] = []
    for quantity in quantities:
        sizes = [float(np.nanmax(np.abs(f[quantity]))) for f in errors.values() if f[quantity].notna().any()]
        limit = geometry.first_view(sizes)
        found.append(None if limit is None else [-limit, limit])
    return found
