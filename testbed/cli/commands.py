"""What the verbs of the command line do: glue between files, the Python API and the screen."""

from __future__ import annotations

import math
import os
import re
import shutil
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.errors import OWN, InputError, MissingExtra, TestbedError, nearest, tell_user
from testbed.base.files import check_place, writing
from testbed.cli.completion import LISTS
from testbed.cli.console import print_claims, print_failures, print_summary, progress_line
from testbed.montecarlo.folders import Folder, check_own

if TYPE_CHECKING:
    from testbed.data.records import SensorLog
    from testbed.scenario import Scenario

AUTO_CAP = 1000
"""Most runs of --runs auto: an interval then has a thirtieth of one run's scatter."""
MOVING_DPS = 2.0
"""Standard deviation of a gyro that no catalogue sensor reaches at rest, with noise of 2 °/√h at 200 Hz 0.5 °/s."""


def run(
    load: Callable[..., Scenario],
    out: Path | None,
    runs: str | None,
    estimators: str | None,
    sweep: list[str] | None,
    readings: bool,
    width: float,
    cap: int | None,
    report: bool = True,
    offered: Sequence[str] = (),
    external: Sequence[Path] = (),
    **options: Any,
) -> None:
    """``testbed run``: the Monte Carlo, the table on screen, the report. ``load`` makes the scenario from overrides.

    ``offered`` are the estimators that plug-ins brought, ``external`` the folders of logs that other programs answered.
    """
    import testbed.montecarlo.runner
    from testbed.montecarlo.readings import KIND as READINGS
    from testbed.montecarlo.store import KIND as RESULT
    from testbed.montecarlo.sweep import first_point
    from testbed.report import preload, render

    if external and runs == "auto":
        raise InputError("--external: only so many runs have answers; give --runs a number in place of auto")

    def loaded(*arguments: Any) -> Scenario:
        return _choose_estimators(load(*arguments), estimators, external)

    scenario = loaded(first_point(sweep or []))  # which may complete the settings
    unused = [name for name in offered if name not in {entry.name for entry in scenario.estimators}]
    if unused and estimators is None:
        tell_user(f"no row of {scenario.name} uses {', '.join(unused)}: add --estimators +{',+'.join(unused)}")
    folder = out or Path("results") / scenario.name
    check_own(folder, "testbed sweep" if sweep else READINGS if readings else RESULT)
    if readings:
        if sweep:
            raise InputError("--readings and --sweep: one of them; a reading is a result of its own")
        from testbed.montecarlo.readings import CAP, FIRST

        auto = testbed.montecarlo.runner.Auto(width, cap or CAP, min(FIRST, cap or CAP))
        count = auto if runs in (None, "auto") else _run_count(runs)
        _readings(lambda name: loaded({}, name), out, count, report, **options)
        return
    count = testbed.montecarlo.runner.Auto(width, cap or AUTO_CAP) if runs == "auto" else _run_count(runs)
    if sweep:
        _sweep(loaded, sweep, folder, runs=count, **options)
        return
    _announce_compilation()
    if not options.get("resume") and (earlier := _stored_runs(folder)):
        tell_user(f"{folder} holds {earlier} runs of an earlier result, which this one replaces")
    with progress_line("runs") as show:

        def tell(done: int, total: int) -> None:
            show(done, total)
            if report and not done:
                preload()  # while the workers are at it

        result = testbed.montecarlo.runner.run(scenario, folder, runs=count, progress=tell, **options)
    used = result.runs["run"].nunique()
    if (stored := _stored_runs(folder)) > used:
        tell_user(f"{stored} runs are stored in {folder}; tables and report are of the first {used}")
    if (counted := int(result.summary["n"].max())) < used:
        tell_user(f"{used - counted} of {used} runs are copies of others: nothing in them varied, and they count once")
    print_summary(scenario, result.summary, result.runs, result.near_pole)
    sys.stdout.flush()
    for note in result.notes:
        tell_user(f"note: {note}")
    print_failures(result.runs)
    if not result.claims.empty:
        print_claims(result.claims)
    if not (result.runs["status"] == "ok").any():
        raise TestbedError(f"{folder}: no estimator came to the end of a run")
    if report:
        try:
            render(folder, svg=False)
        except KeyboardInterrupt:
            raise TestbedError(
                f"{folder}: stopped before the report was made; testbed report {folder} makes it"
            ) from None
    print(f"report: {folder / 'report.html'}" if report else f"tables: {folder}; the report: testbed report {folder}")


