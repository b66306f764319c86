"""KF-GINS text files (i2Nav, Wuhan University): IMU increments, position fixes and a reference, times in seconds of week.

Columns, separated by blanks, without a header (README of github.com/i2Nav-WHU/KF-GINS):

- imu: time s, increments of angle x y z (rad) and of velocity x y z (m/s) over the interval before it, b forward-right-down
- gnss: time s, latitude, longitude (deg), height m, sigma north east down (m); seven columns, no velocities
- reference: GPS week, time s, latitude, longitude (deg), height m, velocity north east down (m/s), roll pitch yaw (deg)

A week's end within the files is followed: seconds that fall by half a week or more go on in the next one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, GnssFixes, ImuSamples
from testbed.data.specs import GnssSpec, ImuSpec
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import check_finite, check_place, check_time, existing
from testbed.physics.rotations import eulers_to_quats

WEEK = 604800.0
COLUMNS = {"imu": 7, "gnss": 7, "reference": 11}
LONGEST_STEP = 5.0
"""Usual intervals; an increment after a longer silence belongs to one of them, not to all of it."""


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The files that ``config`` names (parts imu, gnss, reference); imu and gnss are required."""
    root = folder / config.dir
    if missing := [part for part in ("imu", "gnss") if part not in config.files]:
        raise InputError(
            f"{root}: name the {' and '.join(missing)} file under files (kfgins files have no fixed names)"
        )
    paths = {part: existing(root / name, part) for part, name in config.files.items()}
    raw = Raw(name=paths["imu"].stem, places={part: str(path) for part, path in paths.items()})
    imu = numbers(paths["imu"], COLUMNS["imu"])
    start = float(np.floor(imu[0, 0]))
    t = _seconds(imu[:, 0], start, paths["imu"])
    if len(t) < 4:
        raise InputError(f"{paths['imu']}: has {len(t)} rows, at least 4 are needed")
    steps = np.diff(t)
    usual = float(np.median(steps))
    spans = np.where(steps > LONGEST_STEP * usual, usual, steps)[:, None]
    raw.t_start = float(t[0])
    raw.imu = ImuSamples(
        t[1:], imu[1:, 1:4] / spans, imu[1:, 4:7] / spans, ImuSpec("unknown", float(np.round(1 / usual, 3)))
    )
    raw.gnss, raw.gnss_position_only = _fixes(paths["gnss"], start), True
    raw.stated = {"gnss"}
    if "reference" in paths:
        r = numbers(paths["reference"], COLUMNS["reference"])
        lat, lon = np.radians(r[:, 2]), np.radians(r[:, 3])
        check_place(lat, lon, str(paths["reference"]))
        at = _seconds(r[:, 1], start, paths["reference"])
        raw.motion = (at, lat, lon, r[:, 4], r[:, 5:8], eulers_to_quats(np.radians(r[:, 8:11])))
    return raw


def _fixes(path: Path, start: float) -> GnssFixes:
    g = numbers(path, COLUMNS["gnss"])
    t = _seconds(g[:, 0], start, path)
    lat, lon = np.radians(g[:, 1]), np.radians(g[:, 2])
    check_place(lat, lon, str(path))
    std = np.hstack([g[:, 4:7], np.full((len(t), 3), np.inf)])
    typical = np.median(g[:, 4:7], axis=0)
    rate = float(np.round(1.0 / np.median(np.diff(t)), 3)) if len(t) > 1 else 1.0
    spec = GnssSpec("kfgins gnss", rate, float(typical[:2].max()), float(typical[2]))
    return GnssFixes(t, lat, lon, g[:, 3], np.zeros((len(t), 3)), spec, (), std)


def numbers(path: Path, width: int) -> Array:
    """(N,width) of a text file of numbers. Raises InputError that names the row which is not one."""
    import pandas as pd

    try:
        frame = pd.read_csv(path, sep=r"\s+", header=None, comment="%")
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a table of numbers ({str(error).splitlines()[0]})") from None
    if frame.shape[1] != width:
        raise InputError(f"{path}: has {frame.shape[1]} columns, expected {width}")
    for k in range(width):
        if not pd.api.types.is_numeric_dtype(frame[k]):
            bad = pd.to_numeric(frame[k], errors="coerce").isna()
            row = int(np.argmax(bad.to_numpy()))
            raise InputError(
                f"{path}: column {k + 1} of row {row} is '{str(frame[k].iloc[row])[:40]}', expected a number"
            )
    return check_finite(frame.to_numpy(dtype=np.float64), str(path))


def _seconds(t: Array, start: float, path: Path) -> Array:
    """Seconds from ``start`` on, over the end of a week."""
    weeks = np.concatenate([[0.0], np.cumsum(np.diff(t) < -0.5 * WEEK)])
    t = t + WEEK * weeks - start
    return check_time(t + WEEK if t[0] < -0.5 * WEEK else t, f"{path}: time")
