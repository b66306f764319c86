"""What the fixes and the gyros say of the start: velocity from positions, rest, and a heading from the first motion.

A receiver without velocities: central differences carry sigma √(1/2) σ/Δ and, as the position of the middle fix is not in
them, are independent of that fix's own error; they are weak, as they should be, beside the positions themselves. Where the
vehicle starts, the velocity is that of a parabola through the positions of the first seconds, with its formal sigma.

A heading that nothing tells at the start is that of the first course, carried back by the gyros (Groves, 2nd ed., 5.6.2:
the course of a vehicle without side slip is its heading). SI, rad; n north-east-down.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from testbed.data.records import Array, GnssFixes, ImuSamples, Trajectory
from testbed.formats.kinematics import from_rotvec, multiply
from testbed.physics import earth
from testbed.physics.rotations import quats_to_matrices

PARABOLA_S = 5.0
"""Fixes of so many seconds make the parabola: a jerk of 0.5 m/s³ bends it by 0.5 · 2.5³/6 = 1.3 m, below a fix's own error."""
MANOEUVRE = 3.0
"""m/s², 1 sigma of a vehicle's acceleration before anything is measured: a bank of 17°, hard braking of a car half of it more."""
JERK = 1.0
"""m/s³, of a vehicle that begins a turn or brakes: it sets a central difference over a span s off by JERK s²/24."""
REST_BLOCK_S = 1.0
REST_RATE, REST_FORCE = np.radians(0.3), 0.1
"""rad/s and m/s²: changes of a second's mean beyond these (and four times its noise) end a rest. A slow turn of a vehicle
is 1 °/s, a gentle start 0.3 m/s²."""
REST_SPEED = 0.3
"""m/s, beside four times the velocity's sigma."""
MOVED_M, MOVED_RAD = 1.0, np.radians(2.0)
"""Of a reference: beyond the noise of RTK and of optical systems, whose velocities are differences and noisier."""
LONGEST_REST_S = 120.0
"""A longer mean gains nothing: a bias instability of hours shows after a minute or two."""
EARTH_RATE = 7.3e-5
"""rad/s: what the Earth adds to a gyro at rest whose heading is not known."""
SLOWEST_MOTION = 1.0
"""m/s: below it a velocity sigma of 0.1 m/s is 6° and more."""
FAST_MOTION = 5.0
"""m/s: so fast a vehicle goes forward."""


class Start(NamedTuple):
    """Velocity (m/s) and acceleration (m/s²) in n at the first fix, and their sigmas per axis."""

    v_n: Array
    a_n: Array
    v_std: float
    a_std: float


class Rest(NamedTuple):
    """A rest from the start on: its length (s), mean gyro (3,) and mean specific force (3,)."""

    span: float
    gyro: Array
    force: Array


def moves_at(reference: Trajectory, t: float) -> float:
    """When a reference first goes `MOVED_M` or turns `MOVED_RAD` from where it is at ``t``, s; infinity where it never does."""
    rows = np.flatnonzero(reference.t >= t - 1e-9)
    if not len(rows):
        return np.inf
    first = rows[0]
    origin = (np.full(len(rows), x[first]) for x in (reference.lat, reference.lon, reference.h))
    gone = np.column_stack(
        earth.position_difference(*(x[rows] for x in (reference.lat, reference.lon, reference.h)), *origin)
    )
    turned = 2.0 * np.arccos(np.minimum(np.abs(reference.q_nb[rows] @ reference.q_nb[first]), 1.0))
    moved = (np.linalg.norm(gone, axis=1) > MOVED_M) | (turned > MOVED_RAD)
    return float(reference.t[rows[np.argmax(moved)]]) if moved.any() else np.inf


def with_derived_velocity(gnss: GnssFixes) -> GnssFixes:
    """Fixes of a receiver that states none, with velocities from the differences of positions and their sigmas."""
    n = len(gnss.t)
    std = gnss.measurement_std().copy()
    if n < 2:
        std[:, 3:] = 100.0  # one fix says nothing of the velocity
        return replace(gnss, v_n=np.zeros((n, 3)), std=std)
    ned = offsets(gnss)
    before, after = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
    span = (gnss.t[after] - gnss.t[before])[:, None]
    v_n = (ned[after] - ned[before]) / span
    noise = np.hypot(std[after, :3], std[before, :3]) / span
    std[:, 3:] = np.hypot(noise, JERK * span**2 / 24.0)
    return replace(gnss, v_n=v_n, std=std)


