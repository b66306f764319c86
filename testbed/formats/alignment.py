"""Initial state of a recording that states none: coarse levelling, heading from course or magnetometer, place from GNSS.

Groves, 2nd ed., section 5.6.2 (levelling) and 6.1.1 (magnetic heading). The accelerometer is averaged over the first
seconds in the body frame of the start (the gyro turns each sample back), and the acceleration that the GNSS velocity
shows is allowed for. Standard deviations are part of the answer: accelerometer turn-on bias over gravity and the GNSS
velocity noise for roll and pitch; velocity noise over speed and a crab angle, or hard iron over the horizontal field,
for the heading. Where nothing tells the heading its sigma is that of a uniform angle, 104°. n north-east-down; SI, rad.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, GnssFixes, ImuSamples, InitialState, MagSamples, Trajectory
from testbed.formats.config import AlignmentConfig
from testbed.formats.kinematics import from_rotvec, multiply
from testbed.formats.recording import interpolate_motion
from testbed.physics import earth
from testbed.physics.rotations import euler_error_matrix, euler_to_quat, quat_to_euler, quats_to_matrices

SLOWEST_COURSE = 5.0
"""m/s: below this the course says little of the heading."""
LEVEL_STD = np.radians(0.5)
"""Mounting and averaging error of levelling, beyond what the specification accounts for."""
MAG_STD = np.radians(5.0)
"""Heading error of an uncalibrated magnetometer in its vehicle, beyond the specification."""
MAG_ITERATIONS = 60
"""Heading needs roll and pitch and, in a turn, these need the heading: each round leaves about tan(dip) a/g of the error."""
UNKNOWN_STD = np.pi / np.sqrt(3.0)
REFERENCE_STD = np.array([0.1, 0.1, 0.1, 0.05, 0.05, 0.05, *np.radians([0.1, 0.1, 0.5])])
"""Smallest sigma of a start from the reference: m, m/s, rad."""


@dataclass(frozen=True)
class Aligned:
    """The log's tables cut to start at the initial state, and the initial state."""

    imu: ImuSamples
    gnss: GnssFixes | None
    initial: InitialState


def align(
    config: AlignmentConfig,
    imu: ImuSamples,
    gnss: GnssFixes | None,
    mag: MagSamples | None,
    reference: Trajectory | None,
    t_start: float,
    place: str,
) -> Aligned:
    """Initial state at the first IMU time that GNSS (or the reference) reaches; what lies before is cut off.

    ``t_start`` is the beginning of the first IMU interval. The first fix makes the initial position and velocity, so it
    is not offered to the filter a second time. Raises InputError where neither GNSS nor a reference can give a start.
    """
    start = config.start
    if start == "auto":
        start = "gnss" if (gnss is not None and len(gnss.t)) or reference is None else "reference"
    if "reference" in (start, config.attitude) and reference is None:
        raise InputError(f"{place}: the initial state is to come from the reference, but the recording has none")
    if start == "gnss" and (gnss is None or not len(gnss.t)):
        raise InputError(f'{place}: without GNSS fixes the initial state needs [recording.initial] start = "reference"')
    source = gnss if start == "gnss" else reference
    assert source is not None
    needed = max(
        float(source.t[0]),
        float(reference.t[0]) if config.attitude == "reference" and reference is not None else -np.inf,
    )
    imu, t = cut_before(imu, t_start, needed, place)
    attitude, attitude_std = _attitude(config, imu, gnss, mag, reference, t)
    q_nb = np.array(euler_to_quat(*attitude))
    jacobian = np.array(euler_error_matrix(*attitude))
    if start == "gnss":
        assert gnss is not None
        lat, lon, h, v_n, motion_std, gnss = from_first_fix(gnss, t, q_nb)
    else:
        assert reference is not None
        lat, lon, h, v_n, _ = reference_at(reference, t)
        motion_std = REFERENCE_STD[:6]
    bias_std = np.repeat([imu.spec.accel.turn_on_bias, imu.spec.gyro.turn_on_bias], 3)
    std = np.concatenate([motion_std, np.sqrt(jacobian**2 @ attitude_std**2), bias_std])
    return Aligned(imu, gnss, InitialState(t, lat, lon, h, v_n, q_nb, np.zeros(3), np.zeros(3), std))


