"""Alignment at rest: what a filter can know of its start after its vehicle has stood for a while.

Levelling and gyro bias from the means of the IMU, heading from the magnetometer, a known direction, or unknown (Groves, 2nd
ed., section 5.6.2 and eq. 6.4). Errors are what the sensors imply, none is drawn around the truth but position and, where it
is given, heading. SI units and radians; attitude errors are rotation vectors in n.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import NO_HEADING_STD, ImuSamples, InitialState, MagSamples, Trajectory
from testbed.data.specs import ImuSpec, MagSpec, TriadSpec
from testbed.physics.earth import G0, RATE, earth_rate_n, gravity, metres_per_radian
from testbed.physics.interpolate import point_state
from testbed.physics.rotations import euler_to_quat, quat_rotate_inverse, quats_to_eulers, wrap
from testbed.sensors.config import InitialConfig
from testbed.sensors.draws import Draws

REST_MPS = 1e-3
"""What counts as standing: in a minute 6 cm, and 1e-5 m/s² if it came and went within that."""
STANDING_STD_MPS = 0.001
"""Sigma of the velocity that is set to zero: the bound above."""


def align_at_rest(
    config: InitialConfig, trajectory: Trajectory, imu: ImuSamples, mag: MagSamples | None, draws: Draws
) -> tuple[InitialState, ImuSamples]:
    """The state at the end of the rest with its standard deviations, and the IMU samples that come after it.

    Raises InputError where the vehicle moves meanwhile, or the heading is to come from a magnetometer that is not there.
    """
    assert config.align_at_rest_s is not None
    begin = float(trajectory.t[0])
    until = begin + config.align_at_rest_s
    used = imu.t <= until + 1e-9
    _check_rest(config, trajectory, until, int(used.sum()), len(imu.t))
    end = float(imu.t[used][-1])
    lat, lon, h, _ = point_state(trajectory, np.array([end]), np.array(imu.spec.lever_arm_b))
    f_b, w_b = imu.accel[used].mean(axis=0), imu.gyro[used].mean(axis=0)
    roll, pitch = math.atan2(-f_b[1], -f_b[2]), math.atan2(f_b[0], math.hypot(f_b[1], f_b[2]))
    true_yaw = float(quats_to_eulers(trajectory.q_nb[:1])[0, 2])
    drawn = draws.alignment("initial").standard_normal(15)
    yaw, yaw_std = _heading(config, mag, until, (roll, pitch), true_yaw + math.radians(config.yaw_deg) * drawn[8])
    q_nb = np.array(euler_to_quat(roll, pitch, yaw))
    seconds = end - begin
    spinning = np.array(quat_rotate_inverse(q_nb, earth_rate_n(float(lat[0]))))
    tilt = _tilt_std(imu.spec.accel, seconds, float(gravity(float(lat[0]), float(h[0]))))
    accel, gyro = _left(imu.spec.accel, seconds), _left_gyro(imu.spec, seconds, min(yaw_std, 1.0), float(lat[0]))
    position = config.position_m
    std = np.repeat([position, STANDING_STD_MPS, tilt, accel, gyro], 3)
    std[8] = yaw_std
    north, east = metres_per_radian(float(lat[0]), float(h[0]))
    start = InitialState(
        t=end,
        lat=float(lat[0] + position * drawn[0] / north),
        lon=float(lon[0] + position * drawn[1] / east),
        h=float(h[0] - position * drawn[2]),
        v_n=np.zeros(3),
        q_nb=q_nb,
        accel_bias=np.zeros(3),
        gyro_bias=w_b - spinning,
        std=np.maximum(std, 1e-10),
    )
    return start, replace(imu, t=imu.t[~used], gyro=imu.gyro[~used], accel=imu.accel[~used])


def after(samples: Mapping[str, Any], t: float) -> dict[str, Any]:
    """The aiding samples that come after the alignment."""
    out = {}
    for kind, sensor in samples.items():
        rows = sensor.t > t + 1e-9
        parts = {name: getattr(sensor, name)[rows] for name in ("t", *sensor.shapes)}
        if getattr(sensor, "std", None) is not None:
            parts["std"] = sensor.std[rows]
        out[kind] = replace(sensor, **parts)
    return out


def _check_rest(config: InitialConfig, trajectory: Trajectory, until: float, used: int, samples: int) -> None:
    standing = trajectory.t <= until + 1e-9
    speed = np.linalg.norm(trajectory.v_n[standing], axis=1)
    if speed.max() > REST_MPS:
        k = int(np.argmax(speed > REST_MPS))
        raise InputError(
            f"[initial] align_at_rest_s = {config.align_at_rest_s:g}: the vehicle moves at t = {trajectory.t[k]:.6g} s "
            f"({speed[k]:.3g} m/s); let it stand so long, or align for less"
        )
    if used < 2 or used > samples - 2:
        raise InputError(
            f"[initial] align_at_rest_s = {config.align_at_rest_s:g}: {used} of {samples} IMU samples are in it"
        )


def _heading(
    config: InitialConfig, mag: MagSamples | None, until: float, tilt: tuple[float, float], given: float
) -> tuple[float, float]:
    """Heading and its sigma, rad."""
    if config.align_heading == "unknown":
        return 0.0, NO_HEADING_STD
    if config.align_heading in (None, "given"):
        return wrap(given), math.radians(config.yaw_deg)
    if mag is None:
        raise InputError('[initial] align_heading = "mag", but the scenario has no [sensors.mag]')
    used = mag.t <= until + 1e-9
    if not used.any():
        raise InputError("[initial] align_at_rest_s: no sample of the magnetometer is in it")
    x, y, z = mag.field[used].mean(axis=0)
    (cr, sr), (cp, sp) = ((math.cos(a), math.sin(a)) for a in tilt)
    along, across = cp * x + sp * (sr * y + cr * z), cr * y - sr * z
    level = math.hypot(along, across)
    return wrap(mag.spec.declination - math.atan2(across, along)), _mag_std(mag.spec, level, int(used.sum()))


def _mag_std(spec: MagSpec, level: float, n: int) -> float:
    """Of a magnetic heading: hard iron and noise across the horizontal field, soft iron and misalignment as angles."""
    size = math.sqrt(sum(part * part for part in spec.field_n))
    across = math.hypot(spec.turn_on_bias, spec.noise_sigma / math.sqrt(n), spec.soft_iron * size)
    return math.hypot(across / level, spec.misalignment * size / level)


def _tilt_std(spec: TriadSpec, seconds: float, g: float) -> float:
    """Sigma of a levelled angle: what a horizontal accelerometer errs by over gravity, and how askew it sits."""
    error = math.hypot(_left(spec, seconds), spec.white_noise / math.sqrt(seconds))
    return math.hypot(error / g, spec.misalignment, spec.nonorthogonality)


def _left(spec: TriadSpec, seconds: float) -> float:
    """Sigma of a bias that nobody has measured."""
    return math.hypot(spec.turn_on_bias, spec.gauss_markov_sigma(), spec.rate_random_walk * math.sqrt(seconds))


def _left_gyro(spec: ImuSpec, seconds: float, yaw_std: float, lat: float) -> float:
    """Sigma of the gyro bias that the mean at rest leaves: noise, what wandered, Earth rate in a wrong direction, and gravity."""
    gyro = spec.gyro
    wander = gyro.gauss_markov_sigma() * math.sqrt(min(1.0, seconds / gyro.correlation_time_s))
    walk = gyro.rate_random_walk * math.sqrt(seconds / 3.0)
    earth = RATE * math.cos(lat) * yaw_std
    return math.hypot(gyro.white_noise / math.sqrt(seconds), wander, walk, earth, gyro.g_sensitivity * G0)
