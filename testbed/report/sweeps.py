"""A sweep as a figure, a table and a page: one metric over the first setting, a line per estimator, a panel per other value.

Means over the runs with the 95 % interval that ``summary.csv`` of each point states; units of metrics and of the settings' keys.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from testbed.base.errors import InputError, nearest
from testbed.base.figure_style import COLOURS, COLUMN_WIDTH, PAGE_WIDTH, STYLE, logarithmic
from testbed.base.files import write_atomic, write_with
from testbed.report import html
from testbed.report.labels import number, window_label
from testbed.report.tables import Cell, Column, Table
from testbed.report.text import latex_table, markdown_table
from testbed.scenario.explain import UNITS
from testbed.scoring.quantities import axis_title, metric_label, unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURES = ("sweep.png", "sweep.svg", "sweep.pdf")
FILES = (*PICTURES, "sweep.tex", "report.html")
SPREAD = 20.0
"""From this ratio of the largest to the smallest value on, all above zero, an axis is logarithmic unless said otherwise."""
MARKS = "os^Dv<>P"
NO_STATISTICS = ("mean", "ci_low", "ci_high")


def key_label(key: str) -> str:
    """``sensors.gnss.rate_hz`` -> ``gnss rate, Hz``: the label of an axis."""
    parts = [part for part in key.split(".") if not part.isdigit() and part != "params"]
    name, _, end = parts[-1].rpartition("_")
    words, known = (name, f", {UNITS[end]}") if name and end in UNITS else (parts[-1], "")
    return f"{' '.join([*parts[-2:-1], words])}{known}".replace("_", " ")


def chosen(table: pd.DataFrame, metric: str, window: str) -> pd.DataFrame:
    """The rows of one metric and window. Raises InputError with the nearest name where there are none."""
    for column, wanted in (("metric", metric), ("window", window)):
        if wanted not in set(table[column]):
            raise InputError(f"the sweep has no {column} '{wanted}'; {nearest(wanted, table[column].unique())}")
    rows = table[(table["metric"] == metric) & (table["window"] == window)]
    if rows.empty:
        raise InputError(f"the sweep has no metric '{metric}' in the window '{window}'")
    return rows


def figure(
    table: pd.DataFrame,
    keys: Sequence[str],
    metric: str,
    window: str = "all",
    log: str | None = None,
    width: float | None = None,
) -> Figure:
    """Means with their intervals as bands (as bars where the setting is no number).

    ``log``: "x", "y", "xy" or "none"; by default an axis is logarithmic where its values span more than `SPREAD`. ``width`` in
    inches: a column of a journal for one panel, the page for several, unless given.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    first, others = keys[0], list(keys[1:])
    rows = chosen(table, metric, window)
    panels: list[tuple[Any, Any]] = list(rows.groupby(others, sort=False)) if others else [((), rows)]
    width = width or (COLUMN_WIDTH if len(panels) == 1 else PAGE_WIDTH)
    drawn = Figure(figsize=(width, max(2.4, 0.72 * width / len(panels))), layout="constrained")
    FigureCanvasAgg(drawn)
    axes = drawn.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    numeric = pd.api.types.is_numeric_dtype(rows[first]) and not pd.api.types.is_bool_dtype(rows[first])
    for axis, (values, part) in zip(axes, panels, strict=True):
        for k, (estimator, line) in enumerate(part.groupby("estimator", sort=False)):
            _line(axis, line, first, str(estimator), k, numeric)
        axis.set_xlabel(key_label(first))
        axis.set_title("\n".join(f"{key_label(o)}: {v}" for o, v in zip(others, values, strict=False)), fontsize=7)
    for axis in axes:
        if numeric and (_wide(rows[first]) if log is None else "x" in log):
            logarithmic(axis, "x")
        if _wide(rows["mean"]) if log is None else "y" in log:
            logarithmic(axis, "y")
    about = "" if window == "all" else f"\n{window_label(window)}"
    axes[0].set_ylabel(axis_title(metric) + about)
    axes[0].legend(fontsize=6)
    return drawn


def _wide(values: pd.Series) -> bool:
    finite = values[np.isfinite(values)]
    return len(finite) > 0 and finite.min() > 0 and finite.max() > SPREAD * finite.min()


