"""Points of a plan evaluated: the flight as it is, the sensors and filters with the point's figures, the metrics of each seed.

All points are sensed with the random numbers of the scenario's runs 0, 1, ... (one stream per error source, whatever its size),
so that two points differ by their figures alone.
"""

from __future__ import annotations

import signal
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from testbed import pipeline
from testbed.base.child_processes import can_fork, end_with_parent, quietly
from testbed.base.errors import InputError, TestbedError, nearest
from testbed.base.time_limit import single_threaded, thread_environment
from testbed.data.records import Array, Trajectory
from testbed.data.registry import load_plugin, log_for, make_estimator
from testbed.scenario import Scenario
from testbed.scoring.judged import judge
from testbed.scoring.quantities import DIVERGED
from testbed.sensitivity.factors import Factor, at

PORTION = 4
"""Points that a worker takes at once: a second or two of work, against a millisecond for handing it over."""


class Cell(NamedTuple):
    """What an index is about: a metric of an estimator's row in a window."""

    estimator: str
    window: str
    metric: str

    def __str__(self) -> str:
        return "|".join(self)


@dataclass(frozen=True)
class Model:
    """The function whose indices are sought: from a point (d,) of the unit cube to the cells' values for each seed."""

    scenario: Scenario
    factors: tuple[Factor, ...]
    cells: tuple[Cell, ...]
    runs: int
    plugins: tuple[str, ...] = ()


class Evaluated(NamedTuple):
    """Values (cells, runs) at a point, NaN where a run was lost, and why the first of them was."""

    values: Array
    lost: str = ""


class Evaluator:
    """Evaluates points in this process; holds the flights."""

    def __init__(self, model: Model) -> None:
        self.model = model
        for plugin in model.plugins:
            load_plugin(plugin)
        varies = pipeline.flight_varies(model.scenario)
        self._flights = [pipeline.fly(model.scenario, run) for run in range(model.runs if varies else 1)]

    def flight(self, run: int) -> Trajectory:
        """The truth of a run."""
        return self._flights[run % len(self._flights)]

    def __call__(self, u: Array) -> Evaluated:
        """Evaluate a point (d,)."""
        model = self.model
        settings = {factor.key: factor.value(float(share)) for factor, share in zip(model.factors, u, strict=True)}
        values, lost = np.full((len(model.cells), model.runs), np.nan), ""
        scenario = at(model.scenario, settings, "sensitivity")
        for run in range(model.runs):
            for row, reason, found in self.one_run(scenario, run, {cell.window for cell in model.cells}):
                found["", DIVERGED] = float(bool(reason))
                lost = lost or (reason and f"{row}, run {run}: {reason}")
                for k, cell in enumerate(model.cells):
                    if cell.estimator == row:
                        window = "" if cell.metric == DIVERGED else cell.window
                        values[k, run] = found.get((window, cell.metric), np.nan)
        return Evaluated(values, lost)

    def one_run(
        self, scenario: Scenario, run: int, windows: set[str] | None = None
    ) -> Iterator[tuple[str, str, dict[tuple[str, str], float]]]:
        """Row of each estimator, why it was lost in this run, and its metrics by window and name."""
        flight = self.flight(run)
        log, errors = pipeline.sense(scenario, flight, run=run)
        chosen = [w for w in pipeline.windows_of(scenario, flight, log) if windows is None or w.name in windows]
        truth = pipeline.truth_at_imu(flight, log)
        for entry in scenario.estimators:
            try:
                with np.errstate(all="ignore"):
                    estimator = make_estimator(entry.name, **entry.params)
                    solution = estimator.run(log_for(estimator, log))
                limit = scenario.monte_carlo.divergence_position_m
                reason, rows, *_ = judge(solution, truth, log, errors, chosen, limit)
            except MemoryError:
                raise
            except Exception as error:  # a plug-in may raise anything, and loses this run only
                reason, rows = f"{type(error).__name__}: {error}", []
            yield entry.row, reason, {(window, metric): value for window, metric, value in rows}


