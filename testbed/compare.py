"""Regression between two results: which metrics changed beyond their statistical error, and which way.

Runs of the same flights, sensors and seed are paired (Wilcoxon signed-rank), others independent (Welch's t-test). The
p-values are corrected for the number of metrics with Holm's method, so an unchanged pair of results is called unchanged
in 95 % of all comparisons. Lower is better for every metric that is compared: all ``rmse_`` and the share of lost runs.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.errors import InputError
from testbed.records import Array
from testbed.statistics import difference_interval, signed_rank
from testbed.store import Store, open_result, read_part

if TYPE_CHECKING:
    import pandas as pd

ALPHA = 0.05
SMALLEST_PCT = 0.1
"""A change below this is the same, however certain: rounding of another order of operations is no regression."""
LOST = "lost_runs"
"""The compared share of runs that did not end ``ok``."""
MISSING = "missing"
METRICS = ("run", "estimator", "window", "metric", "value")
COLUMNS = "estimator window metric old new change_pct ci_low ci_high p_value verdict".split()


def compare_results(old: str | Path, new: str | Path, smallest_pct: float = SMALLEST_PCT) -> pd.DataFrame:
    """The metrics that changed between two result folders, worst first: the rows of `compare_all` that are not the same."""
    table = compare_all(old, new, smallest_pct)
    changed = table[table["verdict"] != "same"]
    return changed.sort_values("change_pct", ascending=False, na_position="first", kind="stable").reset_index(drop=True)


def compare_all(old: str | Path, new: str | Path, smallest_pct: float = SMALLEST_PCT) -> pd.DataFrame:
    """Every compared metric with `COLUMNS`; ``ci_low`` and ``ci_high`` bound ``new - old``.

    ``verdict`` is same, better or worse, or missing for a row that the new result lacks. Raises InputError when a folder is no
    result, or the two are of different scenarios.
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
    before, after = (_values(store) for store in stores)
    rows: list[dict[str, Any]] = []
    for cell, a in before.items():
        row: dict[str, Any] = dict(zip(("estimator", "window", "metric"), cell, strict=True))
        b = after.get(cell)
        rows.append(row | ({"old": float(a.mean()), "verdict": MISSING} if b is None else _change(a, b, paired)))
    table = pd.DataFrame(rows, columns=COLUMNS)
    p_values, change = table["p_value"].to_numpy(dtype=float), table["change_pct"].to_numpy(dtype=float)
    certain = holm(p_values) < ALPHA
    exact = paired & np.isnan(p_values)  # a single run of the same data leaves nothing to chance
    moved = (np.abs(change) > smallest_pct) & (certain | exact)
    verdict = np.where(moved, np.where(change > 0, "worse", "better"), "same")
    return table.assign(verdict=table["verdict"].where(table["verdict"].notna(), verdict))


def holm(p_values: Array) -> Array:
    """Holm's step-down adjusted p-values; NaN stays NaN and does not count."""
    out = np.full(len(p_values), np.nan)
    known = np.flatnonzero(np.isfinite(p_values))
    order = known[np.argsort(p_values[known], kind="stable")]
    factors = len(order) - np.arange(len(order))
    out[order] = np.minimum(1.0, np.maximum.accumulate(p_values[order] * factors))
    return out


def _change(a: pd.Series, b: pd.Series, paired: bool) -> dict[str, float]:
    """One metric's change; a and b are indexed by run."""
    from scipy.stats import ttest_ind

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
    equal = np.array_equal(x, y) or (np.ptp(x) == 0.0 and np.ptp(y) == 0.0 and old == new)
    p_value = 1.0 if equal else signed_rank(y, x) if paired else float(ttest_ind(y, x, equal_var=False).pvalue)
    return out | {"ci_low": low, "ci_high": high, "p_value": p_value}


def _values(store: Store) -> dict[tuple[str, str, str], pd.Series]:
    """Per-run values, indexed by run, of each metric that is compared."""
    import pandas as pd
    import pyarrow.compute as pc
    import pyarrow.dataset as ds

    rmse = pc.starts_with(ds.field("metric"), "rmse_")
    frame = read_part(store, "metrics.parquet", lambda path: ds.dataset(path).to_table(filter=rmse).to_pandas())
    runs = read_part(store, "runs.parquet", pd.read_parquet)
    for name, table, needed in (("metrics", frame, METRICS), ("runs", runs, ("run", "estimator", "status"))):
        if lacking := [column for column in needed if column not in table]:
            raise InputError(f"{store.out / name}.parquet: damaged (it has no column '{lacking[0]}')")
    lost = runs.assign(window="all", metric=LOST, value=(runs["status"] != "ok").astype(float))
    both = pd.concat([frame, lost[frame.columns]], ignore_index=True)
    return {
        (str(e), str(w), str(m)): part.set_index("run")["value"]
        for (e, w, m), part in both.groupby(["estimator", "window", "metric"], sort=False)
    }


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
