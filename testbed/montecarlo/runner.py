"""The Monte Carlo runner: fly, sense, estimate and score over many seeds; store every run; write the tables.

Unit of work: `testbed.montecarlo.work_unit`. Where it is computed: `testbed.montecarlo.executors`. What is kept: `testbed.montecarlo.store`. The tables do not
depend on the number of workers, on their order, or on how often the batch was interrupted and resumed.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import testbed
from testbed import pipeline
from testbed.base.checksums import DamagedError
from testbed.base.errors import InputError, TestbedError, nearest, tell_user
from testbed.base.notes import check_sensors, notes_of
from testbed.data.records import Trajectory
from testbed.montecarlo import executors
from testbed.montecarlo.external import answers_digest
from testbed.montecarlo.first_run import heading_notes, innovation_notes, pole_notes
from testbed.montecarlo.folders import check_own
from testbed.montecarlo.result import Result
from testbed.montecarlo.store import FORMAT, KIND, Store, StoreError, batch_of, files_digest
from testbed.montecarlo.work_unit import Setup, envelope_times
from testbed.scenario import LONGEST_TIMEOUT_S, Scenario
from testbed.scenario.windows import cut_notes
from testbed.scoring.verdicts import few_runs_notes
from testbed.training.flights import TrainingFlights

MOST_RUNS = 1_000_000
"""What the six digits of a stored run's name can number."""

Progress = Callable[[int, int], None]
"""Called with the number of runs done and the number wanted."""


class Interrupted(TestbedError):
    """The user stopped the batch; what is done is stored."""


