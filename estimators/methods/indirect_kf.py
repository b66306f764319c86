"""`indirect-kf`: loosely coupled INS/GNSS by a 15-state closed-loop error-state Kalman filter.

Groves, 2nd ed., chapter 14: the composition of accelerometer bias, gyro bias and GNSS fixes. NED frame, SI units and
radians. Q and P0 come from the specification and the initial state that the log carries, R from the receiver's stated
accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from estimators.aiding.gnss import MINIMUM_STD, require_gnss
from estimators.core.composition import Composition, Prepared, prepare
from estimators.core.heading_bank import require_heading, run_or_search
from estimators.core.side_by_side import run_side_by_side
from estimators.core.stepwise import Stepwise
from testbed.base.errors import InputError
from testbed.data.records import NavSolution, SensorLog, Trajectory

Array = NDArray[np.float64]

SCALES = (
    "accel_noise_scale",
    "gyro_noise_scale",
    "accel_bias_scale",
    "gyro_bias_scale",
    "position_std_scale",
    "velocity_std_scale",
)


@dataclass(frozen=True)
class IndirectKf:
    """Error-state filter with position and velocity fixes.

    Scales multiply a standard deviation (or root spectral density) of the specification; 1 is the data sheet. Each is one
    number, or three: along x, y, z of the body, or north, east, down.
    ``accel_noise_scale``, ``gyro_noise_scale``: of the white noise. ``accel_bias_scale``, ``gyro_bias_scale``: of what
    drives the biases. ``position_std_scale``, ``velocity_std_scale``: of the receiver's stated accuracy.
    ``process_noise``: 12 root densities (accelerometer x y z, gyro x y z, accelerometer bias x y z, gyro bias x y z, SI) in
    place of the specification's, to which the scales still apply. ``measurement_noise``: likewise 6 standard deviations
    (m N E D, m/s N E D) in place of the receiver's.
    """

    accel_noise_scale: float | tuple[float, ...] = 1.0
    gyro_noise_scale: float | tuple[float, ...] = 1.0
    accel_bias_scale: float | tuple[float, ...] = 1.0
    gyro_bias_scale: float | tuple[float, ...] = 1.0
    position_std_scale: float | tuple[float, ...] = 1.0
    velocity_std_scale: float | tuple[float, ...] = 1.0
    process_noise: tuple[float, ...] | None = None
    measurement_noise: tuple[float, ...] | None = None

    name: ClassVar[str] = "indirect-kf"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")
    parameter_space: ClassVar[dict[str, tuple[float, float, str]]] = dict.fromkeys(SCALES, (1e-3, 1e3, "log"))
    """What a tuner may search: name to (low, high, scale of the axis)."""

    def __post_init__(self) -> None:
        for key in SCALES:
            value = getattr(self, key)
            if isinstance(value, bool) or np.shape(value) not in ((), (3,)) or not _positive(value):
                raise InputError(f"{self.name}: {key} = {value!r}, must be a positive number or three of them")
        for key, length in (("process_noise", 12), ("measurement_noise", 6)):
            values = getattr(self, key)
            if values is not None and not (
                np.shape(values) == (length,) and np.isfinite(values).all() and min(values) >= 0.0
            ):
                raise InputError(f"{self.name}: {key} = {values!r}, must be {length} numbers, none negative")

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError when it has no GNSS."""
        return run_or_search(self.prepared(log))

    def run_many(self, logs: Sequence[SensorLog]) -> list[NavSolution]:
        """`run` on each of some logs with the same times, side by side."""
        return run_side_by_side([self.prepared(log) for log in logs])

    def start(self, log: SensorLog) -> Stepwise:
        """The filter at the start of a log, to be led step by step. Raises InputError when it has no GNSS."""
        return Stepwise(self.prepared(log))

    def prepared(self, log: SensorLog) -> Prepared:
        """What a run on this log starts from. Raises InputError when it has no GNSS."""
        require_gnss(log, self.name)
        prepared = prepare(Composition(), log)
        white, drive, r = self.noise(prepared)
        own = self.measurement_noise is not None  # deviations alone
        return replace(prepared, white=white, drive=drive, r=r, mix=None if own else prepared.mix)

    def noise(self, prepared: Prepared) -> tuple[Array, Array, Array]:
        """Spectral densities (6,) of the IMU and (6,) of what drives the biases; noise variances (E,6) of the fixes."""
        scales = [self.accel_noise_scale, self.gyro_noise_scale, self.accel_bias_scale, self.gyro_bias_scale]
        base = np.sqrt(np.concatenate([prepared.white, prepared.drive]))
        if self.process_noise is not None:
            base = np.array(self.process_noise, dtype=float)
        with np.errstate(over="ignore"):
            q = (base * _triples(scales)) ** 2
        std = np.sqrt(prepared.r)
        if self.measurement_noise is not None:
            std[:] = np.maximum(self.measurement_noise, MINIMUM_STD)
        return q[:6], q[6:], (std * _triples([self.position_std_scale, self.velocity_std_scale])) ** 2

    @staticmethod
    def searcher(log: SensorLog, reference: Trajectory, stride: int = 10) -> Any:
        """For tuners: what one log gives with many settings, see `estimators.core.search.Searcher`."""
        from estimators.core.search import Searcher

        require_gnss(log, "indirect-kf")
        require_heading(log, "indirect-kf")
        return Searcher(Composition(), log, reference, stride)


def _positive(value: Any) -> bool:
    try:
        return bool(np.all(np.isfinite(value)) and np.all(np.asarray(value) > 0.0))
    except TypeError:
        return False


def _triples(scales: Sequence[float | tuple[float, ...]]) -> Array:
    """One or three numbers per group to three per group, in one row."""
    return np.concatenate([np.broadcast_to(np.asarray(scale, dtype=float), 3) for scale in scales])
