"""A cell: what one entry made of one block of a track's runs, as a sealed file. The unit of work senses a block, has every
entry answer it, scores, and writes the cells; the seconds go into a file of their own, so that cells are the same bytes again.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

import testbed
from testbed import pipeline
from testbed.base.checksums import DamagedError, read_json, sealed_json
from testbed.base.files import write_atomic
from testbed.base.guarded import reason_of
from testbed.data.records import NAVIGATION_STATES, NavSolution, SensorLog, Trajectory
from testbed.data.registry import GROUP
from testbed.league.child import attitude_only
from testbed.league.entry import GROUP as ROWS
from testbed.league.entry import Entry
from testbed.league.launch import Answer, Logs, answers
from testbed.league.suite import SUITE, Track
from testbed.montecarlo.aggregate import SETTLED_S
from testbed.scenario.windows import Window
from testbed.scoring.error_series import ErrorSeries, nearest_rows
from testbed.scoring.judged import Judged, judge

BLOCK = 25
"""Runs of a cell: a child's start, some seconds, is then a small part of its work, and an interrupted league loses minutes."""
KEEP_HZ = 10.0
"""Rows per second that are scored: errors of a navigation solution are correlated over seconds, so that more rows weigh the
disk and tell nothing."""
SCORED = ("rmse_position_3d_m", "rmse_position_2d_m", "rmse_velocity_3d_mps", "rmse_attitude_deg", "rmse_heading_deg")
"""Over the whole run, kept beside the figure that ranks."""
GROUPS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9)}


@dataclass(frozen=True)
class Cell:
    """One entry on the runs ``first`` to ``last`` (excluded) of a track."""

    track: Track
    entry: Entry
    first: int
    last: int

    @property
    def name(self) -> str:
        """Of its file."""
        return f"cells/{self.track.name}/{self.entry.name}-{self.first // BLOCK}.json"

    @property
    def timings(self) -> str:
        """Name of the file of its seconds."""
        return f"times/{self.track.name}/{self.entry.name}-{self.first // BLOCK}.json"

    @property
    def identity(self) -> dict[str, Any]:
        """What it is the result of."""
        return {
            "suite": SUITE,
            "testbed": testbed.__version__,
            "code": code_digest(),
            "track": self.track.digest,
            "entry": self.entry.digest,
            "runs": [self.first, self.last],
        }

    def stored(self, out: Path) -> dict[str, Any] | None:
        """What a finished cell holds; None where there is none of just this identity."""
        try:
            held = read_json(out / self.name)
            read_json(out / self.timings)
        except DamagedError:
            return None
        return held if held.get("identity") == self.identity else None


def cells_of(track: Track, entry: Entry, runs: int) -> list[Cell]:
    """The cells of an entry on a track."""
    return [Cell(track, entry, first, min(first + BLOCK, runs)) for first in range(0, runs, BLOCK)]


def work(cells: Sequence[Cell], out: Path, built: dict[str, Path]) -> None:
    """Compute and store the cells of one block of one track."""
    track, first, last = cells[0].track, cells[0].first, max(cell.last for cell in cells)
    scratch = Path(tempfile.mkdtemp(prefix="testbed-league-"))
    try:
        sensed = sense(track, range(first, last))
        recorded = track.scenario.recording is not None
        logs = Logs([each.log for each in sensed], scratch / "logs", track.table.filters, None if recorded else KEEP_HZ)
        for cell in cells:
            count = cell.last - cell.first
            home = scratch / "entries" / cell.entry.name
            found = answers(cell.entry, logs, count, home, built.get(cell.entry.name))
            rows = [scored(track, cell.first + k, sensed[k], answer) for k, answer in enumerate(found)]
            shutil.rmtree(home, ignore_errors=True)
            times = {"us": [answer.us for answer in found], "reference_us": [answer.reference_us for answer in found]}
            write_atomic(out / cell.timings, sealed_json(times))
            write_atomic(out / cell.name, sealed_json({"identity": cell.identity, "runs": rows}))
    finally:
        with contextlib.suppress(OSError):
            shutil.rmtree(scratch)


@dataclass(frozen=True)
class Sensed:
    """A run before any entry: the truth where the IMU sits, what is recorded of it, and where it is scored."""

    truth: Trajectory
    log: SensorLog
    windows: list[Window]


def sense(track: Track, runs: Sequence[int]) -> list[Sensed]:
    """Some runs of a track. Where they fly the same they share one truth."""
    scenario, varies = track.scenario, pipeline.flight_varies(track.scenario)
    found = []
    trajectory = pipeline.fly(scenario, runs[0])
    for run in runs:
        if varies and run != runs[0]:
            trajectory = pipeline.fly(scenario, run)
        log, _ = pipeline.sense(scenario, trajectory, run=run)
        windows = pipeline.windows_of(scenario, trajectory, log)
        found.append(Sensed(pipeline.truth_at_imu(trajectory, log), log, windows))
    return found


