"""A recording: what an importer returns, and the checks and resampling that all importers share.

Times are seconds on the recording's own clock; a reference is brought to the rows that the bench scores on: the initial
time, then every IMU time. SI units and radians, n north-east-down, b forward-right-down.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError, MissingExtra, shown
from testbed.data.records import Array, SensorLog, Trajectory
from testbed.formats.kinematics import conjugate, from_rotvec, implied_imu, multiply, to_rotvec
from testbed.physics.rotations import euler_to_quat


@dataclass(frozen=True)
class Recording:
    """Recorded data as the bench uses it: the log that a filter may see, and the reference to score against.

    ``reference`` is None where the recording has none. Its rows are at ``log.initial.t`` and ``log.imu.t`` as far as
    the recorded reference reaches; ``f_b`` and ``w_ib_b`` are those that the reference motion implies.
    """

    log: SensorLog
    reference: Trajectory | None = None
    notes: tuple[str, ...] = ()
    """What was found, left out or assumed."""
    position_only: bool = False
    """Whether the velocities of its fixes are derived from their positions."""


def seconds(t: float) -> str:
    """A time in a message, to the millisecond, also where it counts from an epoch."""
    return f"{round(float(t), 3) + 0.0:.3f}".rstrip("0").rstrip(".")


THOUSAND = (500.0, 2000.0)
"""Ratio of two spans of time of one recording that differ by milliseconds for seconds, to a factor of two between them."""


def thousandfold(span: float, other: float) -> bool:
    """Whether one of two spans is about a thousand times the other."""
    return min(span, other) > 0.0 and THOUSAND[0] < max(span / other, other / span) < THOUSAND[1]


def check_time(t: Array, place: str) -> Array:
    """Finite, increasing time (N,). Raises InputError that names ``place`` and the sample."""
    check_finite(t, place)
    if len(t) > 1 and not (rising := np.diff(t) > 0.0).all():
        k = int(np.argmin(rising)) + 1
        raise InputError(f"{place}: time must increase, but sample {k} is at {t[k]:.9g} s after {t[k - 1]:.9g} s")
    return t


LARGEST = 1e12
"""In SI units; beyond what any recorded quantity is (nanoseconds are seconds here), and its square is still a number."""


def check_finite(values: Array, place: str) -> Array:
    """Raises InputError that names ``place`` and the first sample that is NaN, infinite or beyond `LARGEST`."""
    rows = np.reshape(values, (len(values), int(np.prod(values.shape[1:]))))
    for sound, fault in ((np.isfinite, "not a finite number"), (_possible, "beyond every quantity that is recorded")):
        good = sound(rows).all(axis=1)
        if not good.all():
            k, count = int(np.argmin(good)), int((~good).sum())
            raise InputError(f"{place}: sample {k} is {fault} ({count} such samples in all)")
    return values


def _possible(values: Array) -> NDArray[np.bool_]:
    return np.abs(values) <= LARGEST


def check_place(lat: Array, lon: Array, place: str) -> None:
    """Latitude within ±90° and longitude within ±360°, both rad; catches degrees given as radians and the reverse."""
    if len(lat) and np.abs(lat).max() > 0.5 * np.pi:
        k = int(np.argmax(np.abs(lat)))
        raise InputError(
            f"{place}: latitude {np.degrees(lat[k]):.6g}° at sample {k} lies outside ±90° (degrees for radians?)"
        )
    if len(lon) and np.abs(lon).max() > 2.0 * np.pi:
        k = int(np.argmax(np.abs(lon)))
        raise InputError(f"{place}: longitude {np.degrees(lon[k]):.6g}° at sample {k} lies outside ±360°")


def check_folder(folder: Path) -> None:
    """Raises InputError where a recording's folder is none."""
    if folder.is_dir():
        return
    if folder.exists():
        raise InputError(
            f"{folder}: is a file; the key recording.dir names the folder of a recording, recording.files the files in it"
        )
    raise InputError(f"{folder}: no such folder; the key recording.dir says where the recording lies")


