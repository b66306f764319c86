"""Initial state of a recording that states none: coarse levelling, heading, place and velocity from GNSS.

Heading: the course at the first fix, the magnetometer with the declination of the place, or the first course carried back
by the gyros (`testbed.formats.first_motion`). At rest the mean of the whole rest levels and gives the gyro biases.

Groves, 2nd ed., section 5.6.2 (levelling) and 6.1.1 (magnetic heading). The accelerometer is averaged over the first
seconds in the body frame of the start (the gyro turns each sample back), and the acceleration that the GNSS velocity
shows is allowed for. Standard deviations are part of the answer: accelerometer turn-on bias over gravity and the GNSS
velocity noise for roll and pitch; velocity noise over speed and a crab angle, or hard iron over the horizontal field,
for the heading. Where nothing tells the heading its sigma is that of a uniform angle, 104°. n north-east-down; SI, rad.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import NO_HEADING_STD, Array, GnssFixes, ImuSamples, InitialState, MagSamples, Trajectory
from testbed.formats import first_motion
from testbed.formats.config import AlignmentConfig
from testbed.formats.first_motion import Rest, Start
from testbed.formats.kinematics import accumulated, from_rotvec, multiply
from testbed.formats.recording import interpolate_motion, seconds
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
MOST_SLOPES = 100
"""Velocities among which slopes are taken: 5000 pairs."""
REFERENCE_STD = np.array([0.1, 0.1, 0.1, 0.05, 0.05, 0.05, *np.radians([0.1, 0.1, 0.5])])
"""Smallest sigma of a start from the reference: m, m/s, rad."""


@dataclass(frozen=True)
class Aligned:
    """The log's tables cut to start at the initial state, the initial state, and what is to be told of it."""

    imu: ImuSamples
    gnss: GnssFixes | None
    initial: InitialState
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Given:
    """What files say beside the samples.

    ``attitude``: roll, pitch, yaw (rad) at the first IMU time and their sigmas; ``gyro_bias`` (3,) rad/s: measured
    beforehand;
    ``position_only``: the velocities of the fixes are derived from their positions.
    """

    attitude: tuple[Array, Array] | None = None
    gyro_bias: Array | None = None
    position_only: bool = False


@dataclass
class _Case:
    """What the parts of an alignment share."""

    config: AlignmentConfig
    imu: ImuSamples
    gnss: GnssFixes | None
    mag: MagSamples | None
    t: float
    place: str
    start: Start | None = None
    rest: Rest | None = None
    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))
    gyro_std: Array = field(default_factory=lambda: np.zeros(3))
    notes: list[str] = field(default_factory=list)


LEVELLING = ("attitude", "heading", "level_s", "crab_deg", "declination_deg")
"""Keys that ask for an attitude of one's own, even where the files state one."""


def align(
    config: AlignmentConfig,
    imu: ImuSamples,
    gnss: GnssFixes | None,
    mag: MagSamples | None,
    reference: Trajectory | None,
    t_start: float,
    place: str,
    given: Given | None = None,
) -> Aligned:
    """Initial state at the first IMU time that GNSS (or the reference) reaches; what lies before is cut off.

    ``t_start`` is the beginning of the first IMU interval. The first fix makes the initial position and velocity, so it
    is not offered to the filter a second time. Raises InputError where neither GNSS nor a reference can give a start.
    """
    given = given or Given()
    start = _source(config, gnss, reference, place)
    source = gnss if start == "gnss" else reference
    assert source is not None
    wants = reference if config.attitude == "reference" else None
    imu, t = cut_before(imu, t_start, max(float(source.t[0]), float(wants.t[0]) if wants else -np.inf), place)
    if gnss is not None:
        gnss = _from(gnss, t)
    if start == "gnss" and (gnss is None or not len(gnss.t)):
        raise InputError(f"{place}: no fix lies within the IMU's samples from {seconds(t)} s on")
    if config.declination_deg is not None and (mag is None or not len(mag.t)):
        raise InputError(
            f"{place}: [recording.initial] declination_deg has no effect: the recording has no magnetometer"
        )
    case = _Case(config, imu, gnss, mag, t, place)
    _known_motion(case, given, np.inf if reference is None else first_motion.moves_at(reference, t))
    stated = given.attitude if not config.model_fields_set & set(LEVELLING) else None
    attitude, attitude_std = _attitude(case, reference, stated)
    q_nb = np.array(euler_to_quat(*attitude))
    jacobian = np.array(euler_error_matrix(*attitude))
    if start == "gnss":
        assert gnss is not None
        lat, lon, h, v_n, motion_std, gnss = from_first_fix(gnss, t, q_nb, case.start if given.position_only else None)
    else:
        assert reference is not None
        lat, lon, h, v_n, _ = reference_at(reference, t)
        motion_std = REFERENCE_STD[:6]
    bias_std = np.concatenate([np.repeat(imu.spec.accel.turn_on_bias, 3), case.gyro_std])
    std = np.concatenate([motion_std, np.sqrt(jacobian**2 @ attitude_std**2), bias_std])
    return Aligned(
        imu, gnss, InitialState(t, lat, lon, h, v_n, q_nb, np.zeros(3), case.gyro_bias, std), tuple(case.notes)
    )


