"""The unit of work of a Monte Carlo: one run, from one flight and one seed to the scores of every estimator.

A unit is a pure function of `Setup` and the run's number (but for the seconds that it took), so it may be computed in
any process, in any order, and again. It returns the bytes of its files; only the main process writes to the disk.
"""

from __future__ import annotations

import sysconfig
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numba.core import event

from testbed import pipeline
from testbed.base.errors import InputError, TestbedError
from testbed.base.time_limit import TimeLimitError, time_limit
from testbed.data.records import Array, NavSolution, SensorErrors, SensorLog, Trajectory
from testbed.data.registry import load_plugin, make_estimator
from testbed.data.shapes import gaps_of
from testbed.montecarlo import first_run as details
from testbed.scenario import EstimatorConfig, Scenario
from testbed.scenario.windows import Window
from testbed.scoring import metrics
from testbed.scoring.quantities import AXES

ENVELOPE_POINTS = 600
"""Largest number of times in an error envelope; the spacing is a whole number of seconds."""

FOREIGN = (str(Path(__file__).parents[1]), *(sysconfig.get_paths()[kind] for kind in ("stdlib", "purelib", "platlib")))
"""Folders of code that is no estimator's: an error that comes up there has its cause further out."""

Heartbeat = Callable[[int, str, float | None], None]
"""Called with run, estimator row and time limit (s) before an estimator starts; with an empty row when the unit ends."""


@dataclass(frozen=True)
class Setup:
    """What every unit of a batch shares."""

    scenario: Scenario
    plugins: tuple[str, ...] = ()
    timeout_s: float | None = None
    cold_s: float = 60.0
    """Added to the time limit of an estimator's first run in a process, which may have to compile or load a network."""
    batch: str = ""
    """Hash that the stored runs carry: what they are runs of."""

    @property
    def limit_s(self) -> float | None:
        """Longest time of one estimator on one run."""
        return self.timeout_s or self.scenario.monte_carlo.timeout_s


@dataclass(frozen=True)
class Outcome:
    """How one estimator fared: ``ok``, ``diverged``, ``timeout`` or ``failed: reason``, with the reason in full."""

    estimator: str
    status: str
    reason: str = ""
    seconds: float = 0.0
    samples: int = 0


@dataclass
class UnitResult:
    """Scores of one run. ``rows`` (estimator, window, metric, value); ``series`` name -> (estimator -> array)."""

    run: int
    outcomes: list[Outcome] = field(default_factory=list)
    rows: list[tuple[str, str, str, float]] = field(default_factory=list)
    series: dict[tuple[str, str], Array] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    """Files of the folder ``details``, from run 0 only."""

    def put_in_order(self, rows: list[str]) -> None:
        """Sort everything by the scenario's rows, in whatever order they ran."""
        place = {row: k for k, row in enumerate(rows)}
        self.outcomes.sort(key=lambda outcome: place[outcome.estimator])
        self.rows.sort(key=lambda row: place[row[0]])
        self.series = dict(sorted(self.series.items(), key=lambda item: place[item[0][0]]))