def _readings(
    load: Callable[[str | None], Scenario], out: Path | None, runs: Any, report: bool, **options: Any
) -> None:
    """Run every reading, tell the class of each claim, write the page and each reading's own report."""
    from testbed.montecarlo.readings import run_readings, slug
    from testbed.report import render
    from testbed.report.readings import write_page

    base = load(None)
    folder = out or Path("results") / f"{base.name}-readings"
    table = run_readings(load, folder, runs, announce=tell_user, **options)
    for claim, rows in table.groupby("claim", sort=False):
        print(f"{claim}: {rows['class'].iloc[0]}")
    if not report:
        print(f"tables: {folder}; the report: testbed report {folder}")
        return
    for reading in base.readings:
        render(folder / "readings" / slug(reading.name), svg=False)
    print(f"report: {write_page(folder)}")


def _stored_runs(folder: Path) -> int:
    return len(list((folder / "runs").glob("*.parquet")))


def _announce_compilation() -> None:
    """The first run of an installation compiles the kernels; without a word that looks like a hang."""
    compiled = any(Path(os.environ["NUMBA_CACHE_DIR"]).glob("*/*.nbi"))
    if not compiled:
        tell_user("first use: compiling the kernels takes a minute or two")


def _sweep(load: Callable[[Mapping[str, Any]], Scenario], grid: list[str], folder: Path, **options: Any) -> None:
    from testbed.montecarlo.sweep import PLOT_METRIC, parse_sweep
    from testbed.montecarlo.sweep import sweep as run_grid
    from testbed.scoring.quantities import metric_label, unit

    table = run_grid(load, dict(parse_sweep(text) for text in grid), folder, announce=tell_user, **options)
    keys = list(table.columns[: len(grid)])
    rows = table[(table["window"] == "all") & (table["metric"] == PLOT_METRIC)]
    print(f"{metric_label(PLOT_METRIC)}, {unit(PLOT_METRIC)}, mean over the runs, whole flight")
    print(rows.pivot(index=keys, columns="estimator", values="mean").to_string(float_format=lambda v: f"{v:.4g}"))
    print(f"sweep: {folder / 'sweep.csv'} and {folder / 'sweep.png'}")


def _run_count(runs: str | None) -> int | None:
    if runs is None:
        return None
    from testbed.base.schema import validate
    from testbed.scenario import MonteCarloConfig, position_of

    if not (count := position_of(runs)):
        raise InputError(f"--runs {runs}: expected a number of runs from 1, or 'auto'")
    return validate(MonteCarloConfig, {"runs": count}, "--runs").runs


def _choose_estimators(scenario: Scenario, names: str | None, answered: Sequence[Path] = ()) -> Scenario:
    """Keep the named rows; a name that is no row of the scenario but an estimator becomes a row with defaults.

    Names that begin with ``+`` come beside all rows of the scenario. A row that a setting changed must be among them. The
    external filters of the folders ``answered`` have a row in any case.
    """
    own = len(scenario.estimators)
    if answered:
        from testbed.montecarlo.external import with_answers

        scenario = with_answers(scenario, answered)
    if names is None:
        return scenario
    from testbed.data.registry import list_estimators
    from testbed.scenario import EstimatorConfig, position_of

    rows = {entry.row: entry for entry in scenario.estimators}
    wanted = list(dict.fromkeys(part.strip() for part in names.split(",") if part.strip()))
    if added := [name for name in wanted if name.startswith("+")]:
        if len(added) < len(wanted):
            raise InputError(f"--estimators {names}: '+' before all names (beside the scenario's rows) or before none")
        wanted = [*rows, *(name.lstrip("+") for name in added)]
    chosen = []
    known = {*rows, *list_estimators()}
    for name in dict.fromkeys(wanted):
        if name not in known:
            raise InputError(f"--estimators: unknown estimator '{name}'; {nearest(name, known)}; {OWN}")
        chosen.append(rows.get(name) or EstimatorConfig(name=name))
    if not chosen:
        raise InputError("--estimators: name at least one")
    chosen += [entry for entry in scenario.estimators[own:] if entry not in chosen]
    kept = {entry.row for entry in chosen}
    for place in [key.split(".")[1] for key in scenario.settings if key.startswith("estimators.")]:
        row = place if (number := position_of(place)) is None else scenario.estimators[number].row
        if row not in kept and row not in {entry.name for entry in chosen}:
            raise InputError(f"'estimators.{place}' is set, but --estimators leaves '{row}' out")
    claims = [claim for claim in scenario.claims if {claim.better, claim.than} <= kept]
    return scenario.model_copy(update={"estimators": chosen, "claims": claims})


def check_free(out: Path) -> None:
    """Raise InputError where ``out`` is anything but a folder that can be made, or an empty one."""
    check_place(out)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: already exists and is not an empty folder; give another --out")