def existing(path: Path, what: str) -> Path:
    """``path`` when it is a file; else InputError with the files beside it."""
    if path.is_file():
        return path
    if path.is_dir():
        raise InputError(f"{path}: is a folder (wanted a file for the {what})")
    beside = sorted(p.name for p in path.parent.glob("*") if p.is_file()) if path.parent.is_dir() else []
    found = f"; the folder holds {', '.join(beside[:12])}" if beside else ""
    raise InputError(f"{path}: no such file (wanted for the {what}){found}")


def only_file(folder: Path, files: Mapping[str, str], part: str, suffixes: tuple[str, ...]) -> Path:
    """The file of ``part``: the one that ``files`` names, else the only one of the folder that ends so."""
    if part in files:
        return existing(folder / files[part], part)
    check_folder(folder)
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes)
    if len(found) != 1:
        raise InputError(
            f"{folder}: holds {len(found)} {' or '.join(suffixes)} files; name the one to use under files.{part}"
        )
    return found[0]


def library(name: str, package: str, extra: str, what: str) -> Any:
    """A module of a package that only one format needs. Raises MissingExtra where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise MissingExtra(f"{what} need the package {package}: pip install 'navigation-testbed[{extra}]'") from None


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keeps to itself what a library prints of a file's damage, in Python or in C: what matters is told in messages and notes."""
    sys.stdout.flush(), sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1), os.dup2(nowhere, 2)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        os.dup2(kept[0], 1), os.dup2(kept[1], 2)
        for descriptor in (*kept, nowhere):
            os.close(descriptor)


def read_mat(path: Path) -> dict[str, Any]:
    """Variables of a MATLAB file up to version 7. Raises InputError for one that cannot be read."""
    from scipy.io import loadmat

    try:
        content = loadmat(path)
    except NotImplementedError:
        raise InputError(f"{path}: a MATLAB 7.3 (HDF5) file; save it in MATLAB with save(..., '-v7')") from None
    except Exception as error:  # scipy raises anything from zlib.error to IndexError on damaged files
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{path}: not a readable .mat file, corrupt or truncated ({reason})") from None
    return {name: values for name, values in content.items() if not name.startswith("__")}


SLOWEST_REFERENCE = 0.11
"""s: longer steps of a reference are not interpolated. At 10 Hz an angular acceleration of 1 rad/s² bends the attitude by
1 rad/s² (0.1 s)²/8 = 0.07° between two rows, which is what the references of cheap sensors are good for."""


def reference_on_grid(grid: Array, motion: tuple[Array, ...], name: str, own_times: bool = False) -> Trajectory:
    """Recorded motion (t, lat, lon, h, v_n, q_nb) as a Trajectory on ``grid``, as far as it reaches.

    A slow reference, or one with gaps, keeps its own times (and so does any with ``own_times``), and only these are scored. Rows that fall on the grid (to 1 ns) are kept as they are; else positions are cubic Hermite with the recorded
    velocity, velocities linear, attitudes along the shortest arc. ``f_b`` and ``w_ib_b`` are the implied IMU means.
    """
    t, lat, lon, h, v_n, q_nb = motion
    if len(t) < 2:
        raise InputError(f"{name}: the reference has {len(t)} samples, at least 2 are needed")
    inside = grid[(grid >= t[0] - 1e-9) & (grid <= t[-1] + 1e-9)]
    if len(inside) < 2:
        raise InputError(
            f"{name}: the reference ({seconds(t[0])} to {seconds(t[-1])} s) does not overlap the IMU ({seconds(grid[0])} to"
            f" {seconds(grid[-1])} s)"
        )
    own_times = own_times or bool(np.diff(t).max() > SLOWEST_REFERENCE)
    if own_times:
        keep = (t >= grid[0] - 1e-9) & (t <= grid[-1] + 1e-9)
        if keep.sum() < 2:
            raise InputError(
                f"{name}: the reference has {int(keep.sum())} rows while the IMU records, at least 2 are needed"
            )
        inside, lat, lon, h, v_n, q_nb = (values[keep] for values in motion)
    elif len(inside) != len(t) or np.abs(inside - t).max() > 1e-9:
        lat, lon, h, v_n, q_nb = interpolate_motion(inside, t, lat, lon, h, v_n, q_nb)
    f_b, w_ib_b = implied_imu(inside, lat, h, v_n, q_nb)
    return Trajectory(inside, lat, lon, h, v_n, q_nb, f_b, w_ib_b, name=name, own_times=own_times)


