"""Single figures of a result for a paper: `draw` one of `KINDS`, in the size and style that is asked for.

Each is made from the same tables as the report's figures, most by the same functions. Inches; metres, m/s, degrees, seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from testbed.base.errors import InputError, nearest
from testbed.base.figure_style import COLUMN_WIDTH, PAGE_WIDTH, STYLE
from testbed.report import figures, over_time
from testbed.report.headline import headline
from testbed.report.labels import window_label
from testbed.report.results import Result, load_result, thin
from testbed.scoring.quantities import AXES, GROUPS, MAIN, quantity_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEFT, RIGHT, BOTTOM, TOP, LEGEND_ROW, LABEL = 0.62, 0.16, 0.40, 0.12, 0.17, 0.46
"""Margins of a figure, height of a row of its legend, and distance of the labels of its y axes, inches."""


@dataclass(frozen=True)
class Wanted:
    """What is asked of a figure: ``estimators`` (labels; empty: the report's choice), ``metric`` or quantity, ``window``."""

    estimators: tuple[str, ...] = ()
    metric: str = ""
    window: str = "all"


def draw(folder: Path, kind: str, wanted: Wanted, size: str = "column", style: str = "") -> Figure:
    """A figure of a result folder. ``size``: "column", "page" or "WIDTHxHEIGHT" in inches; ``style``: one of matplotlib's.

    Raises InputError for a kind, name, size or style that there is not, or a result that lacks what the figure shows.
    """
    import matplotlib
    from matplotlib import style as styles

    if kind not in KINDS:
        raise InputError(f"there is no figure '{kind}'; {nearest(kind, [*KINDS, *OF_OTHER_FOLDERS])}")
    if style and style not in styles.available and not Path(style).is_file():
        raise InputError(f"--style {style}: no style of matplotlib; {nearest(style, styles.available)}")
    width, height = parse_size(size)
    result = load_result(folder)
    for name in wanted.estimators:
        if name not in result.estimators:
            raise InputError(f"{folder}: has no estimator '{name}'; {nearest(name, result.estimators)}")
    with matplotlib.rc_context(STYLE), styles.context(style or {}):
        return fit(KINDS[kind][0](result, wanted), width, height)


def parse_size(size: str) -> tuple[float, float | None]:
    """Width and height in inches of a size's name, or of ``3.5x2.4``; no height: the figure's own proportion."""
    if size in (named := {"column": COLUMN_WIDTH, "page": PAGE_WIDTH}):
        return named[size], None
    try:
        width, height = (float(part) for part in size.lower().split("x"))
    except ValueError:
        raise InputError(f"--size {size}: column, page, or WIDTHxHEIGHT in inches, for example 3.5x2.4") from None
    if not (1.0 <= width <= 40.0 and 1.0 <= height <= 40.0):
        raise InputError(f"--size {size}: between 1 and 40 inches")
    return width, height


def fit(figure: Figure, width: float, height: float | None) -> Figure:
    """Bring a figure to a size: margins and letters keep theirs, the axes take what is left, the legend its rows."""
    old_width, old_height = figure.get_size_inches()
    entries = [(leg.legend_handles, [text.get_text() for text in leg.get_texts()]) for leg in figure.legends]
    names = [name for _, labels in entries for name in labels]
    columns = max(1, min(len(names), int((width - 0.2) / (0.45 + 0.058 * max(map(len, names), default=1)))))
    rows = -(-len(names) // columns)
    shape = figure.axes[0].get_aspect() != "auto"
    height = height or (old_height * width / old_width if shape else old_height) + LEGEND_ROW * max(0, rows - 1)
    boxes = [ax.get_position() for ax in figure.axes]
    x0, x1 = min(b.x0 for b in boxes), max(b.x1 for b in boxes)
    y0, y1 = min(b.y0 for b in boxes), max(b.y1 for b in boxes)
    words = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    named = max((len(word) for word in words if any(map(str.isalpha, word))), default=0)  # rows of a box plot
    left, bottom = max(LEFT, 0.15 + 0.062 * named) / width, BOTTOM / height
    across, up = 1.0 - RIGHT / width - left, 1.0 - (TOP + LEGEND_ROW * rows) / height - bottom
    figure.set_size_inches(width, height)
    for ax, box in zip(figure.axes, boxes, strict=True):
        wide, tall = across * box.width / (x1 - x0), up * box.height / (y1 - y0)
        ax.set_position(
            (left + across * (box.x0 - x0) / (x1 - x0), bottom + up * (box.y0 - y0) / (y1 - y0), wide, tall)
        )
        ax.yaxis.set_label_coords(-LABEL / (wide * width), 0.5)
    for old in list(figure.legends):
        old.remove()
    if names:
        handles = [handle for part, _ in entries for handle in part if handle is not None]
        figure.legend(handles, names, loc="upper right", bbox_to_anchor=(1.0, 1.0), ncols=columns, columnspacing=1.0)
    return figure


def _chosen(result: Result, wanted: Wanted, table: Any = None) -> list[str]:
    """The labels to draw: those asked for, else the report's; of them those that ``table`` has."""
    labels = list(wanted.estimators) or figures.compared(result, headline(result).winner)
    found = [label for label in labels if table is None or label in table]
    if not found:
        raise InputError(
            f"{result.folder}: holds nothing of this kind for {', '.join(labels)}; results of version 0.1 lack NEES and biases over time"
        )
    return found


def _best(result: Result, labels: Sequence[str]) -> str:
    """The one that the headline names, where it is among them."""
    return next((label for label in labels if label == headline(result).winner), labels[0])


def _axes_of(wanted: Wanted, frames: Sequence[pd.DataFrame]) -> list[str]:
    """The signed errors that are meant: a group (position, velocity, attitude), one axis, or the first group with values."""
    groups = {name.lower(): axes for name, axes in GROUPS.items()}
    if wanted.metric:
        if wanted.metric not in groups and wanted.metric not in AXES:
            raise InputError(f"--metric {wanted.metric}: {nearest(wanted.metric, [*groups, *AXES])}")
        return groups.get(wanted.metric, [wanted.metric])
    known = (axes for axes in groups.values() if any(f[axes].notna().any(axis=None) for f in frames))
    return next(known, list(AXES))


def errors(result: Result, wanted: Wanted) -> Figure:
    """Errors of run 0 over time; the band of three sigma of the first estimator."""
    labels = _chosen(result, wanted, result.errors)
    labels = labels if wanted.estimators else [_best(result, labels)]
    frames = {label: thin(result.errors[label], figures.POINTS) for label in labels}
    shown = _axes_of(wanted, list(frames.values()))
    return figures.error_traces(frames, shown, result.outages, result.phases, band=labels[0])


def track(result: Result, wanted: Wanted) -> Figure:
    """Ground track of run 0."""
    labels = _chosen(result, wanted, result.errors)
    frames = {label: thin(result.errors[label], figures.POINTS) for label in labels}
    return figures.ground_track(
        thin(result.truth, figures.POINTS), frames, result.outages, thin(result.gnss, figures.POINTS)
    )


def cdf(result: Result, wanted: Wanted) -> Figure:
    """Share of the time of run 0 in which the error is below a value; the radii of half and of 95 % marked."""
    quantity = wanted.metric or "position_2d_m"
    if quantity not in (known := [*over_time.NORMS, *AXES]):
        raise InputError(f"--metric {quantity}: {nearest(quantity, known)}")
    labels = _chosen(result, wanted, result.errors)
    found = {label: over_time.sizes(result.errors[label], quantity) for label in labels}
    found = {label: values for label, values in found.items() if len(values)}
    if not found:
        raise InputError(f"{result.folder}: no estimator answers for {quantity_label(quantity)}")
    return over_time.error_cdf(found, quantity)


def box(result: Result, wanted: Wanted) -> Figure:
    """Box plots of a metric over the runs; by default the RMSE of the first of `MAIN` that there is."""
    metrics = [wanted.metric] if wanted.metric else [f"rmse_{name}" for name in MAIN]
    labels = _chosen(result, wanted)
    rows = result.per_run(metrics, wanted.window)
    metrics = [m for m in metrics if rows.loc[rows["metric"] == m, "value"].notna().any()]
    if not metrics:
        raise InputError(f"{result.folder}: no run has {wanted.metric or 'an RMSE'} in {window_label(wanted.window)}")
    return figures.spread(rows, labels, metrics[:1])


def nees(result: Result, wanted: Wanted) -> Figure:
    """NEES of run 0 over time divided by its degrees of freedom, with the 95 % bounds of one run."""
    tables = {label: result.nees[label] for label in _chosen(result, wanted, result.nees)}
    return over_time.nees_over_time(tables, result.outages, result.phases)


def biases(result: Result, wanted: Wanted) -> Figure:
    """Estimated biases of run 0 with three sigma, and the true ones; of the first estimator, or the best."""
    labels = _chosen(result, wanted, result.biases)
    label = labels[0] if wanted.estimators else _best(result, labels)
    return over_time.bias_traces(thin(result.biases[label], figures.POINTS), label, result.outages, result.phases)


KINDS: dict[str, tuple[Callable[[Result, Wanted], Figure], str]] = {
    "errors": (errors, "errors of run 0 over time, with three sigma"),
    "track": (track, "ground track of run 0"),
    "cdf": (cdf, "share of the time below an error, with CEP and R95"),
    "box": (box, "a metric over the runs"),
    "nees": (nees, "NEES of run 0 over time"),
    "biases": (biases, "estimated and true biases of run 0"),
}
OF_OTHER_FOLDERS = {
    "allan": "Allan deviation of a log at rest (a folder of testbed sense, import or static_log)",
    "sweep": "a metric over the settings of a sweep",
}
"""Figures of folders that are no results of a Monte Carlo."""
