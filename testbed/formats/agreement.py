"""Do IMU and GNSS show one motion? Turns and specific force of both are correlated over a shift of time.

Two signals that need no attitude: the turn rate about the apparent vertical (the direction of the specific force, Groves,
2nd ed., section 5.6) against the rate of the course over ground, and the size of the specific force against that of the
acceleration of the GNSS velocity less gravity. A ratio of 57 between turns is a unit, an opposite sign an axis, and the
shift at which they agree best is the delay of one clock against the other. SI, rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.records import Array, GnssFixes, ImuSamples
from testbed.formats.raw import Raw
from testbed.physics import earth

LONGEST_SHIFT = 2.0
"""s: receivers report up to about a second late; a larger offset is a clock's, which the turns of a drive make ambiguous."""
SHIFTS = np.arange(-LONGEST_SHIFT, LONGEST_SHIFT + 0.01, 0.04)
SIMILAR = 0.8
"""Correlation from which a motion is taken to be the same: two thirds of the variance are common."""
SLOWEST = 3.0
"""m/s: below it the noise of a GNSS velocity (0.1 m/s) turns the course by degrees."""
LEAST_TURN = 0.02
"""rad/s: slower turns are the noise of a course on a straight line."""
FEWEST = 40
"""Compared intervals: a correlation of 0.8 among 40 unrelated pairs has a chance below 1e-9."""
TELLING_S = 0.05
"""A smaller delay is within the stamps of ordinary loggers: at 20 m/s it is a metre."""
PIECES = 4
"""The shift's standard error comes from its scatter over so many pieces of the recording."""


COMPARED_HZ = 50.0
"""Rate to which the IMU is averaged: a shift is told in hundredths of a second."""
MOST_INTERVALS = 3000
"""Compared intervals: their scatter of 10 % leaves the slope 0.2 %."""


class Fit(NamedTuple):
    """Best shift (s, positive where GNSS is late), its standard error, the correlation there and the ratio IMU over GNSS."""

    shift: float
    error: float
    similar: float
    ratio: float


def check(raw: Raw, doubts: Sequence[str] = ()) -> list[str]:
    """Refuses turns of another unit or sign; tells a delay that the specification does not account for.

    ``doubts`` are those of the velocities, which turn the other way when north and east are exchanged.
    """
    assert raw.imu is not None and raw.gnss is not None
    if len(raw.gnss.t) < FEWEST:
        return []
    imu, gnss = _thinned(raw.imu), raw.gnss
    turning = turns(imu, gnss) if not raw.gnss_position_only else None
    if turning is not None and abs(turning.similar) > SIMILAR:
        if turning.similar < 0.0 and doubts:
            raise InputError(
                f"{doubts[0]} The course that they give turns against the IMU (correlation {turning.similar:.2f})"
            )
        if turning.similar < 0.0:
            raise InputError(
                f"{raw.place('imu')}: turns about the measured vertical go against the course over ground (correlation"
                f" {turning.similar:.2f}): the sign of the accelerometers or of a gyro axis is wrong"
            )
        if not 0.2 < turning.ratio < 5.0:
            unit = "°/s named rad/s" if turning.ratio > 5.0 else "rad/s named °/s"
            raise InputError(
                f"{raw.place('imu')}: the gyros turn {turning.ratio:.3g} times as fast as the course over ground: are the rates {unit}?"
            )
    found = [fit for fit in (turning, forces(imu, gnss) if not raw.gnss_position_only else None) if fit is not None]
    found = [fit for fit in found if fit.similar > SIMILAR and np.isfinite(fit.error)]
    if not found:
        return []
    best = min(found, key=lambda fit: fit.error)
    delay = best.shift - gnss.spec.latency_s
    if abs(delay) < max(TELLING_S, 3.0 * best.error):
        return []
    return [
        f"{raw.place('gnss')}: the fixes show the motion {abs(delay):.2f} s (± {best.error:.2f} s) {'after' if delay > 0 else 'before'}"
        f" the IMU does, beyond the stated latency; [recording.gnss] clock_s = {-delay:.2f} accounts for it"
    ]


def turns(imu: ImuSamples, gnss: GnssFixes) -> Fit | None:
    """Fit of the turn rate about the apparent vertical to that of the course."""
    speed = np.hypot(gnss.v_n[:, 0], gnss.v_n[:, 1])
    course = np.arctan2(gnss.v_n[:, 1], gnss.v_n[:, 0])
    change = (np.diff(course) + np.pi) % (2.0 * np.pi) - np.pi
    usable = np.minimum(speed[1:], speed[:-1]) > SLOWEST
    seconds = _seconds(imu.t)
    down = -_smooth(imu.accel, seconds)
    length = np.sqrt(np.einsum("ki,ki->k", down, down))
    rate = np.einsum("ki,ki->k", imu.gyro, down) / np.maximum(length, 1e-9)
    if usable.any() and np.sqrt(np.mean((change[usable] / np.diff(gnss.t)[usable]) ** 2)) < LEAST_TURN:
        return None
    return _fit(imu.t, rate, gnss.t, change, usable)