def cut_before(imu: ImuSamples, t_start: float, needed: float, place: str) -> tuple[ImuSamples, float]:
    """IMU samples after the last interval boundary that is not later than ``needed``, and that boundary."""
    boundaries = np.concatenate([[t_start], imu.t])
    first = max(int(np.searchsorted(boundaries, needed + 1e-9, side="right")) - 1, 0)
    if len(imu.t) - first < 2:
        raise InputError(f"{place}: the first fix or reference is at {needed:.6g} s, the IMU ends at {imu.t[-1]:.6g} s")
    return replace(imu, t=imu.t[first:], gyro=imu.gyro[first:], accel=imu.accel[first:]), float(boundaries[first])


def level(f_b: Array, a_n: Array, gravity: float, yaw: float) -> tuple[float, float]:
    """Roll and pitch (rad) at which specific force ``f_b`` is acceleration ``a_n`` less gravity, for a known yaw.

    Exact in closed form: roll from the component across the heading, pitch from the other two.
    """
    force = a_n - np.array([0.0, 0.0, gravity])
    c, s = np.cos(yaw), np.sin(yaw)
    along, across, down = c * force[0] + s * force[1], -s * force[0] + c * force[1], force[2]
    length = np.hypot(f_b[1], f_b[2])
    roll = np.arcsin(np.clip(across / length, -1.0, 1.0)) - np.arctan2(f_b[1], -f_b[2])
    z = f_b[1] * np.sin(roll) + f_b[2] * np.cos(roll)
    pitch = np.arctan2(along, down) - np.arctan2(f_b[0], z)
    return float(_wrap(roll)), float(_wrap(pitch))


def magnetic_heading(field_b: Array, roll: float, pitch: float, declination: float) -> tuple[float, float]:
    """True heading (rad) and the horizontal field (the unit of ``field_b``) of a levelled magnetometer."""
    x, y, _ = quats_to_matrices(np.array([euler_to_quat(roll, pitch, 0.0)]))[0] @ field_b
    return float(_wrap(declination - np.arctan2(y, x))), float(np.hypot(x, y))


def _attitude(
    config: AlignmentConfig,
    imu: ImuSamples,
    gnss: GnssFixes | None,
    mag: MagSamples | None,
    reference: Trajectory | None,
    t: float,
) -> tuple[tuple[float, float, float], Array]:
    """Roll, pitch, yaw and their sigmas (rad); given values and sigmas of the configuration come first."""
    if config.attitude == "reference" and reference is not None:
        roll, pitch, yaw = quat_to_euler(reference_at(reference, t)[4])
        std = REFERENCE_STD[6:].copy()
    else:
        roll, pitch, yaw, std = _levelled(config, imu, gnss, mag, t)
    given = (config.roll_deg, config.pitch_deg, config.yaw_deg)
    roll, pitch, yaw = (a if g is None else np.radians(g) for a, g in zip((roll, pitch, yaw), given, strict=True))
    if config.roll_pitch_std_deg is not None:
        std[:2] = np.radians(config.roll_pitch_std_deg)
    if config.yaw_std_deg is not None:
        std[2] = np.radians(config.yaw_std_deg)
    return (float(roll), float(pitch), float(yaw)), std


def _levelled(
    config: AlignmentConfig, imu: ImuSamples, gnss: GnssFixes | None, mag: MagSamples | None, t: float
) -> tuple[float, float, float, Array]:
    window = max(2, int(np.searchsorted(imu.t, t + config.level_s, side="right")))
    span = float(imu.t[:window][-1] - t)
    f_b = _force_at_start(imu, window, t)
    velocity, velocity_std, a_n = np.zeros(3), 0.0, np.zeros(3)
    if gnss is not None and len(gnss.t):
        velocity, velocity_std = gnss.v_n[0], float(gnss.measurement_std()[0, 3])
        last = int(np.searchsorted(gnss.t, gnss.t[0] + span + 1e-9, side="right")) - 1
        if last > 0:
            a_n = (gnss.v_n[last] - gnss.v_n[0]) / (gnss.t[last] - gnss.t[0])
    gravity = float(earth.gravity(gnss.lat[0], gnss.h[0])) if gnss is not None and len(gnss.t) else earth.G0
    speed = float(np.hypot(velocity[0], velocity[1]))
    heading = config.heading
    if heading == "auto":
        heading = "course" if speed >= SLOWEST_COURSE else ("mag" if mag is not None and len(mag.t) else "none")
    yaw, yaw_std = 0.0, UNKNOWN_STD
    if config.yaw_deg is not None:
        yaw = float(np.radians(config.yaw_deg))
        yaw_std = np.radians(5.0)
    elif heading == "course":
        if speed < 1.0:
            raise InputError(f'[recording.initial] heading = "course", but the first fix moves at {speed:.2g} m/s only')
        yaw = float(np.arctan2(velocity[1], velocity[0]))
        yaw_std = float(np.hypot(velocity_std / speed, np.radians(config.crab_deg)))
    roll, pitch = level(f_b, a_n if yaw_std < UNKNOWN_STD else np.zeros(3), gravity, yaw)
    if heading == "mag" and config.yaw_deg is None:
        roll, pitch, yaw, yaw_std = _by_mag(config, mag, t, f_b, a_n, gravity)
    level_std = np.sqrt(
        (imu.spec.accel.turn_on_bias / gravity) ** 2 + 2.0 * (velocity_std / (span * gravity)) ** 2 + LEVEL_STD**2
    )
    return roll, pitch, yaw, np.array([level_std, level_std, yaw_std])