def turned(initial: InitialState, config: AlignmentConfig) -> InitialState:
    """A stated initial state with the angles and sigmas that the scenario gives in place of its own."""
    euler = list(quat_to_euler(initial.q_nb))
    for i, angle in enumerate((config.roll_deg, config.pitch_deg, config.yaw_deg)):
        euler[i] = euler[i] if angle is None else np.radians(angle)
    jacobian = np.array(euler_error_matrix(*euler))
    euler_std = np.sqrt(np.linalg.inv(jacobian) ** 2 @ initial.std[6:9] ** 2)
    if config.roll_pitch_std_deg is not None:
        euler_std[:2] = np.radians(config.roll_pitch_std_deg)
    if config.yaw_std_deg is not None:
        euler_std[2] = np.radians(config.yaw_std_deg)
    std = initial.std.copy()
    std[6:9] = np.sqrt(jacobian**2 @ euler_std**2)
    return replace(initial, q_nb=np.array(euler_to_quat(*euler)), std=std)


def _source(config: AlignmentConfig, gnss: GnssFixes | None, reference: Trajectory | None, place: str) -> str:
    """``gnss`` or ``reference``: where position and velocity at the start come from."""
    start = config.start
    if start == "auto":
        start = "gnss" if (gnss is not None and len(gnss.t)) or reference is None else "reference"
    if "reference" in (start, config.attitude) and reference is None:
        raise InputError(f"{place}: the initial state is to come from the reference, but the recording has none")
    if start == "gnss" and (gnss is None or not len(gnss.t)):
        raise InputError(f'{place}: without GNSS fixes the initial state needs [recording.initial] start = "reference"')
    return start


def _from(gnss: GnssFixes, t: float) -> GnssFixes:
    return gnss.taken(gnss.t >= t - 1e-9)


def _known_motion(case: _Case, given: Given, moves_at: float) -> None:
    """Fill in velocity and acceleration at the start, rest, and the gyro biases with their sigmas."""
    spec, gnss = case.imu.spec.gyro, case.gnss
    case.gyro_std = np.repeat(spec.turn_on_bias, 3)
    if given.gyro_bias is not None:
        case.gyro_bias, case.gyro_std = given.gyro_bias, np.repeat(spec.gauss_markov_sigma(), 3)
    if gnss is not None and len(gnss.t) > 1 and given.position_only:
        case.start = first_motion.at_first_fix(gnss)
    if given.attitude is not None:
        return
    case.rest = first_motion.rest_at_start(case.imu, gnss, case.t, case.config.level_s, moves_at)
    if case.rest is not None and given.gyro_bias is None:
        noise = spec.white_noise / np.sqrt(case.rest.span)
        std = float(np.sqrt(noise**2 + spec.gauss_markov_sigma() ** 2 + first_motion.EARTH_RATE**2))
        if std < spec.turn_on_bias:  # else the data sheet knows more
            case.gyro_bias, case.gyro_std = case.rest.gyro, np.repeat(std, 3)
            case.notes.append(
                f"{case.place}: at rest for the first {case.rest.span:.3g} s: levelled and gyro biases taken from its mean"
            )


def cut_before(imu: ImuSamples, t_start: float, needed: float, place: str) -> tuple[ImuSamples, float]:
    """IMU samples after the last interval boundary that is not later than ``needed``, and that boundary."""
    boundaries = np.concatenate([[t_start], imu.t])
    first = max(int(np.searchsorted(boundaries, needed + 1e-9, side="right")) - 1, 0)
    if len(imu.t) - first < 2:
        raise InputError(
            f"{place}: the first fix or reference is at {seconds(needed)} s, the IMU ends at {seconds(imu.t[-1])} s"
        )
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
    case: _Case, reference: Trajectory | None, stated: tuple[Array, Array] | None
) -> tuple[tuple[float, float, float], Array]:
    """Roll, pitch, yaw and their sigmas (rad); given values and sigmas of the configuration come first."""
    config = case.config
    if config.attitude == "reference" and reference is not None:
        roll, pitch, yaw = quat_to_euler(reference_at(reference, case.t)[4])
        std = REFERENCE_STD[6:].copy()
    elif stated is not None:
        (roll, pitch, yaw), std = stated[0], stated[1].copy()
    else:
        roll, pitch, yaw, std = _levelled(case)
    own = (config.roll_deg, config.pitch_deg, config.yaw_deg)
    roll, pitch, yaw = (a if g is None else np.radians(g) for a, g in zip((roll, pitch, yaw), own, strict=True))
    if config.roll_pitch_std_deg is not None:
        std[:2] = np.radians(config.roll_pitch_std_deg)
    if config.yaw_std_deg is not None:
        std[2] = np.radians(config.yaw_std_deg)
    return (float(roll), float(pitch), float(yaw)), std