def interval_means(t: Array, gyro: Array, accel: Array, sampling: str) -> tuple[float, Array, Array, Array]:
    """Where the first interval begins, and times and means over the intervals before them, of samples (N,), (N,3), (N,3).

    ``sampling`` "interval": the samples are such means. "instant": they are values at their times, and the means are those
    of the trapezoid rule, one fewer.
    """
    if sampling == "instant":
        return float(t[0]), t[1:], 0.5 * (gyro[1:] + gyro[:-1]), 0.5 * (accel[1:] + accel[:-1])
    return float(t[0] - np.median(np.diff(t))), t, gyro, accel


def mounting(kind: str, angles: Any) -> Array:
    """Quaternion (4,) that takes a sensor's axes into b, of its roll, pitch and yaw in the vehicle, deg."""
    numbers = isinstance(angles, list | tuple) and all(isinstance(a, int | float) for a in angles)
    if not numbers or len(angles) != 3:
        raise InputError(f"[recording.{kind}] mounting_deg is {shown(angles)}, expected [roll, pitch, yaw]")
    return np.array(euler_to_quat(*np.radians(angles)))


def rate_of(t: Array) -> float:
    """Samples a second, Hz, in the middle."""
    return float(np.round(1.0 / np.median(np.diff(t)), 3)) if len(t) > 1 else 1.0


def placed(origin: tuple[float, float, float], ned: Array) -> tuple[Array, Array, Array]:
    """Latitude, longitude (rad), height (m) of points (N,3) in m, n, from an origin; flat, so for rooms and test fields."""
    from testbed.physics import earth

    lat, lon, h = origin
    per_lat, per_lon = earth.metres_per_radian(lat, h)
    return lat + ned[:, 0] / per_lat, lon + ned[:, 1] / per_lon, h - ned[:, 2]


def merged_motion(
    attitude: tuple[Array, Array], place: tuple[Array, Array, Array, Array], velocity: tuple[Array, Array]
) -> tuple[Array, ...] | None:
    """t, lat, lon, h, v_n, q_nb at the times of the attitude, from three tables of a log; None where they do not overlap.

    ``attitude``: t, q_nb (N,4); ``place``: t, lat, lon, h; ``velocity``: t, v_n (M,3). Places and velocities are linear
    between their rows.
    """
    t, q_nb = attitude
    inside = (t >= max(place[0][0], velocity[0][0])) & (t <= min(place[0][-1], velocity[0][-1]))
    if inside.sum() < 2:
        return None
    t = t[inside]
    v_n = np.column_stack([np.interp(t, velocity[0], velocity[1][:, i]) for i in range(3)])
    lat, lon, h = (np.interp(t, place[0], x) for x in (place[1], np.unwrap(place[2]), place[3]))
    return t, lat, lon, h, v_n, q_nb[inside]


def interpolate_motion(
    grid: Array, t: Array, lat: Array, lon: Array, h: Array, v_n: Array, q_nb: Array
) -> tuple[Any, ...]:
    """lat, lon, h, v_n, q_nb at ``grid``: Hermite positions, linear velocities, shortest-arc attitudes."""
    from scipy.interpolate import CubicHermiteSpline

    from testbed.physics import earth

    grid = np.clip(grid, t[0], t[-1])
    rates = earth.position_rates(lat, h, v_n[:, 0], v_n[:, 1], v_n[:, 2])
    place = [CubicHermiteSpline(t, x, dx)(grid) for x, dx in zip((lat, np.unwrap(lon), h), rates, strict=True)]
    velocity = np.column_stack([np.interp(grid, t, v_n[:, i]) for i in range(3)])
    k = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 2)
    share = ((grid - t[k]) / (t[k + 1] - t[k]))[:, None]
    turn = to_rotvec(multiply(conjugate(q_nb[k]), q_nb[k + 1]))
    return (*place, velocity, multiply(q_nb[k], from_rotvec(share * turn)))
