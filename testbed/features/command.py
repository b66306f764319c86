"""`testbed features`: which inputs a scenario's networks should see, and how many lags of them.

The candidates and targets are those of an estimator of the scenario that has ``learning_data(flights)``; the flights are the
training flights of ``[extra.training]``. Writes ``ranking.csv``, ``lags.csv`` and ``lags.png``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.csv_text import csv_text
from testbed.base.errors import InputError, nearest
from testbed.base.files import write_with
from testbed.features.learning import LearningData
from testbed.features.lipschitz import LagCurve, lag_curve
from testbed.features.mrmr import Ranked, rank_mrmr
from testbed.montecarlo.folders import Folder, check_own
from testbed.scenario import EstimatorConfig, Scenario

KIND = "testbed features"
MAX_LAG = 6


def features(
    scenario: Scenario,
    out: str | Path,
    estimator: str | None = None,
    inputs: int = 4,
    tell: Callable[[str], None] = print,
) -> Path:
    """Rank the inputs, measure the lag curves of the best ``inputs``, print both and write them to ``out``.

    ``estimator``: the row whose networks are meant (default: the first that can say). Raises InputError when none can.
    """
    from testbed.data.registry import make_estimator
    from testbed.training.flights import training_flights

    check_own(Path(out), KIND)
    entry = _learner(scenario, estimator)
    student: Any = make_estimator(entry.name, **entry.params)
    tell(f"{entry.row}: learning data of the training flights")
    data: LearningData = student.learning_data(training_flights(scenario))
    if not 1 <= inputs <= len(data.names):
        raise InputError(f"--inputs {inputs}: from 1 to {len(data.names)}")
    rankings = {t: rank_mrmr(data.candidates, y, data.names, method="all") for t, y in data.targets.items()}
    curves = {}
    for target, y in data.targets.items():
        chosen = [data.names.index(r.name) for r in rankings[target][:inputs]]
        curves[target] = lag_curve(data.candidates[:, chosen], y, MAX_LAG, present_input=True)
        tell(f"{target:>8}: {ranking_line(rankings[target])}")
        tell(f"{'':>8}  lags {curves[target].order()}: " + " ".join(f"{v:.3g}" for v in curves[target].index))
    with Folder.open(out, KIND) as own:
        own.claim(["ranking.csv", "lags.csv", "lags.png"])
        _write_tables(own, rankings, curves)
        plot_lags(curves, own.out / "lags.png")
        own.finish("lags.png")
        own.save()
    return own.out


def ranking_line(ranking: Sequence[Ranked]) -> str:
    """A ranking in one line, best first, with the scores."""
    return ", ".join(f"{r.name} {r.score:+.2f}" for r in ranking)


def plot_lags(curves: Mapping[str, LagCurve], path: Path) -> None:
    """The Lipschitz index over the number of lags, one line per target; a ring marks the chosen order."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogFormatter, MaxNLocator

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    for target, curve in curves.items():
        (line,) = axes.semilogy(curve.lags, curve.index, marker=".", label=target)
        at = int(np.searchsorted(curve.lags, curve.order()))
        axes.semilogy(curve.lags[at], curve.index[at], "o", mfc="none", ms=10, color=line.get_color())
    for of_axis in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        of_axis(LogFormatter(labelOnlyBase=False, minor_thresholds=(2.0, 0.5)))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("lags of output and inputs")
    axes.set_ylabel("Lipschitz index (scaled signals)")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    write_with(path, partial(figure.savefig, format="png", dpi=120))


def _learner(scenario: Scenario, row: str | None) -> EstimatorConfig:
    from testbed.data.registry import estimator_class

    able = [e for e in scenario.estimators if hasattr(estimator_class(e.name), "learning_data")]
    if not able:
        raise InputError(f"{scenario.source_path}: no estimator of this scenario has inputs to choose")
    if row is None:
        return able[0]
    for entry in able:
        if entry.row == row:
            return entry
    raise InputError(
        f"{scenario.name}: no estimator '{row}' with inputs to choose; {nearest(row, [e.row for e in able])}"
    )


def _write_tables(own: Folder, rankings: Mapping[str, Sequence[Ranked]], curves: Mapping[str, LagCurve]) -> None:
    import pandas as pd

    rows = [
        {
            "target": target,
            "rank": k,
            "input": r.name,
            "score": r.score,
            "relevance": r.relevance,
            "redundancy": r.redundancy,
        }
        for target, ranking in rankings.items()
        for k, r in enumerate(ranking, 1)
    ]
    own.write("ranking.csv", csv_text(pd.DataFrame(rows), float_format="%.6g").encode())
    lags = [
        {"target": target, "lags": int(lag), "index": index, "chosen": int(lag) == curve.order()}
        for target, curve in curves.items()
        for lag, index in zip(curve.lags, curve.index, strict=True)
    ]
    own.write("lags.csv", csv_text(pd.DataFrame(lags), float_format="%.6g").encode())
