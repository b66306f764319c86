"""`nnbias`: networks that say what bias an inertial sample has; EKF or UKF on the samples so corrected.

Beyond the NARX thesis (2021): other targets. Targets are the bias estimates of a filter that lets its biases move fast, inputs
the IMU means themselves: what a filter with constant biases cannot model (scale factor, misalignment) is a function of them.
SI units and radians; biases in b.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from estimators import pretrained
from estimators.direct import Array, DirectEkf, check_range
from estimators.direct_ukf import DirectUkf
from estimators.networks.levenberg_marquardt import Training, train
from estimators.networks.mlp import Mlp, load_networks, save_networks
from estimators.working_copy import Kind
from testbed.errors import InputError
from testbed.records import ImuSamples, NavSolution, SensorLog, Trajectory

CHANNELS = ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")


@dataclass(frozen=True)
class Nnbias:
    """Bias networks under a filter."""

    filter: Kind = "ukf"
    teacher_scale: float = 100.0
    """The teacher's bias noise over the data sheet's: it must follow a bias from one manoeuvre to the next."""
    smooth_s: float = 1.0
    """IMU means are averaged over this time as inputs of the training."""
    step_s: float = 0.2
    settle_s: float = 100.0
    neurons: int = 3
    decay: float = 0.1
    epochs: int = 60
    seed: int = 0
    networks: str = ""
    """Name of stored networks; empty: those of `fit`."""

    name: ClassVar[str] = "nnbias"
    _trained: tuple[Mlp, ...] = field(default=(), init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.filter not in ("ekf", "ukf"):
            raise InputError(f"{self.name}: filter is '{self.filter}', expected 'ekf' or 'ukf'")
        for key, low, high in (
            ("teacher_scale", 1.0, 1e3),
            ("smooth_s", 0.0, 60.0),
            ("step_s", 1e-3, 60.0),
            ("neurons", 1, 100),
        ):
            check_range(self.name, key, getattr(self, key), low, high)

    def fit(self, flights: Iterable[tuple[SensorLog, Trajectory | None]]) -> None:
        """Learn from flights with GNSS throughout. Truth is not looked at."""
        x, y = (np.vstack(part) for part in zip(*(self.lesson(log) for log, _ in flights), strict=True))
        how = Training(epochs=self.epochs, decay=self.decay)
        trained = tuple(train(x, y[:, k], self.neurons, self.seed + k, how).network for k in range(6))
        object.__setattr__(self, "_trained", trained)

    def lesson(self, log: SensorLog) -> tuple[Array, Array]:
        """Inputs (M,6) gyro and accelerometer means, and the teacher's bias estimates (M,6) as `CHANNELS`."""
        from scipy.ndimage import uniform_filter1d

        imu = log.imu
        teacher = DirectEkf(gyro_bias_scale=self.teacher_scale, accel_bias_scale=self.teacher_scale).run(log)
        assert teacher.accel_bias is not None and teacher.gyro_bias is not None
        rate = (len(imu.t) - 1) / (imu.t[-1] - imu.t[0])
        means = uniform_filter1d(np.hstack([imu.gyro, imu.accel]), max(1, round(self.smooth_s * rate)), axis=0)
        rows = slice(
            int(np.searchsorted(imu.t, log.initial.t + self.settle_s)), None, max(1, round(self.step_s * rate))
        )
        return means[rows], np.hstack([teacher.accel_bias, teacher.gyro_bias])[rows]

    def prepare(self, scenario: Any) -> None:
        """Train on ``[extra.training]`` and store the networks, unless that is done already."""
        if self.networks:
            pretrained.prepare(self, scenario)

    def store(self, path: Path, meta: dict[str, Any]) -> None:
        """Write safetensors."""
        save_networks(path, dict(zip(CHANNELS, self._trained, strict=True)), meta)

    def biases(self, log: SensorLog) -> Array:
        """Bias (N,6), as `CHANNELS`, of each sample of a log. Raises InputError without trained networks."""
        trained = self._trained
        if not trained and self.networks:
            parts = load_networks(pretrained.stored(self, log))[0]
            trained = tuple(parts[name] for name in CHANNELS)
        if not trained:
            raise InputError(f"{self.name}: not trained; call fit(flights), or name stored 'networks'")
        x = np.hstack([log.imu.gyro, log.imu.accel])
        return np.column_stack([network.predict(x) for network in trained])

    def run(self, log: SensorLog) -> NavSolution:
        """Take the networks' biases off the samples and filter. Raises InputError without GNSS or without networks."""
        bias = self.biases(log)
        imu = ImuSamples(log.imu.t, log.imu.gyro - bias[:, 3:], log.imu.accel - bias[:, :3], log.imu.spec)
        mean = bias.mean(axis=0)
        first = replace(
            log.initial, accel_bias=log.initial.accel_bias - mean[:3], gyro_bias=log.initial.gyro_bias - mean[3:]
        )
        kind = DirectUkf if self.filter == "ukf" else DirectEkf
        solution = kind().run(replace(log, imu=imu, initial=first))
        assert solution.accel_bias is not None and solution.gyro_bias is not None
        return replace(
            solution, accel_bias=solution.accel_bias + bias[:, :3], gyro_bias=solution.gyro_bias + bias[:, 3:]
        )
