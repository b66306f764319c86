"""What a verb shows: the progress of long work on stderr, tables of results on stdout. Units are in the column heads."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from testbed.base.errors import tell_user
from testbed.scoring.quantities import COMPARED, short_label, unit

if TYPE_CHECKING:
    import pandas as pd

    from testbed.scenario import Scenario

LEFT_OUT = ("rmse_attitude_deg",)
"""Compared in reports, not on a narrow screen."""
LEAST_SPAN_S = 1.0
"""Time from which on a rate is one: runs that are filtered side by side are all done at once."""
SHOWN = {metric: f"{short_label(metric)} {unit(metric)}" for metric in COMPARED if metric.startswith("rmse_")}
TABLE_METRICS = {metric: label for metric, label in SHOWN.items() if metric not in LEFT_OUT}


def usable_streams() -> None:
    """Make stdout and stderr take any text: closed ones swallow it, characters beyond their encoding are escaped.

    Names of files may hold bytes that are no text, and a terminal may know ASCII only.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


@contextmanager
def progress_line(what: str, note: Callable[[], str] = str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar with rate, time left and ``note()`` on a terminal; plain lines, one per tenth, elsewhere."""
    if sys.stderr.isatty():
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            ProgressColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )
        from rich.text import Text

        class NoteColumn(ProgressColumn):
            def render(self, task: Any) -> Text:
                return Text(note())

        columns = (
            TextColumn(what),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            NoteColumn(),
        )
        from rich.console import Console

        bar = Progress(*columns, console=Console(stderr=True), transient=True)
        task = bar.add_task(what, total=None)

        def show(done: int, total: int) -> None:
            bar.start()  # only now: workers are copies of a process without threads, and the bar has one
            bar.update(task, completed=done, total=total)

        try:
            yield show
        finally:
            bar.stop()
        return
    import time

    start, told = time.monotonic(), -1
    first: tuple[float, int] | None = None  # when the first ones were done: before, filters are compiled

    def tell(done: int, total: int) -> None:
        nonlocal told, first
        if first is None and done:
            first = time.monotonic(), done
        tenth = 10 * done // max(total, 1)
        if tenth > told:
            told = tenth
            elapsed = time.monotonic() - start
            since, before = first or (start, 0)
            span = time.monotonic() - since
            known = span >= LEAST_SPAN_S and before < done < total
            left = f", {max(1.0, (total - done) * span / (done - before)):.0f} s left" if known else ""
            print(f"{what}: {done} of {total}, {elapsed:.0f} s{left}", file=sys.stderr, flush=True)

    yield tell


def print_summary(scenario: Scenario, summary: pd.DataFrame, runs: pd.DataFrame, near_pole: bool = False) -> None:
    """The comparative RMSE table: mean over runs in the window ``all``, best of each column marked.

    ``near_pole``: with the attitude error as one rotation, where Euler angles say little.
    """
    from rich.console import Console
    from rich.table import Table

    chosen = summary[(summary["window"] == "all") & summary["metric"].isin(list(SHOWN if near_pole else TABLE_METRICS))]
    wide = chosen.pivot(index="estimator", columns="metric", values="mean")
    statuses = runs.groupby("estimator")["status"].agg(lambda s: int((s != "ok").sum()))
    counted, made = int(summary["n"].max() or 0), runs["run"].nunique()
    several = f"mean of {counted} runs" if counted != 1 or made == 1 else "one run"
    table = Table(
        title=f"{scenario.scenario.title or scenario.name}: RMSE, {several}, whole flight",
        title_justify="left",
    )
    table.add_column("estimator")
    columns = [metric for metric in SHOWN if metric in wide]
    for metric in columns:
        table.add_column(SHOWN[metric], justify="right")
    table.add_column("failed", justify="right")
    best = wide.min()
    for entry in scenario.estimators:
        cells = [entry.row]
        for metric in columns:
            value = wide[metric].get(entry.row)
            text = _number(value, ".4g")
            cells.append(f"[bold]{text}[/bold]" if value == best[metric] else text)
        table.add_row(*cells, str(int(statuses.get(entry.row, 0))))
    Console(width=None if sys.stdout.isatty() else 140).print(table)


def print_failures(runs: pd.DataFrame) -> None:
    """For each estimator that did not always arrive: in how many runs, and why (the reason of the first)."""
    lost = runs[runs["status"] != "ok"]
    for estimator, rows in lost.groupby("estimator", sort=False):
        first = rows.iloc[0]
        kind = first["status"].partition(":")[0]
        reason = f": {first['reason']}" if first["reason"] else ""
        total = (runs["estimator"] == estimator).sum()
        tell_user(f"{estimator}: not ok in {len(rows)} of {total} runs; run {first['run']} {kind}{reason}")


def print_claims(claims: pd.DataFrame) -> None:
    """The claims with the stated figure, ours and the verdict; a source's and our own apart."""
    from rich.console import Console
    from rich.table import Table

    for origin, title in (("paper", "Claims"), ("own", "Our own claims")):
        rows = claims[claims["origin"] == origin].to_dict("records")
        table = Table(title=f"{title}: improvement in %", title_justify="left")
        for column in ("claim", "stated", "measured", "95 % interval", "median", "verdict"):
            table.add_column(column, justify="left" if column in ("claim", "verdict") else "right")
        for row in rows:
            stated = f"equal ± {row['margin_pct']:g}" if row["kind"] == "equal" else _number(row["paper_pct"], ".0f")
            measured, low, high, median = (
                _number(row[key], ".1f") for key in ("measured_pct", "ci_low", "ci_high", "median_pct")
            )
            interval = "–" if low == high == "–" else f"{low} to {high}"
            table.add_row(row["text"] or row["id"], stated, measured, interval, median, row["verdict"])
        if rows:
            Console(width=None if sys.stdout.isatty() else 140).print(table)


def _number(value: float | None, form: str) -> str:
    """A number for a table; a dash where there is none."""
    return "–" if value is None or value != value else format(value, form)
