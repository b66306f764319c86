"""Is a recording what its columns say? One set of checks for all formats, before anything is aligned.

Each finding is a refusal (InputError: file, what was found, what would be right) where no estimator could give a right
answer, or a sentence that is told once and stands in the report. What both IMU and GNSS show of the motion, the turns
and the size of the acceleration, is compared in `testbed.formats.agreement`. SI units, radians; n and b as everywhere.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.records import Array, GnssFixes
from testbed.formats import agreement, clocks, first_motion, reference_motion
from testbed.formats.raw import Raw
from testbed.formats.reference_motion import DISTANCE_S, MOST_ROWS, slope
from testbed.physics import earth
from testbed.physics.earth import G0
from testbed.physics.rotations import quats_to_matrices

FASTEST_GYRO = 40.0
"""rad/s: MEMS gyros end at 4000 °/s = 70 rad/s and their usual full scale is 2000 °/s = 35 rad/s."""
FAR_REFERENCE_M = 1000.0
"""No datum, antenna or receiver sets a reference this far from the fixes of the same vehicle."""
OFF_REFERENCE_M = 50.0
"""Further than a geoid undulation is rare among receivers; below it nothing is said."""
FACTORS = {"g": G0, "mg": 1e-3 * G0, "ft/s²": 0.3048}
"""Units that an accelerometer's numbers are often in, to m/s²."""
STRAY_SIGMAS, STRAY_M, STRAY_MPS2 = 20.0, 50.0, 100.0
"""A step off the way by twenty sigma, 50 m and what 10 g make of it is not the vehicle's."""
SPIKES = {"gyro": (3.0, "rad/s"), "accel": (60.0, "m/s²")}
"""Off both neighbours by so much, a sample alone turns the levelling of 2 s at 100 Hz by 2°; 6 g is more than any but shocks."""
SPIKE_FACTOR = 50.0
"""Times what one sample in a hundred is off its neighbours: vibration and landings are shocks among others."""


def check(raw: Raw) -> list[str]:
    """Sentences on what was found. Drops fixes that are none and such as lie before the IMU; raises InputError."""
    notes: list[str] = []
    _absurd(raw)
    notes += clocks.rates(raw)
    notes += clocks.overlaps(raw)
    if raw.gnss is not None:
        _places(raw.gnss.lat, raw.place("gnss"))
        notes += _no_fixes(raw)
        notes += _before_imu(raw)
        notes += _strays(raw)
        _sigmas(raw)
    if raw.motion is not None:
        _places(raw.motion[1], raw.place("reference"))
    notes += _spikes(raw)
    _sizes(raw)
    notes += _gravity(raw)
    notes += clocks.gaps(raw)
    if raw.motion is not None:
        notes += reference_motion.check(raw)
        notes += _reference_place(raw)
    if raw.gnss is not None:
        level, vertical = _velocities(raw)
        notes += [*level, *vertical, *agreement.check(raw, level)]
    return notes


def _absurd(raw: Raw) -> None:
    """Numbers that no vehicle reaches: a damaged file, or another column than it is taken for."""
    imu = raw.imu
    assert imu is not None
    found = [("imu", "angular rate", imu.gyro, 1e4, "rad/s"), ("imu", "specific force", imu.accel, 1e5, "m/s²")]
    if raw.gnss is not None:
        found += [("gnss", "height", raw.gnss.h, 1e7, "m"), ("gnss", "velocity", raw.gnss.v_n, 2e4, "m/s")]
    if raw.motion is not None:
        found += [
            ("reference", "height", raw.motion[3], 1e7, "m"),
            ("reference", "velocity", raw.motion[4], 2e4, "m/s"),
        ]
    for part, what, values, most, unit in found:
        if len(values) and not (values.max() <= most and values.min() >= -most):
            size = np.abs(values).reshape(len(values), -1).max(axis=1)
            k = int(np.argmax(~(size <= most)))
            raise InputError(
                f"{raw.place(part)}: the {what} is {size[k]:.4g} {unit} at sample {k}, which no vehicle reaches"
            )


