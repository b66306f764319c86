"""Figures at paper size: plain functions on data frames that return matplotlib figures; `drawings` lists those of a result.

Shown: ground track, 3-D path, errors with three sigma, RMSE, Monte Carlo spread, envelopes, consistency, what a filter adds.
Metres from the start, m/s, degrees, seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from testbed.base.figure_style import COLOURS, DASHES, STYLE, new_figure
from testbed.base.files import write_with
from testbed.report import geometry, innovations, over_time, satellites
from testbed.report.headline import headline
from testbed.report.labels import component_label, short_name
from testbed.report.panels import Phases, Spans, legend, panels, shade
from testbed.report.results import Result, thin
from testbed.scoring.quantities import GROUPS, MAIN, axis_title, quantity_label, unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

POINTS = 700  # per line: about one per pixel of the printed width
MOST_EXTRAS = 3
FAR = 1e-2  # of the expected value: so far below it, a filter's covariance says nothing
MOST_LINES = 8  # colours that a reader can tell apart
DPI = 120
PLAIN = "{x:g}"  # tick labels: a power of ten as mathematics takes ten times as long to set


class Drawing(NamedTuple):
    """A figure that can be drawn, and its caption."""

    draw: Callable[[], Figure]
    caption: str


def ground_track(
    truth: pd.DataFrame,
    estimates: Mapping[str, pd.DataFrame],
    outages: Spans = (),
    fixes: pd.DataFrame | None = None,
) -> Figure:
    """North over east from the start, equal axes; the truth without GNSS drawn broad, fixes as dots (outliers stand apart)."""
    figure = new_figure(4.2)
    ax = figure.add_axes((0.11, 0.12, 0.86, 0.80))
    east, north, _ = geometry.local(truth, truth)
    for a, b in outages:
        inside = truth["time_s"].between(a, b).to_numpy()
        ax.plot(east[inside], north[inside], color="#bbbbbb", lw=7, solid_capstyle="butt", label="no GNSS", zorder=1)
    if fixes is not None and len(fixes):
        e, n, _ = geometry.local(fixes, truth)
        ax.plot(e, n, ".", color="#999999", ms=2, label="fixes", zorder=1)
    for k, (label, frame) in enumerate(estimates.items()):
        e, n, _ = geometry.local(frame, truth)
        ax.plot(e, n, color=COLOURS[k % len(COLOURS)][0], ls=DASHES[k % len(DASHES)], label=label)
    ax.plot(east, north, color="black", lw=0.8, label="truth")
    ax.plot(east[:1], north[:1], "o", color="black", ms=5, label="start")
    (x0, x1), (y0, y1) = geometry.map_limits(east, north)
    ax.set(xlabel="East, m", ylabel="North, m", xlim=(x0, x1), ylim=(y0, y1))
    ax.set_aspect("equal", adjustable="box")
    legend(figure, ax)
    return figure


def path_3d(truth: pd.DataFrame, estimates: Mapping[str, pd.DataFrame]) -> Figure:
    """The flight in space; height is stretched where the flight is flat, and the axis says so."""
    figure = new_figure(4.0)
    ax: Any = figure.add_axes((0.0, 0.03, 0.97, 0.92), projection="3d")
    east, north, up = geometry.local(truth, truth)
    (x0, x1), (y0, y1) = geometry.map_limits(east, north)
    z0, z1 = geometry.height_limits(up)
    for k, (label, frame) in enumerate(estimates.items()):
        e, n, u = geometry.local(frame, truth)
        u = np.where((u < z0) | (u > z1), np.nan, u)
        ax.plot(e, n, u, color=COLOURS[k % len(COLOURS)][0], ls=DASHES[k % len(DASHES)], label=label)
    ax.plot(east, north, up, color="black", lw=0.8, label="truth")
    ax.set(xlabel="East, m", ylabel="North, m", zlabel="Height, m", xlim=(x0, x1), ylim=(y0, y1), zlim=(z0, z1))
    span = max(x1 - x0, y1 - y0)
    ax.set_box_aspect(((x1 - x0) / span, (y1 - y0) / span, max(0.25, (z1 - z0) / span)), zoom=1.15)
    ax.locator_params(nbins=5)
    legend(figure, ax)
    return figure


def error_traces(
    errors: Mapping[str, pd.DataFrame],
    quantities: Sequence[str],
    outages: Spans = (),
    phases: Phases = (),
    band: str = "",
) -> Figure:
    """Error over time of one flight, one panel per quantity; the three-sigma band of the estimator named ``band``."""
    figure = new_figure(1.15 * len(quantities) + 0.8)
    axes = panels(figure, len(quantities))
    for k, (label, frame) in enumerate(errors.items()):
        for ax, quantity in zip(axes, quantities, strict=True):
            if frame[quantity].isna().all():  # an attitude filter says nothing of position
                continue
            t = frame["time_s"].to_numpy()
            if label == band and f"sigma_{quantity}" in frame:
                s = 3.0 * frame[f"sigma_{quantity}"].to_numpy()
                ax.fill_between(t, -s, s, color=COLOURS[k % len(COLOURS)][0], alpha=0.18, lw=0, label=f"±3σ of {label}")
            style: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)][0], "ls": DASHES[k % len(DASHES)], "lw": 0.8}
            ax.plot(t, frame[quantity].to_numpy(), label=label, **style)
    for ax, quantity in zip(axes, quantities, strict=True):
        ax.set_ylabel(axis_title(quantity))
        _frame(ax, {label: frame[quantity].to_numpy() for label, frame in errors.items()})
    shade(axes, outages, phases)
    legend(figure, axes[0])
    return figure


def rmse_bars(summary: pd.DataFrame, estimators: Sequence[str], window: str) -> Figure:
    """Mean RMSE per axis with its 95 % interval, one panel each for position, velocity and attitude."""
    figure = new_figure(2.6)
    axes = figure.subplots(1, 3)
    figure.subplots_adjust(left=0.07, right=0.995, bottom=0.12, top=0.84, wspace=0.24)
    table = summary[summary["window"] == window].set_index(["metric", "estimator"])
    width = 0.8 / max(1, len(estimators))
    for ax, (group, quantities) in zip(axes, GROUPS.items(), strict=True):
        tops = []
        for k, label in enumerate(estimators):
            rows = table.reindex([(f"rmse_{q}", label) for q in quantities])
            mean = rows["mean"].to_numpy(dtype=float)
            ends = [np.clip(mean - rows["ci_low"], 0, None), np.clip(rows["ci_high"] - mean, 0, None)]
            x = np.arange(3) + (k - (len(estimators) - 1) / 2) * width
            look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)][0], "error_kw": {"lw": 0.7}}
            ax.bar(x, mean, 0.92 * width, yerr=ends, label=label, **look)
            tops.append(np.nanmax(mean) if np.isfinite(mean).any() else np.nan)
        if np.isfinite(tops).any() and np.nanmax(tops) > 30 * np.nanmin(tops):
            ax.set_yscale("log")
            ax.yaxis.set_major_formatter(PLAIN)
            ax.minorticks_off()
        names = [quantity_label(q).replace(" velocity", "") for q in quantities]
        ax.set_xticks(range(3), names)
        ax.set_title(f"{group} RMSE, {unit(quantities[0])}", fontsize=8, loc="left")
        ax.grid(axis="x", visible=False)
    legend(figure, axes[0])
    return figure


def spread(per_run: pd.DataFrame, estimators: Sequence[str], metrics: Sequence[str]) -> Figure:
    """Box plots over the runs: median, quartiles, whiskers at 5 and 95 %, the runs outside of them."""
    figure = new_figure(0.9 + 0.26 * len(estimators))
    axes = np.atleast_1d(figure.subplots(1, len(metrics), sharey=True))
    names = [short_name(name, 40) for name in estimators]  # 40 characters take 45 % of the width
    bottom, left = 0.42 / figure.get_figheight(), 0.03 + 0.0105 * max(map(len, names), default=0)
    figure.subplots_adjust(left=max(0.14, left), right=0.99, bottom=bottom, top=0.97, wspace=0.12)
    for ax, metric in zip(axes, metrics, strict=True):
        rows = per_run[per_run["metric"] == metric]
        values = [rows.loc[rows["estimator"] == e, "value"].dropna().to_numpy() for e in estimators]
        look: dict[str, Any] = {"widths": 0.6, "patch_artist": True, "flierprops": {"ms": 2.5, "marker": "."}}
        boxes = ax.boxplot(values, orientation="horizontal", whis=(5, 95), medianprops={"color": "black"}, **look)
        for k, box in enumerate(boxes["boxes"]):
            box.set(facecolor=COLOURS[k % len(COLOURS)][0], alpha=0.55, lw=0.6)
        everything = np.concatenate(values)
        if len(everything) and everything.min() > 0 and everything.max() > 30 * everything.min():
            ax.set_xscale("log")
            ax.xaxis.set_major_formatter(PLAIN)
            ax.minorticks_off()
        ax.set_xlabel(axis_title(metric))
    axes[0].set_yticks(range(1, len(estimators) + 1), names)
    axes[0].invert_yaxis()
    return figure


def envelopes(table: pd.DataFrame, quantities: Sequence[str], outages: Spans = (), phases: Phases = ()) -> Figure:
    """RMS error over the runs (line) and the filter's own mean sigma (dotted): they meet when a filter is consistent."""
    figure = new_figure(1.15 * len(quantities) + 0.8)
    axes, shown = panels(figure, len(quantities)), list(dict.fromkeys(table["estimator"]))
    for ax, quantity in zip(axes, quantities, strict=True):
        rows = table[table["quantity"] == quantity]
        found: dict[str, np.ndarray] = {}
        for label, group in rows.groupby("estimator", sort=False):
            t, colour = group["time_s"].to_numpy(), COLOURS[shown.index(label) % len(COLOURS)][0]
            found[str(label)] = group["rms"].to_numpy(dtype=float)
            ax.plot(t, group["rms"], color=colour, label=label)
            ax.plot(t, group["sigma"], color=colour, ls=":", lw=0.8)
        ax.set_ylabel(axis_title(quantity))
        _frame(ax, found, signed=False)
    shade(axes, outages, phases)
    legend(figure, axes[0])
    return figure


