"""Working copies of a direct filter that run stretch by stretch: one that sees the fixes, one that runs free.

A copy is the filter's state and covariance; the arithmetic is that of `direct_kernels` and `ukf_kernels`. Stretches are
ranges of IMU rows. Coordinates, frames and units as `direct.DirectProblem`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from estimators.direct import MEASUREMENTS, Array, DirectProblem

Kind = Literal["ekf", "ukf"]

UNSCENTED = (1.0, 0.0, 0.0)
"""alpha, beta, kappa of `direct-ukf`."""


@dataclass(frozen=True)
class Fixes:
    """Measurements: ``t`` (M,), ``z`` (M,6), variances ``r`` (M,6), and what the filter made of them."""

    t: Array
    z: Array
    r: Array
    residuals: Array = field(init=False)
    covariances: Array = field(init=False)
    figures: Array = field(init=False)

    def __post_init__(self) -> None:
        m = len(self.t)
        for name, shape in (("residuals", (m, 6)), ("covariances", (m, 6, 6)), ("figures", (m, 2))):
            object.__setattr__(self, name, np.full(shape, np.nan))


@dataclass
class WorkingCopy:
    """State ``x`` (15,) and covariance ``p`` (15,15) before IMU row ``row`` of a task."""

    task: DirectProblem
    kind: Kind
    x: Array
    p: Array
    row: int = 0

    @classmethod
    def of(cls, task: DirectProblem, kind: Kind) -> WorkingCopy:
        """The copy at the start of the task."""
        return cls(task, kind, task.x.copy(), task.p.copy())

    def fork(self) -> WorkingCopy:
        """A second copy that starts here. It runs free, for which the EKF's mechanization is that of both filters."""
        return WorkingCopy(self.task, "ekf", self.x.copy(), self.p.copy(), self.row)

    def run_to(self, row: int, fixes: Fixes | None = None, keep: bool = False) -> tuple[Array, Array]:
        """Filter the IMU rows up to, not including, ``row``; returns states and variances (rows,15) after each of them.

        ``fixes`` before this copy's time are left out. ``keep``: write to the task's own arrays.
        """
        kept, first, every = self.task.outputs, self.row, self.task.every
        states, variances = (a[first:row] for a in kept[:2]) if keep else np.empty((2, row - first, 15))
        while self.row < row:
            # Snapshots follow whole multiples of `every` rows, wherever a stretch begins.
            stop = min(row, (self.row // every + 1) * every) if self.row % every else row
            part = slice(self.row - first, stop - first)
            snapshots = np.empty(((stop - self.row) // every, 15, 15))
            self._filter(stop, fixes, states[part], variances[part], snapshots)
            if keep and self.row % every == 0:
                kept[2][self.row // every :][: len(snapshots)] = snapshots
            elif keep and stop % every == 0:
                kept[2][stop // every - 1] = self.p
            self.row = stop
        return states, variances

    def coast_to(self, row: int) -> Array:
        """Run the EKF's mechanization alone up to, not including, ``row``; returns states (rows,15). P stays behind."""
        from estimators.narx_kernels import coast

        task, first = self.task, self.row
        states = np.empty((row - first, 15))
        coast(float(task.t[first - 1]) if first else task.start, task.t, task.imu, first, self.x, task.setting, states)
        self.row = row
        return states

    def _filter(self, stop: int, fixes: Fixes | None, states: Array, variances: Array, snapshots: Array) -> None:
        from estimators import direct_kernels, strong_tracking, ukf_kernels

        task, rows = self.task, slice(self.row, stop)
        t = task.t[rows]
        start = float(task.t[self.row - 1]) if self.row else task.start
        fixes = fixes or Fixes(np.empty(0), np.empty((0, MEASUREMENTS)), np.empty((0, MEASUREMENTS)))
        same = direct_kernels.SAME_TIME
        low = 0 if self.row == 0 else np.searchsorted(fixes.t, start + same, "right")
        some = slice(int(low), int(np.searchsorted(fixes.t, t[-1] + same, "right")))
        out = (states, variances, snapshots, fixes.residuals[some], fixes.covariances[some], fixes.figures[some])
        timeline, given = (start, t, task.imu[rows]), (fixes.t[some], fixes.z[some], fixes.r[some])
        if self.kind == "ukf":
            ukf_kernels.filter_log(
                *timeline, *given, self.x, self.p, task.noise, task.setting, UNSCENTED, task.every, out
            )
        else:
            tracking = (1.0, np.inf)
            model = (strong_tracking.EKF, task.noise, task.setting, tracking, task.every, out)
            direct_kernels.filter_log(*timeline, *given, self.x, self.p, *model)
