"""RTKLIB solutions (.pos) as the fixes of a recording, beside the IMU as a table (`testbed.formats.table`).

Format: RTKLIB manual 2.4.2, appendix B.1. Header lines begin with %; the last one names the columns. Geodetic degrees or
ECEF metres; time as calendar or as GPS week and seconds, GPST or UTC. Q is 1 fixed, 2 float, 3 SBAS, 4 DGPS, 5 single,
6 PPP. Standard deviations are those of north, east, up (or x, y, z) in metres; velocities (vn, ve, vu) with theirs where
RTKLIB was told to write them.

Times become UTC: GPST minus the leap seconds, as other loggers' clocks run. An IMU that is stamped in GPST needs
``[recording.imu] clock_s = -18``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, GnssFixes
from testbed.data.specs import GnssSpec
from testbed.formats import beside
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import check_finite, check_place, check_time, rate_of

LEAP_SECONDS = 18.0
"""GPST minus UTC since 2017-01-01 (IERS Bulletin C 52); none was announced since."""
GPS_EPOCH = 315964800.0
"""Unix time of 1980-01-06."""
QUALITIES = (1, 2, 3, 4, 5, 6)
LLH, XYZ = ("latitude(deg)", "longitude(deg)", "height(m)"), ("x-ecef(m)", "y-ecef(m)", "z-ecef(m)")


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The tables of a folder with the fixes of a .pos file (part ``pos``; default: the only one there)."""

    def fixes_of(path: Path, base: float) -> beside.ReceiverFile:
        fixes, position_only, notes = read_pos(path, base)
        return beside.ReceiverFile(fixes, position_only, notes=notes)

    return beside.read(config, folder, "pos", (".pos",), fixes_of)


def read_pos(path: Path, base: float = 0.0) -> tuple[GnssFixes, bool, list[str]]:
    """Fixes of a .pos file, times from ``base`` (Unix, s) on; whether it has no velocities; and what is to be told."""
    names, rows = _table(path)
    column = {name: k for k, name in enumerate(names)}
    t, notes = _times(path, names, rows, base)
    values = _numbers(path, names, rows)

    def pick(*wanted: str) -> Array:
        if missing := [name for name in wanted if name not in column]:
            raise InputError(f"{path}: has no column {', '.join(missing)}; it has {' '.join(names)}")
        return check_finite(values[:, [column[name] for name in wanted]], str(path))

    quality = pick("Q")[:, 0]
    good = np.isin(quality, QUALITIES)
    if not good.any():
        raise InputError(f"{path}: has no row with a solution (Q from 1 to 6)")
    if not good.all():
        notes.append(f"{path}: {int((~good).sum())} rows without a solution (Q) are left out")
    if LLH[0] in column:
        lat, lon, h = pick(*LLH).T
        lat, lon = np.radians(lat), np.radians(lon)
        std = pick("sdn(m)", "sde(m)", "sdu(m)")
    elif XYZ[0] in column:
        lat, lon, h = _geodetic(pick(*XYZ))
        std = _turned_std(lat, lon, pick("sdx(m)", "sdy(m)", "sdz(m)"))
    else:
        raise InputError(
            f"{path}: the columns are {' '.join(names[:6])}; write latitude, longitude in decimal degrees (out-solformat llh,"
            " out-degform deg) or xyz"
        )
    check_place(lat, lon, str(path))
    n = len(t)
    position_only = "vn(m/s)" not in column
    v_n, v_std = np.zeros((n, 3)), np.full((n, 3), np.inf)
    if not position_only:
        v_n = pick("vn(m/s)", "ve(m/s)", "vu(m/s)") * [1.0, 1.0, -1.0]
        v_std = pick("sdvn", "sdve", "sdvu")
    shares = ", ".join(f"{int((quality == q).sum())} with Q {q:.0f}" for q in np.unique(quality[good]))
    notes.append(f"{path}: {shares}")
    typical = np.median(std[good], axis=0)
    spec = GnssSpec("RTKLIB", rate_of(t), float(typical[:2].max()), float(typical[2]))
    if not position_only:
        spec = replace(spec, velocity_sigma=float(np.median(v_std[good])))
    fixes = GnssFixes(t[good], lat[good], lon[good], h[good], v_n[good], spec, (), np.hstack([std, v_std])[good])
    return fixes, position_only, notes


def _table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Column names after the time's two, and the rows as words."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a readable .pos file ({error})") from None
    heads = [
        line for line in lines if line.startswith("%") and ("GPST" in line or "UTC" in line) and "Q" in line.split()
    ]
    if not heads:
        raise InputError(
            f"{path}: no header line that names the columns (% GPST latitude(deg) ...); is this RTKLIB's .pos?"
        )
    words = heads[-1].lstrip("%").split()
    rows = [line.split() for line in lines if line.strip() and not line.startswith("%")]
    if not rows:
        raise InputError(f"{path}: has no rows below its header")
    wide = len(words) + 1
    for k, row in enumerate(rows):
        if len(row) != wide:
            raise InputError(
                f"{path}: row {k} has {len(row)} columns, the header names {wide} (the time's two among them)"
            )
    return words, rows


def _numbers(path: Path, names: list[str], rows: list[list[str]]) -> Array:
    """(N,len(names)): the first column, the time, is left at zero."""
    try:
        return np.hstack([np.zeros((len(rows), 1)), np.array([row[2:] for row in rows], dtype=np.float64)])
    except ValueError:
        for k, row in enumerate(rows):
            for name, word in zip(names[1:], row[2:], strict=True):
                if not _is_number(word):
                    raise InputError(f"{path}: {name} is '{word[:40]}' at row {k}, expected a number") from None
        raise


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _times(path: Path, names: list[str], rows: list[list[str]], base: float) -> tuple[Array, list[str]]:
    try:
        if "/" in rows[0][0]:
            days = np.array([row[0].replace("/", "-") for row in rows], dtype="datetime64[D]")
            clock = np.array([[float(x) for x in row[1].split(":")] for row in rows])
            seconds = clock @ np.array([3600.0, 60.0, 1.0])
            whole = days.astype("datetime64[s]").astype(np.int64)
        else:
            whole = np.array([int(row[0]) for row in rows]) * 604800 + int(GPS_EPOCH)
            seconds = np.array([float(row[1]) for row in rows])
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: a time is neither 2025/07/08 19:34:18.499 nor week and seconds ({error})") from None
    notes = []
    offset = 0.0
    if names[0] == "GPST":
        offset = LEAP_SECONDS
        notes.append(f"{path}: GPST is read as UTC + {LEAP_SECONDS:.0f} s")
    t = (whole - int(base)).astype(np.float64) + (seconds - offset - (base - int(base)))
    return check_time(t, f"{path}: time"), notes


def _geodetic(xyz: Array) -> tuple[Any, Any, Any]:
    import pymap3d

    lat, lon, h = pymap3d.ecef2geodetic(*xyz.T, deg=False)
    return np.asarray(lat), np.asarray(lon), np.asarray(h)


def _turned_std(lat: Array, lon: Array, std: Array) -> Array:
    """Sigmas north, east, down of uncorrelated errors along x, y, z."""
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    rows = [
        [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
        [-sin_lon, cos_lon, 0.0 * lat],
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
    ]
    return np.column_stack([np.sqrt(sum((c * std[:, i]) ** 2 for i, c in enumerate(row))) for row in rows])
