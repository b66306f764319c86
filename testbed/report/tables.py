"""The report's tables as plain values: one `Table` each, rendered alike by page, Markdown and LaTeX, so that the numbers agree.

Means and 95 % intervals come from ``summary.csv``, verdicts from ``claims.csv``; nothing is estimated again here.
Units stand in the column heads.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

from testbed.report.labels import MISSING, number, percent, verdict_kind, window_label
from testbed.report.results import Result
from testbed.scoring.quantities import COMPARED, TIME_METRIC, metric_label, quantity_label, short_label, unit

NOT_PRINTED = -1
"""Stands in a scenario's table where the paper has no figure."""
REASONS = 4
"""Most frequent reasons shown per estimator."""
COSTS = (TIME_METRIC, "seconds")


@dataclass(frozen=True)
class Column:
    """Head of a column: ``label``, ``unit``, the ``group`` that spans neighbours, and the long ``title``."""

    label: str
    unit: str = ""
    group: str = ""
    title: str = ""
    numeric: bool = True


@dataclass(frozen=True)
class Cell:
    """``text`` as printed, ``value`` to sort by, ``interval`` in words, ``best`` of its column, verdict ``kind``."""

    text: str
    value: float | None = None
    interval: str = ""
    best: bool = False
    kind: str = ""


@dataclass(frozen=True)
class Table:
    """``rows`` are (name, cells). ``corner`` heads the column of names."""

    key: str
    title: str
    columns: list[Column]
    rows: list[tuple[str, list[Cell]]]
    note: str = ""
    corner: str = "Estimator"


def comparison(result: Result, window: str) -> Table:
    """One row per estimator, one column per error measure: mean over the runs, its 95 % interval, best of each column."""
    metrics = [m for m in COMPARED if any(_finite(_lookup(result, window, m, e, "mean")) for e in result.estimators)]
    best = {m: _best(result, window, m) for m in metrics}
    rows = []
    for label in result.estimators:
        rows.append((label, [_mean_cell(result, window, m, label, best[m]) for m in metrics]))
    columns = [Column(short_label(m), unit(m), title=metric_label(m)) for m in metrics]
    counts = sorted({int(n) for n in result.summary.loc[result.summary["window"] == window, "n"].dropna()})
    over = (
        f"{counts[0]} to {counts[-1]} runs"
        if len(counts) > 1
        else f"{counts[0]} run{'s' * (counts[0] != 1)}"
        if counts
        else "no runs"
    )
    note = (
        f"RMSE ({window_label(window)}) unless the head says otherwise: mean over {over}. Best of each column in bold."
    )
    if window == "all":
        note += "".join(f" Note: {sentence}." for sentence in result.notes)
    return Table(f"comparison-{window}", f"Errors, {window_label(window)}", columns, rows, note)


def claims(result: Result) -> list[Table]:
    """The source's claims and, apart, our own: the stated figure, ours with its interval, and the verdict."""
    own = result.claims["origin"] == "own"
    parts = (("claims", "Claims", result.claims[~own]), ("claims-own", "Our own claims", result.claims[own]))
    return [_claims_table(result, key, title, part.to_dict("records")) for key, title, part in parts if len(part)]


def _claims_table(result: Result, key: str, title: str, rows: list[dict[Any, Any]]) -> Table:
    columns = [
        Column("Claim", numeric=False),
        Column("Stated", "%", title="Improvement that the source states, or the margin of an equality claim"),
        Column("Measured", "%", title="Improvement measured here: ratio of means"),
        Column("95 % interval", "%", numeric=False),
        Column("Median", "%", title="The same from the median of the paired ratios"),
        Column("Runs", title="Paired runs"),
        Column("p", title="Corrected for the number of claims (Holm)"),
        Column("Verdict", numeric=False),
    ]
    cells = [(str(row["id"]), claim_cells(row)) for row in rows]
    note = [
        "Improvement: by how many percent the first method's error is lower; negative means higher. Runs are paired by seed; "
        f"intervals cover {'flights and seeds' if result.flights_vary else 'seeds of one flight' if result.flown else 'runs'}.",
        *(told for row in rows if (told := _uneven(row))),
    ]
    return Table(key, title, columns, cells, " ".join(note), corner="No.")