def _levelled(case: _Case) -> tuple[float, float, float, Array]:
    """Roll, pitch, yaw and their sigmas."""
    config, imu, gnss = case.config, case.imu, case.gnss
    window = max(2, int(np.searchsorted(imu.t, case.t + config.level_s, side="right")))
    span = float(imu.t[:window][-1] - case.t)
    motion = case.start or _between_fixes(case, span)
    if case.rest is not None:
        f_b, motion = case.rest.force, Start(np.zeros(3), np.zeros(3), motion.v_std, 0.0)
    else:
        f_b = _force_at_start(imu, window, case.t)
    gravity = float(earth.gravity(gnss.lat[0], gnss.h[0])) if gnss is not None and len(gnss.t) else earth.G0
    level_std = float(
        np.sqrt((imu.spec.accel.turn_on_bias / gravity) ** 2 + (motion.a_std / gravity) ** 2 + LEVEL_STD**2)
    )
    heading = _chosen_heading(case, motion)
    if config.yaw_deg is not None:
        yaw, yaw_std = float(np.radians(config.yaw_deg)), float(np.radians(5.0))
    elif heading == "mag":
        if "crab_deg" in config.model_fields_set:
            raise InputError(
                f"{case.place}: [recording.initial] crab_deg has no effect: the heading is the magnetometer's; leave it out, or"
                ' give heading = "course" or "motion"'
            )
        roll, pitch, yaw, yaw_std = _by_mag(case, f_b, motion.a_n, gravity)
        return roll, pitch, yaw, np.array([level_std, level_std, yaw_std])
    elif heading == "course":
        speed = float(np.hypot(motion.v_n[0], motion.v_n[1]))
        if speed < 1.0:
            raise InputError(f'[recording.initial] heading = "course", but the first fix moves at {speed:.2g} m/s only')
        yaw = float(np.arctan2(motion.v_n[1], motion.v_n[0]))
        yaw_std = float(np.hypot(motion.v_std / speed, np.radians(config.crab_deg)))
    elif heading == "motion":
        yaw, yaw_std = _by_motion(case, level(f_b, np.zeros(3), gravity, 0.0))
    else:
        yaw, yaw_std = 0.0, NO_HEADING_STD
    if yaw_std >= NO_HEADING_STD:
        case.notes.append(
            f"{case.place}: nothing tells the heading at the start (no course, no magnetometer): it is taken as 0° with the"
            " sigma of a uniform angle, 104°; [recording.initial] yaw_deg gives it"
        )
    # the acceleration is known in n, so that a heading which is not known makes no use of it
    roll, pitch = level(f_b, motion.a_n if yaw_std < NO_HEADING_STD else np.zeros(3), gravity, yaw)
    return roll, pitch, yaw, np.array([level_std, level_std, yaw_std])


def _between_fixes(case: _Case, span: float) -> Start:
    """Velocity of the first fix, and the mean acceleration over ``span`` s from the velocities.

    The last velocity less the first, which is the mean of the acceleration exactly, unless the median of the slopes between all
    pairs (Sen, JASA 63, 1968), which a single wrong velocity does not move, is elsewhere.
    """
    gnss = case.gnss
    if gnss is None or not len(gnss.t):
        return Start(np.zeros(3), np.zeros(3), 0.0, 0.0)
    v_std = float(gnss.measurement_std()[0, 3])
    last = int(np.searchsorted(gnss.t, gnss.t[0] + span + 1e-9, side="right")) - 1
    if last < 1:
        return Start(gnss.v_n[0], np.zeros(3), v_std, first_motion.MANOEUVRE)
    a_n = (gnss.v_n[last] - gnss.v_n[0]) / (gnss.t[last] - gnss.t[0])
    a_std = float(np.sqrt(2.0) * v_std / span)
    first, second = np.triu_indices(min(last, MOST_SLOPES) + 1, 1)
    slopes = (gnss.v_n[second] - gnss.v_n[first]) / (gnss.t[second] - gnss.t[first])[:, None]
    median = np.median(slopes, axis=0)
    if np.linalg.norm(a_n - median) > first_motion.MANOEUVRE + 5.0 * a_std:
        case.notes.append(
            f"{case.place}: the velocities of the first {span:.2g} s do not agree with one another: the acceleration at the start"
            f" is the median of their slopes, {np.linalg.norm(median):.2g} m/s², not the first and last one's,"
            f" {np.linalg.norm(a_n):.2g} m/s²"
        )
        a_n = median
    return Start(gnss.v_n[0], a_n, v_std, a_std)


