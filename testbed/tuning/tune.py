"""The driver: every search that ``[extra.tune]`` asks for, stored as it goes, then scored on seen and unseen runs.

Folder: ``manifest.json``, ``scenario.toml``, ``evaluations/SEARCH.parquet``, ``best/SEARCH.toml`` (a parameter file),
``history.csv``, ``searches.csv``, ``scores.csv``, ``heldout.csv``, ``timings.csv``. All but the timings and the seconds of
the evaluations are a function of scenario and seeds, however often the work was interrupted. Metrics in m, m/s, degrees.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.checksums import DamagedError
from testbed.base.errors import InputError, TestbedError, nearest
from testbed.base.schema import dump_toml
from testbed.data.registry import load_plugin
from testbed.montecarlo import folders
from testbed.montecarlo.folders import Folder, check_own
from testbed.scenario import Scenario
from testbed.tuning.config import Task, TuneConfig, tasks_of, tune_config, tuned_entry
from testbed.tuning.history import AGAIN, History
from testbed.tuning.objective import Objective, make_objective, record, scenario_space
from testbed.tuning.search import ONE_BY_ONE, make_search
from testbed.tuning.tables import write_tables

KIND = "testbed tuning"
SAME_VALUE = 1e-6
"""Relative difference that another processor may make."""
FREE = ("algorithms", "iterations", "seeds", "test_runs", "innovation_search", "paper")
"""Keys of ``[extra.tune]`` that may change when a study is resumed: they add searches, or change none."""


@dataclass(frozen=True)
class Progress:
    """Where a study is: evaluations done of ``total``, the running search, its best value, seconds left (None: unknown)."""

    done: int
    total: int
    search: str
    best: float
    left_s: float | None


class Stopped(TestbedError):
    """The study was stopped before its end; what is done is stored."""


def tune(
    scenario: Scenario,
    out: str | Path,
    config: TuneConfig | None = None,
    jobs: int | None = None,
    resume: bool = False,
    only: str | None = None,
    time_limit_s: float | None = None,
    progress: Callable[[Progress], None] | None = None,
    plugins: Sequence[str | Path] = (),
) -> Path:
    """Run a study and return its folder; `testbed.tuning.report.write_report` renders it.

    ``jobs`` threads or processes share each population (default: all cores). ``only`` runs the search of this name and
    no tables. After ``time_limit_s`` the study stops at a whole evaluation; ``resume`` goes on. Raises Stopped when it
    is not complete, InputError for a folder that holds something else.
    """
    for plugin in plugins:
        load_plugin(plugin)
    config = config or tune_config(scenario)
    tasks = tasks_of(config)
    if only is not None:
        names = [task.name for task in tasks]
        if only not in names:
            raise InputError(f"--only {only}: no such search; {nearest(only, names)}")
        tasks = [task for task in tasks if task.name == only]
    jobs = jobs or os.cpu_count() or 1
    deadline = None if time_limit_s is None else time.monotonic() + time_limit_s
    meter = _Meter(sum(task.iterations for task in tasks) * config.population, progress)
    with _open(Path(out), scenario, config, resume or only is not None) as folder:
        folder.claim([f"evaluations/{task.name}.parquet" for task in tasks])
        recordings = record(scenario, config, config.train_runs)
        for likelihood in (False, True):
            chosen = [task for task in tasks if task.likelihood == likelihood]
            if chosen:
                with make_objective(scenario, config, recordings, likelihood, jobs, plugins) as objective:
                    for group in _abreast(chosen):
                        _search(group, config, objective, folder, deadline, meter)
        if only is None:
            write_tables(folder, scenario, config, tasks, recordings)
            _manifest(folder, scenario, config, finished=True)
    return folder.out


def _abreast(tasks: Sequence[Task]) -> Iterator[list[Task]]:
    """Searches in the order in which they run, side by side what can fill one another's lanes.

    The seeds of an algorithm and length together, as a population alone leaves lanes empty; a longer search after the shorter
    one, whose values it may borrow; at the end all that ask for single candidates.
    """
    groups: dict[tuple[str, int], list[Task]] = {}
    for task in tasks:
        alone = task.algorithm not in ONE_BY_ONE
        groups.setdefault((task.algorithm, task.iterations) if alone else ("", 0), []).append(task)
    single = groups.pop(("", 0), [])
    yield from groups.values()
    if single:
        yield single


class _Course:
    """One running search, with what it has evaluated so far."""

    def __init__(self, task: Task, config: TuneConfig, objective: Objective, folder: Folder) -> None:
        self.task, self._folder, self._objective, self._config = task, folder, objective, config
        path = folder.out / "evaluations" / f"{task.name}.parquet"
        others = sorted(
            set(path.parent.glob(replace(task, iterations=0).name.replace("0000", "*") + ".parquet")) - {path}
        )
        study = folder.manifest["identity"]
        self.history = History(path, objective.space.names, relatives=others, study=study)
        self._fresh = config.noise == "fresh"
        _unchanged(self.history, objective, self.runs(0, 1))
        settings = config.settings.get(task.algorithm)
        bounds = objective.space.bounds
        self.search = make_search(task.algorithm, bounds, config.population, task.iterations, task.seed, settings)
        self._watch = StopRule(config)
        self.done = False

    def replay(self, meter: _Meter) -> None:
        """Go on as far as the stored values carry."""
        while not self.done and (f := self.history.recall(self.search.ask())) is not None:
            self.tell(f, meter)
            meter.add(len(f), self.task.name, self.best, fresh=False)

    def runs(self, first: int, count: int) -> list[int] | None:
        """Whose noise the evaluations from ``first`` on meet, where it is not that of the recordings."""
        return list(self.task.fresh_runs(first, count)) if self._fresh else None

    @property
    def best(self) -> float:
        """The best value so far."""
        return self._watch.best

    def tell(self, f: Any, meter: _Meter) -> None:
        """Hand values on; the end of the search writes its parameter file."""
        self.search.tell(f)
        stop = self._watch.stops(f)
        self.done = stop or self.search.done
        if self.done:
            self._finish(meter)

    def _finish(self, meter: _Meter) -> None:
        task = self.task
        x, f, _ = self.history.all()
        if len(f) > 1 and (f == f[0]).all():
            why = "all diverge" if f[0] >= self._config.penalty else "the filter takes no notice of what is searched"
            raise InputError(
                f"{self.history.path}: the objective is {f[0]:.6g} for each of {len(f)} candidates ({why}: "
                f"{', '.join(self.history.names)}), so none is best; tune other parameters or another estimator"
            )
        meter.skip(task.iterations * self._config.population - len(f))
        best = int(f.argmin())
        what = "-2 log likelihood per fix" if task.likelihood else "objective"
        header = f"# Best of {len(f)} evaluations by {task.name}: {what} {f[best]:.6g}\n"
        content = (header + parameter_file(self._objective, x[best])).encode()
        self._folder.write_all({f"best/{task.name}.toml": content})

    def close(self) -> None:
        """Store what there is."""
        self.history.save()
        self.search.close()


def _search(
    tasks: Sequence[Task],
    config: TuneConfig,
    objective: Objective,
    folder: Folder,
    deadline: float | None,
    meter: _Meter,
) -> None:
    """Run or complete searches side by side: a round evaluates what all of them ask for."""
    courses: list[_Course] = []
    names = tasks[0].name + (f" and {len(tasks) - 1} beside it" if len(tasks) > 1 else "")
    try:
        for task in tasks:
            courses.append(_Course(task, config, objective, folder))
            courses[-1].replay(meter)
        while running := [course for course in courses if not course.done]:
            if deadline is not None and time.monotonic() > deadline:
                raise Stopped(f"{folder.out}: time is up in {names}; the same command with --resume goes on")
            asked = [course.search.ask() for course in running]
            start = time.perf_counter()
            runs = [course.runs(len(course.history), len(x)) for course, x in zip(running, asked, strict=True)]
            f = objective(np.concatenate(asked), [run for some in runs for run in some or ()] or None)
            each = (time.perf_counter() - start) / len(f)
            ends = np.cumsum([len(x) for x in asked])
            for course, x, values in zip(running, asked, np.split(f, ends[:-1]), strict=True):
                course.history.add(x, values, each * len(values))
                course.tell(values, meter)
            meter.add(len(f), names, min(course.best for course in courses), fresh=True)
            for course in running:
                course.replay(meter)
    except KeyboardInterrupt:
        raise Stopped(f"{folder.out}: stopped in {names}; the same command with --resume goes on") from None
    finally:
        for course in courses:
            course.close()


def _unchanged(history: History, objective: Objective, runs: list[int] | None) -> None:
    """Raise InputError when a stored candidate has another value now: flight, sensors or estimator have changed."""
    if stored := history.first():
        path, x, f = stored
        now = float(objective(x, runs)[0])
        if abs(now - f[0]) > SAME_VALUE * abs(now):
            raise InputError(
                f"{path}: its first candidate had the objective {f[0]:.9g} and has {now:.9g} now: the flight, the "
                "sensors or the estimator have changed since; delete the folder to start anew"
            )


def parameter_file(objective: Objective, x: Any) -> str:
    """A point of the space as the text of a file that ``params_file`` of a scenario can name."""
    params = objective.space.over(objective.fixed, x)
    return dump_toml(
        {"params": {k: list(v) if isinstance(v, tuple) else v for k, v in params.items() if v is not None}}
    )


class StopRule:
    """Looks at each whole iteration: target reached, or no improvement for ``stall`` of them."""

    def __init__(self, config: TuneConfig) -> None:
        self._target, self._stall, self._population = config.target, config.stall, config.population
        self.best = float("inf")
        self._count = self._improved_at = 0

    def stops(self, f: Any) -> bool:
        """Take new values; whether the search should end."""
        self._count += len(f)
        if f.min() < self.best:
            self.best, self._improved_at = float(f.min()), self._count
        if self._count % self._population:
            return False
        reached = self._target is not None and self.best <= self._target
        return reached or (
            self._stall is not None and self._count - self._improved_at >= self._stall * self._population
        )


class _Meter:
    """Counts evaluations and estimates the time left from those that were not recalled."""

    def __init__(self, total: int, tell: Callable[[Progress], None] | None) -> None:
        self.total, self._tell = total, tell
        self._done = self._fresh = 0
        self._start = time.monotonic()

    def add(self, count: int, search: str, best: float, fresh: bool) -> None:
        self._done += count
        self._fresh += count if fresh else 0
        if not fresh and self._fresh == 0:
            self._start = time.monotonic()
        if self._tell is not None:
            rate = self._fresh / max(time.monotonic() - self._start, 1e-9)
            left = (self.total - self._done) / rate if self._fresh else None
            self._tell(Progress(self._done, self.total, search, best, left))

    def skip(self, count: int) -> None:
        """A search that stopped early leaves so many evaluations out."""
        self.total -= count


def _open(out: Path, scenario: Scenario, config: TuneConfig, resume: bool) -> Folder:
    """Make or reopen the folder, to be closed."""
    previous = check_own(out, KIND)
    if previous is None:
        pass
    elif previous.get("identity") != identity(scenario, config):
        if resume or any((out / "evaluations").glob("*.parquet")):
            raise InputError(f"{out}: holds a study of another scenario, space or objective; give another --out")
    elif not resume and any((out / "evaluations").glob("*.parquet")):
        raise InputError(
            f"{out}: already holds this study; complete it with --resume, delete the folder, or give another --out"
        )
    folder = _Study.open(out, KIND)
    try:
        _manifest(folder, scenario, config, finished=False)
        folder.write_all({"scenario.toml": scenario.to_toml().encode()})
    except BaseException:
        folder.close()
        raise
    return folder


class _Study(Folder):
    """The folder of a study, which can be resumed."""

    again = AGAIN


def identity(scenario: Scenario, config: TuneConfig) -> str:
    """Hash of all that determines the value of a candidate and the course of a search."""
    data = scenario.to_data()
    for key in ("claims", "tables", "scenario"):
        data.pop(key, None)
    data["monte_carlo"].pop("runs")
    data["estimators"] = [tuned_entry(scenario, config).model_dump(mode="json")]
    data["extra"] = {k: v for k, v in config.model_dump(mode="json").items() if k not in FREE}
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a study, or None where the folder is none. Raises DamagedError for a damaged one."""
    manifest = folders.read_manifest(folder, KIND)
    if manifest is not None and not {"identity", "finished", "tune"} <= set(manifest):
        raise DamagedError(f"{folder / folders.MANIFEST}: damaged (it lacks what testbed tune writes)")
    return manifest