def claim_cells(claim: Mapping[Any, Any]) -> list[Cell]:
    """Text, stated figure, effect, interval, median, runs, p-value and verdict of a row of ``claims.csv``."""
    margin, p_value = _value(claim["margin_pct"]), _value(claim["p_holm"])
    verdict = str(claim["verdict"]) if isinstance(claim["verdict"], str) else "not tested"
    stated = percent(claim["paper_pct"]) if margin is None else f"equal ± {margin:g}"
    return [
        Cell(str(claim["text"])),
        Cell(stated, _value(claim["paper_pct"])),
        Cell(percent(claim["measured_pct"]), _value(claim["measured_pct"])),
        Cell(_interval(claim["ci_low"], claim["ci_high"], percent) or MISSING),
        Cell(percent(claim["median_pct"]), _value(claim["median_pct"])),
        Cell(f"{_value(claim['n']) or 0:.0f}", _value(claim["n"])),
        Cell("< 0.001" if p_value is not None and p_value < 0.001 else number(p_value, 2), p_value),
        Cell(verdict, kind=verdict_kind(verdict)),
    ]


def _uneven(claim: Mapping[Any, Any]) -> str:
    """What a claim's means hide: runs far above all others, and runs that one of the two lost."""
    runs = claim["runaways"].split() if isinstance(claim["runaways"], str) else []
    without = f" (without: {percent(claim['trimmed_pct'])} %)"
    parts = [f"run{'s' * (len(runs) > 1)} {', '.join(runs)} far above all others{without}"] if runs else []
    for side in ("better", "than"):
        if lost := int(_value(claim[f"lost_{side}"]) or 0):
            parts.append(f"{lost} run{'s' * (lost > 1)} lost by {claim[side]}")
    return f"{claim['id']}: {'; '.join(parts)}." if parts else ""


def paper_tables(result: Result) -> list[Table]:
    """The paper's own tables, its numbers beside ours (``[[tables]]`` of the scenario)."""
    return [_paper_table(result, k, spec) for k, spec in enumerate(result.scenario.get("tables", []), start=1)]


def _paper_table(result: Result, index: int, spec: Mapping[str, Any]) -> Table:
    estimators = [str(c) for c in spec.get("columns", [])]
    statistic = str(spec.get("statistic", "mean"))
    columns = [Column(side, group=head) for head in estimators for side in ("paper", "ours")]
    rows = []
    for row in spec.get("rows", []):
        cells: list[Cell] = []
        window = str(row.get("window") or spec.get("window", "all"))
        for printed, estimator in zip_longest(row.get("paper", [])[: len(estimators)], estimators):
            known = None if printed == NOT_PRINTED else printed
            cells += [Cell(number(known, 4), _value(known)), _measured(result, window, row, estimator, statistic)]
        name = str(row.get("name", row.get("metric", "")))
        rows.append((f"{name}, {row['unit']}" if row.get("unit") else name, cells))
    text = f"Ours: {statistic} over {result.replications} run{'s' * (result.replications != 1)} with its 95 % interval."
    note = " ".join(filter(None, (str(spec.get("note", "")), text)))
    return Table(
        f"paper-{index}", str(spec.get("title", f"Table {index} of the paper")), columns, rows, note, corner=""
    )


def _measured(result: Result, window: str, row: Mapping[str, Any], estimator: str, statistic: str) -> Cell:
    metric, scale = str(row.get("metric", "")), float(row.get("scale", 1.0))
    if metric in COSTS:
        value = scale * _cost(result, metric, estimator)
        return Cell(number(value), _value(value))
    wanted = (statistic, "ci_low", "ci_high")
    value, low, high = (scale * _lookup(result, window, metric, estimator, column) for column in wanted)
    return Cell(number(value), _value(value), _interval(low, high) if statistic == "mean" else "")


def _cost(result: Result, metric: str, estimator: str) -> float:
    found = result.timings[result.timings["estimator"] == estimator]
    if found.empty:
        return math.nan
    median = float(found["median_us"].iloc[0])
    return median if metric == TIME_METRIC else 1e-6 * median * float(found["samples"].iloc[0])


def timings(result: Result) -> Table | None:
    """Computation time per IMU sample and against real time."""
    if result.timings.empty:
        return None
    columns = [
        Column("Median", "µs", title="Median time per IMU sample"),
        Column("Fastest", "µs", title="Fastest run, per IMU sample"),
        Column("Samples", "", title="IMU samples per run"),
        Column("One run", "s", title="Median time of a run"),
    ]
    fastest = result.timings["median_us"].min()
    rows = []
    for label in result.estimators:
        for r in result.timings[result.timings["estimator"] == label].to_dict("records"):
            whole = r["median_us"] * r["samples"] * 1e-6
            cells = [
                Cell(number(r["median_us"]), _value(r["median_us"]), best=r["median_us"] == fastest),
                Cell(number(r["min_us"]), _value(r["min_us"])),
                Cell(f"{int(r['samples']):,}".replace(",", "\u202f"), _value(r["samples"])),
                Cell(number(whole), _value(whole)),
            ]
            rows.append((label, cells))
    return Table(
        "timings",
        "Computation time",
        columns,
        rows,
        "Time spent inside the estimator on this machine, one thread; of one that takes several runs side by side, each run's share.",
    )


