"""The command line: small verbs around the Python API. Heavy imports are made inside the verbs.

Exit codes: 0 done, 1 the work failed, 2 bad usage or bad input. A user's mistake gives one message and no traceback.
"""

from __future__ import annotations

import os
import shlex
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from testbed.cli import completion
from testbed.cli.league import league_command
from testbed.cli.options import (
    SCENARIO,
    OutOption,
    PluginOption,
    ProfileOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    VariantOption,
    load_plugins,
    loader,
)
from testbed.cli.plot import plot_command
from testbed.cli.sensitivity import sensitivity_command

app = typer.Typer(
    name="testbed",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="JSBSim flies a scripted manoeuvre, sensor models record it, every navigation filter is scored on the same recording.",
)

DEBUG = "--debug"


def _show_version(asked: bool) -> None:
    if asked:
        import testbed

        print(testbed.__version__)
        raise typer.Exit


@app.callback()
def options(
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error inside of the bench (anywhere in the line).")
    ] = False,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    """What stands before the verb; `main` has taken ``--debug`` out already, here it is for the help."""


def main() -> None:
    """Entry point of the command ``testbed``. Whatever goes wrong ends in one message and an exit code, see `_failed`."""
    from testbed.cli.console import usable_streams

    words = sys.argv[1:]
    usable_streams()
    try:
        app(args=[word for word in words if word != DEBUG])
    except (SystemExit, typer.Exit):
        raise
    except BaseException as error:
        if DEBUG in words:
            raise
        sys.exit(_failed(error, words))


def _failed(error: BaseException, words: Sequence[str]) -> int:
    """Tell what ended a verb in one message; its exit code. What nobody foresaw names its place and how to report it."""
    from testbed.base.errors import TestbedError, readable

    if isinstance(error, BrokenPipeError):
        # Python flushes once more at the end, and would complain of the closed pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    code = 1
    if isinstance(error, TestbedError):
        told, code = str(error), error.exit_code
    elif isinstance(error, KeyboardInterrupt):
        told = "stopped"
    elif isinstance(error, OSError) and error.filename is not None:
        told = f"{error.filename}: {error.strerror}"
    else:
        frames = traceback.extract_tb(error.__traceback__)
        place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
        what = " ".join(f"{type(error).__name__}: {error}".split())
        line = shlex.join(["testbed", *words, DEBUG])
        told = f"an error inside of the bench: {what}{place}; to report it, send the output of '{line}' and its input files"
    print(f"testbed: {readable(told)}", file=sys.stderr)
    return code


@app.command("run")
def run_command(
    scenario: Annotated[str | None, SCENARIO] = None,
    runs: Annotated[
        str | None, typer.Option(help="Number of Monte Carlo runs, or 'auto' to stop when the claims are settled.")
    ] = None,
    seed: SeedOption = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Worker processes; default: one per core; 1: no process but this one.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler, e.g. tcp://host:8786.")
    ] = None,
    profile: ProfileOption = None,
    variant: VariantOption = None,
    estimators: Annotated[
        str | None,
        typer.Option(
            metavar="A,B",
            help="Only these rows of the scenario (or further estimators); +A: A beside all of its rows.",
            autocompletion=completion.estimators,
        ),
    ] = None,
    settings: SetOption = None,
    out: OutOption = None,
    resume: Annotated[bool, typer.Option("--resume", help="Complete what is missing in an earlier result.")] = False,
    timeout: Annotated[float | None, typer.Option(min=0.1, help="Longest time of one estimator on one run, s.")] = None,
    sweep: Annotated[list[str] | None, typer.Option(metavar="KEY=V1,V2", help="Run a grid over settings.")] = None,
    metric: Annotated[
        str | None, typer.Option(help="With --sweep: the metric that is drawn (rmse_position_3d_m).")
    ] = None,
    window: Annotated[str | None, typer.Option(help="With --sweep: the window that is drawn (all).")] = None,
    log: Annotated[
        str | None,
        typer.Option(metavar="x|y|xy|none", help="With --sweep: logarithmic axes; default: where values span 20."),
    ] = None,
    readings: Annotated[
        bool, typer.Option("--readings", help="Run every reading of the source and judge the claims under each.")
    ] = False,
    width: Annotated[
        float | None,
        typer.Option(
            min=0.1, help="With --runs auto or --readings: interval width of every claim, percentage points (10)."
        ),
    ] = None,
    cap: Annotated[
        int | None, typer.Option(min=1, help="Most runs with --runs auto (1000) and with --readings (200).")
    ] = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Render the report; the tables are always written.")
    ] = True,
    plugin: PluginOption = None,
    external: Annotated[
        list[Path] | None,
        typer.Option(
            "--external",
            metavar="DIR",
            help="Folder of logs (sense --runs) with answers of other programs, which become rows.",
        ),
    ] = None,
) -> None:
    """Fly, sense, estimate, score over many seeds; print the table and write the report."""
    from testbed.cli import listing
    from testbed.cli import run as running

    if scenario is None:
        listing.show("scenarios")
        print("\nRun one with: testbed run NAME")
        return
    offered = load_plugins(plugin)
    running.run(
        loader(scenario, profile, variant, settings, seed),
        out=out,
        runs=runs,
        jobs=jobs,
        scheduler=scheduler,
        estimators=estimators,
        resume=resume,
        timeout=timeout,
        sweep=sweep,
        drawn={"metric": metric, "window": window, "log": log},
        readings=readings,
        width=width,
        cap=cap,
        report=report,
        plugins=plugin or [],
        offered=offered,
        external=external or [],
    )