def forces(imu: ImuSamples, gnss: GnssFixes) -> Fit | None:
    """Fit of the size of the specific force to that of the acceleration that the velocities show, less gravity."""
    dt = np.diff(gnss.t)[:, None]
    force = np.diff(gnss.v_n, axis=0) / dt
    force[:, 2] -= earth.gravity(gnss.lat[:-1], gnss.h[:-1])
    size = np.linalg.norm(force, axis=1)
    if np.std(size) < 0.5:  # m/s²: less is the noise of 0.1 m/s differenced over a fifth of a second
        return None
    return _fit(imu.t, np.linalg.norm(imu.accel, axis=1), gnss.t, size * dt[:, 0], np.ones(len(size), dtype=bool), True)


def _fit(t: Array, rate: Array, at: Array, change: Array, usable: NDArray[np.bool_], level: bool = False) -> Fit | None:
    """Fit of the integral of ``rate`` (N,) over each interval of the fixes to ``change`` (M-1,); ``level`` takes out means."""
    even = np.diff(at) < 1.5 * np.median(np.diff(at))
    keep = usable & even & (at[:-1] > t[0] + LONGEST_SHIFT) & (at[1:] < t[-1] - LONGEST_SHIFT)
    if keep.sum() < FEWEST:
        return None
    chosen = np.flatnonzero(keep)
    keep = chosen[:: -(-len(chosen) // MOST_INTERVALS)]
    total = np.concatenate([[0.0], np.cumsum(rate[1:] * np.diff(t))])
    first, last = at[:-1][keep], at[1:][keep]
    # row s of ``swept`` is what the IMU did while the fixes, late by SHIFTS[s], showed their change
    swept = _shifted(t, total, last) - _shifted(t, total, first)
    span, shown = (last - first), change[keep]
    swept, shown = swept / span, shown / span
    similar = _correlations(swept, shown, level)
    k = int(np.argmax(np.abs(similar)))
    pieces = np.array_split(np.arange(len(shown)), PIECES)
    peaks = [_peak(np.sign(similar[k]) * _correlations(swept[:, p], shown[p], level)) for p in pieces]
    error = float(np.std(peaks, ddof=1) / np.sqrt(PIECES))
    y, x = (swept[k] - swept[k].mean(), shown - shown.mean()) if level else (swept[k], shown)
    return Fit(_peak(np.sign(similar[k]) * similar), error, float(similar[k]), abs(float(y @ x) / float(x @ x)))


def _shifted(t: Array, total: Array, at: Array) -> Array:
    """(S,M) of ``total`` (N,) at ``at`` (M,) less each of SHIFTS, linear on an even grid, where a place is a division away."""
    grid = np.arange(t[0], t[-1], 1.0 / COMPARED_HZ)
    even = np.interp(grid, t, total)
    place = ((at - t[0])[None, :] - SHIFTS[:, None]) * COMPARED_HZ
    k = np.clip(place.astype(np.int64), 0, len(grid) - 2)
    share = place - k
    return (1.0 - share) * even[k] + share * even[k + 1]


def _correlations(swept: Array, shown: Array, level: bool) -> Array:
    if level:
        swept, shown = swept - swept.mean(axis=1, keepdims=True), shown - shown.mean()
    norm = np.sqrt(np.einsum("si,si->s", swept, swept) * float(shown @ shown))
    return swept @ shown / np.maximum(norm, 1e-30)


def _peak(values: Array) -> float:
    """Shift of the largest value, between the steps by a parabola; NaN at the ends."""
    k = int(np.argmax(values))
    if k in (0, len(values) - 1):
        return float("nan")
    before, here, after = values[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    return float(SHIFTS[k] + (0.5 * (before - after) / bend * (SHIFTS[1] - SHIFTS[0]) if bend < 0.0 else 0.0))


def _thinned(imu: ImuSamples) -> ImuSamples:
    """Means over whole blocks of samples; integrals stay what they are."""
    size = int(1.0 / (float(np.median(np.diff(imu.t[:10_000]))) * COMPARED_HZ))
    count = len(imu.t) // max(size, 1)
    if size < 2 or count < 2:
        return imu
    # einsum, as a mean over a short inner axis takes ten times as long
    blocks = (x[: count * size].reshape(count, size, 3) for x in (imu.gyro, imu.accel))
    gyro, accel = (np.einsum("ksi->ki", x) / size for x in blocks)
    return replace(imu, t=imu.t[size - 1 : count * size : size], gyro=gyro, accel=accel)


def _seconds(t: Array) -> int:
    """Samples in a second, at least one."""
    return max(1, round(1.0 / float(np.median(np.diff(t)))))


def _smooth(values: Array, width: int) -> Array:
    """Running means over ``width`` rows."""
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(values, width, axis=0, mode="nearest"))
