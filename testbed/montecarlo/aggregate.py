"""From the files of the runs to the tables of a result: one pass in run order, memory independent of their number.

Writes ``metrics.parquet, runs.parquet, summary.csv, timings.csv, claims.csv, improvements.csv, consistency.csv,
envelopes.parquet``. All but the timings (and the seconds in ``runs.parquet``) are a pure function of scenario and seed.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from testbed.base.csv_text import csv_text
from testbed.base.files import writing
from testbed.data.records import Array
from testbed.montecarlo.store import SCRATCH, ColumnStore, Store, StoredRun, decode
from testbed.scenario import Scenario
from testbed.scoring import statistics, verdicts
from testbed.scoring.effects import effect
from testbed.scoring.quantities import AXES, IMPROVED, NEES, NIS, TIME_METRIC, is_consistency

if TYPE_CHECKING:
    import pyarrow as pa

FLOAT_FORMAT = "%.10g"
SETTLED_S = 30.0
"""Consistency is judged after this time, when a filter has settled (or after half of a shorter flight)."""
CSV_TABLES = ("summary", "timings", "claims", "improvements", "consistency")

_BLOCK_BYTES = 8_000_000
_BATCH_RUNS = 50

Cell = tuple[str, str, str]


@dataclass
class Tables:
    """The tables of a result as data frames."""

    summary: pd.DataFrame
    claims: pd.DataFrame
    runs: pd.DataFrame
    timings: pd.DataFrame
    improvements: pd.DataFrame
    consistency: pd.DataFrame


@dataclass
class _Pass:
    """What the one pass over the runs gathers."""

    cells: dict[Cell, int] = field(default_factory=dict)
    counted: list[int] = field(default_factory=list)
    """Numbers of the runs that are no copy of an earlier one: the rows of all statistics."""
    seen: set[bytes] = field(default_factory=set)
    runs: list[tuple[int, str, str, float, int, str]] = field(default_factory=list)
    tests: dict[tuple[str, str], statistics.ConsistencySum] = field(default_factory=dict)
    series: dict[tuple[str, str], int] = field(default_factory=dict)
    points: int = 0
    keys: pa.Table | None = None
    places: Array = field(default_factory=lambda: np.empty(0, dtype=int))
    """Columns of the cells ``keys`` of the latest run; most runs have the same."""


def aggregate(store: Store, scenario: Scenario, runs: Sequence[int], times: Array) -> Tables:
    """Write every table of the result. ``times`` are those of the envelopes."""
    store.forget(["claims-timings.csv"])
    written = [*(f"{name}.csv" for name in CSV_TABLES), "metrics.parquet", "runs.parquet", "envelopes.parquet"]
    store.claim([*written, *SCRATCH])
    values = ColumnStore(store.out / SCRATCH[0])
    series = ColumnStore(store.out / SCRATCH[1], np.float32)
    try:
        gathered = _gather(store, scenario, runs, values, series, len(times))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            tables = _tables(scenario, gathered, values, times)
            for name in CSV_TABLES:
                write_csv(store, f"{name}.csv", getattr(tables, name))
            pure, timed = _split_timed(tables.claims)
            write_csv(store, "claims.csv", pure)
            if len(timed):
                write_csv(store, "claims-timings.csv", timed)
            write_parquet(store, "runs.parquet", tables.runs)
            _write_envelopes(store, gathered, series, times)
    finally:
        values.close()
        series.close()
        store.forget(SCRATCH)
    return tables


def write_csv(store: Store, name: str, frame: pd.DataFrame) -> None:
    """Ten significant digits, so that equal numbers are equal bytes."""
    store.write(name, csv_text(frame, float_format=FLOAT_FORMAT, lineterminator="\n").encode())


def write_parquet(store: Store, name: str, frame: pd.DataFrame) -> None:
    """A data frame as a Parquet file of the folder."""
    store.write(name, frame.to_parquet(index=False))


def claim_values(store: Store, runs: Iterable[int], wanted: Iterable[Cell]) -> dict[Cell, Array]:
    """Per-run values of a few cells, read from the files of the runs."""
    cells = list(dict.fromkeys(wanted))
    columns: dict[Cell, list[float]] = {cell: [] for cell in cells}
    for run in runs:
        stored = decode(store.run_path(run), store.batch, run)
        found = dict(zip(_cells_of(stored), stored.values.tolist(), strict=True)) | _time_cells(stored)
        for cell in cells:
            columns[cell].append(found.get(cell, np.nan))
    return {cell: np.array(column) for cell, column in columns.items()}


def _cells_of(stored: StoredRun) -> list[Cell]:
    columns = (stored.keys[name].to_pylist() for name in ("estimator", "window", "metric"))
    return list(zip(*columns, strict=True))


def _time_cells(unit: StoredRun) -> dict[Cell, float]:
    return {
        (o.estimator, "all", TIME_METRIC): 1e6 * o.seconds / o.samples
        for o in unit.outcomes
        if o.status == "ok" and o.samples
    }


def _gather(
    store: Store, scenario: Scenario, runs: Sequence[int], values: ColumnStore, series: ColumnStore, points: int
) -> _Pass:
    import pyarrow as pa
    import pyarrow.parquet as pq

    out = _Pass(points=points)
    text = [(name, pa.string()) for name in ("estimator", "window", "metric")]
    schema = pa.schema([("run", pa.int64()), *text, ("value", pa.float64())])
    temporary = store.out / SCRATCH[2]
    with writing(store.out, store.again):
        with pq.ParquetWriter(temporary, schema) as writer:
            batch: list[pa.Table] = []
            for k, run in enumerate(runs, 1):
                stored = decode(store.run_path(run), store.batch, run)
                _take(stored, out, values, series)
                columns = [pa.array(np.full(len(stored.values), run)), *stored.keys.columns, pa.array(stored.values)]
                batch.append(pa.table(columns, schema=schema))
                if k % _BATCH_RUNS == 0 or k == len(runs):
                    writer.write_table(pa.concat_tables(batch).combine_chunks())
                    batch = []
        temporary.replace(store.out / "metrics.parquet")
    store.finish("metrics.parquet")
    return out


def _take(unit: StoredRun, out: _Pass, values: ColumnStore, series: ColumnStore) -> None:
    """Add one run to the columns and sums; of a copy of an earlier run only how it ended."""
    out.runs += [(unit.run, o.estimator, o.status, o.seconds, o.samples, o.reason) for o in unit.outcomes]
    if out.keys is None or not unit.keys.equals(out.keys):
        places = [out.cells.setdefault(cell, len(out.cells)) for cell in _cells_of(unit)]
        out.keys, out.places = unit.keys, np.array(places, dtype=int)
    if _is_copy(unit.values, out):
        return
    out.counted.append(unit.run)
    more: dict[Cell, float] = {(o.estimator, "all", "diverged"): float(o.status == "diverged") for o in unit.outcomes}
    more |= _time_cells(unit)
    extra = [out.cells.setdefault(cell, len(out.cells)) for cell in more]
    row = np.full(len(out.cells), np.nan)
    row[out.places] = unit.values
    row[extra] = list(more.values())
    values.append(row)
    wide = np.full((len(out.series) + len(unit.series), out.points), np.nan, dtype=np.float32)
    for (estimator, name), column in unit.series.items():
        if is_consistency(name):
            total = out.tests.setdefault((estimator, name), statistics.ConsistencySum.zero(out.points))
            parts = (column, unit.series[estimator, f"dof_{name}"], unit.series[estimator, f"count_{name}"])
            total.add(*(_fit(part, out.points) for part in parts))
        elif not name.startswith(("dof_", "count_")):
            wide[out.series.setdefault((estimator, name), len(out.series))] = _fit(column, out.points)
    series.append(wide[: len(out.series)].ravel())


def _is_copy(values: Array, out: _Pass) -> bool:
    """Whether a run has the scores of an earlier one to the bit, as all runs of a recording have: it is then no further sample.

    A run that nobody finished has no scores to compare, and counts.
    """
    if not len(values):
        return False
    digest = hashlib.sha256(out.places.tobytes() + values.tobytes()).digest()
    known = digest in out.seen
    out.seen.add(digest)
    return known


def _fit(column: Array, points: int) -> Array:
    """A series cut or filled to the number of times; flights of different length have different ones."""
    if len(column) >= points:
        return column[:points]
    return np.concatenate([column, np.full(points - len(column), np.nan, dtype=column.dtype)])


def _tables(scenario: Scenario, gathered: _Pass, values: ColumnStore, times: Array) -> Tables:
    seed = scenario.monte_carlo.seed
    rows = [entry.row for entry in scenario.estimators]

    def column(estimator: str, window: str, metric: str) -> Array | None:
        k = gathered.cells.get((estimator, window, metric))
        return None if k is None else values.columns(k, k + 1)[:, 0]

    runs = pd.DataFrame(gathered.runs, columns=["run", "estimator", "status", "seconds", "samples", "reason"])
    tested = verdicts.check_claims(scenario.active_claims(), column, seed, gathered.counted)
    return Tables(
        summary=_summary(gathered, values, rows, seed),
        claims=pd.DataFrame(tested, columns=verdicts.COLUMNS),
        runs=runs,
        timings=_timings(runs, rows),
        improvements=_improvements(gathered, column, rows, seed),
        consistency=_consistency(gathered, rows, times),
    )


def _summary(gathered: _Pass, values: ColumnStore, rows: list[str], seed: int) -> pd.DataFrame:
    """Every cell but the computation time, described; estimators in the scenario's order, windows and metrics as they came."""
    total = len(gathered.cells)
    width = max(1, min(_BLOCK_BYTES // (8 * max(1, len(values))), _BLOCK_BYTES // (8 * statistics.DRAWS)))
    parts = [statistics.describe(values.columns(k, min(k + width, total)), seed) for k in range(0, total, width)]
    keys = pd.DataFrame(list(gathered.cells), columns=["estimator", "window", "metric"])
    described = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}
    frame = keys.assign(**described)
    windows = {window: k for k, window in enumerate(dict.fromkeys(keys["window"]))}
    metrics = {metric: k for k, metric in enumerate(dict.fromkeys(keys["metric"]))}
    frame = frame[frame["metric"] != TIME_METRIC]
    order = [frame["estimator"].map(rows.index), frame["window"].map(windows), frame["metric"].map(metrics)]
    return frame.iloc[np.lexsort([key.to_numpy() for key in reversed(order)])].reset_index(drop=True)


def _timings(runs: pd.DataFrame, rows: list[str]) -> pd.DataFrame:
    """µs per IMU sample of the runs that were finished; an estimator that finished none has no row."""
    done = runs[(runs["status"] == "ok") & (runs["samples"] > 0)]
    out = []
    for row in rows:
        part = done[done["estimator"] == row]
        if part.empty:
            continue
        cost = 1e6 * part["seconds"] / part["samples"]
        samples = int(part["samples"].median())
        out.append({"estimator": row, "samples": samples, "median_us": cost.median(), "min_us": cost.min()})
    return pd.DataFrame(out, columns=["estimator", "samples", "median_us", "min_us"])


def _improvements(gathered: _Pass, column: verdicts.Values, rows: list[str], seed: int) -> pd.DataFrame:
    """Each estimator against the first one of the scenario: `quantities.IMPROVED` in every window that both have."""
    out = []
    for window in dict.fromkeys(window for _, window, _ in gathered.cells):
        for metric in IMPROVED:
            baseline = column(rows[0], window, metric)
            for row in rows[1:]:
                own = column(row, window, metric)
                measured = effect(own, baseline, seed) if own is not None and baseline is not None else None
                if measured is not None:
                    numbers = (measured.percent, measured.low, measured.high, measured.p_value, measured.n)
                    out.append((row, rows[0], window, metric, *numbers))
    columns = "estimator baseline window metric improvement_pct ci_low ci_high p_value n".split()
    return pd.DataFrame(out, columns=columns)


def _consistency(gathered: _Pass, rows: list[str], times: Array) -> pd.DataFrame:
    """Run-averaged NEES and NIS over time against their chi-square bounds."""
    settled = min(SETTLED_S, 0.5 * float(times[-1])) if len(times) else 0.0
    out: list[dict[str, Any]] = []
    for row in rows:
        names = [name for estimator, name in gathered.tests if estimator == row]
        for name in sorted(names, key=lambda name: [*NEES, NIS, name].index(name)):
            out.append({"estimator": row, "quantity": name} | gathered.tests[row, name].summary(times, settled))
    columns = "estimator quantity dof n_runs mean lower upper share_inside".split()
    return pd.DataFrame(out, columns=columns)


def _write_envelopes(store: Store, gathered: _Pass, series: ColumnStore, times: Array) -> None:
    """``envelopes.parquet``, one quantity of one estimator at a time, in blocks of times."""
    points, frames = gathered.points, []
    width = max(1, _BLOCK_BYTES // (8 * max(1, len(series))))
    for (estimator, quantity), k in gathered.series.items():
        if quantity not in AXES:
            continue
        s = gathered.series.get((estimator, f"sigma_{quantity}"))
        parts = []
        for a in range(0, points, width):
            b = min(a + width, points)
            sigma = None if s is None else series.columns(s * points + a, s * points + b)
            parts.append(statistics.envelope(series.columns(k * points + a, k * points + b), sigma))
        data = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        frames.append(pd.DataFrame({"estimator": estimator, "time_s": times, "quantity": quantity} | data))
    columns = "estimator time_s quantity mean p05 p95 rms sigma".split()
    write_parquet(
        store, "envelopes.parquet", pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=columns)
    )


def _split_timed(frame: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Claims on computation time stand apart: they are no pure function of scenario and seed."""
    timed = frame["metric"] == TIME_METRIC
    return frame[~timed], frame[timed]