@app.command("fly")
def fly_command(
    scenario: ScenarioArgument,
    out: OutOption = None,
    profile: ProfileOption = None,
    variant: VariantOption = None,
    settings: SetOption = None,
    seed: SeedOption = None,
) -> None:
    """Fly only: the trajectory as Parquet, CSV, KML and NaveGo-style .mat."""
    from testbed.cli import commands

    commands.fly(loader(scenario, profile, variant, settings, seed)({}), out)


@app.command("sense")
def sense_command(
    scenario: ScenarioArgument,
    out: OutOption = None,
    profile: ProfileOption = None,
    variant: VariantOption = None,
    settings: SetOption = None,
    seed: SeedOption = None,
    runs: Annotated[
        str | None, typer.Option(help="Logs of so many runs, for filters in any language (see 'run --external').")
    ] = None,
) -> None:
    """Fly and record: the trajectory and one sensor log, or with --runs the logs of a Monte Carlo."""
    from testbed.cli import commands

    commands.sense(loader(scenario, profile, variant, settings, seed)({}), out, runs)


@app.command("allan")
def allan_command(
    log: Annotated[
        Path, typer.Argument(help="A record at rest: folder of a sensor log, or a table (.csv, .parquet) of one's own.")
    ],
    sensor: Annotated[str, typer.Option("--sensor", help="Name of the catalogue entry that is written.")] = "mine",
    mapping: Annotated[
        Path | None, typer.Option("--map", help="TOML file whose table 'columns' maps other names and units.")
    ] = None,
    out: OutOption = None,
) -> None:
    """Allan deviation of a record at rest, the fitted figures, and a catalogue entry of them."""
    from testbed.cli import commands

    commands.allan(log, out, sensor, mapping)


@app.command("import")
def import_command(
    format: Annotated[
        str,
        typer.Argument(
            help="ardupilot, broad, euroc, kfgins, kitti, mcap, navego, nmea, rinex, rosbag, rtklib, table, ubx or ulog.",
            autocompletion=completion.formats,
        ),
    ],
    files: Annotated[list[Path], typer.Argument(help="The recording: a folder or files.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the sensor log.")],
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="A key of the table 'recording', e.g. imu.model=ADIS16448, start_s=20."
        ),
    ] = None,
    mapping: Annotated[
        Path | None, typer.Option("--map", help="TOML file whose table 'columns' maps other names and units.")
    ] = None,
) -> None:
    """Recorded data into a sensor log that every estimator can run on."""
    from testbed.cli import commands

    commands.import_recording(format, files, out, settings, mapping)


@app.command("score")
def score_command(
    solutions: Annotated[
        list[Path],
        typer.Argument(metavar="SOLUTION...", help="CSV or Parquet with units in the names, TUM, RTKLIB .pos."),
    ],
    truth: Annotated[
        str,
        typer.Option("--truth", metavar="REF|SCENARIO", help="Table of the true motion, or a scenario that is flown."),
    ],
    align: Annotated[
        str, typer.Option("--align", help="none, translation, yaw or rigid: what is taken out before, and told.")
    ] = "none",
    out: Annotated[Path | None, typer.Option("--out", help="CSV file for the figures.")] = None,
) -> None:
    """Score other people's solutions: RMSE, CEP, R95, drift over distances."""
    from testbed.cli import commands

    commands.score(solutions, truth, align, out)


@app.command("report")
def report_command(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Result folders.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the index over several results (results).")
    ] = None,
) -> None:
    """Render results again; several results also into one index."""
    from testbed.cli import commands

    commands.report(folders, out)


app.command("plot")(plot_command)


@app.command("compare")
def compare_command(
    old: Annotated[Path, typer.Argument(help="Result folder of the reference.")],
    new: Annotated[Path, typer.Argument(help="Result folder to judge.")],
    windows: Annotated[bool, typer.Option("--windows", help="Also the changes in single windows.")] = False,
) -> None:
    """Say which metrics changed beyond their statistical error; exit code 1 if any got worse or is missing."""
    from testbed.cli import commands

    raise typer.Exit(commands.compare(old, new, windows))