def cells_of(model: Model, metrics: Sequence[str], windows: Sequence[str]) -> tuple[list[Cell], list[str]]:
    """The cells that the scenario has at its own figures, and notes on those that it lacks.

    Raises InputError for a window that does not exist, and where no estimator is scored on any of the metrics.
    """
    evaluator = Evaluator(model)
    _try_ends(evaluator)
    flight = evaluator.flight(0)
    log, _ = pipeline.sense(model.scenario, flight)
    known = [window.name for window in pipeline.windows_of(model.scenario, flight, log)]
    for window in windows:
        if window not in known:
            raise InputError(f"--window {window}: no such window in {model.scenario.name}; {nearest(window, known)}")
    cells, notes = [], []
    for row, reason, found in evaluator.one_run(model.scenario, 0):
        for window in windows:
            for metric in metrics:
                if (window, metric) in found or metric == DIVERGED:
                    cells.append(Cell(row, window, metric))
                elif reason:
                    cells.append(Cell(row, window, metric))
                    notes.append(f"{row} is lost already with the scenario's own figures: {reason}")
                else:
                    notes.append(f"{row} is not scored on {metric} in window {window}")
    if not cells:
        raise InputError(f"{model.scenario.name}: {'; '.join(notes)}")
    return cells, list(dict.fromkeys(notes))


def _try_ends(evaluator: Evaluator) -> None:
    """Raise InputError where sensors or estimators refuse an end of a range: a point of the plan would only be lost."""
    model = evaluator.model
    for factor in model.factors:
        for value in (factor.low, factor.high):
            try:
                scenario = at(model.scenario, {factor.key: value}, f"--over {factor}")
                pipeline.sense(scenario, evaluator.flight(0))
                for entry in scenario.estimators:
                    make_estimator(entry.name, **entry.params)
            except InputError as error:
                told = str(error).removeprefix(f"--over {factor}: ")
                raise InputError(f"--over {factor}: at {value:g}: {told}") from None


_evaluator: Evaluator | None = None


def _start_worker(model: Model) -> None:
    global _evaluator
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's business
    end_with_parent()
    single_threaded().__enter__()
    _evaluator = Evaluator(model)


def _work(points: Array) -> list[Evaluated]:
    assert _evaluator is not None
    return [_evaluator(u) for u in points]


def evaluate(
    model: Model, points: Array, rows: Sequence[int], jobs: int
) -> Generator[tuple[list[int], list[Evaluated]]]:
    """Values at the points of these rows, in portions, as they are done; ``jobs`` processes, or this one."""
    portions = [list(rows[k : k + PORTION]) for k in range(0, len(rows), PORTION)]
    if jobs == 1 or len(portions) < 2:
        with single_threaded():
            evaluator = Evaluator(model)
            for portion in portions:
                yield portion, [evaluator(points[row]) for row in portion]
        return
    yield from _in_processes(model, points, portions, jobs)


def _in_processes(
    model: Model, points: Array, portions: Sequence[list[int]], jobs: int
) -> Generator[tuple[list[int], list[Evaluated]]]:
    """Two portions per worker are in flight. Raises TestbedError when a worker dies."""
    context = get_context("fork" if can_fork() else "spawn")
    waiting = iter(portions)
    flying: dict[Future[list[Evaluated]], list[int]] = {}
    pool = ProcessPoolExecutor(jobs, context, _start_worker, (model,))
    try:
        while True:
            with thread_environment(), quietly():
                for portion in islice(waiting, 2 * jobs - len(flying)):
                    flying[pool.submit(_work, points[portion])] = portion
            if not flying:
                return
            for future in wait(flying, return_when=FIRST_COMPLETED).done:
                yield flying.pop(future), future.result()
    except BrokenProcessPool:
        raise TestbedError(
            "a worker process ended (crash or memory); what is done is stored, and the same command with --resume goes on"
        ) from None
    finally:
        processes = list((pool._processes or {}).values())
        for process in processes:
            process.kill()
        pool.shutdown(wait=True, cancel_futures=True)