@dataclass(frozen=True)
class Auto:
    """Sequential stopping: run until the interval of every claim is narrower than ``width_pct``, or ``cap`` runs are done.

    Looks after ``first`` runs and then whenever the number has grown by half, so the stopping time depends on the seed only.
    """

    width_pct: float = 5.0
    cap: int = 1000
    first: int = 20

    def checkpoints(self) -> Iterator[int]:
        """Numbers of runs at which to look."""
        n = min(self.first, self.cap)
        while n < self.cap:
            yield n
            n = min(self.cap, n + max(1, n // 2))
        yield n


def run(
    scenario: Scenario | str | Path,
    out: str | Path,
    runs: int | Auto | None = None,
    seed: int | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    estimators: Sequence[str] | None = None,
    timeout: float | None = None,
    progress: Progress | None = None,
    plugins: Sequence[str | Path] = (),
) -> Result:
    """Run a scenario's Monte Carlo and write the result folder ``out``; ``testbed report`` makes its page.

    ``runs``, ``seed``, ``estimators`` (labels) and ``timeout`` (s, per estimator and run) stand above the scenario's;
    ``jobs`` processes (default: one per core; 1 computes in this process, where a debugger works, and which an estimator can
    end), or a Dask cluster at ``scheduler``.
    ``resume`` completes what an earlier call left. Raises InputError before anything is written, Interrupted on Ctrl-C.
    """
    jobs = jobs if jobs is not None else os.cpu_count() or 1
    if jobs < 1:
        raise InputError(f"--jobs {jobs}: at least one")
    setup = plan(pipeline.loaded(scenario), runs, seed, estimators, timeout, plugins)
    scenario = setup.scenario
    identity = {
        "format": FORMAT,
        "scenario": scenario.digest(),
        "plugins": files_digest(setup.plugins),
        "testbed": testbed.__version__,
        **answers_digest(scenario),
    }
    setup = replace(setup, batch=batch_of(identity))
    check_own(Path(out), KIND)
    trajectory = prepare(setup)
    with (
        nullcontext() if scheduler is None else executors.connect(scheduler) as client,
        Store.create(out, identity, scenario.to_toml(), resume) as store,
    ):
        started = time.monotonic()
        store.save(**provenance(scenario, setup), finished=False)
        done = set(store.finished_runs(tell_user))
        wanted = 0
        for wanted in runs.checkpoints() if isinstance(runs, Auto) else [scenario.monte_carlo.runs]:
            missing = [k for k in range(wanted) if k not in done]
            _complete(store, missing, wanted, _units(setup, missing, jobs, client), progress)
            done.update(missing)
            if isinstance(runs, Auto) and _narrow(store, scenario, wanted, runs.width_pct):
                break
        if client is not None:
            client.close()
        tables = _tables(store, scenario, wanted, trajectory)
        pole = pole_notes(trajectory)
        told = [*cut_notes(scenario.windows, trajectory), *pole, *_of_first_run(store)]
        few = few_runs_notes(tables.claims.to_dict("records"))
        store.save(notes=[*store.manifest["notes"], *told, *few])
        seconds = round(time.monotonic() - started, 3)
        store.save(finished=True, runs=wanted, jobs=jobs, seconds=store.manifest.get("seconds", 0.0) + seconds)
    return Result(store.out, **vars(tables), notes=tuple(store.manifest["notes"]), near_pole=bool(pole))


def _of_first_run(store: Store) -> list[str]:
    """What innovations and sigmas of run 0 say of the filters."""
    path = store.out / "details" / "info.json"
    if not path.is_file():
        return []
    info = json.loads(path.read_text())
    return innovation_notes(info) + heading_notes(info)


def _tables(store: Store, scenario: Scenario, runs: int, trajectory: Trajectory) -> Any:
    """The tables of all that is stored."""
    from testbed.montecarlo.aggregate import aggregate

    try:
        return aggregate(store, scenario, range(runs), envelope_times(trajectory))
    except KeyboardInterrupt:
        told = f"{store.out}: stopped before the tables were made; all {runs} runs are stored"
        raise Interrupted(f"{told}, and the same command with --resume makes them") from None
    except DamagedError as error:
        raise StoreError(f"{error}; the same command with --resume computes it again") from None


def plan(
    scenario: Scenario,
    runs: int | Auto | None = None,
    seed: int | None = None,
    estimators: Sequence[str] | None = None,
    timeout: float | None = None,
    plugins: Sequence[str | Path] = (),
) -> Setup:
    """What `run` computes with these arguments, as its workers are told. Raises InputError."""
    scenario = with_settings(scenario, runs if isinstance(runs, int) else None, seed, estimators)
    if isinstance(runs, Auto) and not scenario.active_claims():
        raise InputError(f"{scenario.name}: --runs auto watches the intervals of claims, but the scenario has none")
    if timeout is not None and timeout <= 0:
        raise InputError(f"--timeout {timeout:g}: must be above 0 s")
    setup = Setup(scenario, tuple(str(Path(p).resolve()) for p in plugins), timeout)
    if setup.limit_s is not None and not setup.limit_s <= LONGEST_TIMEOUT_S:
        raise InputError(
            f"{'--timeout' if timeout is not None else f'{scenario.source_path}: monte_carlo.timeout_s'} {setup.limit_s:g}: "
            f"at most {LONGEST_TIMEOUT_S:g} s; leave it out for no limit"
        )
    wanted = runs.cap if isinstance(runs, Auto) else scenario.monte_carlo.runs
    if wanted > MOST_RUNS:
        raise InputError(f"{scenario.name}: {wanted} runs: at most {MOST_RUNS}")
    return setup


def with_settings(
    scenario: Scenario, runs: int | None = None, seed: int | None = None, estimators: Sequence[str] | None = None
) -> Scenario:
    """The scenario with a number of runs, a seed, and only the estimators of these labels (claims on others go)."""
    changes: dict[str, Any] = {}
    if runs is not None and runs < 1:
        raise InputError(f"--runs {runs}: at least one")
    if seed is not None and seed < 0:
        raise InputError(f"--seed {seed}: must not be negative")
    settings = {key: value for key, value in (("runs", runs), ("seed", seed)) if value is not None}
    if settings:
        changes["monte_carlo"] = scenario.monte_carlo.model_copy(update=settings)
    if estimators is not None:
        known = [entry.row for entry in scenario.estimators]
        for label in estimators:
            if label not in known:
                raise InputError(f"{scenario.name}: no estimator '{label}'; {nearest(label, known)}")
        if not estimators:
            raise InputError("--estimators: name at least one")
        changes["estimators"] = [entry for entry in scenario.estimators if entry.row in estimators]
        changes["claims"] = [c for c in scenario.claims if c.better in estimators and c.than in estimators]
    return scenario.model_copy(update=changes) if changes else scenario


def prepare(setup: Setup) -> Trajectory:
    """Find out what is wrong before anything is written: plug-ins, estimators, windows; fly, so that workers find the flight.

    An estimator with a method ``prepare(scenario)`` is given the occasion to load what its runs will share, one with
    ``learn(flights)`` the training flights (`testbed.training.flights.TrainingFlights`).
    """
    from testbed.data.registry import load_plugin, make_estimator

    scenario = setup.scenario
    for plugin in setup.plugins:
        load_plugin(plugin)
    for k, entry in enumerate(scenario.estimators):
        try:
            estimator = make_estimator(entry.name, **entry.params)
            check_sensors(estimator)
        except InputError as error:
            raise InputError(f"{scenario.source_path}: 'estimators.{k}': {error}") from None
        if (ready := getattr(estimator, "prepare", None)) is not None:
            ready(scenario)
        if (learn := getattr(estimator, "learn", None)) is not None:
            learn(TrainingFlights(scenario))
    trajectory = pipeline.fly(scenario, 0)
    log, _ = pipeline.sense(scenario, trajectory)
    check_claims(scenario, [window.name for window in pipeline.windows_of(scenario, trajectory, log)])
    return trajectory


def check_claims(scenario: Scenario, windows: Sequence[str]) -> None:
    """Raise InputError for a claim on a metric or window that does not exist."""
    from testbed.scoring.quantities import TIME_METRIC, metric_names

    metrics = [*metric_names(), TIME_METRIC]
    for claim in scenario.active_claims():
        where = f"{scenario.source_path or scenario.name}: claim '{claim.id or claim.text}'"
        if claim.metric not in metrics:
            raise InputError(
                f"{where}: unknown metric '{claim.metric}'; {nearest(claim.metric, metrics)} (testbed list metrics shows all)"
            )
        if claim.window not in windows:
            raise InputError(f"{where}: unknown window '{claim.window}'; {nearest(claim.window, windows)}")


def provenance(scenario: Scenario, setup: Setup) -> dict[str, Any]:
    """What a reader of the result will want to know: versions, git revision, machine, seeds."""
    import platform
    from importlib.metadata import PackageNotFoundError, version

    packages = {}
    for name in ("numpy", "scipy", "numba", "pandas", "jsbsim", "torch"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "scenario": scenario.name,
        "variant": scenario.variant,
        "profile": scenario.profile,
        "reading": scenario.reading,
        "settings": {key: value for key, value in scenario.settings.items() if key != "monte_carlo.seed"},
        "seed": scenario.monte_carlo.seed,
        "runs": scenario.monte_carlo.runs,
        "estimators": [entry.row for entry in scenario.estimators],
        "notes": notes_of(scenario),
        "plugins": [_as_seen_from_here(Path(p)) for p in setup.plugins],
        "testbed": testbed.__version__,
        "git": git_revision(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": packages,
    }


def _as_seen_from_here(path: Path) -> str:
    """Relative to the current folder where it lies below, else the file's name: a result speaks of no machine's folders."""
    here = Path.cwd()
    return path.relative_to(here).as_posix() if path.is_relative_to(here) else path.name


def git_revision() -> str | None:
    """Commit of the checkout that the package runs from, with ``+`` where it was changed; None outside of git.

    ``reports`` do not count: they are made of results, and no result of them.
    """
    import subprocess

    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return None
    try:
        commands = (
            ["git", "rev-parse", "--short=12", "HEAD"],
            ["git", "status", "--porcelain", "--untracked-files=no", "--", ".", ":(exclude)reports"],
        )
        head, changes = (subprocess.run(c, cwd=folder, capture_output=True, text=True, timeout=10) for c in commands)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return head.stdout.strip() + ("+" if changes.stdout.strip() else "") if head.returncode == 0 else None


def _complete(store: Store, missing: list[int], wanted: int, units: Any, progress: Progress | None) -> None:
    """Compute and store the missing runs; ``units`` is a generator of them."""
    done = wanted - len(missing)
    try:
        if progress is not None:
            progress(done, wanted)

        for unit in units:
            store.write_run(unit.run, unit.content, unit.files)
            done += 1
            if progress is not None:
                progress(done, wanted)
    except KeyboardInterrupt:
        raise Interrupted(
            f"{store.out}: stopped with {done} of {wanted} runs stored; the same command with --resume completes them"
        ) from None
    finally:
        units.close()


def _units(setup: Setup, missing: list[int], jobs: int, client: Any) -> Any:
    """Generator of finished units: on the Dask cluster of ``client``, in this process, or in a pool.

    A lone run with plug-ins has a worker, too: one of them may end the process that it runs in.
    """
    if client is not None:
        return executors.cluster(setup, missing, client)
    here = jobs == 1 or (len(missing) == 1 and not setup.plugins)
    if not missing or (setup.limit_s is None and here):
        return executors.inline(setup, missing)
    return executors.Pool(setup, min(jobs, len(missing))).run(missing)


def _narrow(store: Store, scenario: Scenario, runs: int, width_pct: float) -> bool:
    """Whether the interval of every claim is narrower than ``width_pct``, or will never be because the runs are copies.

    Claims on computation time are not looked at, or the number of runs would depend on the machine.
    """
    from testbed.montecarlo.aggregate import claim_values
    from testbed.scoring.quantities import TIME_METRIC
    from testbed.scoring.verdicts import measure

    claims = [claim for claim in scenario.active_claims() if claim.metric != TIME_METRIC]
    cells = [(row, c.window, c.metric) for c in claims for row in (c.better, c.than)]
    values = claim_values(store, range(runs), cells)
    effects = [measure(claim, lambda *cell: values.get(cell), scenario.monte_carlo.seed) for claim in claims]
    return all(e is None or (e.n == 1 and runs > 1) or e.high - e.low < width_pct for e in effects)
