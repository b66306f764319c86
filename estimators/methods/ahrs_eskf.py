"""`ahrs-eskf`: attitude and gyro bias from gyros, accelerometers and a magnetometer, for carriers of bounded velocity.

What disturbs the direction of gravity is the carrier's acceleration, and acceleration is the derivative of a velocity that
stays bounded: its density falls with the square of the frequency. So the specific force is integrated to a horizontal
velocity, and the measurement is that this velocity is about zero (or a speed from airspeed or GNSS), which a white or
first-order acceleration as in `ahrs-kf` does not say. Kernels: `estimators.methods.ahrs_eskf_kernels`. SI units, µT.

No model of the Earth's field is needed: the field corrects the heading alone, where norm and dip are those of the start,
unless ``whole_field`` says that its direction is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from estimators.methods.ahrs_kf import SNAPSHOT_INTERVAL_S, interval
from testbed.base.errors import InputError, nearest
from testbed.data.records import ATTITUDE_STATES, GYRO_BIAS_STATES, Innovations, NavSolution, SensorLog

if TYPE_CHECKING:
    from estimators.methods.ahrs_eskf_kernels import AttitudeRecording, Inputs, Settings
    from estimators.methods.ahrs_field import FieldWatch

Array = NDArray[np.float64]

DEG = math.pi / 180.0
STATES = (*ATTITUDE_STATES, *GYRO_BIAS_STATES)
SPEEDS = ("", "airspeed", "gnss")
STEP_S = 0.02
"""Of the covariance: a hundredth of the filter's shortest time constant (about 2 s), so that finer steps change nothing."""
REST_RATE, REST_FORCE, REST_TIME_S, REST_AVERAGE_S, REST_BIAS = 2.0 * DEG, 0.5, 1.5, 0.5, 0.03 * DEG
"""Rest as VQF knows it (Laidig and Seel 2023, table 2): thresholds of rate and specific force, for how long, the averaging
time of what they are compared with, and how well the bias is seen (1 sigma)."""
NORM_SHARE, DIP, NORM_AVERAGE_S, CLEAN_S = 0.1, 10.0 * DEG, 0.05, 0.5
START_S, REFERENCE_S, RENEWAL_S, TURNING, PATIENCE_S = 1.0, 20.0, 20.0, 20.0 * DEG, 60.0
"""Rejection of a disturbed field as VQF has it (same table); the reference begins as the mean over ``START_S``."""
UNKNOWN_MPS = 100.0
"""1 sigma of a velocity of which nothing is known at the start."""