def _places(lat: Array, place: str) -> None:
    if len(lat) and np.abs(lat).max() > 0.5 * np.pi:
        k = int(np.argmax(np.abs(lat)))
        raise InputError(f"{place}: latitude {np.degrees(lat[k]):.6g}° at sample {k} lies outside ±90°")


def _no_fixes(raw: Raw) -> list[str]:
    """Rows at latitude and longitude 0 among others that lie elsewhere: how receivers write that they have no fix."""
    g = raw.gnss
    assert g is not None
    zero = (g.lat == 0.0) & (g.lon == 0.0)
    if not zero.any() or zero.all():
        return []
    distant = np.hypot(g.lat[~zero], g.lon[~zero]).min() > np.radians(1.0)  # a degree is an hour by car from there
    if not distant:
        return []
    raw.gnss = select(g, ~zero)
    first = int(np.argmax(zero))
    return [
        f"{raw.place('gnss')}: sample {first} lies at latitude 0, longitude 0, which means no fix"
        f" ({int(zero.sum())} such rows are left out)"
    ]


def _before_imu(raw: Raw) -> list[str]:
    g = raw.gnss
    assert g is not None
    early = g.t < raw.t_start - 1e-9
    if not early.any():
        return []
    raw.gnss = select(g, ~early)
    return [
        f"{raw.place('gnss')}: {int(early.sum())} fixes lie before the IMU's first sample, up to"
        f" {raw.t_start - g.t[0]:.3g} s, and are left out"
    ]


def _strays(raw: Raw) -> list[str]:
    """Fixes off the way of their neighbours, farther than any vehicle goes; at the start they are left out.

    A filter can gate a stray among others; the first fix it would take at its word.
    """
    g = raw.gnss
    assert g is not None
    if len(g.t) < 5:
        return []
    dt = np.diff(g.t)
    step = np.diff(first_motion.offsets(g), axis=0)
    limit = np.maximum(STRAY_SIGMAS * float(np.median(g.measurement_std()[:, :3])), STRAY_M) + STRAY_MPS2 * dt**2
    if not raw.gnss_position_only:
        step = step - 0.5 * (g.v_n[1:] + g.v_n[:-1]) * dt[:, None]
        far = np.linalg.norm(step, axis=1) > limit
        fast = STRAY_MPS2 * dt + STRAY_SIGMAS * float(np.median(g.measurement_std()[:, 3:]))
        far |= np.linalg.norm(np.diff(g.v_n, axis=0), axis=1) > fast
    else:
        far = np.linalg.norm(step - np.median(step, axis=0), axis=1) > limit + 340.0 * dt  # the speed of sound
    if not far.any() or far.mean() > 0.1:  # many: the units are wrong, which is told as that
        return []
    told = [
        f"{raw.place('gnss')}: {int(far.sum())} steps between fixes go off the way, the first at sample {int(np.argmax(far)) + 1}"
    ]
    stray = 0
    while stray < len(far) - 1 and far[stray]:
        stray += 1
    if stray:
        raw.gnss = select(g, np.arange(len(g.t)) >= stray)
        told.append(f"{raw.place('gnss')}: the first {stray} of these would be the start, and are left out")
    return told


def _sigmas(raw: Raw) -> None:
    g = raw.gnss
    assert g is not None
    if g.std is None:
        return
    stated = g.std[:, :3] if raw.gnss_position_only else g.std
    good = np.isfinite(stated) & (stated > 0.0)
    if not good.all():
        k, i = (int(v) for v in np.argwhere(~good)[0])
        name = [
            *(f"std_{a}_m" for a in ("north", "east", "down")),
            *(f"std_v_{a}_mps" for a in ("north", "east", "down")),
        ]
        raise InputError(
            f"{raw.place('gnss')}: {name[i]} is {stated[k, i]:g} at sample {k}, a standard deviation is above 0"
            f" ({int((~good).any(axis=1).sum())} such rows); take the column out and give [recording.gnss] its figures"
        )


