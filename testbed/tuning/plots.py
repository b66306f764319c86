"""Figures of a tuning study: convergence, the variables of the best candidates, path and errors of the best one.

Small PNG files. Coordinates have no unit (log10 of a factor, or the value itself); errors in m, m/s, degrees; time in s.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.files import write_with
from testbed.data.registry import log_for, make_estimator
from testbed.scoring.metrics import error_series
from testbed.scoring.quantities import AXES, axis_title
from testbed.tuning.objective import Recording

if TYPE_CHECKING:
    import pandas as pd

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#000000")
DASHES = ("-", "-", "-", "-", "-", "-", "--", ":")
DPI = 90


def convergence(history: pd.DataFrame, searches: pd.DataFrame, path: Path, baseline: float | None = None) -> None:
    """Best value over evaluations of every search; the longest search of an algorithm is named."""
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(8.0, 4.5), layout="constrained")
    chosen = searches[searches["kind"] == "objective"]
    for k, algorithm in enumerate(dict.fromkeys(chosen["algorithm"])):
        own = chosen[chosen["algorithm"] == algorithm].sort_values("iterations")
        for name in own["search"]:
            part = history[history["search"] == name]
            label = algorithm if name == own["search"].iloc[-1] else None
            look: dict[str, Any] = {"color": COLOURS[k % 8], "ls": DASHES[k % 8], "lw": 1.6 if label else 0.8}
            axes.plot(part["evaluations"], part["best"], label=label, **look)
    if baseline is not None:
        axes.axhline(baseline, color="0.3", lw=0.8, ls="-.")
        axes.annotate(
            "data sheet", (1.0, baseline), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8
        )
    axes.set(xlabel="evaluations", ylabel="best objective", yscale="log")
    for part in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        part("{x:g}")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8, ncols=2)
    _save(figure, path)


def variables(searches: pd.DataFrame, names: list[str], low: np.ndarray, high: np.ndarray, path: Path) -> None:
    """Box plot of each coordinate over the best candidates of all searches; a mark per algorithm."""
    plt = _pyplot()
    chosen = searches[searches["kind"] == "objective"]
    figure, axes = plt.subplots(figsize=(8.0, 0.26 * len(names) + 1.4), layout="constrained")
    places = np.arange(len(names))
    axes.boxplot([chosen[n] for n in names], orientation="horizontal", positions=places, widths=0.6, showfliers=False)
    for k, algorithm in enumerate(dict.fromkeys(chosen["algorithm"])):
        own = chosen[chosen["algorithm"] == algorithm]
        values = own[names].to_numpy()
        axes.plot(values.ravel(), np.tile(places, len(own)), "o", ms=3.5, color=COLOURS[k % 8], label=algorithm)
    axes.plot(low, places, "|", color="0.3", ms=9)
    axes.plot(high, places, "|", color="0.3", ms=9)
    axes.set_yticks(places, names, fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("coordinate of the search (bars: walls of the box)")
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    _save(figure, path)


def best_flight(name: str, candidates: Mapping[str, Mapping[str, Any]], recording: Recording, path: Path) -> None:
    """Errors over time of several settings of an estimator on one recording, and the path of the last of them."""
    plt = _pyplot()
    figure, grid = plt.subplots(4, 3, figsize=(10.0, 8.0), layout="constrained", sharex=False)
    spread = grid[3, 0].get_gridspec()
    for unused in grid[3]:
        unused.remove()
    track = figure.add_subplot(spread[3, :])
    step = max(1, len(recording.log.imu.t) // 1500)
    for k, (label, params) in enumerate(candidates.items()):
        estimator = make_estimator(name, **params)
        solution = estimator.run(log_for(estimator, recording.log))
        series = error_series(recording.trajectory, solution)
        for axis, axes in enumerate(grid[:3].ravel()):
            axes.plot(series.t[::step], series.values[::step, axis], lw=0.8, color=COLOURS[k % 8], label=label)
            axes.set_title(axis_title(AXES[axis]), fontsize=8)
            axes.grid(alpha=0.3)
            axes.tick_params(labelsize=7)
    truth = recording.trajectory
    for lat, lon, look in (
        (truth.lat, truth.lon, {"color": "0.2"}),
        (solution.lat, solution.lon, {"color": COLOURS[k % 8], "ls": "--"}),
    ):
        track.plot(np.degrees(lon[::step]), np.degrees(lat[::step]), lw=1.0, **look)
    track.set(xlabel="longitude, °", ylabel="latitude, °")
    track.ticklabel_format(useOffset=False)
    track.legend(["truth", label], fontsize=7)
    grid[0, 0].legend(fontsize=7)
    figure.suptitle(f"errors with {recording.case}, run {recording.run}, over time in s", fontsize=9)
    _save(figure, path)


def _pyplot() -> Any:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _save(figure: Any, path: Path) -> None:
    write_with(path, partial(figure.savefig, format="png", dpi=DPI))
    _pyplot().close(figure)
