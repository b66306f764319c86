"""The objective of a search: a population of candidates in, one value for each out; sensing is done once.

Metrics as `testbed.scoring.metrics` names them (m, m/s, degrees), summed over metrics and cases and averaged over runs. Candidates and
recordings are spread over threads where the estimator releases Python's lock (a method ``searcher`` of the class that
defines ``run``, whose result may take ``batch_size`` candidates at once by a method ``batch``), else over processes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.data.estimator import fast_path
from testbed.data.records import Array, Innovations, SensorErrors, SensorLog, Trajectory
from testbed.data.registry import estimator_class, load_plugin, log_for, make_estimator
from testbed.scenario import Scenario
from testbed.scenario.windows import Window
from testbed.scoring.metrics import divergence, error_series, score
from testbed.tuning.config import RMSE_METRICS, TuneConfig, case_scenario, tuned_entry
from testbed.tuning.space import Space, make_space

DEVIANCE = "innovation_deviance"
"""Name of -2 log likelihood of the innovations per fix, up to a constant."""
Metrics = dict[str, float]
Task = tuple[Sequence[Mapping[str, Any]], int, Sequence[int] | None]
"""Parameters of some candidates, the recording on which they are scored, and the runs whose noise they meet instead of its own."""
Sense = Callable[[Any, int], SensorLog]
"""What a recording's sensors give in another run on the same flight."""


@dataclass(frozen=True)
class Recording:
    """One flight as one case's sensors recorded it in one Monte Carlo run."""

    case: str
    run: int
    log: SensorLog
    trajectory: Trajectory
    errors: SensorErrors | None
    windows: tuple[Window, ...]
    divergence_m: float


def record(scenario: Scenario, config: TuneConfig, runs: Sequence[int]) -> list[Recording]:
    """Fly and sense every case in every run."""
    out = []
    for case in config.cases:
        made = case_scenario(scenario, case)
        trajectory = None
        for run in runs:
            if trajectory is None or pipeline.flight_varies(made):
                trajectory = pipeline.fly(made, run)
            log, errors = pipeline.sense(made, trajectory, run=run)
            windows = tuple(pipeline.windows_of(made, trajectory, log))
            if config.window not in [w.name for w in windows]:
                raise InputError(
                    f"{scenario.source_path}: [extra.tune] window: no window '{config.window}' in this scenario"
                )
            out.append(
                Recording(case.name, run, log, trajectory, errors, windows, made.monte_carlo.divergence_position_m)
            )
    return out


def full_score(name: str, params: Mapping[str, Any], recording: Recording, window: str = "all") -> Metrics:
    """Every metric of an estimator on a recording, and `DEVIANCE`; empty where it failed or diverged."""
    try:
        estimator = make_estimator(name, **params)
        solution = estimator.run(log_for(estimator, recording.log))
    except InputError:
        raise
    except (ArithmeticError, ValueError, np.linalg.LinAlgError):
        return {}
    if divergence(error_series(recording.trajectory, solution), recording.divergence_m):
        return {}
    windows = [w for w in recording.windows if w.name == window]
    table = score(recording.trajectory, solution, windows, errors=recording.errors, gnss=recording.log.gnss)
    out = dict(zip(table["metric"], table["value"], strict=True))
    if solution.innovations:
        parts = [nu for nu in map(Innovations.taken, solution.innovations.values()) if len(nu.t)]
        counts = [len(nu.t) for nu in parts]
        out[DEVIANCE] = float(np.average(list(map(deviance, parts)), weights=counts)) if parts else float("inf")
    return out


def deviance(innovations: Innovations) -> float:
    """Mean of log det S + nu' S^-1 nu; infinite where an S is not positive definite."""
    used = np.isfinite(innovations.value).all(axis=1)
    nu, s = innovations.value[used], innovations.covariance[used]
    sign, log_det = np.linalg.slogdet(s)
    if len(nu) == 0 or (sign <= 0).any():
        return float("inf")
    squared = np.einsum("ki,ki->k", nu, np.linalg.solve(s, nu[:, :, None])[:, :, 0])
    return float(np.mean(log_det + squared))


