"""What the smaller verbs of the command line do: glue between files, the Python API and the screen."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.errors import InputError, MissingExtra, tell_user
from testbed.base.files import check_place
from testbed.cli.console import progress_line
from testbed.cli.outputs import check_free, fresh_folder
from testbed.cli.run import run_count
from testbed.montecarlo.folders import Folder, check_own

if TYPE_CHECKING:
    from testbed.data.records import SensorLog
    from testbed.scenario import Scenario

MOVING_DPS = 2.0
"""Standard deviation of a gyro that no catalogue sensor reaches at rest, with noise of 2 °/√h at 200 Hz 0.5 °/s."""


def fly(scenario: Scenario, out: Path | None) -> None:
    """``testbed fly``."""
    from testbed import pipeline
    from testbed.formats import export_trajectory

    folder = out or Path("results") / f"{scenario.name}-flight"
    check_free(folder)
    trajectory = pipeline.fly(scenario)
    with fresh_folder(folder) as scratch:
        for kind, suffix in (("parquet", "parquet"), ("csv", "csv"), ("kml", "kml"), ("navego", "mat")):
            try:
                export_trajectory(trajectory, scratch / f"trajectory.{suffix}", kind)
            except MissingExtra as missing:
                tell_user(f"note: trajectory.{suffix} is left out: {missing}")
    print(
        f"{trajectory.t[-1] - trajectory.t[0]:g} s in {len(trajectory.t)} samples, {len(trajectory.phases)} manoeuvres: {folder}"
    )


def sense(scenario: Scenario, out: Path | None, runs: str | None = None) -> None:
    """``testbed sense``."""
    folder = out or Path("results") / f"{scenario.name}-log{'' if runs is None else 's'}"
    check_free(folder)
    if (count := run_count(runs)) is not None:
        from testbed.montecarlo.external import ANSWERS, run_name, write_logs
        from testbed.scenario import check_once

        check_once(scenario.settings, "monte_carlo.runs", "--runs")

        with fresh_folder(folder) as scratch, progress_line("logs") as show:
            counts = write_logs(scenario, scratch, count, show)
        print(f"{', '.join(f'{n} {kind}' for kind, n in counts.items())} samples of {count} runs: {folder}")
        print(f"a filter called NAME answers run 0 in {folder / ANSWERS / 'NAME' / run_name(0)}.csv, and so on; then")
        print(f"testbed run with the same scenario, --runs {count} and --external {folder} takes the answers in")
        return
    from testbed import pipeline
    from testbed.formats import export_log, export_trajectory

    trajectory = pipeline.fly(scenario)
    log, _ = pipeline.sense(scenario, trajectory)
    with fresh_folder(folder) as scratch:
        export_trajectory(trajectory, scratch / "trajectory.parquet", "parquet")
        log.save(scratch / "log")
        export_log(log, scratch / "csv", "csv", reference=trajectory)
        export_log(log, scratch / "mat", "navego", reference=trajectory)
    counts = {name: len(frame) for name, frame in log.frames().items()}
    print(f"{', '.join(f'{n} {kind}' for kind, n in counts.items())} samples: {folder}")


def allan(log: Path, out: Path | None, sensor: str = "mine", mapping: Path | None = None) -> None:
    """``testbed allan``: a log of the bench, or a table of one's own with the unit in each column's name."""
    from testbed.formats.table_samples import at_rest
    from testbed.sensors import allan as analysis
    from testbed.sensors import allan_export

    folder = out or Path("results") / "allan"
    check_own(folder, "testbed allan")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", sensor):
        raise InputError(f"--sensor {sensor}: letters, digits, - and _ make the name of a catalogue entry")
    read = own_log(log) or at_rest(log, mapping)
    table = analysis.analyse(read)
    if (spread := math.degrees(read.imu.gyro.std(axis=0).max())) > MOVING_DPS:
        tell_user(
            f"{log}: the gyros vary by {spread:.2g} °/s, so it was not at rest; the figures are those of the motion"
        )
    print(table.to_string(index=False, float_format=lambda value: f"{value:.4g}"))
    pooled = analysis.pooled_figures(read)
    words = allan_export.text(allan_export.in_words_of_others(read.imu.spec.rate_hz, pooled))
    print(f"\n{words}")
    with Folder.open(folder, "testbed allan") as own:
        own.claim(["allan.csv", "allan.png", "sensors.toml", "other-tools.txt"])
        own.write("allan.csv", table.to_csv(index=False).encode())
        own.write("sensors.toml", allan_export.entry(sensor, read, pooled).encode())
        own.write("other-tools.txt", words.encode())
        analysis.plot(read, folder / "allan.png")
        own.finish("allan.png")
        own.save()
    print(f"plot: {folder / 'allan.png'}")
    print(f'catalogue entry: {folder / "sensors.toml"}; use it with model = "{sensor}", file = "sensors.toml"')


def own_log(path: Path) -> SensorLog | None:
    """The log that the bench wrote into a folder, or None where it is none of these."""
    from testbed.data.records import SensorLog

    for folder in (path / "log", path):
        if (folder / "imu.parquet").is_file() and (folder / "imu.parquet").stat().st_size and _is_log(folder):
            return SensorLog.load(folder)
    return None


def _is_log(folder: Path) -> bool:
    """Whether ``imu.parquet`` has the header of a stored log; tables of one's own have the same name."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return b"testbed" in b" ".join((pq.read_schema(folder / "imu.parquet").metadata or {}).keys())
    except (OSError, pa.ArrowException):
        return True  # reading it says what is wrong


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