@contextmanager
def fresh_folder(out: Path) -> Iterator[Path]:
    """A temporary folder that takes the place of ``out`` at the end; on an error nothing half-written remains."""
    check_free(out)
    place = out.resolve()  # a link is followed, and . has a name
    with writing(out):
        place.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
        try:
            yield scratch
            check_free(out)  # somebody else may have been quicker
            if place.exists():  # stays, and so does who stands in it
                for path in sorted(scratch.iterdir()):
                    path.rename(place / path.name)
                scratch.rmdir()
            else:
                scratch.chmod(0o777 & ~_umask())
                scratch.rename(place)
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
    if (count := _run_count(runs)) is not None:
        from testbed.montecarlo.external import ANSWERS, run_name, write_logs

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
    read = _own_log(log) or at_rest(log, mapping)
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


def _own_log(path: Path) -> SensorLog | None:
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
    true = files.read_truth(path) if table_file else pipeline.fly(load_scenario(truth))
    origin = files.origin_of(true)
    scored = [score_track(true, files.read(solution, origin), align) for solution in solutions]
    table = pd.DataFrame({str(file): result.metrics for file, result in zip(solutions, scored, strict=True)})
    print(f"errors against {truth}, at the solutions' own times; rpe: RMS over each distance in % of it")
    print(table.to_string(float_format=lambda value: f"{value:.4g}", na_rep="–"))
    for file, result in zip(solutions, scored, strict=True):
        print(f"{file}: {result.aligned}")
    if out is not None:
        table.T.rename_axis("solution").assign(alignment=[result.aligned for result in scored]).to_csv(out)
        print(f"table: {out}")


def report(folders: list[Path], out: Path) -> None:
    """``testbed report``."""
    from testbed.montecarlo.folders import read_manifest as manifest_of
    from testbed.montecarlo.readings import KIND as READINGS
    from testbed.report import render, render_index
    from testbed.report.readings import write_page
    from testbed.tuning.report import write_report
    from testbed.tuning.tune import read_manifest

    check_place(out)
    for folder in folders:
        if not (folder / "manifest.json").is_file():
            raise InputError(f"{folder}: no result of 'testbed run' or 'testbed tune' (it has no manifest.json)")
    for folder in folders:
        if manifest_of(folder, READINGS) is not None:
            write_page(folder)
        elif read_manifest(folder) is None:
            render(folder)
        else:
            write_report(folder)
        print(f"report: {folder / 'report.html'}")
    if len(folders) > 1:
        print(f"index: {render_index(folders, out)}")


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


def show(what: str, name: str | None = None) -> None:
    """``testbed list``; ``name``: one of the estimators, with its parameters."""
    if name is not None:
        if what != "estimators":
            raise InputError(f"testbed list {what} {name}: only 'list estimators' takes a name")
        show_estimator(name)
    elif what == "scenarios":
        from testbed.base.schema import read_toml
        from testbed.scenario import list_scenarios

        for name, path in list_scenarios().items():
            print(f"{name:20s} {read_toml(path).get('scenario', {}).get('title', '')}")
    elif what == "estimators":
        import inspect

        from testbed.data.registry import estimator_class, list_estimators

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
    elif what == "manoeuvres":
        from testbed.flight.config import manoeuvre_keys

        for name, (about, keys) in manoeuvre_keys().items():
            print(f"{name:13s} {about}\n{'':13s} {keys}")
    elif what == "metrics":
        from testbed.scoring.quantities import NEES, NIS, QUANTITIES, STATISTICS, TIME_METRIC

        print(f"STATISTIC_QUANTITY, for example rmse_north_m\nstatistics: {', '.join(STATISTICS)}")
        print(f"quantities: {', '.join(QUANTITIES)}\nagainst the fixes: rmse_gnss_north_m, mean_gnss_north_m, ...")
        print(f"consistency: {', '.join(NEES)}, {NIS}\ntime: {TIME_METRIC}")
    else:
        raise InputError(f"cannot list '{what}'; {nearest(what, LISTS)}")


def show_estimator(name: str) -> None:
    """``testbed list estimators NAME``: what it is, its parameters, and the parts that it can be composed of."""
    import inspect

    from testbed.data.registry import describe_parameters, estimator_class

    kind = estimator_class(name)
    print(f"{name}: {(inspect.getdoc(kind) or '').split(chr(10))[0]}\n")
    print_columns(("parameter", "default", "range", "meaning"), describe_parameters(name))
    parts: Mapping[str, list[tuple[str, str]]] = getattr(kind, "describe", dict)()
    for title, rows in parts.items():
        print()
        print_columns((title, ""), rows)


def print_columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Text in columns of their own width, the last one wrapped to the screen."""
    width = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head) - 1)]
    indent = sum(width) + 2 * len(width)
    room = max(30, shutil.get_terminal_size((120, 24)).columns - indent)
    for *cells, text in (head, *rows):
        lines = textwrap.wrap(text, room) or [""]
        start = "".join(f"{cell:{w}s}  " for cell, w in zip(cells, width, strict=True))
        print("\n".join([(start + lines[0]).rstrip(), *(" " * indent + line for line in lines[1:])]))