def _manifest(folder: Folder, scenario: Scenario, config: TuneConfig, finished: bool) -> None:
    import testbed
    from testbed.montecarlo.runner import git_revision

    folder.save(
        kind=KIND,
        identity=identity(scenario, config),
        finished=finished,
        scenario=scenario.name,
        title=scenario.scenario.title,
        variant=scenario.variant,
        profile=scenario.profile,
        estimator=tuned_entry(scenario, config).row,
        space=scenario_space(scenario, config).names,
        tune=config.model_dump(mode="json"),
        cores=os.cpu_count(),
        testbed=testbed.__version__,
        git=git_revision(),
    )


def conclude(scenario: Scenario, out: str | Path, config: TuneConfig | None = None) -> Path:
    """Write the tables of the searches that are complete, for a study whose other searches are given up; returns the folder.

    `tune` with ``resume`` still completes it. Raises InputError when the folder holds another study or no complete search.
    """
    config = config or tune_config(scenario)
    place, previous = Path(out), read_manifest(Path(out))
    if previous is None or previous["identity"] != identity(scenario, config):
        raise InputError(f"{place}: holds no study of this scenario, space and objective")
    tasks = [task for task in tasks_of(config) if (place / "best" / f"{task.name}.toml").is_file()]
    if not tasks:
        raise InputError(f"{place}: no search is complete; go on with testbed tune ... --resume")
    with _Study.open(place, KIND) as folder:
        write_tables(folder, scenario, config, tasks, record(scenario, config, config.train_runs))
        _manifest(folder, scenario, config, finished=True)
    return place