def import_recording(
    format: str, files: list[Path], out: Path, settings: list[str] | None = None, mapping: Path | None = None
) -> None:
    """``testbed import``: the log for Python and ``allan``, and the same as tables with a scenario that runs on them.

    ``settings`` are keys of ``[recording]``, ``mapping`` is its mapping file.
    """
    from testbed.formats import export_log, import_log
    from testbed.scenario import parse_setting, set_key

    check_free(out)
    options: dict[str, Any] = {}
    for key, value in (parse_setting(text) for text in settings or []):
        set_key(options, key.removeprefix("recording."), value, "--set")
    if "format" in options or "dir" in options:
        raise InputError("--set: format and folder of an import are the verb's own arguments")
    recording = import_log(format, files, **options, **({"mapping": str(mapping)} if mapping else {}))
    for note in recording.notes:
        tell_user(f"note: {note}")
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


def score(solutions: list[Path], truth: str, align: str, out: Path | None) -> None:
    """``testbed score``: other people's solutions against a scenario's truth or a file; one column for each."""
    import pandas as pd

    from testbed import pipeline
    from testbed.formats import solutions as files
    from testbed.scenario import load_scenario
    from testbed.scoring.tracks import score_track

    if out is not None and out.exists():
        raise InputError(f"{out}: already exists; give another --out")
    path = Path(truth)
    table_file = path.suffix in (".csv", ".parquet")
    doubts: list[str] = []
    true = files.read_truth(path, doubts) if table_file else pipeline.fly(load_scenario(truth))
    origin = files.origin_of(true)
    scored = [score_track(true, files.read(solution, origin), align) for solution in solutions]
    table = pd.DataFrame({str(file): result.metrics for file, result in zip(solutions, scored, strict=True)})
    print(f"errors against {truth}, at the solutions' own times; rpe: RMS over each distance in % of it")
    print(table.to_string(float_format=lambda value: f"{value:.4g}", na_rep="–"))
    for note in doubts:
        tell_user(f"note: {note}")
    for file, result in zip(solutions, scored, strict=True):
        print(f"{file}: {result.aligned}")
        for note in result.notes:
            tell_user(f"note: {file}: {note}")
    if out is not None:
        table.T.rename_axis("solution").assign(alignment=[result.aligned for result in scored]).to_csv(out)
        print(f"table: {out}")


def report(folders: list[Path], out: Path | None) -> None:
    """``testbed report``; ``out`` is the folder of the index over several results."""
    from testbed.montecarlo.folders import read_manifest as manifest_of
    from testbed.montecarlo.readings import KIND as READINGS
    from testbed.montecarlo.sweep import KIND as SWEEP
    from testbed.montecarlo.sweep import write_page as write_sweep
    from testbed.report import render, render_index
    from testbed.report.readings import write_page
    from testbed.tuning.report import write_report
    from testbed.tuning.tune import read_manifest

    several = len(folders) > 1
    if out is not None and not several:
        raise InputError(
            f"--out {out}: the folder of an index over several results, but one is named; its report stands in {folders[0]}"
        )
    index = out or Path("results")
    check_place(index)
    for folder in folders:
        if not (folder / "manifest.json").is_file():
            raise InputError(f"{folder}: no result of 'testbed run' or 'testbed tune' (it has no manifest.json)")
    for folder in folders:
        if manifest_of(folder, READINGS) is not None:
            write_page(folder)
        elif manifest_of(folder, SWEEP) is not None:
            write_sweep(folder)
        elif read_manifest(folder) is None:
            render(folder)
        else:
            write_report(folder)
        print(f"report: {folder / 'report.html'}")
    if several:
        print(f"index: {render_index(folders, index)}")


def compare(old: Path, new: Path, windows: bool = False) -> int:
    """``testbed compare``: 1 when a metric got worse or is missing, else 0."""
    from testbed.montecarlo.compare import MISSING, NOT_TESTED, compare_results

    changes = compare_results(old, new)
    gone = changes[changes["verdict"] == MISSING]
    changes = changes[changes["verdict"] != MISSING]
    for estimator, rows in gone.groupby("estimator", sort=False):
        print(f"missing in {new}: {len(rows)} metrics of {estimator} ({', '.join(rows['window'].unique())})")
    if changes.empty:
        print("no metric changed beyond its statistical error")
        return int(len(gone) > 0)
    counts = changes["verdict"].value_counts()
    whole = changes["window"] == "all"
    shown = changes if windows or not whole.any() else changes[whole]
    print(shown.to_string(index=False, float_format=lambda v: f"{v:.4g}"))
    told = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    left = len(changes) - len(shown)
    if NOT_TESTED in counts:
        print("not tested: a result of one run (or of copies of one) has no statistical error to compare with")
    print(f"{told}" + (f"; {left} of them in single windows, shown with --windows" if left else ""))
    return int(len(gone) > 0 or (changes["verdict"] == "worse").any())