def _by_mag(
    config: AlignmentConfig, mag: MagSamples | None, t: float, f_b: Array, a_n: Array, gravity: float
) -> tuple[float, float, float, float]:
    if mag is None or not len(mag.t):
        raise InputError('[recording.initial] heading = "mag", but the recording has no magnetometer')
    near = np.abs(mag.t - t) <= max(0.1, float(np.abs(mag.t - t).min()) + 1e-9)
    field_b = mag.field[near].mean(axis=0)
    declination = mag.spec.declination if config.declination_deg is None else float(np.radians(config.declination_deg))
    roll, pitch = level(f_b, np.zeros(3), gravity, 0.0)
    for _ in range(MAG_ITERATIONS):
        yaw, horizontal = magnetic_heading(field_b, roll, pitch, declination)
        roll, pitch = level(f_b, a_n, gravity, yaw)
    return roll, pitch, yaw, float(np.hypot(MAG_STD, mag.spec.turn_on_bias / horizontal))


def _force_at_start(imu: ImuSamples, window: int, t: float) -> Array:
    """Mean specific force of the first samples, each turned back into the body frame of time ``t``."""
    steps = np.diff(np.concatenate([[t], imu.t[:window]]))[:, None]
    q, turned = np.array([[1.0, 0.0, 0.0, 0.0]]), np.empty((window, 3))
    for k in range(window):
        middle = multiply(q, from_rotvec(0.5 * steps[k : k + 1] * imu.gyro[k : k + 1]))
        turned[k] = quats_to_matrices(middle)[0] @ imu.accel[k]
        q = multiply(q, from_rotvec(steps[k : k + 1] * imu.gyro[k : k + 1]))
    return (turned * steps).sum(axis=0) / steps.sum()


def from_first_fix(gnss: GnssFixes, t: float, q_nb: Array) -> tuple[float, float, float, Array, Array, GnssFixes]:
    """Position (of the IMU, moved back to ``t``), velocity, their sigmas, and the fixes after the first."""
    v_n = gnss.v_n[0].copy()
    back = quats_to_matrices(q_nb[None])[0] @ np.array(gnss.spec.lever_arm_b) + v_n * (gnss.t[0] - t)
    per_lat, per_lon = earth.metres_per_radian(gnss.lat[0], gnss.h[0])
    lat, lon, h = gnss.lat[0] - back[0] / per_lat, gnss.lon[0] - back[1] / per_lon, gnss.h[0] + back[2]
    std = np.maximum(gnss.measurement_std()[0], 1e-3)
    rest = {key: getattr(gnss, key)[1:] for key in ("t", "lat", "lon", "h", "v_n")}
    remaining = replace(gnss, **rest, std=None if gnss.std is None else gnss.std[1:])
    return float(lat), float(lon), float(h), v_n, std, remaining


def reference_at(reference: Trajectory, t: float) -> tuple[float, float, float, Array, Array]:
    r = reference
    lat, lon, h, v_n, q_nb = interpolate_motion(np.array([t]), r.t, r.lat, r.lon, r.h, r.v_n, r.q_nb)
    return float(lat[0]), float(lon[0]), float(h[0]), v_n[0], q_nb[0]


def _wrap(angle: float) -> float:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
