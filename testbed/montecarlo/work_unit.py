"""The unit of work of a Monte Carlo: a few runs, each from one flight and one seed to the scores of every estimator.

What comes out for a run is a pure function of `Setup` and its number (but for the seconds that it took), so it may be computed
in any process, in any order, beside any other runs, and again. It returns the bytes of its files; only the main process writes
to the disk.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.base.guarded import reason_of, timed
from testbed.base.time_limit import TimeLimitError
from testbed.data.records import Array, NavSolution, SensorErrors, SensorLog, Trajectory
from testbed.data.registry import load_plugin, log_for, make_estimator
from testbed.montecarlo import first_run as details
from testbed.scenario import EstimatorConfig, Scenario
from testbed.scenario.windows import Window
from testbed.scoring import metrics
from testbed.scoring.judged import judge
from testbed.scoring.quantities import AXES

ENVELOPE_POINTS = 600
"""Largest number of times in an error envelope; the spacing is a whole number of seconds."""

BLOCK = 8
"""Most runs of a unit: estimators with ``run_many`` filter so many side by side."""
LONGEST_BLOCK = 50_000
"""IMU samples of a log above which each run goes by itself: eight solutions of 50,000 rows are a quarter of a gigabyte."""

Heartbeat = Callable[[Sequence[int], str, float | None], None]
"""Called with runs, estimator row and time limit (s) before an estimator starts; with an empty row when the unit ends."""


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

    skipped: dict[str, str] = field(default_factory=dict)
    """Estimators that are known to kill or hang a worker in this run, and their status."""

    def put_in_order(self, rows: list[str]) -> None:
        """Sort everything by the scenario's rows, in whatever order they ran."""
        place = {row: k for k, row in enumerate(rows)}
        self.outcomes.sort(key=lambda outcome: place[outcome.estimator])
        self.rows.sort(key=lambda row: place[row[0]])
        self.series = dict(sorted(self.series.items(), key=lambda item: place[item[0][0]]))


@dataclass
class Sensed:
    """A run before any estimator: its truth, what the sensors recorded and erred by, and where it is scored."""

    result: UnitResult
    trajectory: Trajectory
    log: SensorLog
    errors: SensorErrors | None
    windows: list[Window]
    for_details: list[tuple[EstimatorConfig, NavSolution, metrics.ErrorSeries]] = field(default_factory=list)
    """What run 0 is drawn from."""


