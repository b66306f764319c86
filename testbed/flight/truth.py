"""Truth from sampled motion: a `Trajectory` whose position, velocity, attitude and IMU increments agree exactly.

Velocity in n and attitude at the rows of the truth are splined, see `truth_kernels`: between two rows the motion is that of
the splines, so that a perfect IMU at the rate of the rows closes. What is sampled at another rate, as JSBSim's state is, is
brought to the rows by splines of its own. JSBSim's accelerations and its gravity are not used: they would not be consistent
with this project's Earth. All splines are made block by block, as memory is short. SI units and radians.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from testbed.data.records import Phase, Trajectory
from testbed.flight import truth_kernels as kernels
from testbed.physics.rotations import eulers_to_quats

Array = NDArray[np.float64]
BLOCK = 1 << 16
"""Knots that are splined at once: 10 MB."""
OVERLAP = 40
"""A knot bends a cubic spline n knots away by (2 - sqrt 3)^n (de Boor, chapter IV): 1e-23 in so many, far below rounding."""
SNAP = 1e-6
"""Knots: a row this close to a knot lies on it, in spite of what rounding makes of two rates."""


class Resampler:
    """Takes velocity and attitude at one rate, in pieces of any length, and gives them at another; memory holds a block.

    ``knot_rate_hz`` is the rate of the samples, ``rate_hz`` that of the rows; the first of both is at t = 0.
    """

    def __init__(self, knot_rate_hz: float, rate_hz: float) -> None:
        self.dt, self.per_row = 1.0 / knot_rate_hz, knot_rate_hz / rate_hz
        self._knots = np.empty((0, 7))
        self._begin, self._row = 0, 0
        """Number of the buffer's first knot; rows that are done."""
        self._rows: list[Array] = []

    def add(self, v_n: Array, euler: Array) -> None:
        """Further samples: velocity (M,3) in n, m/s, and Euler angles (M,3)."""
        q_nb = eulers_to_quats(np.ascontiguousarray(euler))
        if len(self._knots) and self._knots[-1, 3:] @ q_nb[0] < 0.0:
            q_nb = -q_nb
        self._knots = np.concatenate([self._knots, np.hstack([v_n, q_nb])])
        if len(self._knots) > BLOCK:
            self._take(len(self._knots) - 1 - OVERLAP)

    def finish(self) -> tuple[Array, Array]:
        """v_n (N,3) and q_nb (N,4) at all rows that the samples reach. Needs at least 4 samples in all."""
        self._take(len(self._knots) - 1)
        count = sum(len(part) for part in self._rows)
        v_n, q_nb = np.empty((count, 3)), np.empty((count, 4))
        row = 0
        # a part is given back as soon as it is copied: a long flight is never held twice
        for part in _taken(self._rows):
            v_n[row : row + len(part)], q_nb[row : row + len(part)] = part[:, :3], part[:, 3:]
            row += len(part)
        return v_n, q_nb

    def _take(self, stop: int) -> None:
        """Rows up to the knot ``stop`` of the buffer; then forget all but `OVERLAP` knots before it."""
        count = math.floor((self._begin + stop) / self.per_row + SNAP) + 1 - self._row
        at = np.arange(self._row, self._row + count) * self.per_row
        near = np.rint(at)
        on_knots = np.abs(at - near) < SNAP
        at = np.where(on_knots, near, at) - self._begin
        if on_knots.all():
            rows = self._knots[at.astype(np.intp)]
        else:
            rows = np.empty((count, 7))
            slopes = kernels.spline_slopes(self._knots, self.dt)
            kernels.resample(self._knots, slopes, self.dt, np.minimum(at, stop), rows)
            rows[:, 3:] /= np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
        self._rows.append(rows)
        self._row += count
        drop = max(0, stop - OVERLAP)
        self._knots, self._begin = self._knots[drop:].copy(), self._begin + drop


def _taken(parts: list[Array]) -> Iterator[Array]:
    """The parts in their order; the list lets go of each."""
    parts.reverse()
    while parts:
        yield parts.pop()


def make_trajectory(
    v_n: Array,
    attitude: Array,
    rate_hz: float,
    start: tuple[float, float, float],
    extra: Mapping[str, Array] | None = None,
    phases: tuple[Phase, ...] = (),
    name: str = "",
) -> Trajectory:
    """Trajectory from velocity (N,3) in n (m/s) and attitude, both sampled at ``rate_hz`` from t = 0.

    ``attitude``: Euler angles (N,3), or quaternions (N,4) that are continuous in sign. ``start`` is latitude, longitude
    (rad) and height (m) at t = 0. Needs N >= 4.
    """
    v_n = np.ascontiguousarray(v_n)
    attitude = np.ascontiguousarray(attitude)
    q_nb = eulers_to_quats(attitude) if attitude.shape[1] == 3 else attitude
    n, dt = len(v_n), 1.0 / rate_hz
    place, f_b, w_ib_b = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    place[0] = start
    for begin in range(0, n - 1, BLOCK):
        end = min(begin + BLOCK, n - 1)
        low, high = max(0, begin - OVERLAP), min(n, end + OVERLAP + 1)
        v_slope = kernels.spline_slopes(v_n[low:high], dt)[begin - low : end - low + 1]
        q_slope = kernels.spline_slopes(q_nb[low:high], dt)[begin - low : end - low + 1]
        rows = slice(begin, end + 1)
        place[rows] = kernels.integrate_position(v_n[rows], v_slope, dt, *place[begin])
        force, rate = kernels.imu_means(place[rows], v_n[rows], v_slope, q_nb[rows], q_slope, dt)
        f_b[begin + 1 : end + 1], w_ib_b[begin + 1 : end + 1] = force[1:], rate[1:]
    f_b[0], w_ib_b[0] = f_b[1], w_ib_b[1]
    place[:, 1] = np.mod(place[:, 1] + np.pi, 2.0 * np.pi) - np.pi
    t = np.arange(n) / rate_hz
    return Trajectory(t, place[:, 0], place[:, 1], place[:, 2], v_n, q_nb, f_b, w_ib_b, extra or {}, phases, name)
