"""What `ahrs-lstm` learns from: flights written down as the network sees them, beside what a teacher's gain would be.

A flight becomes a file of float32 rows, one per step of the network: 90 inputs and 72 elements of the teacher's gain.
Flights are objects like `testbed.training.dataset.Shard`: ``rows``, ``window(start, rows)``, ``log()``. SI units, µT.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.learning.ahrs_lstm_kernels import INPUTS
from estimators.learning.ahrs_weights import Weights, growth_of, samples_per_step
from estimators.methods.ahrs_kf import AhrsKf, interval, line_of, prepare

WIDTH = INPUTS + 72
"""Numbers in a row."""


@dataclass(frozen=True)
class Teacher:
    """The filter that the network imitates: an `ahrs-kf` that may adapt, and may be told the true linear acceleration."""

    kf: AhrsKf
    told_factor: float = 0.0
    """Sigma of linear acceleration added per true linear acceleration (mean over a second); 0: it is told nothing."""


class Lesson:
    """The rows of one flight; `read` holds no more than those that it returns."""

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, path.stat().st_size // (4 * WIDTH)

    def read(self, start: int, rows: int) -> NDArray[np.float32]:
        """(rows, 162)"""
        flat = np.fromfile(self.path, np.float32, count=rows * WIDTH, offset=4 * WIDTH * start)
        return flat.reshape(rows, WIDTH)


def write_lesson(
    flight: Any,
    kf: AhrsKf,
    teacher: Teacher,
    weights: Weights,
    teacher_flies: bool,
    path: Path,
    reference_error: NDArray[np.float64] | None = None,
) -> Lesson:
    """Fly one flight and write its rows. ``reference_error`` (3,), rad, turns the truth."""
    from estimators.core.timeline import walk
    from estimators.learning.ahrs_lstm_kernels import LessonRows, make_network_gain, make_taught_gain
    from estimators.methods.ahrs_kernels import make_filter

    log = flight.log()
    every = samples_per_step(weights, log)
    rows = np.empty((len(log.imu.t) // every, WIDTH), np.float32)
    samples, figures, start = prepare(log, kf.name), kf.figures(log), kf.start(log)
    told = np.zeros((len(log.imu.t), 3))
    if teacher.told_factor:
        known = true_acceleration(
            samples.accel, _gravity_b(flight, figures.gravity, reference_error), 1.0 / interval(log)
        )
        told = (teacher.told_factor * known) ** 2
    learner = make_network_gain(weights.network, every, growth_of(weights))
    gain = make_taught_gain(learner, teacher.kf.figures(log), start[1].copy(), told, teacher_flies)
    flown = make_filter(samples, figures, start, gain, LessonRows(rows, every))
    walk(line_of(log), flown, len(rows) * every)
    scratch = path.with_suffix(".tmp")
    rows.tofile(scratch)
    os.replace(scratch, path)
    return Lesson(path)


def checksum_of(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _gravity_b(flight: Any, gravity: float, error: NDArray[np.float64] | None) -> NDArray[np.float64]:
    from testbed.physics.rotations import quat_to_matrix, quats_to_matrices, rotvec_to_quat

    down = quats_to_matrices(flight.window(0, flight.rows)["q_nb"].astype(np.float64))[:, 2]
    turned = down if error is None else down @ np.array(quat_to_matrix(rotvec_to_quat(error)))
    return np.asarray(gravity * turned)


def true_acceleration(accel: NDArray[Any], gravity_b: NDArray[Any], rate: float) -> NDArray[Any]:
    """(N,3) linear acceleration in b, m/s², as the mean over the second around each sample, from specific force and truth."""
    half = max(1, round(0.5 * rate))
    padded = np.pad(np.cumsum(accel + gravity_b, axis=0), ((half + 1, half), (0, 0)), mode="edge")
    padded[: half + 1] = 0.0
    n = len(accel)
    first, last = np.maximum(np.arange(n) - half, 0), np.minimum(np.arange(n) + half, n - 1)
    return np.asarray((padded[2 * half + 1 :] - padded[:n]) / (last - first + 1)[:, None])


def scales(lessons: Sequence[Lesson]) -> dict[str, NDArray[np.float32]]:
    """``centre`` and ``unit`` (90) of the inputs and ``correction`` (12), the rms of the teacher's corrections."""
    rows = np.vstack([lesson.read(0, lesson.rows)[lesson.rows // 50 :: 5] for lesson in lessons]).astype(np.float64)
    inputs, wanted = rows[:, :INPUTS], rows[:, INPUTS:].reshape(-1, 6, 12)
    correction = np.sqrt((np.einsum("nci,nc->ni", wanted, inputs[:, :6]) ** 2).mean(0))
    correction = np.repeat(correction.reshape(-1, 3).max(1), 3) + 1e-12
    return input_scales(inputs) | {"correction": correction.astype(np.float32)}


def input_scales(inputs: NDArray[np.float64]) -> dict[str, NDArray[np.float32]]:
    """``centre`` and ``unit`` (90) from inputs (N,90) of flights.

    The unit is small, that of quiet flight: the lower quartile of what is left of the centre, the largest of three axes.
    """
    centre = np.median(inputs, axis=0)
    unit = np.repeat(np.quantile(np.abs(inputs - centre), 0.25, axis=0).reshape(-1, 3).max(1), 3)
    spread = np.repeat(inputs.std(0).reshape(-1, 3).max(1), 3)
    unit = np.maximum(unit, 1e-3 * spread + 1e-12)
    return {"centre": centre.astype(np.float32), "unit": unit.astype(np.float32)}
