"""Figures of what a result keeps of its first run over time: distribution of errors, NEES, biases. SI, metres, °, mg, °/h."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.special import chdtri

from testbed.base.figure_style import COLOURS, DASHES, logarithmic, new_figure
from testbed.data.records import ACCEL_BIAS_STATES, GYRO_BIAS_STATES
from testbed.physics.earth import G0
from testbed.report.panels import Phases, Spans, legend, panels, shade
from testbed.scoring.quantities import AXES, quantity_label, unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BIAS_UNITS = {"accel": (1e3 / G0, "mg"), "gyro": (np.degrees(1.0) * 3600.0, "°/h")}
SHARES = {0.5: "CEP", 0.95: "R95"}
"""Of horizontal errors: the radius within which this share of them lies."""
NORMS = {"position_2d_m": AXES[:2], "position_3d_m": AXES[:3], "velocity_3d_mps": AXES[3:6]}
"""Quantities that are sizes of several axes."""
BIASES = (*ACCEL_BIAS_STATES, *GYRO_BIAS_STATES)
ALIGNMENT_SHARE = 10
"""A tenth of the record: where a filter still finds its biases, which would set the scale of all that follows."""


def sizes(frame: pd.DataFrame, quantity: str) -> np.ndarray:
    """Finite sizes of an error over time, in order of size."""
    values = frame[list(NORMS.get(quantity, (quantity,)))].to_numpy(dtype=float)
    norm: np.ndarray = np.sqrt(np.sum(values**2, axis=1))
    return np.sort(norm[np.isfinite(norm)])


def spans_decades(found: Mapping[str, np.ndarray]) -> bool:
    """Whether the sorted errors differ so much between estimators that a linear axis would show one of them only."""
    largest, middle = max(v[-1] for v in found.values()), min(float(np.median(v)) for v in found.values())
    return bool(largest > 100.0 * max(middle, 1e-12) and min(v[0] for v in found.values()) > 0.0)


def error_cdf(found: Mapping[str, np.ndarray], quantity: str) -> Figure:
    """Share of the time in which the error is below a value; the radii of half and of 95 % marked. ``found``: see `sizes`."""
    figure = new_figure(2.8)
    ax = figure.add_axes((0.11, 0.15, 0.86, 0.75))
    for k, (label, values) in enumerate(found.items()):
        look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)][0], "ls": DASHES[k % len(DASHES)]}
        ax.plot(values, (np.arange(len(values)) + 1.0) / len(values), label=label, **look)
        for share in SHARES:
            ax.plot(np.quantile(values, share), share, "o", ms=3, color=look["color"])
    for share, name in SHARES.items():
        ax.axhline(share, color="#999999", lw=0.5, ls=":")
        if quantity == "position_2d_m":
            ax.text(1.0, share + 0.01, name, transform=ax.get_yaxis_transform(), ha="right", va="bottom", fontsize=6)
    if spans_decades(found):
        logarithmic(ax, "x")
        ax.set_xlim(min(float(np.quantile(v, 0.02)) for v in found.values()), max(v[-1] for v in found.values()))
    label = quantity_label(quantity)
    ax.set(xlabel=f"{label} error, {unit(quantity)}", ylabel="share of the time", ylim=(0.0, 1.0))
    legend(figure, ax)
    return figure


def bounds(dof: float) -> tuple[float, float]:
    """Within which NEES of one run, divided by its degrees of freedom, lies 95 % of the time."""
    low, high = chdtri(dof, (0.975, 0.025)) / dof
    return float(low), float(high)


def nees_over_time(tables: Mapping[str, pd.DataFrame], outages: Spans = (), phases: Phases = ()) -> Figure:
    """NEES divided by its degrees of freedom, with the 95 % bounds of one run; a panel per group of states."""
    quantities = list(dict.fromkeys(q for table in tables.values() for q in table["quantity"]))
    figure = new_figure(1.15 * len(quantities) + 0.8)
    axes = panels(figure, len(quantities))
    for ax, quantity in zip(axes, quantities, strict=True):
        for k, (label, table) in enumerate(tables.items()):
            rows = table[table["quantity"] == quantity]
            if rows.empty:
                continue
            look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)][0], "ls": DASHES[k % len(DASHES)], "lw": 0.8}
            ax.plot(rows["time_s"], rows["value"] / rows["dof"], label=label, **look)
            dof = float(rows["dof"].iloc[0])
        ax.axhspan(*bounds(dof), color="#dddddd", lw=0, zorder=0)
        ax.axhline(1.0, color="black", lw=0.5)
        logarithmic(ax, "y")
        ax.set_ylabel(quantity_label(quantity).replace("NEES ", "NEES/n, "), fontsize=7)
    shade(axes, outages, phases)
    legend(figure, axes[0])
    return figure


def bias_names(frame: pd.DataFrame) -> list[str]:
    """The bias states that a table has."""
    return [name for name in BIASES if name in frame]


def bias_label(name: str) -> tuple[str, float]:
    """``gyro_bias_x_radps`` -> ``gyro x, °/h`` and the factor to this unit."""
    triad, _, axis = name.split("_")[:3]
    factor, symbol = BIAS_UNITS[triad]
    return f"{triad} {axis}, {symbol}", float(factor)


def bias_range(value: Sequence[float] | np.ndarray, spread: Sequence[float] | np.ndarray) -> tuple[float, float] | None:
    """Limits that show a bias once it is found; None where there are none to give."""
    value, spread = np.asarray(value), np.asarray(spread)
    late = slice(len(value) // ALIGNMENT_SHARE, None)
    reach = float(np.nanmax(np.abs(value[late] - value[-1]) + spread[late])) if len(value) else 0.0
    return (value[-1] - 1.2 * reach, value[-1] + 1.2 * reach) if np.isfinite(reach) and reach > 0.0 else None


def bias_traces(frame: pd.DataFrame, label: str, outages: Spans = (), phases: Phases = ()) -> Figure:
    """Estimated biases with three sigma and the true ones, a panel each."""
    names = bias_names(frame)
    figure = new_figure(0.85 * len(names) + 0.8)
    axes = panels(figure, len(names))
    for ax, name in zip(axes, names, strict=True):
        title, factor = bias_label(name)
        t, value = frame["time_s"], factor * frame[name]
        spread = 3.0 * factor * frame[f"sigma_{name}"] if f"sigma_{name}" in frame else 0.0 * value
        ax.fill_between(t, value - spread, value + spread, color=COLOURS[0][0], alpha=0.18, lw=0, label="±3σ")
        ax.plot(t, value, color=COLOURS[0][0], label=label)
        if f"true_{name}" in frame:
            ax.plot(t, factor * frame[f"true_{name}"], color="black", lw=0.8, label="truth")
        if (limits := bias_range(value, spread)) is not None:
            ax.set_ylim(*limits)
        ax.set_ylabel(title)
    shade(axes, outages, phases)
    legend(figure, axes[0])
    return figure
