"""How figures look: size, lines, colours, for those of a report and those that a record draws of itself.

Colours: Okabe and Ito (2008), a palette that stays distinct under the common colour-vision deficiencies; yellow is left out
(unreadable on white).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 6.3
"""Inches: the text width of an A4 page."""
COLUMN_WIDTH, PAGE_WIDTH = 3.5, 7.16
"""Inches: a column, and the width of both, of a journal in two columns (IEEE's guide to authors)."""
COLOURS = [
    ("#0072B2", "#4FA8DE"),
    ("#D55E00", "#F0803C"),
    ("#009E73", "#2CC79B"),
    ("#CC79A7", "#E29AC2"),
    ("#B07A00", "#E6B23C"),
    ("#3A9BDC", "#8CCBF2"),
    ("#7A4FA3", "#B493D6"),
    ("#5B5B5B", "#B5B5B5"),
]
"""(on white, on dark)"""
DASHES: list[Any] = ["-", "--", ":", "-.", (0, (6, 1.5)), (0, (4, 1, 1, 1, 1, 1))]
"""Tell lines apart where colours do not."""
STYLE: Any = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.4,
    "grid.color": "#dddddd",
    "legend.frameon": False,
    "legend.fontsize": 7,
    "lines.linewidth": 1.0,
    "svg.hashsalt": "testbed",
    "text.parse_math": False,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,  # letters that journals accept
    "path.simplify_threshold": 0.5,
}


def logarithmic(axes: Axes, which: str) -> None:
    """Make the axis ``which`` ("x" or "y") logarithmic, powers of ten as plain numbers: no mathematics has to be set."""
    from matplotlib.ticker import NullFormatter

    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def new_figure(height: float) -> Figure:
    """An empty figure of `WIDTH` and a height in inches that needs no screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height))
    FigureCanvasAgg(figure)
    return figure
