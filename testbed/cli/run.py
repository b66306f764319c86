"""What ``testbed run`` does: choose the rows, run the Monte Carlo, the sweep or every reading, print the table, write the report."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from testbed import kernel_cache
from testbed.base.errors import OWN, InputError, TestbedError, nearest, tell_user
from testbed.cli.console import print_claims, print_failures, print_summary, progress_line
from testbed.montecarlo.folders import check_own

if TYPE_CHECKING:
    from testbed.scenario import Scenario

WIDTH_PCT = 10.0
"""Of the interval of a claim where --runs auto and --readings stop, in percentage points."""
AUTO_CAP = 1000
"""Most runs of --runs auto: an interval then has a thirtieth of one run's scatter."""


def run(
    load: Callable[..., Scenario],
    out: Path | None,
    runs: str | None,
    estimators: str | None,
    sweep: list[str] | None,
    readings: bool,
    width: float | None,
    cap: int | None,
    report: bool = True,
    offered: Sequence[str] = (),
    external: Sequence[Path] = (),
    drawn: Mapping[str, str | None] = MappingProxyType({}),
    **options: Any,
) -> None:
    """``testbed run``: the Monte Carlo, the table on screen, the report. ``load`` makes the scenario from overrides.

    ``offered`` are the estimators that plug-ins brought, ``external`` the folders of logs that other programs answered,
    ``drawn`` what the figure of a sweep shows: metric, window, log.
    """
    import testbed.montecarlo.runner
    from testbed.montecarlo.readings import KIND as READINGS
    from testbed.montecarlo.store import KIND as RESULT
    from testbed.report import preload, render
    from testbed.scenario import check_once
    from testbed.scoring.verdicts import describe_claim

    if not sweep and (told := [name for name, value in drawn.items() if value is not None]):
        raise InputError(f"--{told[0]} says what the figure of a sweep shows; give --sweep KEY=V1,V2 with it")
    if (told := [name for name, value in (("width", width), ("cap", cap)) if value is not None]) and not (
        runs == "auto" or (readings and runs is None)
    ):
        raise InputError(
            f"--{told[0]} says when runs are enough; give --runs auto with it, or --readings without --runs N"
        )
    width = WIDTH_PCT if width is None else width
    if external and runs == "auto":
        raise InputError("--external: only so many runs have answers; give --runs a number in place of auto")

    def loaded(*arguments: Any) -> Scenario:
        return _choose_estimators(load(*arguments), estimators, external)

    grid = _grid(sweep or [])
    # its first point may complete the settings
    whole = load({key: values[0] for key, values in grid.items()})
    scenario = _choose_estimators(whole, estimators, external)
    left = [claim.id or describe_claim(claim) for claim in whole.active_claims() if claim not in scenario.claims]
    notes = [f"not judged, as --estimators leaves out a row that they name: {', '.join(left)}"] if left else []
    for option, key, given in (("--runs", "runs", runs), ("--timeout", "timeout_s", options.get("timeout"))):
        if given is not None:
            check_once(scenario.settings, f"monte_carlo.{key}", option)
    if readings and runs is None:
        check_once(scenario.settings, "monte_carlo.runs", "--readings without --runs")
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
        count = auto if runs in (None, "auto") else run_count(runs)
        _readings(lambda name: loaded({}, name), out, count, report, **options)
        _tell(notes)
        return
    count = testbed.montecarlo.runner.Auto(width, cap or AUTO_CAP) if runs == "auto" else run_count(runs)
    if sweep:
        _sweep(loaded, grid, folder, runs=count, **drawn, **options)
        _tell(notes)
        return
    started = time.time()
    _announce_compilation()
    if not options.get("resume") and (earlier := _stored_runs(folder)):
        tell_user(f"{folder} holds {earlier} runs of an earlier result, which this one replaces")
    with progress_line("runs", kernel_cache.news_of(started)) as show:

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
    _tell([*result.notes, *notes])
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


def _tell(notes: Sequence[str]) -> None:
    for note in notes:
        tell_user(f"note: {note}")


def _grid(sweep: list[str]) -> dict[str, list[Any]]:
    """Values per key of a sweep; none where there is no sweep, which then need not be imported."""
    if not sweep:
        return {}
    from testbed.montecarlo.sweep import parse_grid

    return parse_grid(sweep)


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


def _sweep(
    load: Callable[[Mapping[str, Any]], Scenario],
    grid: Mapping[str, Sequence[Any]],
    folder: Path,
    metric: str | None,
    window: str | None,
    log: str | None,
    **options: Any,
) -> None:
    from testbed.montecarlo.sweep import PLOT_METRIC
    from testbed.montecarlo.sweep import sweep as run_grid
    from testbed.report.labels import window_label
    from testbed.scoring.quantities import axis_title

    metric, window = metric or PLOT_METRIC, window or "all"
    table = run_grid(
        load,
        grid,
        folder,
        announce=tell_user,
        metric=metric,
        window=window,
        log=log,
        **options,
    )
    keys = list(table.columns[: len(grid)])
    rows = table[(table["window"] == window) & (table["metric"] == metric)]
    print(f"{axis_title(metric)}, mean over the runs, {window_label(window)}")
    print(rows.pivot(index=keys, columns="estimator", values="mean").to_string(float_format=lambda v: f"{v:.4g}"))
    print(f"sweep: {folder / 'sweep.csv'}, figure and table beside it; report: {folder / 'report.html'}")


def run_count(runs: str | None) -> int | None:
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
    wanted = [part.strip() for part in names.split(",") if part.strip()]
    if twice := next((name for name in wanted if wanted.count(name) > 1), None):
        raise InputError(f"--estimators {names}: '{twice}' stands twice; name each row once")
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