class Bench:
    """A worker's standing equipment: plug-ins loaded once, the flight held as long as runs share it."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        for plugin in setup.plugins:
            load_plugin(plugin)
        self._trajectory: Trajectory | None = None
        self._warm: set[str] = set()

    def trajectory(self, run: int) -> Trajectory:
        """The flight of a run."""
        if pipeline.flight_varies(self.setup.scenario):
            return pipeline.fly(self.setup.scenario, run)
        if self._trajectory is None:
            self._trajectory = pipeline.fly(self.setup.scenario, 0)
        return self._trajectory

    def execute(
        self, run: int, skip: Mapping[str, str] | None = None, heartbeat: Heartbeat | None = None
    ) -> UnitResult:
        """Compute a unit. ``skip`` maps estimators that are known to kill or hang a worker to their status."""
        scenario, result = self.setup.scenario, UnitResult(run)
        try:
            trajectory = self.trajectory(run)
            log, errors = pipeline.sense(scenario, trajectory, run=run)
            windows = pipeline.windows_of(scenario, trajectory, log)
            trajectory = pipeline.truth_at_imu(trajectory, log)
        except Exception as error:
            return lost(self.setup, run, f"no data: {_reason(error)}")
        collected: list[tuple[EstimatorConfig, NavSolution, metrics.ErrorSeries]] = []
        # Every other run goes backwards: two workers that find nothing compiled share the kernels out between them.
        order = scenario.estimators if run % 2 == 0 else scenario.estimators[::-1]
        for entry in order:
            if skip and entry.row in skip:
                result.outcomes.append(Outcome(entry.row, _short(skip[entry.row]), skip[entry.row]))
                continue
            limit = self.setup.limit_s
            if limit is not None and entry.name not in self._warm:
                limit += self.setup.cold_s
            if heartbeat is not None:
                heartbeat(run, entry.row, limit)
            outcome, solution = self._estimate(entry, log, limit)
            self._warm.add(entry.name)
            if solution is not None:
                outcome, series = self._score(result, outcome, solution, trajectory, log, errors, windows)
                if series is not None and run == 0:
                    collected.append((entry, solution, series))
            result.outcomes.append(outcome)
        result.put_in_order([entry.row for entry in scenario.estimators])
        if run == 0:
            result.files = details.make(scenario, trajectory, log, collected, errors)
        if heartbeat is not None:
            heartbeat(run, "", None)
        return result

    def _estimate(
        self, entry: EstimatorConfig, log: SensorLog, limit: float | None
    ) -> tuple[Outcome, NavSolution | None]:
        """One estimator on one log; whatever it raises costs only its own row."""
        guard: AbstractContextManager[Any] = time_limit(limit) if limit else nullcontext()
        samples, start = len(log.imu.t), time.perf_counter()
        try:
            with guard:
                estimator = make_estimator(entry.name, **entry.params)
                if not getattr(estimator, "timed", True):
                    samples = 0  # and so none of the tables of times has it
                compiling: list[float] = []
                with np.errstate(all="ignore"), event.install_timer("numba:compiler_lock", compiling.append):
                    start = time.perf_counter()
                    solution = estimator.run(log)
                    seconds = time.perf_counter() - start
                seconds -= sum(compiling)  # or a process's first run would count what kernels take to compile or load
            if not isinstance(solution, NavSolution):
                raise InputError(f"run(log) returned {type(solution).__name__}, not a NavSolution")
        except TimeLimitError:
            return Outcome(entry.row, "timeout", f"no answer within {limit:g} s", float(limit or 0), samples), None
        except (KeyboardInterrupt, MemoryError):
            raise
        except BaseException as error:
            if _is_interrupt(error):
                raise KeyboardInterrupt from error
            reason = _reason(error)
            return Outcome(entry.row, f"failed: {reason}", reason, time.perf_counter() - start, samples), None
        return Outcome(entry.row, "ok", "", seconds, samples), solution

    def _score(
        self,
        result: UnitResult,
        outcome: Outcome,
        solution: NavSolution,
        trajectory: Trajectory,
        log: SensorLog,
        errors: SensorErrors | None,
        windows: list[Window],
    ) -> tuple[Outcome, metrics.ErrorSeries | None]:
        """Add the rows and series of a solution to the result; a diverged one adds none."""
        row = outcome.estimator
        with np.errstate(all="ignore"):
            try:
                span = max(trajectory.t[0], log.imu.t[0]), min(trajectory.t[-1], log.imu.t[-1])
                if gap := metrics.coverage(solution, *span, gaps_of(log.imu.t)):
                    raise InputError(gap)
                series = metrics.error_series(trajectory, solution)
                reason = metrics.divergence(series, self.setup.scenario.monte_carlo.divergence_position_m)
                if reason:
                    reason += _degrees_hint(solution)
                    return Outcome(row, "diverged", reason, outcome.seconds, outcome.samples), series if len(
                        series.t
                    ) else None
                tests = metrics.consistency(series, solution, errors)
                rows = metrics.score_rows(series, tests, windows)
                if log.gnss is not None:
                    rows += metrics.gnss_rows(solution, log.gnss, windows)
            except Exception as error:
                reason = f"its solution cannot be scored: {_reason(error)}"
                return Outcome(row, f"failed: {reason}", reason, outcome.seconds, outcome.samples), None
        result.rows += [(row, *r) for r in rows]
        for name, values in time_series(series, solution, tests, trajectory).items():
            result.series[row, name] = values
        return outcome, series


def lost(setup: Setup, run: int, reason: str) -> UnitResult:
    """A run that no estimator saw, for example because its dispersed flight could not be flown."""
    return UnitResult(run, [Outcome(entry.row, f"failed: {reason}", reason) for entry in setup.scenario.estimators])


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an error: one that arrives inside of a compiled loop comes out as a SystemError."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def _reason(error: BaseException) -> str:
    """Type, message and place of an error in one line: the innermost place in an estimator; a user's mistake says its own."""
    text = f"{type(error).__name__}: {error}".strip().splitlines()[0][:300]
    frames = traceback.extract_tb(error.__traceback__)
    if not frames or isinstance(error, TestbedError):
        return text
    own = [frame for frame in frames if not frame.filename.startswith(FOREIGN)]
    place = own[-1] if own else frames[-1]
    return f"{text} ({Path(place.filename).name}:{place.lineno})"