def consistency(table: pd.DataFrame, estimators: Sequence[str]) -> Figure:
    """Mean NEES and NIS divided by their expected value, with the 95 % chi-square bounds."""
    from matplotlib.ticker import LogLocator

    quantities = list(dict.fromkeys(table["quantity"]))
    figure = new_figure(1.0 + 0.16 * len(estimators) * len(quantities))
    bottom = 0.42 / figure.get_figheight()
    ax = figure.add_axes((0.17, bottom, 0.80, 0.98 - bottom - 0.24 / figure.get_figheight()))
    step = 0.7 / max(1, len(estimators))
    for row, quantity in enumerate(quantities):
        group = table[table["quantity"] == quantity].set_index("estimator")
        first = group.iloc[0]
        low, high = first["lower"] / first["dof"], first["upper"] / first["dof"]
        ax.fill_betweenx(
            [row - 0.42, row + 0.42], low, high, color="#dddddd", lw=0, label="95 % bounds" if not row else None
        )
        for k, label in enumerate(estimators):
            if label in group.index:
                y = row + (k - (len(estimators) - 1) / 2) * step
                value = group.loc[label, "mean"] / group.loc[label, "dof"]
                ax.plot(value, y, "o", ms=4, color=COLOURS[k % len(COLOURS)][0], label=None if row else label)
    ax.axvline(1.0, color="black", lw=0.6)
    ax.set_yticks(range(len(quantities)), [quantity_label(q) for q in quantities])
    ax.set(xlabel="mean divided by its expected value (1 = consistent)", xscale="log")
    low, high = max(ax.get_xlim()[0], FAR), ax.get_xlim()[1]
    ax.set_xlim(low, high)
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 300.0 * low else (1.0,)))
    ax.xaxis.set_major_formatter(PLAIN)
    ax.minorticks_off()
    ax.invert_yaxis()
    legend(figure, ax)
    return figure


