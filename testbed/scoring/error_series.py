"""Errors of a solution against truth, at the solution's own times, computed when they are asked for.

Statistics come from one compiled pass (`error_kernels`); errors as arrays only where somebody wants to see them. Errors are
estimate minus truth: metres and m/s along n, Euler angles in degrees, the attitude error a rotation vector in n.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from testbed.data.records import KNOWN, Array, NavSolution, Trajectory
from testbed.physics import earth, rotations
from testbed.scoring import error_kernels
from testbed.scoring.error_kernels import Described, Motion
from testbed.scoring.quantities import AXES, QUANTITIES, Quantity, scored_quantities

TIME_TOLERANCE = 1e-9
"""Times closer than this are one (s)."""
_COLUMN = {name: k for k, name in enumerate(QUANTITIES)}


@dataclass(frozen=True)
class ErrorSeries:
    """Errors of a solution at its own times ``t`` (N,): ``estimate`` minus ``truth``, row for row.

    ``scored`` are the quantities that the estimator answers for, ``known`` what the truth knows of the motion.
    """

    t: Array
    estimate: Motion
    truth: Motion
    scored: tuple[Quantity, ...] = tuple(QUANTITIES.values())
    known: tuple[str, ...] = KNOWN

    @property
    def values(self) -> Array:
        """(N,9) as `AXES`."""
        return self._rows[0]

    @property
    def phi(self) -> Array:
        """(N,3) rotation vectors, rad."""
        return self._rows[1]

    @cached_property
    def _rows(self) -> tuple[Array, Array]:
        values, phi = error_kernels.error_rows(self.truth, self.estimate)
        return values, phi

    def at(self, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """``values`` (K,9) and ``phi`` (K,3) of some rows (K,), without those of all."""
        if "_rows" in self.__dict__:
            return self.values[rows], self.phi[rows]
        values, phi = error_kernels.error_rows(*(Motion(*(x[rows] for x in m)) for m in (self.truth, self.estimate)))
        return values, phi

    def axes(self) -> list[int]:
        """The columns of ``values`` that are scored."""
        names = {q.name for q in self.scored}
        return [k for k, name in enumerate(AXES) if name in names]

    @cached_property
    def _blocks(self) -> Described:
        return error_kernels.describe_blocks(self.truth, self.estimate)

    def statistics(self, spans: Sequence[tuple[int, int]]) -> Array | None:
        """(4,len(scored)) over ranges of rows: root mean square, largest size, root mean square of the last rows, mean.

        None where all of the ranges are empty.
        """
        filled = np.array([(a, b) for a, b in spans if b > a], dtype=np.int64)
        if not len(filled):
            return None
        found = error_kernels.describe_spans(self.truth, self.estimate, self._blocks, filled)
        count = float((filled[:, 1] - filled[:, 0]).sum())
        columns = [_COLUMN[q.name] for q in self.scored]
        return np.stack(
            [
                np.sqrt(found.squares.sum(axis=0) / count),
                found.largest.max(axis=0),
                np.sqrt((found.last**2).mean(axis=0)),
                found.total.sum(axis=0) / count,
            ]
        )[:, columns]

    def stays_within(self, limit_m: float) -> bool:
        """Whether all errors that are scored are finite, and the position's size never above a limit."""
        largest = self._blocks.largest.max(axis=0)
        names = [AXES[k] for k in self.axes()]
        finite = np.isfinite(largest[[_COLUMN[name] for name in names]]).all()
        return bool(finite) and bool(np.linalg.norm(largest[[_COLUMN[n] for n in names if n in AXES[:3]]]) <= limit_m)


def error_series(trajectory: Trajectory, solution: NavSolution) -> ErrorSeries:
    """Errors at the solution's times that lie within the trajectory; truth is interpolated where the grids differ.

    Of a truth that is known at its own times only, at these: there the solution is interpolated.
    """
    if trajectory.own_times:
        return _errors_at_rows(trajectory, solution)
    rows = _within(solution.t, trajectory.t)
    t = solution.t[rows]
    estimate = Motion(*(getattr(solution, name)[rows] for name in Motion._fields))
    return _series(t, estimate, Motion(*truth_at(trajectory, t)), solution.states, trajectory.known)


def _within(t: Array, other: Array) -> slice:
    """The rows of ``t`` that lie within the times of ``other``."""
    first = np.searchsorted(t, other[0] - TIME_TOLERANCE, "left")
    return slice(int(first), int(np.searchsorted(t, other[-1] + TIME_TOLERANCE, "right")))


def _series(t: Array, estimate: Motion, truth: Motion, states: Sequence[str], known: tuple[str, ...]) -> ErrorSeries:
    estimate, truth = (Motion(*(np.ascontiguousarray(x) for x in motion)) for motion in (estimate, truth))
    return ErrorSeries(t, estimate, truth, scored_quantities(states, known), known)


def _errors_at_rows(trajectory: Trajectory, solution: NavSolution) -> ErrorSeries:
    """Errors at the rows of the trajectory that lie within the solution, at the point that the rows describe."""
    from testbed.physics.interpolate import state_at

    inside = _within(trajectory.t, solution.t)
    t = trajectory.t[inside]
    truth = Motion(*(getattr(trajectory, name)[inside] for name in Motion._fields))
    estimate = Motion(*state_at(solution, t))  # type: ignore[arg-type]  # it reads the five arrays
    if any(trajectory.arm_b):
        arm = rotations.quats_to_matrices(estimate.q_nb) @ np.array(trajectory.arm_b)
        north, east = earth.metres_per_radian(truth.lat, truth.h)
        lat, lon = estimate.lat + arm[:, 0] / north, estimate.lon + arm[:, 1] / east
        estimate = estimate._replace(lat=lat, lon=lon, h=estimate.h - arm[:, 2])
    return _series(t, estimate, truth, solution.states, trajectory.known)


def truth_at(trajectory: Trajectory, t: Array) -> tuple[Array, Array, Array, Array, Array]:
    """``lat, lon, h, v_n, q_nb`` of the truth at times ``t``: its own rows where they match, else interpolated."""
    if (rows := _matching(trajectory.t, t)) is not None:
        return tuple(getattr(trajectory, name)[rows] for name in Motion._fields)
    from testbed.physics.interpolate import state_at

    return state_at(trajectory, np.clip(t, trajectory.t[0], trajectory.t[-1]))


def _matching(grid: Array, t: Array) -> slice | NDArray[np.intp] | None:
    """The rows of ``grid`` at the times ``t``, as a slice where they follow on one another; None where some time has no row."""
    if len(t) == 0:
        return slice(0, 0)
    first = int(np.searchsorted(grid, t[0] - TIME_TOLERANCE))
    run = slice(first, first + len(t))
    if len(grid[run]) == len(t) and np.abs(grid[run] - t).max() <= TIME_TOLERANCE:
        return run
    rows = np.clip(np.searchsorted(grid, t - TIME_TOLERANCE), 0, len(grid) - 1)
    return rows if np.abs(grid[rows] - t).max() <= TIME_TOLERANCE else None


def nearest_rows(grid: Array, t: Array) -> NDArray[np.intp]:
    """Index of the grid time nearest to each ``t``."""
    k = np.clip(np.searchsorted(grid, t), 1, max(1, len(grid) - 1))
    k = np.minimum(k, len(grid) - 1)
    return k - (t - grid[k - 1] < grid[k] - t)
