"""The recorded drive of rtklibexplorer/GNSS_IMU (BSD-3) as the bench reads it: logger and RTKLIB solution on one clock.

The logger counts milliseconds; its time tags (RTKLIB's: a header of 60 bytes, then pairs of milliseconds and byte offset) tie
them to GPS time.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array

LOGGER, TAGS, SOLUTION = "imu_1934.csv", "imu_1934.csv.tag", "gnss_1934_sf.pos"
COLUMNS = "time_s,accel_x_g,accel_y_g,accel_z_g,gyro_x_dps,gyro_y_dps,gyro_z_dps"
TAG_HEADER = 60
"""Bytes before the logger's tick (uint32), GPS time (uint32 s, float64 fraction) and pairs of tick and byte offset."""


def prepared(source: Path, place: Path) -> Path:
    """A folder ``place`` with ``imu.csv`` and ``gnss.pos``. Raises InputError where ``source`` lacks a file or it is another."""
    for name in (LOGGER, TAGS, SOLUTION):
        if not (source / name).is_file():
            raise InputError(
                f"{source}: has no {name}; it should hold {LOGGER}, {TAGS} and {SOLUTION} of rtklibexplorer/GNSS_IMU"
            )
    try:
        rows = imu_rows((source / LOGGER).read_bytes(), (source / TAGS).read_bytes())
    except (ValueError, IndexError, struct.error, np.linalg.LinAlgError) as error:
        raise InputError(f"{source / LOGGER}: is not the logger's file with its tags ({error})") from None
    place.mkdir(parents=True, exist_ok=True)
    np.savetxt(place / "imu.csv", rows, delimiter=",", header=COLUMNS, comments="", fmt=["%.6f"] + ["%.9g"] * 6)
    (place / "gnss.pos").write_bytes((source / SOLUTION).read_bytes())
    return place


def imu_rows(raw: bytes, tags: bytes) -> Array:
    """(N,7) GPS seconds and the six readings: a line fitted to the pairs ties the logger's milliseconds to GPS time."""
    second, fraction = struct.unpack_from("<Id", tags, TAG_HEADER + 4)
    pairs = np.frombuffer(tags[TAG_HEADER + 16 : len(tags) // 8 * 8 + 4], dtype="<u4")
    pairs = pairs[: len(pairs) // 2 * 2].reshape(-1, 2).astype(float)
    lines = raw.splitlines()
    ends = np.cumsum([len(line) + 2 for line in lines])  # the logger ended its lines with two characters
    whole = np.array([line.count(b",") == 6 for line in lines])
    values = np.array([[float(v) for v in line.split(b",")] for line, good in zip(lines, whole, strict=True) if good])
    k = np.clip(np.searchsorted(ends[whole], pairs[:, 1]), 0, len(values) - 1)
    ticks = values[:, 6] - values[k[0], 6]
    t = second + fraction + np.polyval(np.polyfit(ticks[k], pairs[:, 0], 1), ticks) / 1e3
    return np.column_stack([t, values[:, :6]])[np.concatenate([[True], np.diff(t) > 0.0])]
