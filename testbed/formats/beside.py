"""Fixes of a receiver's own file (.pos, NMEA, UBX) beside the IMU, magnetometer, barometer and reference as tables.

The receiver's times are UTC. An IMU of another clock needs ``[recording.imu] clock_s``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from testbed.data.records import GnssFixes
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import only_file
from testbed.formats.table import Tables, read_mapping
from testbed.formats.table_samples import samples_of

TABLES = ("imu", "mag", "baro", "reference")


@dataclass
class ReceiverFile:
    """What a receiver's file holds: fixes, which velocities they lack, whether they state sigmas, and what is to be told."""

    fixes: GnssFixes
    position_only: bool = False
    level_velocity: bool = False
    notes: list[str] = field(default_factory=list)


def read(
    config: RecordingConfig,
    folder: Path,
    part: str,
    suffixes: tuple[str, ...],
    read_fixes: Callable[[Path, float], ReceiverFile],
) -> Raw:
    """The tables of a folder with the fixes of the file of ``part`` (default: the only one that ends so).

    ``read_fixes`` takes the file and the Unix time, s, that the tables' times count from.
    """
    root = folder / config.dir
    columns = read_mapping(folder / config.mapping) if config.mapping else {}
    files = {name: file for name, file in config.files.items() if name != part}
    tables = Tables(root, files, columns | config.columns, TABLES)
    raw = samples_of(tables, config.sampling)
    path = only_file(root, config.files, part, suffixes)
    raw.places["gnss"] = str(path)
    found = read_fixes(path, float(tables.base))
    raw.gnss, raw.gnss_position_only, raw.gnss_level_velocity = (
        found.fixes,
        found.position_only,
        found.level_velocity,
    )
    if found.fixes.std is not None:
        raw.stated.add("gnss")
    raw.notes += found.notes
    return raw