class Bench:
    """A worker's standing equipment: plug-ins loaded once, the flight held as long as runs share it."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        for plugin in setup.plugins:
            load_plugin(plugin)
        self._trajectory: Trajectory | None = None
        self._warm: set[str] = set()
        self._times: bytes | None = None

    def trajectory(self, run: int) -> Trajectory:
        """The flight of a run."""
        if pipeline.flight_varies(self.setup.scenario):
            return pipeline.fly(self.setup.scenario, run)
        if self._trajectory is None:
            self._trajectory = pipeline.fly(self.setup.scenario, 0)
        return self._trajectory

    def execute(self, run: int) -> UnitResult:
        """Compute one run."""
        return self.execute_block([run])[0]

    def execute_block(
        self,
        runs: Sequence[int],
        skip: Mapping[int, Mapping[str, str]] | None = None,
        heartbeat: Heartbeat | None = None,
    ) -> list[UnitResult]:
        """Compute a unit. ``skip``: of a run, the estimators that are known to kill or hang a worker, and their status."""
        scenario, lost_runs, sensed = self.setup.scenario, [], []
        for run in runs:
            try:
                sensed.append(self._sense(run))
                sensed[-1].result.skipped |= (skip or {}).get(run, {})
            except Exception as error:
                lost_runs.append(lost(self.setup, run, f"no data: {reason_of(error)}"))
        # Every other unit goes backwards: two workers that find nothing compiled share the kernels out between them.
        order = scenario.estimators if runs[0] // len(runs) % 2 == 0 else scenario.estimators[::-1]
        beside = [each for each in sensed if self._may_go_beside_others(each.log)]
        for entry in order:
            together = self._side_by_side(entry, beside, heartbeat)
            for each in sensed:
                self._take(entry, each, together.get(each.result.run), heartbeat)
        for each in sensed:
            each.result.put_in_order([entry.row for entry in scenario.estimators])
            if each.result.run == 0:
                each.result.files = details.make(scenario, each.trajectory, each.log, each.for_details, each.errors)
        if heartbeat is not None:
            heartbeat(runs, "", None)
        return sorted([*lost_runs, *(each.result for each in sensed)], key=lambda result: result.run)

    def _sense(self, run: int) -> Sensed:
        scenario, trajectory = self.setup.scenario, self.trajectory(run)
        log, errors = pipeline.sense(scenario, trajectory, run=run)
        windows = pipeline.windows_of(scenario, trajectory, log)
        return Sensed(UnitResult(run), pipeline.truth_at_imu(trajectory, log), log, errors, windows)

    def _may_go_beside_others(self, log: SensorLog) -> bool:
        """Whether a log has the times of run 0, which alone decides, or the bytes of a run would hang on its neighbours."""
        scenario = self.setup.scenario
        if not scenario.monte_carlo.side_by_side or (scenario.recording is not None and scenario.sensors is None):
            return False
        if len(log.imu.t) > LONGEST_BLOCK:
            return False
        if self._times is None:
            self._times = _times_of(log if log.run == 0 else pipeline.sense(scenario, self.trajectory(0), run=0)[0])
        return _times_of(log) == self._times

    def _side_by_side(
        self, entry: EstimatorConfig, sensed: Sequence[Sensed], heartbeat: Heartbeat | None
    ) -> dict[int, tuple[Outcome, NavSolution]]:
        """Outcome and solution per run of an estimator that takes several logs at once; nothing where it does not.

        Where it fails on some, it is asked again for each of them alone, so that a fault costs only its own run.
        """
        taken = [each for each in sensed if entry.row not in each.result.skipped]
        try:
            estimator = make_estimator(entry.name, **entry.params)
            many: Any = getattr(estimator, "run_many", None)
            if not taken or not goes_side_by_side(type(estimator)):
                return {}
        except Exception:
            return {}  # `_estimate` says what is wrong
        found: dict[int, tuple[Outcome, NavSolution]] = {}
        for part in [taken, *([each] for each in taken)]:
            if part[0].result.run in found or (part is not taken and len(taken) == 1):
                continue
            try:
                limit = self._announce(entry, [each.result.run for each in part], heartbeat)
                solutions, seconds = timed(many, [log_for(estimator, each.log) for each in part], limit)
            except (KeyboardInterrupt, MemoryError):
                raise
            except BaseException as error:
                if _is_interrupt(error):
                    raise KeyboardInterrupt from error
                continue
            for each, solution in zip(part, solutions, strict=True):
                samples = len(each.log.imu.t)
                found[each.result.run] = Outcome(entry.row, "ok", "", seconds / len(part), samples), solution
        return found

    def _announce(self, entry: EstimatorConfig, runs: Sequence[int], heartbeat: Heartbeat | None) -> float | None:
        """Time limit (s) of an estimator on these runs, which the heartbeat is told."""
        limit = self.setup.limit_s
        if limit is not None:
            limit = limit * len(runs) + (self.setup.cold_s if entry.name not in self._warm else 0.0)
        if heartbeat is not None:
            heartbeat(runs, entry.row, limit)
        self._warm.add(entry.name)
        return limit

    def _take(
        self,
        entry: EstimatorConfig,
        sensed: Sensed,
        answer: tuple[Outcome, NavSolution] | None,
        heartbeat: Heartbeat | None,
    ) -> None:
        """Add what an estimator makes of a run to its result; ``answer`` where it is known already."""
        result = sensed.result
        if entry.row in result.skipped:
            status = result.skipped[entry.row]
            result.outcomes.append(Outcome(entry.row, _short(status), status.partition(": ")[2]))
            return
        outcome, solution = answer or self._estimate(entry, sensed.log, self._announce(entry, [result.run], heartbeat))
        if solution is not None:
            outcome, series = self._score(sensed, outcome, solution)
            if series is not None and result.run == 0:
                sensed.for_details.append((entry, solution, series))
        result.outcomes.append(outcome)

    def _estimate(
        self, entry: EstimatorConfig, log: SensorLog, limit: float | None
    ) -> tuple[Outcome, NavSolution | None]:
        """One estimator on one log; whatever it raises costs only its own row."""
        samples, start = len(log.imu.t), time.perf_counter()
        try:
            estimator = make_estimator(entry.name, **entry.params)
            if not getattr(estimator, "timed", True):
                samples = 0  # and so none of the tables of times has it
            solution, seconds = timed(estimator.run, log_for(estimator, log), limit)
            if not isinstance(solution, NavSolution):
                raise InputError(f"run(log) returned {type(solution).__name__}, not a NavSolution")
        except TimeLimitError:
            return Outcome(entry.row, "timeout", f"no answer within {limit:g} s", float(limit or 0), samples), None
        except (KeyboardInterrupt, MemoryError):
            raise
        except BaseException as error:
            if _is_interrupt(error):
                raise KeyboardInterrupt from error
            reason = reason_of(error)
            return Outcome(entry.row, f"failed: {reason}", reason, time.perf_counter() - start, samples), None
        return Outcome(entry.row, "ok", "", seconds, samples), solution

    def _score(
        self, sensed: Sensed, outcome: Outcome, solution: NavSolution
    ) -> tuple[Outcome, metrics.ErrorSeries | None]:
        """Add the rows and series of a solution to the result; a diverged one adds none."""
        row, result, limit = outcome.estimator, sensed.result, self.setup.scenario.monte_carlo.divergence_position_m
        try:
            judged = judge(solution, sensed.trajectory, sensed.log, sensed.errors, sensed.windows, limit)
        except Exception as error:
            reason = f"its solution cannot be scored: {reason_of(error)}"
            return Outcome(row, f"failed: {reason}", reason, outcome.seconds, outcome.samples), None
        series = judged.series
        if judged.lost:
            reason = judged.lost + _degrees_hint(solution)
            diverged = Outcome(row, "diverged", reason, outcome.seconds, outcome.samples)
            return diverged, series if len(series.t) else None
        result.rows += [(row, *r) for r in judged.rows]
        with np.errstate(all="ignore"):
            found = time_series(series, solution, judged.tests, sensed.trajectory)
        result.series |= {(row, name): values for name, values in found.items()}
        return outcome, series


def goes_side_by_side(kind: type) -> bool:
    """Whether a class's ``run_many`` is as much its own as its ``run``: one that changes ``run`` alone goes singly."""
    ancestry = kind.__mro__
    owner = {name: next((k for k, c in enumerate(ancestry) if name in vars(c)), None) for name in ("run", "run_many")}
    run, many = owner["run"], owner["run_many"]
    return many is not None and run is not None and many <= run


def _times_of(log: SensorLog) -> bytes:
    """Hash of the times of all that a log holds."""
    digest = hashlib.sha256(np.float64(log.initial.t).tobytes() + log.imu.t.tobytes())
    for kind, samples in log.aiding.items():
        digest.update(kind.encode() + np.ascontiguousarray(samples.t).tobytes())
    return digest.digest()


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
    series: metrics.ErrorSeries, solution: NavSolution, tests: Mapping[str, metrics.Consistency], trajectory: Trajectory
) -> dict[str, Array]:
    """Float32 series at `envelope_times`: errors, ``sigma_`` of each, and sums of each test, ``dof_``, ``count_``."""
    grid = envelope_times(trajectory)
    out: dict[str, Array] = {}
    covered = (grid >= series.t[0] - 1e-6) & (grid <= series.t[-1] + 1e-6)
    errors, _ = series.at(metrics.nearest_rows(series.t, grid))
    for i in series.axes():
        out[AXES[i]] = np.where(covered, errors[:, i], np.nan).astype(np.float32)
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
