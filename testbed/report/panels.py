"""Parts of paper figures: panels over one time axis, what is shaded behind them, the legend above. Inches, s."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.figure_style import WIDTH
from testbed.report.labels import short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Spans = Sequence[tuple[float, float]]
Phases = Sequence[tuple[str, float, float]]


def panels(figure: Figure, rows: int, heights: Sequence[float] | None = None) -> list[Axes]:
    """Panels over one time axis, of equal ``heights`` unless said."""
    height = figure.get_figheight()
    axes = np.atleast_1d(figure.subplots(rows, 1, sharex=True, height_ratios=heights))
    figure.subplots_adjust(left=0.11, right=0.985, bottom=0.40 / height, top=1 - 0.42 / height, hspace=0.14)
    axes[-1].set_xlabel("Time, s")
    for ax in axes:
        ax.yaxis.set_label_coords(-0.085, 0.5)  # aligned without measuring every tick label
    return list(axes)


def shade(axes: Sequence[Axes], outages: Spans, phases: Phases) -> None:
    """Outages as grey bands; phase borders as ticks, named along the top of the first panel where there is room."""
    for ax in axes:
        ax.margins(x=0)
        for a, b in outages:
            ax.axvspan(a, b, color="#000000", alpha=0.10, lw=0)
        for _, start, _ in phases[1:]:
            ax.axvline(start, color="#999999", lw=0.4, ls=(0, (2, 2)))
    span = phases[-1][2] - phases[0][1] if phases else 1.0
    for name, start, end in phases:
        if (end - start) / span > 0.017 * len(name):
            where: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 6, "color": "#666666"}
            axes[0].text(
                (start + end) / 2, 1.01, name.replace("_", " "), transform=axes[0].get_xaxis_transform(), **where
            )


def legend(figure: Figure, *axes: Axes) -> None:
    """Above the axes, in as many rows as the names need; the figure grows by all rows but the first."""
    each = [ax.get_legend_handles_labels() for ax in axes]
    handles, labels = ([entry for part in parts for entry in part] for parts in zip(*each, strict=True))
    unique = dict(zip(reversed(labels), reversed(handles), strict=True))
    names = [name for name in dict.fromkeys(labels) if name]
    if not names:
        return
    words = [short_name(name, 100) for name in names]  # as many fit into the width
    columns = min(len(names), max(1, int((WIDTH - 0.2) / (0.5 + 0.058 * max(map(len, words))))))
    _grow(figure, 0.15 * (-(-len(names) // columns) - 1))
    figure.legend(
        [unique[n] for n in names],
        words,
        loc="upper right",
        bbox_to_anchor=(0.99, 1.0),
        ncols=columns,
        columnspacing=1.2,
    )


def _grow(figure: Figure, inches: float) -> None:
    """Add height at the top; everything drawn so far keeps its size and distance from the bottom."""
    old = figure.get_figheight()
    figure.set_figheight(old + inches)
    shrink = old / (old + inches)
    for ax in figure.axes:
        box = ax.get_position()
        ax.set_position((box.x0, shrink * box.y0, box.width, shrink * box.height))
    for text in figure.texts:
        text.set_y(1 - (1 - text.get_position()[1]) * shrink)
