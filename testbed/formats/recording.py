"""A recording: what an importer returns, and the checks and resampling that all importers share.

Times are seconds on the recording's own clock; a reference is brought to the rows that the bench scores on: the initial
time, then every IMU time. SI units and radians, n north-east-down, b forward-right-down.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.records import Array, SensorLog, Trajectory
from testbed.formats.kinematics import conjugate, from_rotvec, implied_imu, multiply, to_rotvec


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


def existing(path: Path, what: str) -> Path:
    """``path`` when it is a file; else InputError with the files beside it."""
    if path.is_file():
        return path
    beside = sorted(p.name for p in path.parent.glob("*") if p.is_file()) if path.parent.is_dir() else []
    found = f"; the folder holds {', '.join(beside[:12])}" if beside else ""
    raise InputError(f"{path}: no such file (wanted for the {what}){found}")


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
            f"{name}: the reference ({t[0]:.6g} to {t[-1]:.6g} s) does not overlap the IMU ({grid[0]:.6g} to {grid[-1]:.6g} s)"
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
