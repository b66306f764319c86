"""What the verbs of the command line do: glue between files, the Python API and the screen."""

from __future__ import annotations

import math
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.errors import InputError, TestbedError, nearest

if TYPE_CHECKING:
    import pandas as pd

    from testbed.scenario import Scenario

TABLE_METRICS = {
    "rmse_north_m": "north m",
    "rmse_east_m": "east m",
    "rmse_down_m": "down m",
    "rmse_position_3d_m": "3-D m",
    "rmse_velocity_3d_mps": "vel m/s",
    "rmse_roll_deg": "roll °",
    "rmse_pitch_deg": "pitch °",
    "rmse_yaw_deg": "yaw °",
}
MOVING_DPS = 2.0
"""Standard deviation of a gyro that no catalogue sensor reaches at rest, with noise of 2 °/√h at 200 Hz 0.5 °/s."""


def run(
    load: Callable[[Mapping[str, Any]], Scenario],
    out: Path | None,
    runs: str | None,
    estimators: str | None,
    sweep: list[str] | None,
    width: float,
    cap: int,
    report: bool = True,
    **options: Any,
) -> None:
    """``testbed run``: the Monte Carlo, the table on screen, the report. ``load`` makes the scenario from overrides."""
    import testbed.runner
    from testbed.report import render

    scenario = _choose_estimators(load({}), estimators)
    folder = out or Path("results") / scenario.name
    check_place(folder)
    count = testbed.runner.Auto(width, cap) if runs == "auto" else _run_count(runs)
    if sweep:
        _sweep(lambda point: _choose_estimators(load(point), estimators), sweep, folder, runs=count, **options)
        return
    with progress_line("runs") as tell:
        result = testbed.runner.run(scenario, folder, runs=count, progress=tell, **options)
    print_summary(scenario, result.summary, result.runs)
    sys.stdout.flush()
    print_failures(result.runs)
    if not result.claims.empty:
        print_claims(result.claims)
    if not (result.runs["status"] == "ok").any():
        raise TestbedError(f"{folder}: no estimator came to the end of a run")
    if report:
        render(folder)
    print(f"report: {folder / 'report.html'}" if report else f"tables: {folder}; the report: testbed report {folder}")


def _sweep(load: Callable[[Mapping[str, Any]], Scenario], grid: list[str], folder: Path, **options: Any) -> None:
    from testbed.sweep import parse_sweep
    from testbed.sweep import sweep as run_grid

    table = run_grid(load, dict(parse_sweep(text) for text in grid), folder, announce=_tell, **options)
    keys = list(table.columns[: len(grid)])
    rows = table[(table["window"] == "all") & (table["metric"] == "rmse_position_3d_m")]
    print(rows.pivot(index=keys, columns="estimator", values="mean").to_string(float_format=lambda v: f"{v:.4g}"))
    print(f"sweep: {folder / 'sweep.csv'} and {folder / 'sweep.png'}")


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _run_count(runs: str | None) -> int | None:
    if runs is None:
        return None
    if not runs.isdigit() or int(runs) < 1:
        raise InputError(f"--runs {runs}: expected a number of runs from 1, or 'auto'")
    return int(runs)


def _choose_estimators(scenario: Scenario, names: str | None) -> Scenario:
    """Keep the named rows; a name that is no row of the scenario but an estimator becomes a row with defaults."""
    if names is None:
        return scenario
    from testbed.registry import list_estimators
    from testbed.scenario import EstimatorConfig

    rows = {entry.row: entry for entry in scenario.estimators}
    chosen = []
    known = {*rows, *list_estimators()}
    for name in dict.fromkeys(part.strip() for part in names.split(",") if part.strip()):
        if name not in known:
            raise InputError(f"--estimators: unknown estimator '{name}'; {nearest(name, known)}")
        chosen.append(rows.get(name) or EstimatorConfig(name=name))
    if not chosen:
        raise InputError("--estimators: name at least one")
    kept = {entry.row for entry in chosen}
    claims = [claim for claim in scenario.claims if {claim.better, claim.than} <= kept]
    return scenario.model_copy(update={"estimators": chosen, "claims": claims})


