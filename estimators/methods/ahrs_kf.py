"""`ahrs-kf`: attitude from gyros, accelerometers and a magnetometer by a 12-state indirect Kalman filter, without GNSS.

The measurement unit of "AHRS with LSTM-corrected Kalman gain" (2022); its structure is the one that MathWorks documents
for ``ahrsfilter``, here with the full covariance carried along. Its steps are `estimators.methods.ahrs_kernels`. SI units, µT.

The filter estimates attitude and gyro bias alone. Position and velocity of its answer stand still at the initial state,
and are not named among its states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.records import ATTITUDE_STATES, Innovations, NavSolution, SensorLog

if TYPE_CHECKING:
    from estimators.core.timeline import Timeline
    from estimators.methods.ahrs_kernels import AttitudeRecording, Figures, Samples

Array = NDArray[np.float64]

SNAPSHOT_INTERVAL_S = 1.0
CHANNELS = (*(f"gravity {axis}, m/s²" for axis in "xyz"), *(f"field {axis}, µT" for axis in "xyz"))
"""Of its innovations."""
WITHOUT = dict.fromkeys(("gyro_scale", "accel_noise_mps2", "field_noise_ut", "turn_speed_mps", "residual_factor"), 0.0)
"""Parameters that 0 leaves out, at 0: the filter as version 0.1 had it."""
MINIMUM_NOISE = (1e-7, 1e-4, 1e-3)
"""Least 1 sigma of a sample (rad/s, m/s², µT): an ideal sensor would make the covariance singular."""


@dataclass(frozen=True)
class AhrsKf:
    """Attitude filter on gravity and magnetic field.

    The noise of the sensors comes from their specifications times the ``_scale`` parameters (1 is the data sheet). To it
    come, as white noise of a mean over 1 s, what a carrier's motion adds to gravity and what the surroundings add to the
    field; linear acceleration and magnetic disturbance are first-order Gauss-Markov processes in b beside it. The defaults
    are those of a sensor in a hand, from reasoning alone; scenarios of aircraft name their own.
    """

    linear_accel_mps2: float = 0.05
    """What stays for long: 5 mg of accelerometer bias after a calibration."""
    linear_accel_time_s: float = 10.0
    """A hand turns its sensor over within seconds to tens of them, and so the bias against gravity."""
    mag_disturbance_ut: float = 1.0
    """Hard iron that a compass swing leaves."""
    mag_disturbance_time_s: float = 100.0
    """It stays for minutes: it changes with currents and temperature."""
    gyro_noise_scale: float = 1.0
    gyro_bias_scale: float = 1.0
    accel_noise_scale: float = 1.0
    mag_noise_scale: float = 1.0
    turn_speed_mps: float = 0.0
    """Above 0 the filter adapts to turns: sigma of linear acceleration across the speed per rate of turn."""
    residual_factor: float = 0.0
    """Above 0 it adapts to the accelerometer's residual along x: sigma of linear acceleration there per mean residual."""
    adaption_average_s: float = 1.0
    gyro_scale: float = 0.003
    """Error of scale and alignment that a calibration leaves: relative angle error, drawn anew every second."""
    accel_noise_mps2: float = 1.8
    """Of the carrier's acceleration, a mean over 1 s: 0.5 m/s once a second is 3.1 m/s² rms, correlated over 1/(2 pi) s, and
    the square root of twice variance times time is 1.8."""
    field_noise_ut: float = 12.0
    """Of the field around the carrier, a mean over 1 s: 15° of 45 µT, as a hand meets it indoors (see `ahrs-eskf`)."""

    name: ClassVar[str] = "ahrs-kf"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "mag")
    parameter_space: ClassVar[dict[str, tuple[float, float, str]]] = {
        "linear_accel_mps2": (0.01, 30.0, "log"),
        "linear_accel_time_s": (0.001, 300.0, "log"),
        "mag_disturbance_ut": (0.01, 30.0, "log"),
        "mag_disturbance_time_s": (0.1, 1e5, "log"),
        "gyro_noise_scale": (0.1, 100.0, "log"),
        "gyro_bias_scale": (0.1, 100.0, "log"),
        "accel_noise_scale": (0.1, 1000.0, "log"),
        "mag_noise_scale": (0.1, 1000.0, "log"),
        "gyro_scale": (1e-5, 0.05, "log"),
        "accel_noise_mps2": (1e-3, 30.0, "log"),
        "field_noise_ut": (1e-3, 100.0, "log"),
    }
    """What a tuner may search: name to (low, high, scale of the axis)."""

    def __post_init__(self) -> None:
        for key in {*self.parameter_space} - {*WITHOUT}:
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
                raise InputError(f"{self.name}: {key} = {value!r}, must be a positive number")
        for key in WITHOUT:
            if not 0.0 <= getattr(self, key) < math.inf:
                raise InputError(f"{self.name}: {key} = {getattr(self, key)!r}, must not be negative")
        if not 0.0 < self.adaption_average_s < math.inf:
            raise InputError(f"{self.name}: adaption_average_s = {self.adaption_average_s!r}, must be positive")

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError when it has no magnetometer."""
        from estimators.methods.ahrs_kernels import OwnGain

        return self.solution(log, self.filter(log, OwnGain(np.zeros(1))))

    def filter(self, log: SensorLog, gain: Any) -> AttitudeRecording:
        """What a run over the log leaves behind, with a hook on the ``gain`` (see `ahrs_kernels.AttitudeFilter`)."""
        from estimators.core.timeline import walk
        from estimators.methods.ahrs_kernels import empty_recording, make_filter

        n, t = len(log.imu.t), log.imu.t
        stride = min(n, max(1, round(SNAPSHOT_INTERVAL_S * (n - 1) / (t[-1] - t[0]))))
        keep = empty_recording(n, stride)
        samples = prepare(log, self.name)
        walk(line_of(log), make_filter(samples, self.figures(log), self.start(log), gain, keep), n)
        return keep

    def figures(self, log: SensorLog) -> Figures:
        """What this log's sensors are taken for."""
        from estimators.methods.ahrs_kernels import Figures
        from testbed.physics.earth import gravity

        dt = interval(log)
        gyro, accel, mag = log.imu.spec.gyro, log.imu.spec.accel, log.mag.spec if log.mag else None
        gyro_sigma = max(gyro.white_noise / math.sqrt(dt), MINIMUM_NOISE[0]) * self.gyro_noise_scale
        accel_sigma = max(accel.white_noise / math.sqrt(dt), MINIMUM_NOISE[1]) * self.accel_noise_scale
        mag_dt = interval_of_field(log)
        mag_sigma = max(mag.noise_sigma if mag else 0.0, MINIMUM_NOISE[2]) * self.mag_noise_scale
        wander = 2.0 * gyro.gauss_markov_sigma() ** 2 / gyro.correlation_time_s + gyro.rate_random_walk**2
        accel_decay = math.exp(-dt / self.linear_accel_time_s)
        mag_decay = math.exp(-dt / self.mag_disturbance_time_s)
        return Figures(
            gyro_variance=gyro_sigma**2,
            bias_variance=wander * dt * self.gyro_bias_scale**2,
            accel_growth=self.linear_accel_mps2**2 * (1.0 - accel_decay**2),
            mag_growth=self.mag_disturbance_ut**2 * (1.0 - mag_decay**2),
            accel_variance=accel_sigma**2 + self.accel_noise_mps2**2 / dt,
            mag_variance=mag_sigma**2 + self.field_noise_ut**2 / mag_dt,
            bias_decay=1.0,
            accel_decay=accel_decay,
            mag_decay=mag_decay,
            interval=dt,
            gravity=gravity(log.initial.lat, log.initial.h),
            turn_inflation=self.turn_speed_mps**2 * (1.0 - accel_decay**2),
            residual_inflation=self.residual_factor**2 * (1.0 - accel_decay**2),
            averaging=1.0 - math.exp(-dt / self.adaption_average_s),
            scale_variance=self.gyro_scale**2,
        )

    def start(self, log: SensorLog) -> tuple[Array, Array]:
        """State (13,) and covariance (12,12) in which the filter starts."""
        from testbed.physics.rotations import quat_to_matrix

        initial = log.initial
        state = np.concatenate([initial.q_nb, initial.gyro_bias, np.zeros(6)])
        c_nb, p = np.array(quat_to_matrix(initial.q_nb)), np.zeros((12, 12))
        p[:3, :3] = c_nb.T @ np.diag(initial.std[6:9] ** 2) @ c_nb
        p[3:6, 3:6] = np.diag(initial.std[12:15] ** 2)
        p[6:9, 6:9] = self.linear_accel_mps2**2 * np.eye(3)
        p[9:, 9:] = self.mag_disturbance_ut**2 * np.eye(3)
        return state, p

    def solution(self, log: SensorLog, kept: AttitudeRecording) -> NavSolution:
        """What a run leaves behind as the bench wants it."""
        t, initial, n = log.imu.t, log.initial, len(log.imu.t)
        rows = slice(kept.stride - 1, None, kept.stride)
        at, states = t[rows], kept.state[rows]
        still = np.full(n, initial.lat), np.full(n, initial.lon), np.full(n, initial.h), np.tile(initial.v_n, (n, 1))
        return NavSolution(
            t,
            *still,
            kept.state[:, :4],
            gyro_bias=kept.state[:, 4:7],
            std=kept.std,
            covariance_t=at,
            covariance=_covariance_n(kept.covariance, states),
            innovations={"gravity-mag": Innovations(at, kept.innovation, kept.innovation_covariance, CHANNELS)},
            states=ATTITUDE_STATES,
            extras={"linear_accel_mps2": (at, states[:, 7:10])},
        )


