"""`vqf` and `riann`: two attitude filters that need no tuning, on the bench's logs, for comparison.

VQF: Laidig and Seel 2023 (doi:10.1016/j.inffus.2022.10.014), package ``vqf`` (extra ``peers``). RIANN: Weber, Gühmann and
Seel 2021 (doi:10.3390/ai2030028), a recurrent network on gyros and accelerometers alone, package ``riann`` (extra of that
name). Both answer in a frame with z up and find their attitude by themselves; of the initial state they get the biases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from estimators.methods.ahrs_kf import Array, interval, latest_field, prepare
from estimators.peers.ahrs_peers import ENU_TO_NED, about_down, multiply, require, standing
from testbed.base.errors import MissingExtra
from testbed.data.records import NavSolution, SensorLog


@dataclass(frozen=True)
class Vqf:
    """VQF with its two time constants (s) and the package's defaults for all else."""

    tau_acc: float = 3.0
    tau_mag: float = 9.0
    """Both defaults are the package's, for all kinds of motion."""
    name: ClassVar[str] = "vqf"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "mag")

    def __post_init__(self) -> None:
        require(self, ("tau_acc", "tau_mag"))

    def run(self, log: SensorLog) -> NavSolution:
        """Attitude by the package, with the latest field sample at each IMU sample. Raises MissingExtra without it."""
        try:
            from vqf import VQF
        except ImportError:
            raise MissingExtra("the peer vqf needs the package vqf: pip install 'navigation-testbed[peers]'") from None
        samples = prepare(log, self.name)
        assert log.mag is not None
        settings = {"tauAcc": float(self.tau_acc), "tauMag": float(self.tau_mag)}
        rows = samples.gyro - log.initial.gyro_bias, samples.accel, samples.mag[latest_field(samples)]
        answer: Any = VQF(interval(log), **settings).updateBatch(*map(np.ascontiguousarray, rows))
        return standing(log, _to_ned(answer["quat9D"], log.mag.spec.declination))


@dataclass(frozen=True)
class Riann:
    """RIANN as published: attitude without a heading, which stays as the gyros leave it from the initial one on."""

    name: ClassVar[str] = "riann"
    sensors: ClassVar[tuple[str, ...]] = ("imu",)

    def run(self, log: SensorLog) -> NavSolution:
        """Attitude by the network. Raises MissingExtra without the package."""
        try:
            import riann
        except ImportError:
            raise MissingExtra(
                "the peer riann needs the package riann: pip install 'navigation-testbed[riann]'"
            ) from None
        gyro, accel = log.imu.gyro - log.initial.gyro_bias, log.imu.accel - log.initial.accel_bias
        answer = np.asarray(riann.RIANN(_model(riann)).predict(accel, gyro, 1.0 / interval(log)), dtype=np.float64)
        answer /= np.linalg.norm(answer, axis=1, keepdims=True)
        return standing(log, _heading_of(log, _to_ned(answer, 0.0)))


def _model(package: Any) -> str:
    """The network's file, which the package does not find by itself in every version."""
    return str(Path(package.__file__).with_name("riann.onnx"))


def _to_ned(q: Array, declination: float) -> Array:
    """(N,4) into a frame east-north-up of magnetic north, as q_nb."""
    turn = multiply(about_down(declination), ENU_TO_NED)
    return np.array([multiply(turn, row) for row in q])


def _heading_of(log: SensorLog, q: Array) -> Array:
    """(N,4) turned about down so that the first heading is the initial one."""
    from testbed.physics.rotations import quat_to_euler

    turn = about_down(quat_to_euler(log.initial.q_nb)[2] - quat_to_euler(q[0])[2])
    return np.array([multiply(turn, row) for row in q]) if math.isfinite(turn[0]) else q