@contextmanager
def progress_line(what: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar with rate and time left on a terminal; plain lines, one per tenth, elsewhere."""
    if sys.stderr.isatty():
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        columns = (
            TextColumn(what),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        from rich.console import Console

        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(what, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
        return
    import time

    start, told = time.monotonic(), -1

    def tell(done: int, total: int) -> None:
        nonlocal told
        tenth = 10 * done // max(total, 1)
        if tenth > told:
            told = tenth
            elapsed = time.monotonic() - start
            left = f", {elapsed / done * (total - done):.0f} s left" if done else ""
            print(f"{what}: {done} of {total}, {elapsed:.0f} s{left}", file=sys.stderr, flush=True)

    yield tell


def print_summary(scenario: Scenario, summary: pd.DataFrame, runs: pd.DataFrame) -> None:
    """The comparative RMSE table: mean over runs in the window ``all``, best of each column marked."""
    from rich.console import Console
    from rich.table import Table

    chosen = summary[(summary["window"] == "all") & summary["metric"].isin(list(TABLE_METRICS))]
    wide = chosen.pivot(index="estimator", columns="metric", values="mean")
    statuses = runs.groupby("estimator")["status"].agg(lambda s: int((s != "ok").sum()))
    table = Table(
        title=f"{scenario.scenario.title or scenario.name}: RMSE, mean of {runs['run'].nunique()} runs",
        title_justify="left",
    )
    table.add_column("estimator")
    columns = [metric for metric in TABLE_METRICS if metric in wide]
    for metric in columns:
        table.add_column(TABLE_METRICS[metric], justify="right")
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
        _tell(f"{estimator}: not ok in {len(rows)} of {total} runs; run {first['run']} {kind}{reason}")


def print_claims(claims: pd.DataFrame) -> None:
    """The claims with the paper's figure, ours and the verdict."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="Claims: improvement in %", title_justify="left")
    for column in ("claim", "paper", "measured", "95 % interval", "verdict"):
        table.add_column(column, justify="left" if column in ("claim", "verdict") else "right")
    for row in claims.to_dict("records"):
        measured, low, high = (_number(row[key], ".1f") for key in ("measured_pct", "ci_low", "ci_high"))
        table.add_row(
            row["text"] or row["id"], _number(row["paper_pct"], ".0f"), measured, f"{low} to {high}", row["verdict"]
        )
    Console(width=None if sys.stdout.isatty() else 140).print(table)


def _number(value: float | None, form: str) -> str:
    """A number for a table; a dash where there is none."""
    return "–" if value is None or value != value else format(value, form)


def check_place(out: Path) -> None:
    """Raise InputError where no folder ``out`` can be."""
    place = next((p for p in (out, *out.parents) if p.exists()), out)
    if place.exists() and not place.is_dir():
        raise InputError(f"{place}: is a file, not a folder for results; give another --out")


def check_free(out: Path) -> None:
    """Raise InputError where ``out`` is anything but a folder that can be made, or an empty one."""
    check_place(out)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: already exists and is not an empty folder; give another --out")


@contextmanager
def fresh_folder(out: Path) -> Iterator[Path]:
    """A temporary folder that takes the place of ``out`` at the end; on an error nothing half-written remains."""
    check_free(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        yield scratch
        scratch.chmod(0o777 & ~_umask())
        if out.exists():
            out.rmdir()
        os.replace(scratch, out)
    except BaseException:
        shutil.rmtree(scratch, ignore_errors=True)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def fly(scenario: Scenario, out: Path | None) -> None:
    """``testbed fly``."""
    from testbed import pipeline
    from testbed.formats import export_trajectory

    folder = out or Path("results") / f"{scenario.name}-flight"
    check_free(folder)
    trajectory = pipeline.fly(scenario)
    with fresh_folder(folder) as scratch:
        for kind, suffix in (("parquet", "parquet"), ("csv", "csv"), ("kml", "kml"), ("navego", "mat")):
            export_trajectory(trajectory, scratch / f"trajectory.{suffix}", kind)
    print(
        f"{trajectory.t[-1] - trajectory.t[0]:g} s in {len(trajectory.t)} samples, {len(trajectory.phases)} manoeuvres: {folder}"
    )


def sense(scenario: Scenario, out: Path | None) -> None:
    """``testbed sense``."""
    from testbed import pipeline
    from testbed.formats import export_log, export_trajectory

    folder = out or Path("results") / f"{scenario.name}-log"
    check_free(folder)
    trajectory = pipeline.fly(scenario)
    log, _ = pipeline.sense(scenario, trajectory)
    with fresh_folder(folder) as scratch:
        export_trajectory(trajectory, scratch / "trajectory.parquet", "parquet")
        log.save(scratch / "log")
        export_log(log, scratch / "csv", "csv", reference=trajectory)
        export_log(log, scratch / "mat", "navego", reference=trajectory)
    counts = ", ".join(f"{len(frame)} {name}" for name, frame in log.frames().items())
    print(f"{counts} samples: {folder}")


def allan(log: Path, out: Path | None) -> None:
    """``testbed allan``."""
    from testbed.records import SensorLog
    from testbed.sensors import allan as analysis

    folder = out or Path("results") / "allan"
    check_place(folder)
    read = SensorLog.load(log / "log" if (log / "log" / "imu.parquet").is_file() else log)
    table = analysis.analyse(read)
    if (spread := math.degrees(read.imu.gyro.std(axis=0).max())) > MOVING_DPS:
        _tell(f"{log}: the gyros vary by {spread:.2g} °/s, so it was not at rest; the figures are those of the motion")
    print(table.to_string(index=False, float_format=lambda value: f"{value:.4g}"))
    folder.mkdir(parents=True, exist_ok=True)
    table.to_csv(folder / "allan.csv", index=False)
    analysis.plot(read, folder / "allan.png")
    print(f"plot: {folder / 'allan.png'}")


IMPORTED = """# The imported recording as a scenario.
[scenario]
name = "{name}"

[recording]
format = "table"
dir = "table"

[[estimators]]
name = "ins"

[[estimators]]
name = "indirect-kf"
"""


def import_recording(format: str, files: list[Path], out: Path) -> None:
    """``testbed import``: the log for Python and ``allan``, and the same as tables with a scenario that runs on them."""
    from testbed.formats import export_log, import_log

    check_free(out)
    recording = import_log(format, files)
    with fresh_folder(out) as scratch:
        recording.log.save(scratch / "log")
        if recording.reference is not None:
            recording.reference.save(scratch / "reference.parquet")
            export_log(recording.log, scratch / "table", "parquet", reference=recording.reference)
            name = re.sub(r"[^A-Za-z0-9_.-]+", "-", out.resolve().name)
            (scratch / "scenario.toml").write_text(IMPORTED.format(name=name), encoding="utf-8")
    counts = ", ".join(f"{len(frame)} {name}" for name, frame in recording.log.frames().items())
    print(f"{counts} samples: {out}")
    if recording.reference is None:
        print("there is no reference trajectory to score against; the log can be used from Python")
    else:
        print(f"compare on it with: testbed run {out / 'scenario.toml'}")


def report(folders: list[Path], out: Path) -> None:
    """``testbed report``."""
    from testbed.report import render, render_index

    check_place(out)
    for folder in folders:
        if not (folder / "manifest.json").is_file():
            raise InputError(f"{folder}: no result of 'testbed run' (it has no manifest.json)")
    for folder in folders:
        render(folder)
        print(f"report: {folder / 'report.html'}")
    if len(folders) > 1:
        print(f"index: {render_index(folders, out)}")


def compare(old: Path, new: Path) -> int:
    """``testbed compare``: 1 when a metric got worse, else 0."""
    from testbed.compare import compare_results

    changes = compare_results(old, new)
    if changes.empty:
        print("no metric changed beyond its statistical error")
        return 0
    print(changes.to_string(index=False))
    return int((changes["verdict"] == "worse").any())


def show(what: str) -> None:
    """``testbed list``."""
    if what == "scenarios":
        from testbed.scenario import list_scenarios
        from testbed.schema import read_toml

        for name, path in list_scenarios().items():
            print(f"{name:20s} {read_toml(path).get('scenario', {}).get('title', '')}")
    elif what == "estimators":
        import inspect

        from testbed.registry import estimator_class, list_estimators

        for name in list_estimators():
            first = (inspect.getdoc(estimator_class(name)) or "").split("\n")[0]
            print(f"{name:14s} {first}")
    elif what == "aircraft":
        from testbed.flight import list_aircraft

        print("\n".join(list_aircraft()))
    elif what == "sensors":
        from testbed.sensors import list_sensors

        for kind, entries in list_sensors().items():
            for name, source in entries.items():
                print(f"{kind:5s} {name:14s} {source}")
    else:
        raise InputError(f"cannot list '{what}'; {nearest(what, ['scenarios', 'aircraft', 'sensors', 'estimators'])}")
