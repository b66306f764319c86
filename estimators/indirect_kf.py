"""`indirect-kf`: loosely coupled INS/GNSS by a 15-state closed-loop error-state Kalman filter.

Groves, 2nd ed., chapter 14; the loop is `estimators.indirect_kernel`. NED frame, SI units and radians. Q and P0 come
from the specification and the initial state that the log carries, R from the receiver's stated accuracy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.errors import InputError
from testbed.records import GnssFixes, Innovations, NavSolution, SensorLog, Trajectory
from testbed.specs import TriadSpec

Array = NDArray[np.float64]

SNAPSHOT_INTERVAL_S = 1.0
SCALES = (
    "accel_noise_scale",
    "gyro_noise_scale",
    "accel_bias_scale",
    "gyro_bias_scale",
    "position_std_scale",
    "velocity_std_scale",
)
MINIMUM_STD = np.array([1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4])
"""R of an ideal receiver is zero, which no filter can use: 1 mm and 0.1 mm/s are the least (1 sigma)."""


@dataclass(frozen=True)
class IndirectKf:
    """Error-state filter with position and velocity fixes.

    Scales multiply a standard deviation (or root spectral density) of the specification; 1 is the data sheet. Each is one
    number, or three: along x, y, z of the body, or north, east, down.
    ``process_noise`` (12 root densities: accelerometer x y z, gyro x y z, accelerometer bias x y z, gyro bias x y z; SI)
    and ``measurement_noise`` (6 standard deviations: m N E D, m/s N E D) replace it altogether; the scales still apply.
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
        from estimators.indirect_kernel import filter_log

        gnss, imu = require_gnss(log, self.name), log.imu
        n, m = len(imu.t), len(gnss.t)
        lla, v_n, q_nb = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
        bias, std = np.empty((n, 6)), np.empty((n, 15))
        stride = min(n, max(1, round(SNAPSHOT_INTERVAL_S * (n - 1) / (imu.t[-1] - imu.t[0]))))
        snapshots = np.empty((n // stride, 15, 15))
        innovation, innovation_covariance = np.full((m, 6), np.nan), np.full((m, 6, 6), np.nan)
        outputs = (lla, v_n, q_nb, bias, std, stride, snapshots, innovation, innovation_covariance)
        r = self.measurement_std(log) ** 2
        filter_log(*recordings(log), r, *self.model(log), 1, *outputs)
        used = np.isfinite(innovation[:, 0])
        return NavSolution(
            imu.t,
            lla[:, 0],
            lla[:, 1],
            lla[:, 2],
            v_n,
            q_nb,
            accel_bias=bias[:, :3],
            gyro_bias=bias[:, 3:],
            std=std,
            covariance_t=imu.t[stride - 1 :: stride],
            covariance=snapshots,
            innovations=Innovations(gnss.t[used], innovation[used], innovation_covariance[used]),
        )

    def process_std(self, log: SensorLog) -> Array:
        """(12,) root spectral densities that the filter uses on this log."""
        scales = [self.accel_noise_scale, self.gyro_noise_scale, self.accel_bias_scale, self.gyro_bias_scale]
        base = np.sqrt(noise_model(log).q) if self.process_noise is None else np.array(self.process_noise, dtype=float)
        return base * _triples(scales)

    def measurement_std(self, log: SensorLog) -> Array:
        """(M,6) 1-sigma of each fix that the filter uses on this log."""
        gnss = require_gnss(log, self.name)
        scales = _triples([self.position_std_scale, self.velocity_std_scale])
        if self.measurement_noise is None:
            return np.maximum(gnss.measurement_std(), MINIMUM_STD) * scales
        return np.tile(np.maximum(self.measurement_noise, MINIMUM_STD) * scales, (len(gnss.t), 1))

    @staticmethod
    def searcher(
        log: SensorLog, reference: Trajectory, stride: int = 10
    ) -> Callable[[IndirectKf], tuple[Array, float]]:
        """For tuners: what one log gives with many settings, see `estimators.indirect_search.searcher`."""
        from estimators.indirect_search import searcher

        return searcher(log, reference, stride)

    def model(self, log: SensorLog) -> tuple[Array, Array, Array, Array, Array]:
        """Start vector, P0, Q, bias decay and bias mean: the model arguments of the compiled loop, in its order."""
        noise = noise_model(log)
        return start_vector(log), noise.covariance, self.process_std(log) ** 2, noise.decay, noise.bias_mean


def _positive(value: Any) -> bool:
    try:
        return bool(np.all(np.isfinite(value)) and np.all(np.asarray(value) > 0.0))
    except TypeError:
        return False


def _triples(scales: Sequence[float | tuple[float, ...]]) -> Array:
    """One or three numbers per group to three per group, in one row."""
    return np.concatenate([np.broadcast_to(np.asarray(scale, dtype=float), 3) for scale in scales])


def recordings(log: SensorLog) -> tuple[float, Array, Array, Array, Array, Array, Array, Array]:
    """The recordings as the compiled loop takes them: start, IMU time, gyro, accel, lever arm, fix time, place, velocity."""
    gnss = require_gnss(log, "indirect-kf")
    place = np.column_stack([gnss.lat, gnss.lon, gnss.h])
    lever = np.array(gnss.spec.lever_arm_b, dtype=float)
    return log.initial.t, log.imu.t, log.imu.gyro, log.imu.accel, lever, gnss.t - gnss.spec.latency_s, place, gnss.v_n


def require_gnss(log: SensorLog, name: str) -> GnssFixes:
    """The log's GNSS fixes. Raises InputError when it has none."""
    if log.gnss is None or len(log.gnss.t) == 0:
        raise InputError(
            f"estimator '{name}' needs GNSS fixes, but the log '{log.name}' has none; add [sensors.gnss] or use 'ins'"
        )
    return log.gnss


def start_vector(log: SensorLog) -> Array:
    """(16,): lat, lon, h, v_n, q_nb, accel bias, gyro bias of the log's initial state."""
    s = log.initial
    return np.concatenate([[s.lat, s.lon, s.h], s.v_n, s.q_nb, s.accel_bias, s.gyro_bias]).astype(float)


class NoiseModel(NamedTuple):
    """What the log's specifications imply for a filter."""

    q: Array
    """(12,) spectral densities, as `error_model.add_noise` takes them."""
    decay: Array
    """(2,) inverse correlation time of accelerometer and gyro bias, 1/s."""
    bias_mean: Array
    """(6,) what the biases return to."""
    covariance: Array
    """(15,15) P0."""


def noise_model(log: SensorLog) -> NoiseModel:
    """Process noise and initial covariance of a log."""
    spec, start = log.imu.spec, log.initial
    std = np.array(start.std, dtype=float)
    dt = (log.imu.t[-1] - start.t) / len(log.imu.t)
    accel_white, accel_drive, accel_decay, accel_share = triad_noise(spec.accel, std[9:12], dt)
    gyro_white, gyro_drive, gyro_decay, gyro_share = triad_noise(spec.gyro, std[12:15], dt)
    q = np.repeat([accel_white, gyro_white, accel_drive, gyro_drive], 3)
    mean = np.concatenate([accel_share * np.asarray(start.accel_bias), gyro_share * np.asarray(start.gyro_bias)])
    return NoiseModel(q, np.array([accel_decay, gyro_decay]), mean, np.diag(std**2))


MEMORY = 0.3
"""How far back a bias estimate looks, in correlation times of the bias: tens of seconds for the units of the catalogue."""
RANDOM_WALK_SHARE = 3.0 * (0.5 * MEMORY**2 - 1.0 + (1.0 + MEMORY) * np.exp(-MEMORY)) / MEMORY**3
"""Least-squares slope of 1 - exp(-x) over 0 < x < MEMORY, relative to its slope at 0."""


def triad_noise(spec: TriadSpec, bias_std: Array, dt: float) -> tuple[float, float, float, float]:
    """White noise density², bias driving density², inverse correlation time and share of the constant part, of a triad.

    One state per axis stands for the sum of a constant c (turn-on bias) and a Gauss-Markov process g. Its best guess far
    ahead is ``share`` times the initial estimate, ``share`` = var c / (var c + var g). Taken as Gauss-Markov about that
    value it is g itself without c, and a random walk where c dominates; there the driving density is the one whose growth
    follows the structure function 2 var g (1 - exp(-t/tau)) of g best over the filter's `MEMORY`, as the growth at t = 0
    would make the filter too cautious. A data sheet's random walk holds at the output, rounding to
    one bit included, unless the bit is coarser than the noise.
    """
    markov = spec.gauss_markov_sigma() ** 2
    steady = spec.turn_on_bias**2 + markov
    share = spec.turn_on_bias**2 / steady if steady > 0.0 else 1.0
    drive = 2.0 * markov / spec.correlation_time_s * (1.0 - share * (1.0 - RANDOM_WALK_SHARE))
    final = steady * (1.0 - share**2) + share**2 * float(np.mean(bias_std**2))
    decay = drive / (2.0 * final) if final > 0.0 else 0.0
    white = max(spec.white_noise**2, spec.resolution**2 / 12.0 * dt)
    return white, drive + spec.rate_random_walk**2, decay, share