@app.command("features")
def features_command(
    scenario: ScenarioArgument,
    estimator: Annotated[
        str | None, typer.Option(help="Row whose networks are meant; default: the first that can say.")
    ] = None,
    inputs: Annotated[int, typer.Option(min=1, help="How many of the best inputs get a lag curve.")] = 4,
    out: OutOption = None,
    profile: ProfileOption = None,
    variant: VariantOption = None,
    settings: SetOption = None,
) -> None:
    """Rank a network's candidate inputs (MRMR) and measure the lags that they need (Lipschitz)."""
    from testbed.features.command import features

    loaded = loader(scenario, profile, variant, settings)({})
    print(f"tables and plot: {features(loaded, out or Path('results') / f'{loaded.name}-features', estimator, inputs)}")


@app.command("dataset")
def dataset_command(
    scenario: ScenarioArgument,
    flights: Annotated[int | None, typer.Option(min=1, help="Number of flights in place of the scenario's.")] = None,
    out: OutOption = None,
    profile: ProfileOption = None,
    variant: VariantOption = None,
    settings: SetOption = None,
) -> None:
    """Fly and record training data for the networks of a scenario."""
    from testbed.cli.console import progress_line
    from testbed.scenario import check_once
    from testbed.training.dataset import make_dataset

    loaded = loader(scenario, profile, variant, settings)({})
    if flights is not None:
        check_once(loaded.settings, "extra.dataset.flights", "--flights")
    with progress_line("flights") as tell:
        print(f"data set: {make_dataset(loaded, out or Path('results') / f'{loaded.name}-dataset', flights, tell)}")


@app.command("train")
def train_command(
    scenario: ScenarioArgument,
    data: Annotated[
        Path | None, typer.Option(help="Data set of 'testbed dataset'; default: made and kept in the cache.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint.")] = False,
    out: OutOption = None,
    profile: ProfileOption = None,
    variant: VariantOption = None,
    settings: SetOption = None,
) -> None:
    """Train the networks of a scenario and store their weights."""
    from testbed.training.train import train

    loaded = loader(scenario, profile, variant, settings)({})
    print(f"weights: {train(loaded, out or Path('results') / f'{loaded.name}-training', data, resume)}")


@app.command("tune")
def tune_command(
    scenario: ScenarioArgument,
    algorithms: Annotated[
        str | None, typer.Option(metavar="A,B", help="ga, pso, ipo, mipo, sipo, iipo, cma-es, de.")
    ] = None,
    iterations: Annotated[
        str | None, typer.Option(metavar="N,M", help="Iterations of the independent searches.")
    ] = None,
    population: Annotated[int | None, typer.Option(min=2, help="Candidates per iteration.")] = None,
    seeds: Annotated[str | None, typer.Option(metavar="1,2", help="Seeds of the searches.")] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Threads; default: one per core.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Complete an earlier study.")] = False,
    time_limit: Annotated[float | None, typer.Option(min=1.0, help="Stop, resumable, after so many seconds.")] = None,
    out: OutOption = None,
    profile: ProfileOption = None,
    variant: VariantOption = None,
    settings: SetOption = None,
    plugin: PluginOption = None,
) -> None:
    """Search the declared parameters of estimators; score the best on seeds that the search never saw."""
    from testbed.tuning.command import tune

    load_plugins(plugin)
    tune(
        loader(scenario, profile, variant, settings)({}),
        out,
        algorithms=algorithms,
        iterations=iterations,
        population=population,
        seeds=seeds,
        jobs=jobs,
        resume=resume,
        time_limit=time_limit,
        plugins=plugin or [],
    )


@app.command("list")
def list_command(
    what: Annotated[
        str,
        typer.Argument(
            help="scenarios, aircraft, manoeuvres, sensors, estimators or metrics.", autocompletion=completion.listable
        ),
    ],
    name: Annotated[str | None, typer.Argument(help="One of the estimators: its parameters and parts.")] = None,
    plugin: PluginOption = None,
) -> None:
    """What the bench ships and finds."""
    from testbed.cli.listing import show

    load_plugins(plugin)
    show(what, name)


@app.command("explain")
def explain_command(
    key: Annotated[
        str | None,
        typer.Argument(help="Such as sensors.gnss.outages, or the end of it.", autocompletion=completion.keys),
    ] = None,
) -> None:
    """What a key of a scenario means: unit, range, default, examples."""
    from testbed.cli.explain import explain

    explain(key)


@app.command("new")
def new_command(
    kind: Annotated[
        str,
        typer.Argument(
            help="estimator, c-filter, octave-filter, policy, scenario or aircraft.",
            autocompletion=completion.starting_files,
        ),
    ],
    name: Annotated[str, typer.Argument(help="Its name; the file goes into this folder.")],
    like: Annotated[str | None, typer.Option("--like", help="The aircraft to start from (default: aerosonde).")] = None,
) -> None:
    """A starting file that works as it is: an estimator or a filter in C or Octave, a policy, a scenario, or a copy of an aircraft."""
    from testbed.cli.templates import command_for, new_file

    path = new_file(kind, name, like=like)
    print(f"{path}; try it with: {command_for(kind, path, name)}")


app.command("sensitivity")(sensitivity_command)
app.command("league")(league_command)