def _spikes(raw: Raw) -> list[str]:
    """Single IMU samples that no motion explains: a flipped bit, a glitch of the bus. Their neighbours' mean takes their place."""
    imu = raw.imu
    assert imu is not None
    notes = []
    for name, (limit, unit) in SPIKES.items():
        values = getattr(imu, name)
        if len(values) < 3 or (values.max() <= limit and values.min() >= -limit):
            continue
        large = np.unique(np.flatnonzero(np.abs(values.ravel()) > limit) // 3)
        usual = float(np.quantile(_off_neighbours(values, np.arange(0, len(values), _stride(imu.t))), 0.99))
        off = _off_neighbours(values, large)
        rows = large[off > max(limit, SPIKE_FACTOR * usual)]
        if not len(rows):
            continue
        before, after = _neighbours(rows, len(values))
        mended = values.copy()
        mended[rows] = 0.5 * (values[before] + values[after])
        raw.imu = imu = replace(imu, **{name: mended})
        notes.append(
            f"{raw.place('imu')}: sample {rows[0]} ({name}) stands {off.max():.3g} {unit} off the one before and the one after,"
            f" as no motion does ({len(rows)} such; the mean of its neighbours takes its place): is the file damaged?"
        )
    return notes


def _neighbours(rows: NDArray[np.int64], n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows before and after; at the ends the two next to them."""
    return np.where(rows == 0, 2, rows - 1), np.where(rows == n - 1, n - 3, rows + 1)


def _off_neighbours(values: Array, rows: NDArray[np.int64]) -> Array:
    """Distance of rows of ``values`` (N,3) from the nearer one of their neighbours."""
    before, after = _neighbours(rows, len(values))
    here = values[rows]
    return np.minimum(*(np.linalg.norm(here - values[k], axis=1) for k in (before, after)))


def _sizes(raw: Raw) -> None:
    """Angular rates that no gyro measures, and specific force of a wrong unit."""
    imu = raw.imu
    assert imu is not None
    fastest = float(np.quantile(np.abs(imu.gyro[:: _stride(imu.t)]).max(axis=1), 0.99))
    if fastest > FASTEST_GYRO:
        raise InputError(
            f"{raw.place('imu')}: one gyro sample in a hundred is above {fastest:.3g} rad/s; are the rates in °/s? Name their unit"
        )
    force = float(np.median(np.linalg.norm(imu.accel[:: _stride(imu.t)], axis=1)))
    step = float(np.median(np.diff(imu.t[:MOST_ROWS])))
    for unit, factor in FACTORS.items():
        if 0.8 < force * factor / G0 < 1.25:
            raise InputError(
                f"{raw.place('imu')}: the specific force is {force:.4g} m/s² in the middle, which would be 1 g"
                f" if its unit were {unit}; name it"
            )
    if 0.8 < force / step / G0 < 1.25:
        raise InputError(
            f"{raw.place('imu')}: the specific force is {force:.4g} m/s² in the middle, which times the rate is 1 g:"
            " are these increments? Divide them by the sampling interval, or use the format kfgins"
        )


def _stride(t: Array) -> int:
    """Of rows, so that no more than `MOST_ROWS` are looked at."""
    return max(1, len(t) // MOST_ROWS)


def _gravity(raw: Raw) -> list[str]:
    imu = raw.imu
    assert imu is not None
    force = float(np.median(np.linalg.norm(imu.accel[:: _stride(imu.t)], axis=1)))
    if raw.motion is not None:
        t, *_, q_nb = raw.motion
        rows = np.flatnonzero((t >= imu.t[0]) & (t <= imu.t[-1]))
        rows = rows[:: max(1, len(rows) // MOST_ROWS)]
        k = np.clip(np.searchsorted(imu.t, t[rows]), 0, len(imu.t) - 1)
        down = np.einsum("ki,ki->k", quats_to_matrices(q_nb[rows])[:, 2], imu.accel[k])
        if len(rows) and down.mean() > 0.5 * G0:
            raise InputError(
                f"{raw.place('imu')}: by the reference's attitude the specific force points down ({down.mean():+.3g} m/s²), at"
                f" rest it is {-G0:.4g} m/s²: the accelerometer's sign or an axis is wrong, a leading minus in columns turns it"
            )
    if not 0.5 * G0 < force < 2.0 * G0:
        return [
            f"{raw.place('imu')}: the specific force is {force:.3g} m/s² in the middle of its values, gravity is 9.8"
        ]
    mean = float(imu.accel[:: _stride(imu.t), 2].mean())
    if raw.motion is None and mean > 0.5 * G0:
        return [
            f"{raw.place('imu')}: the specific force is {mean:+.3g} m/s² along z on average, so z points up (b is"
            " forward-right-down); attitudes are those of the sensor as it lies, [recording.imu] mounting_deg turns it"
        ]
    return []


def _reference_place(raw: Raw) -> list[str]:
    if raw.gnss is None or raw.motion is None:
        return []
    g, (t, lat, lon, h, *_) = raw.gnss, raw.motion
    inside = (g.t >= t[0]) & (g.t <= t[-1])
    if not inside.any():
        return []
    at = g.t[inside]
    true = [np.interp(at, t, x) for x in (lat, np.unwrap(lon), h)]
    ned = np.column_stack(earth.position_difference(g.lat[inside], g.lon[inside], g.h[inside], *true))
    off, high = float(np.median(np.hypot(ned[:, 0], ned[:, 1]))), float(np.median(np.abs(ned[:, 2])))
    told = f"{raw.place('reference')}: lies {off:.4g} m beside and {high:.4g} m above or below the fixes (medians)"
    if off > FAR_REFERENCE_M:
        raise InputError(f"{told}: these are not of one vehicle, or their clocks differ")
    sigma = float(np.median(g.measurement_std()[:, :3]))
    return [told] if max(off, high) > max(OFF_REFERENCE_M, 10.0 * sigma) else []


def _velocities(raw: Raw) -> tuple[list[str], list[str]]:
    """Velocities against the differences of the positions: sentences on the unit along the ground, and on the sign of the vertical."""
    g = raw.gnss
    assert g is not None
    level: list[str] = []
    vertical: list[str] = []
    if len(g.t) < 10 or raw.gnss_position_only:
        return level, vertical
    count = max(1, min(round(DISTANCE_S / float(np.median(np.diff(g.t)))), len(g.t) // 10))
    rows = np.arange(0, len(g.t), count)
    ned = np.diff(first_motion.offsets(g)[rows], axis=0)
    way = np.vstack([np.zeros(3), np.cumsum(0.5 * (g.v_n[1:] + g.v_n[:-1]) * np.diff(g.t)[:, None], axis=0)])
    moved, shown = ned, np.diff(way[rows], axis=0)
    ratio, similar = slope(shown[:, :2].ravel(), moved[:, :2].ravel())
    if np.median(np.linalg.norm(g.v_n[:, :2], axis=1)) > 1.0 and (similar < 0.5 or not 0.8 < ratio < 1.25):
        level.append(
            f"{raw.place('gnss')}: the positions move {ratio:.3g} times as far as the velocities say (similarity {similar:.2f}):"
            " units, or north and east exchanged?"
        )
    ratio, similar = slope(shown[:, 2], moved[:, 2])
    if similar < -0.5:
        vertical.append(f"{raw.place('gnss')}: the height falls when v_down is negative: is it the velocity upwards?")
    return level, vertical


def select(samples: GnssFixes, keep: NDArray[np.bool_]) -> GnssFixes:
    """Some rows of some samples."""
    changes: dict[str, Any] = {
        name: values[keep] for name, values in vars(samples).items() if isinstance(values, np.ndarray)
    }
    return replace(samples, **changes)