def consistency(result: Result) -> Table | None:
    """NEES and NIS: mean over runs and time, expected value, and the share of time inside the chi-square bounds."""
    frame = result.consistency.dropna(subset=["mean"])
    if frame.empty:
        return None
    quantities = list(dict.fromkeys(frame["quantity"]))
    kinds = frame.groupby("quantity")["dof"].nunique()
    columns = []
    for quantity in quantities:
        expected = {f"{dof:.3g}" for dof in frame.loc[frame["quantity"] == quantity, "dof"]}
        group = f"{quantity_label(quantity)} (expect {expected.pop() if len(expected) == 1 else 'as stated'})"
        columns += [
            Column("mean", group=group),
            Column("inside", "%", group=group, title="Share of time inside the bounds"),
        ]
    rows = []
    records = {(r["estimator"], r["quantity"]): r for r in frame.to_dict("records")}
    for label in result.estimators:
        cells: list[Cell] = []
        for quantity in quantities:
            found = records.get((label, quantity))
            r = found or {}
            of = f"expect {r['dof']:.3g}, " if found and kinds[quantity] > 1 else ""
            bounds = f"{of}bounds {number(r['lower'])} to {number(r['upper'])}" if found else ""
            share = 100.0 * float(r.get("share_inside", math.nan))
            cells += [Cell(number(r.get("mean")), _value(r.get("mean")), bounds), Cell(percent(share), _value(share))]
        if any(c.value is not None for c in cells):
            rows.append((label, cells))
    note = (
        "An honest filter's mean equals the expected value; above it the filter is overconfident, below it too cautious. "
        "“Inside”: share of the time that the average over the runs lies in its 95 % chi-square bounds."
    )
    return Table("consistency", "Consistency", columns, rows, note)


def failures(result: Result) -> Table | None:
    """Runs that diverged or failed, counted by reason; None when all went well."""
    if result.runs.empty:
        return None
    bad = result.runs[result.runs["status"] != "ok"]
    if bad.empty:
        return None
    # the status of a failed run repeats the reason
    words = bad["status"].astype(str).str.partition(":")[0] + bad["reason"].map(
        lambda reason: f": {reason}" if isinstance(reason, str) and reason else ""
    )
    counts = words.groupby([bad["estimator"], words], sort=False).size()
    most = counts.groupby(level=0, sort=False).head(REASONS)
    rows = [
        (str(e), [Cell(str(what)), Cell(str(n), float(n))])
        for (e, what), n in zip(most.index.to_list(), most, strict=True)
    ]
    columns = [Column("What happened", numeric=False), Column("Runs")]
    more = len(counts) - len(most)
    note = f"Of {result.run_count} runs. A lost run is left out of that estimator's means."
    note += f" {more} rarer reasons are not shown." if more else ""
    return Table("failures", "Runs that diverged or failed", columns, rows, note)


def _mean_cell(result: Result, window: str, metric: str, estimator: str, best: str) -> Cell:
    mean, low, high = (_lookup(result, window, metric, estimator, c) for c in ("mean", "ci_low", "ci_high"))
    return Cell(number(mean), _value(mean), _interval(low, high), best=number(mean) == best)


def _lookup(result: Result, window: str, metric: str, estimator: str, column: str) -> float:
    return result.means.get((window, metric, estimator), {}).get(column, math.nan)


def _best(result: Result, window: str, metric: str) -> str:
    """The lowest mean as printed, so that equal figures are marked alike; empty where there is nothing to compare."""
    means = [v for e in result.estimators if math.isfinite(v := _lookup(result, window, metric, e, "mean"))]
    return number(min(means)) if len(means) > 1 else ""


def _interval(low: object, high: object, form: Any = number) -> str:
    return f"{form(low)} to {form(high)}" if _finite(low) and _finite(high) else ""


def _finite(value: object) -> bool:
    return _value(value) is not None


def _value(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return float(value) if math.isfinite(value) else None