def scored(track: Track, run: int, sensed: Sensed, answer: Answer) -> dict[str, Any]:
    """One run of an entry, scored: ``error`` is the figure that ranks, None of a run that is lost."""
    lost = {"run": run, "status": answer.status, "reason": answer.reason, "error": None}
    if answer.solution is None:
        return lost
    try:
        solution = attitude_only(answer.solution) if track.table.filters == "attitude" else answer.solution
        limit = track.scenario.monte_carlo.divergence_position_m
        judged = judge(solution, sensed.truth, sensed.log, None, sensed.windows, limit)
    except Exception as error:  # whatever an answer holds costs only its own run
        return lost | {"status": "failed", "reason": f"its answer cannot be scored: {reason_of(error)}"}
    if judged.lost:
        return lost | {"status": "diverged", "reason": judged.lost}
    values = {(window, metric): value for window, metric, value in judged.rows}
    figure = values.get((track.table.window, track.table.metric))
    if figure is None:
        return lost | {"status": "failed", "reason": f"its answer has no {track.table.metric}"}
    also = {metric: _digits(values["all", metric]) for metric in SCORED if ("all", metric) in values}
    nees = {name: _digits(value) for name, value in normalised(solution, judged).items()}
    return lost | {"error": _digits(figure), "also": also, "nees": nees}


def normalised(solution: NavSolution, judged: Judged) -> dict[str, float]:
    """NEES over its degrees of freedom, by group, averaged over the settled part of a run.

    Of an answer with sigmas alone the squares of the errors over the sigmas take its place: the same expectation, whatever the
    correlations.
    """
    series = judged.series
    if len(series.t) == 0:
        return {}
    settled = series.t[0] + min(SETTLED_S, 0.5 * float(series.t[-1] - series.t[0]))
    if solution.covariance is not None:
        found = {}
        for group in GROUPS:
            test = judged.tests.get(f"nees_{group}")
            if test is not None and (after := test.t > settled).any():
                found[group] = float(np.mean(test.value[after] / test.dof[after]))
        return found
    return {} if solution.std is None else _of_sigmas(solution, series, settled)


def _of_sigmas(solution: NavSolution, series: ErrorSeries, settled: float) -> dict[str, float]:
    """`normalised` of sigmas."""
    assert solution.std is not None
    rows = np.flatnonzero(series.t > settled)
    values, phi = series.at(rows)
    errors = np.column_stack([values[:, :6], phi])
    sigmas = np.asarray(solution.std)[nearest_rows(solution.t, series.t[rows])]
    found = {}
    for group, columns in GROUPS.items():
        names = [name for name in NAVIGATION_STATES[columns] if name in solution.states]
        if not len(rows) or group not in series.known or not names:
            continue
        own = [solution.states.index(name) for name in names]
        true = [NAVIGATION_STATES.index(name) for name in names]
        with np.errstate(all="ignore"):
            found[group] = float(np.mean((errors[:, true] / sigmas[:, own]) ** 2))
    return found


def _digits(value: float) -> float | None:
    """Ten significant digits, so that equal numbers are equal bytes; None of what is no number."""
    return float(f"{value:.10g}") if np.isfinite(value) else None


@cache
def code_digest() -> str:
    """Hash of the sources that a result follows from: the bench without what only shows, and the packages of estimators
    without the folders of rows, whose files count for them alone."""
    folders = [Path(testbed.__file__).parent]
    for name in sorted({point.module.split(".")[0] for point in entry_points(group=GROUP)} - {"testbed"}):
        folders += _places(name)
    of_rows = [place for point in entry_points(group=ROWS) for place in _places(point.module)]
    total = hashlib.sha256()
    for k, folder in enumerate(folders):
        for path in sorted(folder.rglob("*.py")):
            inside = path.relative_to(folder)
            counts = not any(place in path.parents for place in of_rows) if k > 0 else not _only_shows(inside)
            if counts and "__pycache__" not in inside.parts:
                total.update(inside.as_posix().encode() + b"\0" + path.read_bytes())
    return total.hexdigest()[:16]


def _places(package: str) -> list[Path]:
    """Folders of a package."""
    spec = find_spec(package)
    return [] if spec is None else [Path(place) for place in spec.submodule_search_locations or ()]


def _only_shows(module: Path) -> bool:
    """Whether no cell follows from a module of the bench."""
    return module.parts[0] in SHOWING or (module.parts[0] == "league" and module.stem not in MAKING)


SHOWING = ("cli", "report", "tuning", "features", "sensitivity", "training", "templates")
"""Packages of the bench that no cell follows from."""
MAKING = ("suite", "entry", "child", "launch", "cells")
"""Modules of the league that cells follow from."""
