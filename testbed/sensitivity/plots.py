"""The figure of a study: for each estimator a bar per figure of the data sheet, with intervals, the most decisive on top."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.figure_style import COLOURS, STYLE, new_figure
from testbed.sensitivity.design import MORRIS, SOBOL

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

BARS = {SOBOL: ("ST", "S1"), MORRIS: ("mu_star",)}
LABELS = {"ST": "with interplays (ST)", "S1": "alone (S1)", "mu_star": "mean effect µ*"}


def draw(rows: pd.DataFrame, methods: Sequence[str], what: str) -> Figure:
    """A row of panels for each estimator, a column for each method; figures in one order, by the first estimator's ranking."""
    import matplotlib as mpl

    estimators = list(dict.fromkeys(rows["estimator"]))
    order = _order(rows[rows["estimator"] == estimators[0]])
    with mpl.rc_context(STYLE):
        figure = new_figure((0.5 + 0.24 * len(order)) * len(estimators) + 0.6)
        figure.set_layout_engine("constrained")
        panels = figure.subplots(len(estimators), len(methods), squeeze=False, sharey=True)
        for line, estimator in zip(panels, estimators, strict=True):
            own = rows[rows["estimator"] == estimator].set_index("key").loc[order]
            for axes, method in zip(line, methods, strict=True):
                _bars(axes, own, BARS[method])
                axes.set_title(estimator, fontsize=8, loc="left")
            line[0].set_yticks(np.arange(len(order)), order, fontsize=6)
            line[0].set_ylim(len(order) - 0.5, -0.5)
        for axes, method in zip(panels[-1], methods, strict=True):
            axes.set_xlabel("share of the variance" if method == SOBOL else f"{what}, per range of the figure")
        for axes in panels[0]:
            axes.legend(loc="lower right")
        figure.suptitle(what, fontsize=9)
    return figure


def _order(rows: pd.DataFrame) -> list[str]:
    by = "ST" if "ST" in rows else "mu_star"
    return list(rows.sort_values(by, ascending=False, kind="stable")["key"])


def _bars(axes: Any, rows: pd.DataFrame, names: Sequence[str]) -> None:
    """Horizontal bars of some indices side by side."""
    height = 0.8 / len(names)
    for k, name in enumerate(names):
        places = np.arange(len(rows)) + (k - 0.5 * (len(names) - 1)) * height
        value = rows[name].to_numpy(dtype=float)
        reach = np.nan_to_num(rows[f"{name}_high"].to_numpy(dtype=float) - value)
        axes.barh(places, np.nan_to_num(value), height, color=COLOURS[k][0], label=LABELS[name])
        axes.errorbar(np.nan_to_num(value), places, xerr=reach, fmt="none", ecolor="0.3", elinewidth=0.7, capsize=1.5)
