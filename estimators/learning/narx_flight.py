"""A log being worked through by `nnckf` and `nnakf`: its stretches, the filter, and the second copy that runs free.

Coordinates of `direct`; SI units and radians, NED; seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from estimators.learning.narx_kernels import antennas
from estimators.learning.narx_networks import Drift
from estimators.methods.direct import Array, DirectProblem
from estimators.methods.working_copy import Fixes, WorkingCopy
from testbed.data.records import NavSolution, SensorLog

if TYPE_CHECKING:
    from estimators.learning.narx_aiding import NarxAiding

RECOVERY_S = 20.0
"""From the end of an outage to the next re-set of the free copy: the filter has found its way back."""
GAP_EPOCHS = 2.5
"""Fixes that are missing for more than so many epochs are an outage."""


class Stretch(NamedTuple):
    """Part of a log, up to IMU row ``end``. ``kind``: plain filtering, a lesson with GNSS, or an outage."""

    kind: Literal["plain", "lesson", "outage"]
    end: int
    t: Array
    """Epochs of the networks: the re-set, then fixes, or the moments at which fixes are missing."""


class NarxFlight:
    """A log being worked through: the main copy, the fixes, and the free copy's last run."""

    def __init__(self, settings: NarxAiding, log: SensorLog) -> None:
        self.settings, self.log = settings, log
        scales = (settings.accel_noise_scale, settings.gyro_noise_scale, 1.0, 1.0)
        self.task = DirectProblem.of(log, settings.name, scales, (1.0, 1.0))
        self.main = WorkingCopy.of(self.task, settings.filter)
        self.own = self.main.fork() if settings.uncorrected else None
        """The free copy where it has attitude and biases of its own."""
        self.fixes = Fixes.of_task(self.task)
        self.free_states = self.free_readings = np.empty((0, 0))
        rate = log.gnss.spec.rate_hz if log.gnss is not None else 1.0
        self.epoch = 1.0 / rate
        self.stride = max(1, round(settings.step_s * rate))

    def plan(self) -> Iterator[Stretch]:
        """The stretches of the log in order."""
        t, fixes = self.task.t, self.fixes.t
        fixes = fixes[fixes <= t[-1]]
        nothing, length = np.empty(0), self.settings.longest_outage_s
        free_from = self.task.start + self.settings.settle_s
        edges = np.append(fixes, t[-1] + self.epoch)
        gaps = list(np.flatnonzero(np.diff(edges) > GAP_EPOCHS * self.epoch)) if len(fixes) else []
        for k in [*gaps, None] if len(fixes) else []:
            last = float(edges[k]) if k is not None else float(t[-1])
            reset = free_from
            while reset + length <= last + 1e-6:
                inside = fixes[(fixes > reset + 1e-6) & (fixes <= reset + length + 1e-6)]
                yield Stretch("plain", self._row(reset), nothing)
                epochs = np.append(reset, inside[self.stride - 1 :: self.stride])
                yield Stretch("lesson", self._row(reset + length), epochs)
                reset += length
            yield Stretch("plain", self._row(last), nothing)
            if k is None:
                break
            end = float(edges[k + 1])
            missed = last + self.epoch * self.stride * np.arange(0, (end - last) / (self.epoch * self.stride) - 1e-6)
            yield Stretch("outage", self._row(end - 0.5 * self.epoch), missed[missed <= t[-1]])
            free_from = end + RECOVERY_S
        yield Stretch("plain", len(t), nothing)

    def _row(self, time: float) -> int:
        """The first IMU row after a time."""
        return int(np.searchsorted(self.task.t, time + 1e-6, "right"))

    def lesson(self, stretch: Stretch, spread: bool = True) -> Drift:
        """Run both copies through a stretch with GNSS; what the free one lacked is the target.

        ``spread``: whether the drift's variance is wanted, which costs as much as all the rest.
        """
        free, rows = self.second_copy(), slice(self.main.row, stretch.end)
        first = free.x.copy()
        main, _ = self.main.run_to(stretch.end, self.fixes)
        drift = self._drift(stretch, first, free, rows, spread and self.own is None)
        y = np.vstack(
            [np.zeros(6), self.settings.lacking(self, stretch.t[1:], _at(stretch.t[1:], self.task.t[rows], main))]
        )
        return replace(drift, y=y)

    def free_drift(self, stretch: Stretch) -> Drift:
        """Run the free copy alone through an outage."""
        free, rows = self.second_copy(), slice(self.main.row, stretch.end)
        return self._drift(stretch, free.x.copy(), free, rows, spread=False)

    def pass_over(self, stretch: Stretch) -> None:
        """Filter a stretch that teaches nothing."""
        self.main.run_to(stretch.end, self.fixes)
        if self.own is not None:
            self.own.coast_to(stretch.end)

    def second_copy(self) -> WorkingCopy:
        """The free copy as it is re-set here, before the main copy's next row."""
        if self.own is None:
            return self.main.fork()
        self.own.x[:6] = self.main.x[:6]
        return self.own

    def _drift(self, stretch: Stretch, first: Array, free: WorkingCopy, rows: slice, spread: bool) -> Drift:
        t, grid, unknown = stretch.t, self.task.t[rows], np.full((len(stretch.t), 6), np.nan)
        if spread:
            states, std = free.run_to(stretch.end)
            variance = np.vstack([np.zeros(6), _at(t[1:], grid, std[:, :9] ** 2)[:, :6]])
        else:
            states, variance = free.coast_to(stretch.end), unknown
        at = np.vstack([first, _at(t[1:], grid, states)])
        self.free_states, self.free_readings = at, self._antenna(at, t)
        return Drift.of(t - t[0], at, unknown, variance)

    def _antenna(self, states: Array, t: Array) -> Array:
        """What the receiver would read (E,6) in these states (E,15)."""
        out = np.empty((len(states), 6))
        rows = np.minimum(np.searchsorted(self.task.t, t), len(self.task.t) - 1)
        antennas(states, self.task.inputs.imu[rows], self.task.motion.setting, out)
        return out

    def solution(self, outputs: list[tuple[Array, Array]], limits: list[tuple[float, int]]) -> NavSolution:
        """The main copy's answer, with the networks' outputs and the count of what their guard limited."""
        used = int(np.searchsorted(self.fixes.t, self.task.t[-1] + 1e-7, "right"))
        extras = {"test_statistic": (self.fixes.t[:used], self.fixes.theta[:used])}
        if outputs:
            t, values = zip(*outputs, strict=True)
            extras["network_output"] = np.concatenate(t), np.concatenate(values)
            starts, counts = zip(*limits, strict=True)
            extras["network_limited"] = np.array(starts), np.array(counts, dtype=float)
        return self.task.solution(used, extras)


def _at(t: Array, grid: Array, states: Array) -> Array:
    """States (E,15) at times ``t``: interpolated, but for the yaw angle, which is that of the nearest row."""
    out = np.column_stack([np.interp(t, grid, states[:, k]) for k in range(states.shape[1])])
    near = np.clip(np.searchsorted(grid, t), 0, len(grid) - 1)
    out[:, 6:9] = states[near, 6:9]
    return out