def extras(
    table: pd.DataFrame,
    label: str,
    outages: Spans = (),
    phases: Phases = (),
    components: Mapping[str, Sequence[str]] | None = None,
) -> Figure:
    """What an estimator reports beside its state (mode probabilities, network outputs), one panel per name."""
    names = list(dict.fromkeys(table["name"]))[:4]
    figure = new_figure(1.3 * len(names) + 0.8)
    axes = panels(figure, len(names))
    for ax, name in zip(axes, names, strict=True):
        for k, (component, group) in enumerate(table[table["name"] == name].groupby("component", sort=False)):
            ax.plot(
                group["time_s"],
                group["value"],
                color=COLOURS[k % len(COLOURS)][0],
                label=component_label(component, k, (components or {}).get(name, ())),
            )
        ax.set_ylabel(name.replace("_", " "))
    shade(axes, outages, phases)
    figure.text(0.11, 1 - 0.18 / figure.get_figheight(), label)
    legend(figure, axes[0])
    return figure


def drawings(result: Result) -> dict[str, Drawing]:
    """Every figure that the result has data for, by name."""
    lead = headline(result)
    lines = compared(result, lead.winner)
    estimates = {label: thin(result.errors[label], POINTS) for label in lines if label in result.errors}
    spans, phases = result.outages, result.phases
    found: dict[str, Drawing] = {}

    def add(name: str, caption: str, draw: Callable[..., Figure], *arguments: object) -> None:
        found[name] = Drawing(partial(draw, *arguments), caption)

    if len(result.truth) and estimates:
        truth = thin(result.truth, POINTS)
        fixes = thin(result.gnss, POINTS)
        add("ground_track", "Ground track of run 0; broad grey: no GNSS.", ground_track, truth, estimates, spans, fixes)
        add("path_3d", "Path of run 0 in space.", path_3d, truth, estimates)
    for group, quantities in GROUPS.items():
        if any(f[quantities].notna().any(axis=None) for f in estimates.values()):
            caption = f"{group} error of run 0 with ±3σ of {lead.winner}; shaded: no GNSS."
            add(f"error_{group.lower()}", caption, error_traces, estimates, quantities, spans, phases, lead.winner)
    found |= _over_time(result, lead.winner, list(estimates))
    if result.estimators:
        add("rmse", "Mean RMSE over the runs with 95 % intervals.", rmse_bars, result.summary, lines, lead.window)
    metrics = [f"rmse_{quantity}" for quantity in MAIN]
    per_run = result.per_run(metrics, lead.window).dropna(subset=["value"])
    if len(per_run):
        shown = [m for m in metrics if (per_run["metric"] == m).any()]
        caption = "Spread over the runs: median, quartiles, 5 and 95 %."
        add("monte_carlo", caption, spread, per_run, result.estimators, shown)
    table = result.envelopes.dropna(subset=["rms"])
    if len(table := table[table["estimator"].isin(lines)]):
        judged = [group for group, names in GROUPS.items() if lead.metric.endswith(f"_{names[0].rpartition('_')[2]}")]
        there = [group for group in (*judged, *GROUPS) if table["quantity"].isin(GROUPS[group]).any()]
        group = there[0]  # of the measure that the headline is about: an attitude filter's position says nothing
        caption = f"{group} error over the runs: RMS (line) and the filters' own sigma (dotted)."
        add("envelope", caption, envelopes, table, GROUPS[group], spans, phases)
    if len(table := result.consistency.dropna(subset=["mean"])):
        add("consistency", "NEES and NIS relative to their expected value.", consistency, table, lines)
    for name, (channels, label, colour) in innovations.figures(result, lead.winner).items():
        add(name, innovations.CAPTION.format(label), innovations.figure, channels, label, colour, spans)
    if len(result.satellites):
        add("sky", satellites.SKY_CAPTION, satellites.sky, result.satellites)
        add("satellites", satellites.TIME_CAPTION, satellites.over_time, result.satellites, spans, phases)
        add("residuals", satellites.RESIDUALS_CAPTION, satellites.residuals, result.satellites)
    for label, frame in list(result.extras.items())[:MOST_EXTRAS]:
        name = f"extras_{result.info['estimators'][label]}"
        components = result.components(label)
        add(name, f"Beside the state, {label}, run 0.", extras, frame, label, spans, phases, components)
    return found