def _covariance_n(snapshots: Array, states: Array) -> Array:
    """Attitude covariance (M,3,3) in n from (M,12,12) in b: phi = -C theta, theta the correction of the estimate in b."""
    from testbed.physics.rotations import quats_to_matrices

    c_nb = quats_to_matrices(np.ascontiguousarray(states[:, :4]))
    return np.asarray(c_nb @ snapshots[:, :3, :3] @ c_nb.transpose(0, 2, 1))


def interval(log: SensorLog) -> float:
    """Sample interval of the IMU, s."""
    return float((log.imu.t[-1] - log.imu.t[0]) / (len(log.imu.t) - 1))


def interval_of_field(log: SensorLog) -> float:
    """Time between the field samples that the filter uses, s: at least that of the IMU."""
    t = log.mag.t if log.mag else log.imu.t
    return max(interval(log), float(np.median(np.diff(t))) if len(t) > 1 else 0.0)


def line_of(log: SensorLog) -> Timeline:
    """The time line of an attitude filter, whose events are the IMU samples: it starts one interval before the first."""
    from estimators.core.timeline import make_timeline

    return make_timeline(log.imu.t[0] - interval(log), log.imu.t, log.imu.t)


def prepare(log: SensorLog, who: str) -> Samples:
    """The log's samples, freed of the accelerometer bias that the calibration before the flight gave.

    Each field sample goes with the first IMU sample at or after its time. Raises InputError without a magnetometer.
    """
    from estimators.methods.ahrs_kernels import Samples

    if log.mag is None or len(log.mag.t) == 0:
        raise InputError(f"{who}: the log has no magnetometer; give the scenario a table [sensors.mag]")
    t, mag = log.imu.t, log.mag
    row = np.full(len(t), -1, dtype=np.int64)
    place = np.searchsorted(t, mag.t - 1e-6)
    inside = place < len(t)
    row[place[inside]] = np.flatnonzero(inside)
    accel = log.imu.accel - log.initial.accel_bias
    return Samples(log.imu.gyro, accel, mag.field, row, np.array(mag.spec.field_n))


def latest_field(samples: Samples) -> NDArray[np.int64]:
    """(N,) row of the latest field sample at each IMU sample; before the first, of the first."""
    rows = np.maximum.accumulate(samples.mag_row)
    return np.where(rows < 0, max(0, rows[np.argmax(rows >= 0)]), rows)
