"""Working copies of a direct filter that run stretch by stretch: one that sees the fixes, one that runs free.

A copy is a filter and its place on the time line of a log; the steps are those of `direct_kernels` and `ukf_kernels`.
Stretches are ranges of IMU rows. Coordinates, frames and units as `direct.DirectProblem`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from estimators.core.timeline import SAME_TIME, Timeline, walk
from estimators.learning.narx_kernels import Coasting
from estimators.methods.direct import Array, DirectProblem, make_ekf, make_keep, make_tracking
from estimators.methods.direct_kernels import MEASUREMENTS, Ekf
from estimators.methods.direct_ukf import make_ukf
from estimators.methods.ukf_kernels import Ukf
from testbed.base.errors import InputError

Kind = Literal["ekf", "ukf"]


class Fixes(NamedTuple):
    """Measurements in the filter's coordinates, and what it makes of them."""

    t: Array
    """(M,)"""
    z: Array
    """(M,6)"""
    r: Array
    """(M,6) variances."""
    theta: Array
    """(M,) test statistic."""
    innovation: Array
    """(M,6)"""
    innovation_covariance: Array
    """(M,6,6)"""
    fading: Array
    """(M,)"""

    @classmethod
    def of(cls, t: Array, z: Array, r: Array) -> Fixes:
        """Measurements that no filter has seen yet."""
        count, m = len(t), MEASUREMENTS
        shapes = (count, (count, m), (count, m, m), count)
        return cls(t, z, r, *(np.full(shape, np.nan) for shape in shapes))

    @classmethod
    def of_task(cls, task: DirectProblem) -> Fixes:
        """A log's own; the innovations are kept in the task."""
        keep, theta = task.keep, np.full(len(task.gnss_t), np.nan)
        kept = keep.innovation, keep.innovation_covariance, keep.fading
        return cls(task.gnss_t, task.inputs.z, task.inputs.r, theta, *kept)


NO_FIXES = Fixes.of(np.empty(0), np.empty((0, MEASUREMENTS)), np.empty((0, MEASUREMENTS)))


@dataclass
class WorkingCopy:
    """A filter ``model`` of a task, before the IMU row that ``line`` stands at."""

    task: DirectProblem
    model: Ekf | Ukf
    line: Timeline

    @classmethod
    def of(cls, task: DirectProblem, kind: Kind) -> WorkingCopy:
        """The copy at the start of the task, which keeps what it finds there."""
        return cls(task, _in_b(task, make_ukf(task) if kind == "ukf" else _ekf(task)), task.timeline())

    @property
    def row(self) -> int:
        """The next IMU row."""
        return int(self.line.place[0])

    @property
    def x(self) -> Array:
        """State (15,) before that row."""
        return self.model.state

    @property
    def p(self) -> Array:
        """Its covariance (15,15)."""
        return self.model.p

    def fork(self) -> WorkingCopy:
        """A second copy that starts here. It runs free, for which the EKF's mechanization is that of both filters."""
        model = _in_b(self.task, _ekf(self.task))
        model = model._replace(state=self.x.copy(), p=self.p.copy(), keep=make_keep(self.task.t, 0))
        return WorkingCopy(self.task, model, self._own_line(self.task.gnss_t))

    def run_to(self, row: int, fixes: Fixes = NO_FIXES) -> tuple[Array, Array]:
        """Filter the IMU rows up to, not including, ``row``; returns states and sigmas (rows,15) after each of them.

        ``fixes`` before this copy's time are left out.
        """
        first = self.row
        self._use(fixes)
        walk(self.line, self.model, row)
        return self.model.keep.state[first:row], self.model.keep.std[first:row]

    def coast_to(self, row: int) -> Array:
        """Run the EKF's mechanization alone up to, not including, ``row``; returns states (rows,15). P stays behind."""
        first, model = self.row, self.model
        self._use(NO_FIXES)
        walk(
            self.line, Coasting(model.inputs, model.motion, model.state, model.work, model.axes, model.keep.state), row
        )
        states: Array = model.keep.state[first:row]
        return states

    def _use(self, fixes: Fixes) -> None:
        """Take measurements from now on from ``fixes``."""
        now = float(self.line.now[0])
        self.line = self._own_line(fixes.t)
        self.line.place[1] = np.searchsorted(fixes.t, now + (SAME_TIME if self.row else -SAME_TIME), "right")
        keep = self.model.keep._replace(**{name: getattr(fixes, name) for name in KEPT})
        inputs = self.model.inputs._replace(z=fixes.z, r=fixes.r)
        self.model = self.model._replace(inputs=inputs, keep=keep, theta=fixes.theta)

    def _own_line(self, event_t: Array) -> Timeline:
        """A time line with these events that stands where this copy does."""
        return self.line._replace(event_t=event_t, now=self.line.now.copy(), place=self.line.place.copy())


def _ekf(task: DirectProblem) -> Ekf:
    return make_ekf(task, make_tracking("ekf"))


def _in_b(task: DirectProblem, model: Any) -> Any:
    """A filter that stays in the axes of b: networks are shown its Euler angles. Raises InputError for a start near their pole."""
    if task.axes.turned[0]:
        raise InputError("networks see Euler angles, which say nothing at the start: its pitch is above 80°")
    return model._replace(axes=model.axes._replace(history=np.zeros(0, dtype=np.uint8)))


KEPT = ("innovation", "innovation_covariance", "fading")
"""What `Fixes` and a recording have in common."""