@dataclass(frozen=True)
class AhrsEskf:
    """Attitude filter on a bounded velocity, or on a measured speed.

    Noise is given as 1 sigma of a mean over 1 s. One set of values serves hands, feet and slow robots; a multirotor states its
    ``velocity_mps``, and an aircraft names a ``speed``: a turn of minutes is no motion of bounded velocity in that sense.
    """

    velocity_mps: float = 0.5
    """Of the carrier: a hand moves at 0.5 m/s rms and turns round about once a second, so a mean over 1 s has this. A carrier
    that keeps its direction for seconds has its speed: a multirotor that circles at 6 m/s with 0.5 seems to be tilted."""
    velocity_walk_mps: float = 0.05
    """Noise of the integrated specific force per second: 5 mg of rectified vibration and error of scale and alignment."""
    gyro_dps: float = 0.1
    """Gyro noise: ten times a consumer part's data sheet (0.01 °/s/√Hz), which leaves out vibration and sampling."""
    gyro_scale: float = 0.003
    """Error of scale and alignment after calibration, which makes an error per turn; drawn anew every second."""
    bias_walk_dps: float = 0.01
    """Of the gyro bias in a second: 0.5 °/s in 40 minutes, what warming up does to a consumer part."""
    bias_limit_dps: float = 0.5
    """The bias is never doubted beyond this (or beyond the log's initial deviation): what a calibration leaves."""
    heading_deg: float = 15.0
    """Of a magnetic heading: indoors the field turns by some 10° from place to place, and a hand changes place each second."""
    reject_field: bool = True
    """Whether a field of another norm or dip than that of the start is left out."""
    whole_field: bool = False
    """Whether the field corrects the tilt too: where its direction is known and iron is far, as in the air."""
    speed: str = ""
    """What measures the velocity in place of zero: "airspeed" (along x, in gusts about a steady wind) or "gnss"."""
    slip_deg: float = 2.0
    """Of the angle between the air's flow and the x axis: what is left of it where an aircraft turns into the gusts."""
    gust_mps: float = 1.5
    """1 sigma of each component of the gusts: light turbulence above 2000 ft, 5 ft/s (MIL-F-8785C, figure 7)."""
    gust_length_m: float = 533.0
    """Over which they stay alike: 1750 ft, Dryden's scale there (MIL-F-8785C, section 3.7.2.1)."""
    misalignment_deg: float = 0.0
    """1 sigma per axis of each triad against the carrier's axes, where no calibration has taken it out: what the data sheet
    states. Nothing shows it; the stated sigma holds it (see `with_misalignment`), and the estimate is as without."""

    name: ClassVar[str] = "ahrs-eskf"
    parameter_space: ClassVar[dict[str, tuple[float, float, str]]] = {
        "velocity_mps": (0.05, 500.0, "log"),
        "velocity_walk_mps": (1e-3, 5.0, "log"),
        "gyro_dps": (1e-3, 1.0, "log"),
        "gyro_scale": (1e-5, 0.05, "log"),
        "bias_walk_dps": (1e-5, 0.1, "log"),
        "bias_limit_dps": (0.01, 10.0, "log"),
        "heading_deg": (0.5, 100.0, "log"),
        "slip_deg": (0.1, 20.0, "log"),
        "gust_mps": (0.01, 10.0, "log"),
        "gust_length_m": (10.0, 5000.0, "log"),
    }
    """What a tuner may search: name to (low, high, scale of the axis)."""

    def __post_init__(self) -> None:
        for key in self.parameter_space:
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
                raise InputError(f"{self.name}: {key} = {value!r}, must be a positive number")
        angle = self.misalignment_deg
        if isinstance(angle, bool) or not isinstance(angle, int | float) or not 0.0 <= angle <= 45.0:
            raise InputError(f"{self.name}: misalignment_deg = {angle!r}, must be within 0 to 45")
        if self.speed not in SPEEDS:
            raise InputError(f"{self.name}: speed = {self.speed!r}; {nearest(str(self.speed), SPEEDS[1:])}")
        for key in ("reject_field", "whole_field"):
            if not isinstance(getattr(self, key), bool):
                raise InputError(f"{self.name}: {key} = {getattr(self, key)!r}, must be true or false")

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the samples of a log that it uses."""
        return ("imu", "mag", *filter(None, (self.speed,)))

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError when it lacks the magnetometer, or the speed that is asked for."""
        from estimators.core.timeline import make_timeline, walk
        from estimators.methods.ahrs_eskf_kernels import HeadingFilter, empty_recording, make_work

        n, t = len(log.imu.t), log.imu.t
        stride = min(n, max(1, round(SNAPSHOT_INTERVAL_S * (n - 1) / (t[-1] - t[0]))))
        keep = empty_recording(n, stride)
        event_t, inputs = self.inputs(log)
        state, p = self.start(log)
        model = HeadingFilter(inputs, self.settings(log), self.watch(), state, p, make_work(len(p)), keep)
        walk(make_timeline(t[0] - interval(log), t, event_t), model, n)
        with_misalignment(log, keep, self.misalignment_deg * DEG)
        return solution(log, keep)

    def inputs(self, log: SensorLog) -> tuple[Array, Inputs]:
        """Times of the events (E,), and the samples as the kernels take them."""
        from estimators.methods.ahrs_eskf_kernels import AIRSPEED, FIELD, GROUND_VELOCITY, Inputs

        if log.mag is None or len(log.mag.t) == 0:
            raise InputError(f"{self.name}: the log has no magnetometer; give the scenario a table [sensors.mag]")
        parts: list[tuple[Array, int, Array, float]] = [(log.mag.t, FIELD, log.mag.field, 0.0)]
        if self.speed:
            samples = getattr(log, self.speed, None)
            if samples is None or len(samples.t) == 0:
                raise InputError(
                    f"{self.name}: speed = {self.speed!r}, but the log has none; give [sensors.{self.speed}]"
                )
            if self.speed == "airspeed":
                z = np.column_stack([samples.speed, np.zeros((len(samples.t), 2))])
                parts.append((samples.t, AIRSPEED, z, max(samples.spec.noise_sigma, 0.1) ** 2))
            else:
                sigma = max(samples.spec.velocity_sigma, 0.01)
                parts.append((samples.t - samples.spec.latency_s, GROUND_VELOCITY, samples.v_n, sigma**2))
        t = np.concatenate([part[0] for part in parts])
        kind = np.concatenate([np.full(len(part[0]), part[1], dtype=np.int64) for part in parts])
        z, r = np.concatenate([part[2] for part in parts]), np.concatenate([np.full(len(p[0]), p[3]) for p in parts])
        order = np.argsort(t, kind="stable")
        accel = log.imu.accel - log.initial.accel_bias
        return t[order], Inputs(log.imu.gyro, accel, kind[order], np.ascontiguousarray(z[order]), r[order])

    def settings(self, log: SensorLog) -> Settings:
        """What this log's sensors and motion are taken for."""
        from estimators.methods.ahrs_eskf_kernels import Settings

        assert log.mag is not None
        dt, limit = interval(log), max(self.bias_limit_dps * DEG, float(log.initial.std[12:15].max()))
        measured, field = self.speed != "", float(np.linalg.norm(log.mag.spec.field_n))
        per_s = (
            float(np.median(np.diff(log.airspeed.t))) if self.speed == "airspeed" and len(log.airspeed.t) > 1 else 1.0
        )
        return Settings(
            stride=max(1, round(STEP_S / dt)),
            interval=dt,
            gyro_density=(self.gyro_dps * DEG) ** 2,
            scale_density=self.gyro_scale**2,
            bias_walk=(self.bias_walk_dps * DEG) ** 2,
            bias_limit=limit**2,
            velocity_walk=self.velocity_walk_mps**2,
            velocity_density=0.0 if measured else self.velocity_mps**2,
            still_density=0.0 if measured else 0.01**2,
            heading_density=(self.heading_deg * DEG) ** 2,
            declination=log.mag.spec.declination,
            direction=tuple(np.array(log.mag.spec.field_n) / field) if self.whole_field else (0.0, 0.0, 0.0),
            rest_rate=REST_RATE,
            rest_force=REST_FORCE,
            rest_time=math.inf if measured else REST_TIME_S,
            rest_weight=1.0 - math.exp(-dt / REST_AVERAGE_S),
            rest_bias=REST_BIAS**2,
            slip_density=(self.slip_deg * DEG) ** 2 / per_s,
            gust_variance=self.gust_mps**2,
            gust_length=self.gust_length_m,
            lever_arm=log.gnss.spec.lever_arm_b if self.speed == "gnss" and log.gnss is not None else (0.0, 0.0, 0.0),
        )

    def watch(self) -> FieldWatch:
        """The rule by which a field is taken or left out, before the first sample."""
        from estimators.methods.ahrs_field import FieldWatch

        share = NORM_SHARE if self.reject_field else 0.0
        times = START_S, REFERENCE_S, CLEAN_S, RENEWAL_S, TURNING, PATIENCE_S
        return FieldWatch(share, DIP, NORM_AVERAGE_S, *times, np.zeros(10))

    def start(self, log: SensorLog) -> tuple[Array, Array]:
        """State (9,) and covariance (8,8) in which the filter starts; two more of each with an airspeed, the gusts."""
        initial = log.initial
        known = self.speed == "gnss"
        velocity = initial.v_n[:2] if known else np.zeros(2)
        sigma = initial.std[3:5] if known else np.full(2, UNKNOWN_MPS if self.speed else 2.0 * self.velocity_mps)
        gusts = np.full(2 if self.speed == "airspeed" else 0, self.gust_mps)
        std = np.concatenate([initial.std[6:9], initial.std[12:15], sigma, gusts])
        return np.concatenate([initial.q_nb, initial.gyro_bias, velocity, 0.0 * gusts]), np.diag(std**2)