def _over_time(result: Result, winner: str, lines: Sequence[str]) -> dict[str, Drawing]:
    """Distribution of the errors of run 0, its NEES, and the biases that the winner estimates."""
    found: dict[str, Drawing] = {}
    sizes = {label: over_time.sizes(result.errors[label], "position_2d_m") for label in lines}
    if sizes := {label: values for label, values in sizes.items() if len(values)}:
        caption = "Share of the time of run 0 with a horizontal error below a value; dots: CEP and R95."
        found["cdf"] = Drawing(partial(over_time.error_cdf, sizes, "position_2d_m"), caption)
    if nees := {label: result.nees[label] for label in lines if label in result.nees}:
        caption = "NEES of run 0 divided by its degrees of freedom; grey: 95 % of the time for an honest filter."
        found["nees"] = Drawing(partial(over_time.nees_over_time, nees, result.outages, result.phases), caption)
    if winner in result.biases:
        frame = thin(result.biases[winner], POINTS)
        caption = f"Biases of run 0 as {winner} estimates them with ±3σ, and the true ones."
        found["biases"] = Drawing(partial(over_time.bias_traces, frame, winner, result.outages, result.phases), caption)
    return found


def compared(result: Result, winner: str) -> list[str]:
    """The estimators drawn in colour: all, or of many those that the claims compare, with the winner, up to `MOST_LINES`."""
    if len(result.estimators) <= MOST_LINES:
        return result.estimators
    named = [str(claim.get(side)) for claim in result.scenario.get("claims", []) for side in ("than", "better")]
    order = [winner, *dict.fromkeys(named), *result.estimators]
    chosen = [label for label in dict.fromkeys(order) if label in result.estimators][:MOST_LINES]
    return [label for label in result.estimators if label in chosen]


def save(drawing: Drawing, path: Path, svg: bool = True) -> None:
    """Draw a figure and write it as PNG, ``path`` (and SVG beside it)."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = drawing.draw()
        write_with(path, partial(figure.savefig, format="png", dpi=DPI, metadata={"Software": None}))
        if svg:
            plain = {"Date": None, "Creator": None}
            write_with(path.with_suffix(".svg"), partial(figure.savefig, format="svg", metadata=plain))


def _frame(ax: Axes, series: Mapping[str, np.ndarray], signed: bool = True) -> None:
    """The limits that the page has, where the largest error dwarfs the smallest; who leaves the frame is named in it."""
    sizes = {label: float(np.nanmax(np.abs(s))) for label, s in series.items() if np.isfinite(s).any()}
    if (limit := geometry.first_view(list(sizes.values()))) is None:
        return
    ax.set_ylim(-limit if signed else 0.0, limit)
    beyond = ", ".join(f"{label} to {size:.3g}" for label, size in sizes.items() if size > limit)
    if beyond:
        ax.text(
            0.99, 0.95, f"beyond: {beyond}", transform=ax.transAxes, fontsize=6, ha="right", va="top", color="#666666"
        )