def offsets(gnss: GnssFixes) -> Array:
    """Positions (M,3) in m, n, from the first fix."""
    first = (np.full(len(gnss.t), x[0]) for x in (gnss.lat, gnss.lon, gnss.h))
    return np.column_stack(earth.position_difference(gnss.lat, gnss.lon, gnss.h, *first))


def at_first_fix(gnss: GnssFixes) -> Start:
    """Velocity and acceleration of a parabola through the positions of the first seconds."""
    keep = gnss.t <= gnss.t[0] + PARABOLA_S + 1e-9
    if keep.sum() < 4:
        keep = np.arange(len(gnss.t)) < 4
    t, ned = gnss.t[keep] - gnss.t[0], offsets(gnss)[keep]
    sigma = gnss.measurement_std()[keep, :3]
    degree = min(2, len(t) - 1)
    powers = np.vander(t, degree + 1, increasing=True)
    out, spread = np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        weighted, shown = powers / sigma[:, i : i + 1], ned[:, i] / sigma[:, i]
        if degree == 2:  # few or short fixes say nothing of the acceleration
            weighted, shown = np.vstack([weighted, [0.0, 0.0, 2.0 / MANOEUVRE]]), np.append(shown, 0.0)
        out[: degree + 1, i] = np.linalg.lstsq(weighted, shown, rcond=None)[0]
        spread[: degree + 1, i] = np.sqrt(np.diag(np.linalg.pinv(weighted.T @ weighted)))
    if degree < 1:
        return Start(np.zeros(3), np.zeros(3), 100.0, 0.0)
    return Start(out[1], 2.0 * out[2], float(spread[1].max()), 2.0 * float(spread[2, :2].max()))