def _chosen_heading(case: _Case, motion: Start) -> str:
    if case.config.heading != "auto":
        return case.config.heading
    speed = float(np.hypot(motion.v_n[0], motion.v_n[1]))
    if speed >= max(SLOWEST_COURSE, 3.0 * motion.v_std):
        return "course"
    return "mag" if case.mag is not None and len(case.mag.t) else "motion"


def _by_motion(case: _Case, tilt: tuple[float, float]) -> tuple[float, float]:
    """Heading and its sigma from the first motion that shows one, carried back by the gyros."""
    gnss, crab = case.gnss, float(np.radians(case.config.crab_deg))
    if gnss is None or len(gnss.t) < 2:
        return 0.0, NO_HEADING_STD
    drift = float(case.gyro_std.max())
    ways = (first_motion.carried_back, first_motion.chord)
    told = [way(case.imu, gnss, case.t, tilt, case.gyro_bias, drift, crab) for way in ways]
    found = [course for course in told if course is not None]
    if not found:
        return 0.0, NO_HEADING_STD
    course = min(found, key=lambda c: c.std)
    case.notes.append(
        f"{case.place}: the heading at the start is that of the motion at {course.t:.4g} s, carried back by the gyros"
        f" (1 sigma {np.degrees(course.std):.2g}°)"
    )
    return float(_wrap(course.yaw)), course.std


def _by_mag(case: _Case, f_b: Array, a_n: Array, gravity: float) -> tuple[float, float, float, float]:
    mag, t = case.mag, case.t
    if mag is None or not len(mag.t):
        raise InputError('[recording.initial] heading = "mag", but the recording has no magnetometer')
    near = np.abs(mag.t - t) <= max(0.1, float(np.abs(mag.t - t).min()) + 1e-9)
    field_b = mag.field[near].mean(axis=0)
    declination = case.config.declination_deg
    east = mag.spec.declination if declination is None else float(np.radians(declination))
    roll, pitch = level(f_b, np.zeros(3), gravity, 0.0)
    for _ in range(MAG_ITERATIONS):
        yaw, horizontal = magnetic_heading(field_b, roll, pitch, east)
        roll, pitch = level(f_b, a_n, gravity, yaw)
    return roll, pitch, yaw, float(np.hypot(MAG_STD, mag.spec.turn_on_bias / horizontal))


def _force_at_start(imu: ImuSamples, window: int, t: float) -> Array:
    """Mean specific force of the first samples, each turned back into the body frame of time ``t``."""
    steps = np.diff(np.concatenate([[t], imu.t[:window]]))[:, None]
    gyro = imu.gyro[:window]
    middle = multiply(accumulated(from_rotvec(steps * gyro))[:-1], from_rotvec(0.5 * steps * gyro))
    turned = np.einsum("kij,kj->ki", quats_to_matrices(middle), imu.accel[:window])
    return (turned * steps).sum(axis=0) / steps.sum()


def from_first_fix(
    gnss: GnssFixes, t: float, q_nb: Array, start: Start | None = None
) -> tuple[float, float, float, Array, Array, GnssFixes]:
    """Position (of the IMU, moved back to ``t``), velocity, their sigmas, and the fixes after the first.

    ``start`` gives the velocity where the fix itself states none.
    """
    v_n = gnss.v_n[0].copy() if start is None else start.v_n
    back = quats_to_matrices(q_nb[None])[0] @ np.array(gnss.spec.lever_arm_b) + v_n * (gnss.t[0] - t)
    per_lat, per_lon = earth.metres_per_radian(gnss.lat[0], gnss.h[0])
    lat, lon, h = gnss.lat[0] - back[0] / per_lat, gnss.lon[0] - back[1] / per_lon, gnss.h[0] + back[2]
    std = np.maximum(gnss.measurement_std()[0], 1e-3)
    if start is not None:
        std[3:] = max(start.v_std, 1e-3)
    return float(lat), float(lon), float(h), v_n, std, gnss.taken(slice(1, None))


def reference_at(reference: Trajectory, t: float) -> tuple[float, float, float, Array, Array]:
    r = reference
    lat, lon, h, v_n, q_nb = interpolate_motion(np.array([t]), r.t, r.lat, r.lon, r.h, r.v_n, r.q_nb)
    return float(lat[0]), float(lon[0]), float(h[0]), v_n[0], q_nb[0]


def _wrap(angle: float) -> float:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
