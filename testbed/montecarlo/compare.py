"""Regression between two results: which metrics changed beyond their statistical error, and which way.

Runs of the same flights, sensors and seed are paired (Student's t of the differences), others independent (Welch's t). The
p-values are corrected for the number of metrics with Holm's method, so an unchanged pair of results is called unchanged
in 95 % of all comparisons. Copies of a run are one run, and what one run alone shows to be changed is not tested. Lower is
better for every metric that is compared: all ``rmse_`` and the share of lost runs.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.errors import InputError
from testbed.montecarlo.store import Store, open_result, read_part
from testbed.scoring.effects import distinct_rows
from testbed.scoring.statistics import difference_interval, difference_p, holm
from testbed.scoring.verdicts import NOT_TESTED

if TYPE_CHECKING:
    import pandas as pd

ALPHA = 0.05
SMALLEST_PCT = 0.1
"""A change below this is the same, however certain: rounding of another order of operations is no regression."""
LOST = "lost_runs"
"""The compared share of runs that did not end ``ok``."""
MISSING = "missing"
METRICS = ("run", "estimator", "window", "metric", "value")
CELL = ["estimator", "window", "metric"]
COLUMNS = "estimator window metric old new change_pct ci_low ci_high p_value verdict".split()


def compare_results(old: str | Path, new: str | Path, smallest_pct: float = SMALLEST_PCT) -> pd.DataFrame:
    """The metrics that changed between two result folders, worst first: the rows of `compare_all` that are not the same."""
    table = compare_all(old, new, smallest_pct)
    changed = table[table["verdict"] != "same"]
    return changed.sort_values("change_pct", ascending=False, na_position="first", kind="stable").reset_index(drop=True)


def compare_all(old: str | Path, new: str | Path, smallest_pct: float = SMALLEST_PCT) -> pd.DataFrame:
    """Every compared metric with `COLUMNS`; ``ci_low`` and ``ci_high`` bound ``new - old``.

    ``verdict`` is same, better or worse, not tested where a single run differs, or missing for a row that the new result lacks.
    Raises InputError when a folder is no result, or the two are of different scenarios.
    """
    import pandas as pd

    stores = open_result(old), open_result(new)
    for store in stores:
        if not store.manifest.get("finished"):
            raise InputError(f"{store.out}: is not finished; complete it with the same testbed run and --resume")
    names = [store.manifest.get("scenario") for store in stores]
    if names[0] != names[1]:
        raise InputError(
            f"{old} is of the scenario '{names[0]}', {new} of '{names[1]}': only results of one scenario compare"
        )
    paired = _same_data(*stores)
    before, after = _values(stores, paired)
    rows: list[dict[str, Any]] = []
    for cell, a in before.items():
        row: dict[str, Any] = dict(zip(CELL, cell, strict=True))
        b = after.get(cell)
        rows.append(row | ({"old": float(a.mean()), "verdict": MISSING} if b is None else _change(a, b, paired)))
    table = pd.DataFrame(rows, columns=COLUMNS)
    p_values, change = table["p_value"].to_numpy(dtype=float), table["change_pct"].to_numpy(dtype=float)
    certain = holm(p_values) < ALPHA
    large = np.abs(change) > smallest_pct
    verdict = np.where(large & certain, np.where(change > 0, "worse", "better"), "same")
    verdict = np.where(large & np.isnan(p_values), NOT_TESTED, verdict)
    return table.assign(verdict=table["verdict"].where(table["verdict"].notna(), verdict))


def _change(a: pd.Series, b: pd.Series, paired: bool) -> dict[str, float]:
    """One metric's change; a and b are indexed by run."""
    if paired:
        common = a.index.intersection(b.index)
        a, b = a[common], b[common]
    x, y = a.to_numpy(dtype=float), b.to_numpy(dtype=float)
    if len(x) == 0 or len(y) == 0:
        return {"old": math.nan, "new": math.nan}
    old, new = float(x.mean()), float(y.mean())
    change = 100.0 * (new / old - 1.0) if old != 0.0 else math.copysign(math.inf, new) if new else 0.0
    out = {"old": old, "new": new, "change_pct": change}
    if min(len(x), len(y)) < 2:
        return out
    low, high = difference_interval(y, x, paired)
    return out | {"ci_low": low, "ci_high": high, "p_value": difference_p(y, x, paired)}


def _values(stores: Sequence[Store], paired: bool) -> list[dict[tuple[str, str, str], pd.Series]]:
    """Of each result the per-run values, indexed by run, of each metric that is compared; without copies of runs."""
    import pandas as pd

    found = []
    scores = [_scores(store) for store in stores]
    wide = [frame.pivot(index="run", columns=CELL, values="value") for frame in scores]
    copies = _copies(pd.concat(wide, axis=1, keys=range(len(wide)), join="outer")) if paired else []
    for store, frame, table in zip(stores, scores, wide, strict=True):
        runs = read_part(store, "runs.parquet", pd.read_parquet)
        _with_columns(runs, store, "runs", ("run", "estimator", "status"))
        lost = runs.assign(window="all", metric=LOST, value=(runs["status"] != "ok").astype(float))
        both = pd.concat([frame, lost[frame.columns]], ignore_index=True)
        both = both[~both["run"].isin(copies if paired else _copies(table))]
        groups = both.groupby(CELL, sort=False)
        found.append({(str(e), str(w), str(m)): part.set_index("run")["value"] for (e, w, m), part in groups})
    return found


def _scores(store: Store) -> pd.DataFrame:
    """Rows of ``metrics.parquet`` that are compared."""
    import pyarrow.compute as pc
    import pyarrow.dataset as ds

    rmse = pc.starts_with(ds.field("metric"), "rmse_")
    frame: pd.DataFrame = read_part(
        store, "metrics.parquet", lambda path: ds.dataset(path).to_table(filter=rmse).to_pandas()
    )
    return _with_columns(frame, store, "metrics", METRICS)


def _with_columns(table: pd.DataFrame, store: Store, name: str, needed: Sequence[str]) -> pd.DataFrame:
    """The table. Raises InputError where a column lacks."""
    if lacking := [column for column in needed if column not in table]:
        raise InputError(f"{store.out / name}.parquet: damaged (it has no column '{lacking[0]}')")
    return table


def _copies(table: pd.DataFrame) -> list[int]:
    """Runs (rows) with the scores of an earlier one to the bit."""
    kept = distinct_rows(table.to_numpy(dtype=float))
    return [int(run) for run in np.delete(table.index.to_numpy(), kept)]


def _same_data(old: Store, new: Store) -> bool:
    """Whether run k of both saw the same sensor data: same flight or recording, sensors, alignment, seed and variation."""

    def data(store: Store) -> dict[str, Any]:
        scenario = read_part(store, "scenario.toml", lambda path: tomllib.loads(path.read_text(encoding="utf-8")))
        settings = scenario.get("monte_carlo", {})
        if not isinstance(settings, dict):
            raise InputError(f"{store.out / 'scenario.toml'}: damaged ('monte_carlo' is no section)")
        drawn = {key: settings.get(key) for key in ("seed", "vary", "disperse")}
        return {key: scenario.get(key) for key in ("flight", "recording", "sensors", "initial")} | drawn

    return data(old) == data(new)