def rest_at_start(
    imu: ImuSamples, gnss: GnssFixes | None, t: float, least: float, moves_at: float = np.inf
) -> Rest | None:
    """The rest that a recording begins with, where it lasts ``least`` s; told by IMU and, where there are fixes, by their speed.

    ``moves_at`` (s) is when a reference shows motion: to an IMU alone an even turn is like a rest.
    """
    rate = 1.0 / float(np.median(np.diff(imu.t)))
    size = max(1, round(REST_BLOCK_S * rate))
    count = min(int(LONGEST_REST_S / REST_BLOCK_S), len(imu.t) // size)
    if count < 2:
        return None
    gyro, force = (x[: count * size].reshape(count, size, 3) for x in (imu.gyro, imu.accel))
    moved = np.zeros(count, dtype=bool)
    for values, least_change in ((gyro, REST_RATE), (force, REST_FORCE)):
        means = values.mean(axis=1)
        noise = values[0].std(axis=0) / np.sqrt(size)
        moved |= (np.abs(means - means[0]) > least_change + 4.0 * noise).any(axis=1)
    ends = imu.t[size - 1 : count * size : size]
    if gnss is not None and len(gnss.t):
        fast = np.linalg.norm(gnss.v_n, axis=1) > REST_SPEED + 4.0 * gnss.measurement_std()[:, 3:].max(axis=1)
        far = np.linalg.norm(offsets(gnss), axis=1) > 1.0 + 5.0 * np.linalg.norm(gnss.measurement_std()[:, :3], axis=1)
        if (fast | far).any():
            moved |= ends > gnss.t[np.argmax(fast | far)]
    moved |= ends > moves_at
    still = int(np.argmax(moved)) if moved.any() else count
    # the second in which the vehicle starts is not whole, and the one before may hold the pull of the clutch
    still = still - 1 if moved.any() else still
    if still < 2 or (span := float(ends[still - 1] - t)) < least:
        return None
    return Rest(span, gyro[:still].mean(axis=(0, 1)), force[:still].mean(axis=(0, 1)))


class Course(NamedTuple):
    """Heading at the start (rad), its sigma, and when the motion that told it took place (s)."""

    yaw: float
    std: float
    t: float


def carried_back(
    imu: ImuSamples, gnss: GnssFixes, t: float, level: tuple[float, float], bias: Array, drift: float, crab: float
) -> Course | None:
    """Heading at ``t`` of the first good course, less the turn since then; None where nothing moves in time.

    ``level`` is roll and pitch at ``t``, ``bias`` (3,) that of the gyros, ``drift`` (rad/s) its sigma, ``crab`` (rad) the
    sigma between course and heading.
    """
    from testbed.physics.rotations import euler_to_quat, quats_to_eulers

    speed = np.hypot(gnss.v_n[:, 0], gnss.v_n[:, 1])
    sigma = gnss.measurement_std()[:, 3:5].max(axis=1)
    total = np.sqrt((sigma / np.maximum(speed, 1e-9)) ** 2 + crab**2 + (drift * (gnss.t - t)) ** 2)
    usable = (speed > SLOWEST_MOTION) & (speed > 4.0 * sigma) & (total < np.radians(45.0)) & (gnss.t <= imu.t[-1])
    if (usable & (speed > FAST_MOTION)).any():
        usable &= speed > FAST_MOTION
    if not usable.any():
        return None
    best = int(np.flatnonzero(usable)[np.argmin(total[usable])])
    turned = _turned(imu, t, float(gnss.t[best]), np.array(euler_to_quat(*level, 0.0)), bias)
    course = float(np.arctan2(gnss.v_n[best, 1], gnss.v_n[best, 0]))
    return Course(course - float(quats_to_eulers(turned[None])[0, 2]), float(total[best]), float(gnss.t[best]))


def _turned(imu: ImuSamples, start: float, end: float, q: Array, bias: Array) -> Array:
    """Attitude at ``end`` of a vehicle that had ``q`` at ``start``, by the gyros."""
    rows = imu.t <= end
    steps = np.diff(np.concatenate([[start], imu.t[rows]]))[:, None]
    turns = from_rotvec(steps * (imu.gyro[rows] - bias))
    while len(turns) > 1:  # the product of all, two by two
        odd = turns[-1:] if len(turns) % 2 else turns[:0]
        turns = np.vstack([multiply(turns[: len(turns) - len(turns) % 2 : 2], turns[1::2]), odd])
    return np.asarray(multiply(q[None], turns)[0] if len(turns) else q)


def chord(
    imu: ImuSamples, gnss: GnssFixes, t: float, level: tuple[float, float], bias: Array, drift: float, crab: float
) -> Course | None:
    """`carried_back` for slow or velocity-free fixes: the line between two fixes against the way that the gyros turn.

    The first fix from which the vehicle has gone ten sigma of a position; at even speed the line between both has the mean
    direction of the headings in between.
    """
    from testbed.physics.rotations import euler_to_quat

    ned = offsets(gnss)
    sigma = np.linalg.norm(gnss.measurement_std()[:, :2], axis=1)
    gone = np.hypot(ned[:, 0], ned[:, 1])
    total = np.sqrt((np.hypot(sigma, sigma[0]) / np.maximum(gone, 1e-9)) ** 2 + crab**2 + (drift * (gnss.t - t)) ** 2)
    usable = (gone > 10.0 * sigma) & (total < np.radians(45.0)) & (gnss.t <= imu.t[-1])
    if not usable.any():
        return None
    last = int(np.argmax(usable))
    moving = np.hypot(ned[: last + 1, 0], ned[: last + 1, 1]) > 3.0 * sigma[: last + 1]
    first = max(int(np.argmax(moving)) - 1, 0)
    q, at, way = np.array(euler_to_quat(*level, 0.0)), t, np.zeros(2)
    for k in range(first, last + 1):
        q = _turned(select_after(imu, at), at, float(gnss.t[k]), q, bias)
        at = float(gnss.t[k])
        forward = quats_to_matrices(q[None])[0, :2, 0]
        way = way + forward / max(float(np.hypot(*forward)), 1e-9)
    line = ned[last] - ned[first]
    yaw = float(np.arctan2(line[1], line[0]) - np.arctan2(way[1], way[0]))
    return Course(yaw, float(total[last]), float(gnss.t[last]))


def select_after(imu: ImuSamples, t: float) -> ImuSamples:
    """IMU samples after ``t``."""
    first = int(np.searchsorted(imu.t, t + 1e-9, side="right"))
    return (
        replace(imu, t=imu.t[first:], gyro=imu.gyro[first:], accel=imu.accel[first:]) if len(imu.t) - first > 1 else imu
    )


__all__ = [
    "EARTH_RATE",
    "Course",
    "Rest",
    "Start",
    "at_first_fix",
    "carried_back",
    "chord",
    "moves_at",
    "rest_at_start",
    "with_derived_velocity",
]