def _line(axis: Axes, line: pd.DataFrame, first: str, estimator: str, k: int, numeric: bool) -> None:
    look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)][0], "marker": MARKS[k % len(MARKS)], "ms": 3.5}
    mean, low, high = (line[column].to_numpy(dtype=float) for column in NO_STATISTICS)
    if numeric:
        x = line[first].to_numpy(dtype=float)
        order = np.argsort(x, kind="stable")
        axis.plot(x[order], mean[order], label=estimator, **look)
        axis.fill_between(x[order], low[order], high[order], color=look["color"], alpha=0.2, lw=0)
        return
    ends = [np.nan_to_num(np.clip(side, 0.0, None)) for side in (mean - low, high - mean)]
    axis.errorbar(line[first].astype(str).to_numpy(), mean, yerr=ends, capsize=2, lw=1.0, label=estimator, **look)


def values_table(table: pd.DataFrame, keys: Sequence[str], metric: str, window: str = "all") -> Table:
    """A row per point of the grid, a column per estimator: mean and its interval, the best of each row marked."""
    rows = chosen(table, metric, window)
    estimators = list(dict.fromkeys(rows["estimator"]))
    found = []
    for point, part in rows.groupby(list(keys), sort=False):
        part = part.set_index("estimator")
        best = part["mean"].min()
        cells = []
        for estimator in estimators:
            mean, low, high = (float(part[c].get(estimator, np.nan)) for c in NO_STATISTICS)
            interval = f"{number(low)} to {number(high)}" if np.isfinite([low, high]).all() else ""
            cells.append(Cell(number(mean), mean, interval, best=len(estimators) > 1 and mean == best))
        found.append((", ".join(map(str, point if isinstance(point, tuple) else (point,))), cells))
    columns = [Column(estimator, unit(metric)) for estimator in estimators]
    count = int(rows["n"].max())
    note = f"Mean over {count} run{'s' * (count != 1)} with its 95 % interval, {window_label(window)}. Best of each row in bold."
    corner = ", ".join(map(key_label, keys))
    return Table("sweep", metric_label(metric), columns, found, note, corner=corner)


def save(drawn: Figure, path: Path) -> None:
    """Write a figure in the format of the file's name, with nothing in it that changes from call to call."""
    kind = path.suffix.removeprefix(".")
    import matplotlib

    plain: dict[str, Any] = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}
    meta = plain.get(kind, {"CreationDate": None, "Creator": None, "Producer": None})
    with matplotlib.rc_context(STYLE), _no_clock():
        write_with(path, partial(drawn.savefig, format=kind, dpi=300, metadata=meta))


@contextmanager
def _no_clock() -> Iterator[None]:
    """The letters that a PDF embeds carry the time at which they were cut out, unless the environment says another."""
    before = os.environ.get("SOURCE_DATE_EPOCH")
    os.environ["SOURCE_DATE_EPOCH"] = "0"
    try:
        yield
    finally:
        os.environ.pop("SOURCE_DATE_EPOCH")
        if before is not None:
            os.environ["SOURCE_DATE_EPOCH"] = before


def write(
    folder: Path, table: pd.DataFrame, keys: Sequence[str], metric: str, window: str, log: str | None, title: str
) -> None:
    """The files of `FILES` in ``folder``."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        drawn = figure(table, keys, metric, window, log)
        for name in PICTURES:
            save(drawn, folder / name)
    values = values_table(table, keys, metric, window)
    tex = "% needs \\usepackage{booktabs}\n\n" + latex_table(title.partition(":")[0], values)
    text = f"## {values.title}, {window_label(window)}\n\n{markdown_table(values)}\n\n![{values.title}](sweep.png)\n"
    where = ", ".join(f"[{name}]({name})" for name in ("sweep.csv", "sweep.tex", *PICTURES))
    text += f"\nEvery metric and window of every point: {where}. `testbed plot` draws another of them.\n"
    over = " and ".join(f"{key} ({', '.join(map(str, dict.fromkeys(table[key])))})" for key in keys)
    page = html.document(f"{title}, sweep", "Navigation testbed, a sweep", f"Over {over}.", text, folder)
    for name, content in (("sweep.tex", tex), ("report.html", page)):
        write_atomic(folder / name, content.encode())