class Objective:
    """Evaluates populations. Use it as a context, or `close` it: it holds threads or processes.

    ``metrics`` are summed; pass ``[DEVIANCE]`` for the likelihood. ``fast`` says which path is taken. ``sense`` makes the log
    of a run for candidates that each meet noise of their own.
    """

    def __init__(
        self,
        estimator: str,
        fixed: Mapping[str, Any],
        space: Space,
        recordings: Sequence[Recording],
        metrics: Sequence[str],
        window: str = "all",
        stride: int = 10,
        penalty: float = 1e6,
        jobs: int = 1,
        plugins: Sequence[str | Path] = (),
        sense: Sense | None = None,
    ) -> None:
        self._sense = sense
        self.estimator, self.fixed, self.space, self.metrics = estimator, dict(fixed), space, list(metrics)
        self._plugins = [str(path) for path in plugins]
        self.recordings, self.window, self.penalty, self.jobs = list(recordings), window, penalty, jobs
        runs = {case: sum(r.case == case for r in recordings) for case in {r.case for r in recordings}}
        self._weights = np.array([1.0 / runs[r.case] for r in recordings])
        self._score, self._pool = self._path(stride)

    def _path(self, stride: int) -> tuple[Callable[[Task], list[float]], Executor | None]:
        self._portion, self.takes_logs = 1, False
        make_searcher = fast_path(estimator_class(self.estimator), "searcher")
        self.fast = (
            make_searcher is not None and self.window == "all" and set(self.metrics) <= {*RMSE_METRICS, DEVIANCE}
        )
        if self.fast and make_searcher is not None:
            searchers = [make_searcher(r.log, r.trajectory, stride) for r in self.recordings]
            return self._threaded(searchers), ThreadPoolExecutor(self.jobs) if self.jobs > 1 else None
        arguments = (self.estimator, self.metrics, self.window, self.recordings)
        if self.jobs > 1:
            return _score_in_worker, _processes(self.jobs, (self._plugins, *arguments))
        return _Scorer(*arguments), None

    def _threaded(self, searchers: list[Any]) -> Callable[[Task], list[float]]:
        rows = [RMSE_METRICS.index(m) for m in self.metrics if m != DEVIANCE]
        likelihood = DEVIANCE in self.metrics
        self._portion = getattr(searchers[0], "batch_size", 1)
        self.takes_logs = getattr(searchers[0], "takes_logs", False)

        def score_some(task: Task) -> list[float]:
            candidates, k, runs = task
            made = [make_estimator(self.estimator, **params) for params in candidates]
            score = searchers[k]
            found: Iterable[Any]
            if runs is not None and self._sense is not None:
                logs = [self._sense(self.recordings[k], run) for run in runs]
                found = zip(*score.batch(made, logs), strict=True)
            elif self._portion > 1:
                found = zip(*score.batch(made), strict=True)
            else:
                found = (score(candidate) for candidate in made)
            return [float(rmse[rows].sum()) + (float(d) if likelihood else 0.0) for rmse, d in found]

        return score_some

    def __call__(self, x: Array, runs: Sequence[int] | None = None) -> Array:
        """(n,d) points to (n,) values; the penalty where a candidate diverges on any recording.

        ``runs`` (n): the Monte Carlo run whose noise each of them meets; None: that of the recordings.
        """
        candidates = [self.space.over(self.fixed, row) for row in np.atleast_2d(x)]
        parts = [slice(k, k + self._portion) for k in range(0, len(candidates), self._portion)]
        tasks: list[Task] = [
            (candidates[part], k, None if runs is None else runs[part])
            for k in range(len(self.recordings))
            for part in parts
        ]
        found = map(self._score, tasks) if self._pool is None else self._pool.map(self._score, tasks)
        values = np.concatenate(list(found)).reshape(len(self.recordings), len(candidates))
        total = np.zeros(len(candidates))
        with np.errstate(invalid="ignore"):
            # One after the other: a library's product may round differently with the number of candidates.
            for weight, row in zip(self._weights, values, strict=True):
                total += weight * row
        return np.where(np.isfinite(total), np.minimum(total, self.penalty), self.penalty)

    def close(self) -> None:
        """Let threads and processes go."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def __enter__(self) -> Objective:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Scorer:
    """The general path: runs the estimator and scores its solution as `testbed run` does."""

    def __init__(self, estimator: str, metrics: list[str], window: str, recordings: list[Recording]) -> None:
        self.estimator, self.metrics, self.window, self.recordings = estimator, metrics, window, recordings

    def __call__(self, task: Task) -> list[float]:
        candidates, k, _ = task
        found = [full_score(self.estimator, params, self.recordings[k], self.window) for params in candidates]
        return [float(sum(scores.get(metric, np.inf) for metric in self.metrics)) for scores in found]


_worker: _Scorer | None = None


def _processes(jobs: int, arguments: tuple[Any, ...]) -> Executor:
    """Fresh processes: one that is forked off beside running threads can hang."""
    return ProcessPoolExecutor(jobs, get_context("spawn"), initializer=_start_worker, initargs=arguments)


def _start_worker(
    plugins: list[str], estimator: str, metrics: list[str], window: str, recordings: list[Recording]
) -> None:
    global _worker
    for path in plugins:
        load_plugin(path)
    _worker = _Scorer(estimator, metrics, window, recordings)


def _score_in_worker(task: Task) -> list[float]:
    assert _worker is not None
    return _worker(task)


def scenario_space(scenario: Scenario, config: TuneConfig) -> Space:
    """The space of the estimator that the scenario tunes."""
    return make_space(tuned_entry(scenario, config).name, config.space, scenario.source_path)


def make_objective(
    scenario: Scenario,
    config: TuneConfig,
    recordings: Sequence[Recording],
    likelihood: bool = False,
    jobs: int = 1,
    plugins: Sequence[str | Path] = (),
) -> Objective:
    """The objective that ``[extra.tune]`` describes, or the likelihood of the innovations on the same recordings."""
    entry = tuned_entry(scenario, config)
    metrics = [DEVIANCE] if likelihood else config.metrics
    space = scenario_space(scenario, config)
    sense = None if config.noise == "frozen" else _sense_anew(scenario, config)
    chosen = (metrics, config.window, config.stride, config.penalty, jobs, plugins, sense)
    made = Objective(entry.name, entry.params, space, recordings, *chosen)
    if sense is not None and not made.takes_logs:
        made.close()
        raise InputError(
            f"{scenario.source_path}: [extra.tune] noise = 'fresh': '{entry.row}' with this window and these metrics has no"
            " fast path that takes a log for each candidate; use noise = 'frozen'"
        )
    return made


def _sense_anew(scenario: Scenario, config: TuneConfig) -> Sense:
    """What the sensors of a recording's case give in another run. Raises InputError where flights vary, or nothing is sensed."""
    cases = {case.name: case_scenario(scenario, case) for case in config.cases}
    for made in cases.values():
        if made.flight is None or pipeline.flight_varies(made):
            raise InputError(
                f"{scenario.source_path}: [extra.tune] noise = 'fresh' draws the errors of the sensors anew on one flight: it"
                " needs [flight] and sensors, and no flight that varies"
            )
    return lambda recording, run: pipeline.sense(cases[recording.case], recording.trajectory, run=run)[0]