def _degrees_hint(solution: NavSolution) -> str:
    place = np.abs([solution.lat[0], solution.lon[0]])
    return "; are lat and lon in radians?" if place[0] > 0.5 * np.pi or place[1] > 2.0 * np.pi else ""


def _short(status: str) -> str:
    return status if status.startswith("failed") else status.split(":")[0]


def envelope_times(trajectory: Trajectory) -> Array:
    """Times of the error envelopes: every whole second, or every few, so that there are at most `ENVELOPE_POINTS`."""
    start, end = float(trajectory.t[0]), float(trajectory.t[-1])
    step = max(1.0, float(np.ceil((end - start) / ENVELOPE_POINTS)))
    return start + step * np.arange(1.0, int((end - start + 1e-6) / step) + 1.0, dtype=np.float64)


def time_series(
    series: metrics.ErrorSeries, solution: NavSolution, tests: dict[str, metrics.Consistency], trajectory: Trajectory
) -> dict[str, Array]:
    """Float32 series at `envelope_times`: errors, ``sigma_`` of each, and sums of each test, ``dof_``, ``count_``."""
    grid = envelope_times(trajectory)
    out: dict[str, Array] = {}
    covered = (grid >= series.t[0] - 1e-6) & (grid <= series.t[-1] + 1e-6)
    k = metrics.nearest_rows(series.t, grid)

    def sampled(column: Array) -> Array:
        return np.where(covered, column[k], np.nan).astype(np.float32)

    for i in series.axes():
        out[AXES[i]] = sampled(series.values[:, i])
    for name, sigma in details.axis_sigmas(solution, metrics.nearest_rows(solution.t, grid)).items():
        out[f"sigma_{name}"] = np.where(covered, sigma, np.nan).astype(np.float32)
    if len(grid) < 2:
        return out
    half = 0.5 * (grid[1] - grid[0])
    for name, test in tests.items():
        cell = np.floor((test.t - grid[0] + half) / (2 * half)).astype(int)
        keep = (cell >= 0) & (cell < len(grid))
        out[name] = np.bincount(cell[keep], test.value[keep], len(grid)).astype(np.float32)
        out[f"dof_{name}"] = np.bincount(cell[keep], test.dof[keep], len(grid)).astype(np.float32)
        out[f"count_{name}"] = np.bincount(cell[keep], minlength=len(grid)).astype(np.float32)
    return out
