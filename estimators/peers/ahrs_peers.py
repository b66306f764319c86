"""`madgwick`, `mahony` and `ahrs-ekf`: the attitude filters of the package ``ahrs`` on the bench's logs, for comparison.

Sources: Madgwick (2010), Mahony et al. (2008), and the package's own extended Kalman filter (extra ``peers``). They see
what `ahrs-kf` sees: gyros freed of the calibrated bias, accelerometers freed of theirs, and the magnetometer. The
package's navigation frame is used as north-east-down with gravity along +z seen as specific force; SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from estimators.methods.ahrs_kf import Array, interval, latest_field, prepare
from testbed.base.errors import InputError, MissingExtra
from testbed.data.records import ATTITUDE_STATES, NavSolution, SensorLog


@dataclass(frozen=True)
class _Peer:
    name: ClassVar[str] = ""
    sensors: ClassVar[tuple[str, ...]] = ("imu", "mag")

    def _track(self, gyro: Array, accel: Array, mag: Array, log: SensorLog) -> Array:
        raise NotImplementedError

    def run(self, log: SensorLog) -> NavSolution:
        """Attitude by the package, which gets the latest field sample at each IMU sample."""
        recording = prepare(log, self.name)
        gyro = recording.gyro - log.initial.gyro_bias
        return standing(log, self._track(gyro, recording.accel, recording.mag[latest_field(recording)], log))


def standing(log: SensorLog, q_nb: Array) -> NavSolution:
    """The answer of a filter that knows attitude alone: position and velocity stand still at the initial state."""
    n, initial = len(log.imu.t), log.initial
    still = np.full(n, initial.lat), np.full(n, initial.lon), np.full(n, initial.h), np.tile(initial.v_n, (n, 1))
    return NavSolution(log.imu.t, *still, q_nb, states=ATTITUDE_STATES)


def _package() -> Any:
    try:
        import ahrs
    except ImportError:
        raise MissingExtra(
            "the peers madgwick, mahony and ahrs-ekf need the package ahrs: pip install 'navigation-testbed[peers]'"
        ) from None
    return ahrs.filters


@dataclass(frozen=True)
class Madgwick(_Peer):
    """Gradient-descent filter of Madgwick with one gain (rad/s)."""

    gain: float = 0.041
    """The default is that of the package, from Madgwick's report."""
    name: ClassVar[str] = "madgwick"

    def __post_init__(self) -> None:
        require(self, ("gain",))

    def _track(self, gyro: Array, accel: Array, mag: Array, log: SensorLog) -> Array:
        assert log.mag is not None
        north = about_down(log.mag.spec.declination)  # the package's north is magnetic
        q0 = multiply(about_down(-log.mag.spec.declination), log.initial.q_nb)
        made = _package().Madgwick(gyr=gyro, acc=-accel, mag=mag, frequency=1.0 / interval(log), gain=self.gain, q0=q0)
        return np.array([multiply(north, q) for q in made.Q])


@dataclass(frozen=True)
class Mahony(_Peer):
    """Complementary filter of Mahony with proportional (1/s) and integral (1/s²) gain."""

    proportional: float = 1.0
    integral: float = 0.3
    name: ClassVar[str] = "mahony"

    def __post_init__(self) -> None:
        require(self, ("proportional", "integral"))
        if self.integral == 0.0:
            raise InputError("mahony: integral = 0, the package asks for a number above zero")

    def _track(self, gyro: Array, accel: Array, mag: Array, log: SensorLog) -> Array:
        assert log.mag is not None
        # The package's navigation frame has magnetic north along y and up along z.
        to_ned = multiply(about_down(log.mag.spec.declination), ENU_TO_NED)
        q0 = multiply(_conjugate(to_ned), log.initial.q_nb)
        gains = {"k_P": self.proportional, "k_I": self.integral}
        made = _package().Mahony(gyr=gyro, acc=accel, mag=mag, frequency=1.0 / interval(log), q0=q0, **gains)
        return np.array([multiply(to_ned, q) for q in made.Q])


@dataclass(frozen=True)
class AhrsEkf(_Peer):
    """The package's extended Kalman filter on the quaternion; variances of gyro, unit gravity and unit field."""

    gyro_variance: float = 0.09
    accel_variance: float = 0.25
    mag_variance: float = 0.64
    name: ClassVar[str] = "ahrs-ekf"

    def __post_init__(self) -> None:
        require(self, ("gyro_variance", "accel_variance", "mag_variance"))

    def _track(self, gyro: Array, accel: Array, mag: Array, log: SensorLog) -> Array:
        assert log.mag is not None
        noises = [self.gyro_variance, self.accel_variance, self.mag_variance]
        reference = np.array(log.mag.spec.field_n, dtype=float)
        settings = {"frequency": 1.0 / interval(log), "q0": np.array(log.initial.q_nb), "magnetic_ref": reference}
        made = _package().EKF(gyr=gyro, acc=-accel, mag=mag, frame="NED", noises=noises, **settings)
        return np.asarray(made.Q)


ENU_TO_NED = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
"""From east-north-up to north-east-down."""


def about_down(angle: float) -> Array:
    """The turn by an angle (rad) about down."""
    return np.array([np.cos(0.5 * angle), 0.0, 0.0, np.sin(0.5 * angle)])


def multiply(p: Array, q: Array) -> Array:
    """Hamilton product of two quaternions."""
    from testbed.physics.rotations import quat_multiply

    return np.array(quat_multiply(p, q))


def _conjugate(q: Array) -> Array:
    return np.array([q[0], -q[1], -q[2], -q[3]])


def require(peer: Any, keys: tuple[str, ...]) -> None:
    """Raises InputError where a parameter of a peer is no number, or negative."""
    for key in keys:
        value = getattr(peer, key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < np.inf:
            raise InputError(f"{peer.name}: {key} = {value!r}, must be a number that is not negative")
