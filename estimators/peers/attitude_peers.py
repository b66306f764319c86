"""`vqf` and `riann`: two attitude filters that need no tuning, on the bench's logs, for comparison.

VQF: Laidig and Seel 2023 (doi:10.1016/j.inffus.2022.10.014), package ``vqf`` (extra ``peers``). RIANN: Weber, Gühmann and
Seel 2021 (doi:10.3390/ai2030028), a recurrent network on gyros and accelerometers alone, package ``riann`` (extra of that
name). Both answer in a frame with z up and find their attitude by themselves; of the initial state they get the biases.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from estimators.methods.ahrs_kf import Array, interval, latest_field, prepare
from estimators.peers import quaternions
from estimators.peers.ahrs_peers import ENU_TO_NED, about_down, multiply, require, standing
from estimators.peers.quaternions import conjugates, of_rotations, products
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
    """RIANN as published, which learned tilt alone: its heading means nothing, and the gyros carry the initial one on instead."""

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
        return standing(log, _with_heading(log, _to_ned(answer, 0.0), gyro))


def _model(package: Any) -> str:
    """The network's file, which the package does not find by itself in every version."""
    return str(Path(package.__file__).with_name("riann.onnx"))


def _to_ned(q: Array, declination: float) -> Array:
    """(N,4) into a frame east-north-up of magnetic north, as q_nb."""
    return products(multiply(about_down(declination), ENU_TO_NED), q)


def _with_heading(log: SensorLog, tilt: Array, gyro: Array) -> Array:
    """(N,4) attitudes of a tilt (N,4), any heading, and of rates (N,3): each is turned about down to where the gyros lead.

    From one sample to the next the gyros turn q into q d. Of all turns about down of the next tilt the nearest to that is the one by
    the twist of q d (tilt)*, and as q is itself such a turn of its tilt, the twists of neighbours add up.
    """
    steps = of_rotations(gyro * np.diff(log.imu.t, prepend=log.imu.t[0] - interval(log))[:, None])
    before = np.vstack([log.initial.q_nb, tilt[:-1]])
    apart = products(products(before, steps), conjugates(tilt))
    return products(quaternions.about_down(np.cumsum(2.0 * np.arctan2(apart[:, 3], apart[:, 0]))), tilt)