def with_misalignment(log: SensorLog, kept: AttitudeRecording, sigma: float) -> None:
    """Add to the covariance what triads that are turned by ``sigma`` (rad, 1 sigma per axis) do to the attitude.

    Tilt has the accelerometers' turn itself. The azimuth of the field has the magnetometer's about down and, times the tangent
    of the dip, what it and the accelerometers are turned about the horizontal axes (the slope of `use_heading`). A constant is
    no noise, so that the filter's gain leaves it out (as a parameter that is considered: Schmidt 1966).
    """
    assert log.mag is not None
    north, east, down = log.mag.spec.field_n
    steep = down * down / max(north * north + east * east, 1e-12)
    added = sigma * sigma * np.array([1.0, 1.0, 1.0 + 2.0 * steep])
    kept.std[:, :3] = np.sqrt(kept.std[:, :3] ** 2 + added)
    kept.covariance[:, range(3), range(3)] += added


def solution(log: SensorLog, kept: AttitudeRecording) -> NavSolution:
    """What a run leaves behind as the bench wants it; position and velocity stand still and are no states."""
    t, initial, n = log.imu.t, log.initial, len(log.imu.t)
    at = t[kept.stride - 1 :: kept.stride]
    still = np.full(n, initial.lat), np.full(n, initial.lon), np.full(n, initial.h), np.tile(initial.v_n, (n, 1))
    heading: dict[str, Any] = {
        "value": np.ascontiguousarray(kept.heading[:, :1]),
        "covariance": np.ascontiguousarray(kept.heading[:, 1]).reshape(-1, 1, 1),
        "rejected": kept.heading[:, 2] == 0.0,
    }
    return NavSolution(
        t,
        *still,
        kept.state[:, :4],
        gyro_bias=kept.state[:, 4:7],
        std=kept.std,
        covariance_t=at,
        covariance=kept.covariance,
        innovations={"heading": Innovations(at, **heading, names=("heading, rad",))},
        states=STATES,
        extras={"velocity_mps": (t, kept.state[:, 7:]), "at_rest": (at, kept.at_rest)},
        extra_names={"velocity_mps": ("north", "east")},
    )
