"""Errors over time of single runs of a Monte Carlo: the best, the median and the worst by the report's main measure, and between.

Source: the series in ``runs/`` (at 1 Hz or slower), at the times of the envelopes. Metres, m/s, degrees, seconds.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from testbed.base.checksums import DamagedError
from testbed.montecarlo.store import decode, open_result
from testbed.report.headline import Headline
from testbed.report.results import Result

PLACES = {"best": 0.0, "lower quarter": 0.25, "median": 0.5, "upper quarter": 0.75, "worst": 1.0}
"""Where in the order of the winner's errors a run stands."""


def chosen(result: Result, lead: Headline) -> dict[str, int]:
    """Place in the order of the leading estimator's errors -> run; empty for fewer than two runs."""
    values = result.per_run([lead.metric], lead.window)
    ranked = values[values["estimator"] == lead.winner].dropna(subset=["value"]).sort_values(["value", "run"])
    if len(ranked) < 2:
        return {}
    found: dict[str, int] = {}
    for place, share in PLACES.items():
        run = int(ranked["run"].iloc[round(share * (len(ranked) - 1))])
        if run not in found.values():
            found[place] = run
    return found


def series(result: Result, run: int) -> dict[str, pd.DataFrame]:
    """Estimator -> ``time_s``, errors and their ``sigma_`` of a run; empty where its file is gone or damaged."""
    store = open_result(result.folder)
    path = store.run_path(run)
    times = {key: part["time_s"].to_numpy() for key, part in result.envelopes.groupby(["estimator", "quantity"])}
    if not path.is_file():
        return {}
    try:
        stored = decode(path, store.batch, run).series
    except (DamagedError, KeyError, ValueError):
        return {}
    columns: dict[str, dict[str, np.ndarray]] = {}
    for (estimator, quantity), values in stored.items():
        t = times.get((estimator, quantity.removeprefix("sigma_")))
        if t is not None and len(t) == len(values):
            columns.setdefault(estimator, {"time_s": t})[quantity] = values
    return {label: pd.DataFrame(columns[label]) for label in result.estimators if label in columns}


def views(result: Result, lead: Headline) -> Mapping[str, dict[str, pd.DataFrame]]:
    """``run 7, median`` -> errors of every estimator in that run."""
    found = {f"run {run}, {place}": series(result, run) for place, run in chosen(result, lead).items()}
    return {name: frames for name, frames in found.items() if frames}
