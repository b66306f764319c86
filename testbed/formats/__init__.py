"""Recorded data in, flights and logs out: one registry of formats, one function for each direction.

In: ``navego`` (.mat structs), ``table`` (CSV or Parquet with units in the column names), ``ulog`` (PX4 flight logs),
``ardupilot`` (DataFlash), ``rosbag`` and ``mcap`` (ROS 1 and 2), ``broad``, ``euroc`` and ``kitti`` (as these data sets lie),
``kfgins`` (increments), and the fixes of a receiver's file beside an IMU table: ``rtklib`` (.pos), ``nmea``, ``ubx``, ``rinex``.
Out: ``parquet``, ``csv``, ``navego``, ``kml``. Each format is documented in its module; errors are `InputError`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from testbed.base.errors import InputError, nearest
from testbed.data.records import NavSolution, SensorLog, Trajectory
from testbed.formats.config import PARTS, RecordingConfig

__all__ = ["FORMATS", "Format", "export_log", "export_trajectory", "import_log", "load_recording"]


@dataclass(frozen=True)
class Format:
    """One file format. ``parts`` are the names that ``files`` may use on import; None where it is export only."""

    text: str
    parts: tuple[str, ...] | None = None
    suffix: str = ""


FORMATS: dict[str, Format] = {
    "navego": Format("NaveGo-style MATLAB structs imu, gnss, ref", PARTS["navego"], ".mat"),
    "table": Format("CSV or Parquet tables with units in the column names", PARTS["table"], ".csv"),
    "ulog": Format("PX4 flight log", PARTS["ulog"], ".ulg"),
    "broad": Format("trial of the BROAD data set of attitude references", PARTS["broad"], ".mat"),
    "kfgins": Format("KF-GINS text files: increments, positions, reference", PARTS["kfgins"], ".txt"),
    "rtklib": Format("RTKLIB solution (.pos) beside an IMU table", PARTS["rtklib"], ".pos"),
    "ardupilot": Format("ArduPilot flight log (DataFlash)", PARTS["ardupilot"], ".bin"),
    "rosbag": Format("bag of ROS 1, folder or file of ROS 2", PARTS["rosbag"], ".bag"),
    "mcap": Format("MCAP file of ROS 2", PARTS["mcap"], ".mcap"),
    "nmea": Format("NMEA 0183 sentences beside an IMU table", PARTS["nmea"], ".nmea"),
    "ubx": Format("UBX messages of u-blox receivers beside an IMU table", PARTS["ubx"], ".ubx"),
    "euroc": Format("sequence in EuRoC's layout (imu0, ground truth)", PARTS["euroc"]),
    "kitti": Format("drive of the KITTI raw data (oxts)", PARTS["kitti"]),
    "rinex": Format("RINEX 3 observations and navigation beside an IMU table", PARTS["rinex"], ".rnx"),
    "csv": Format("CSV with units in the column names", None, ".csv"),
    "parquet": Format("Parquet with units in the column names", None, ".parquet"),
    "kml": Format("KML track for Google Earth, coloured by error", None, ".kml"),
}


def import_log(format: str, files: Path | str | Sequence[Path | str], /, **options: Any) -> Any:
    """Read recorded data into a `Recording` (``log`` and, where there is one, ``reference``).

    ``files``: a folder, or the files of one folder, of which each belongs to the part that its name begins with
    (``imu1.mat``, ``gnss.csv``). ``options``: keys of ``[recording]``. ``csv`` and ``parquet`` mean ``table``.
    """
    from testbed.base.schema import validate

    kind = "table" if format in ("csv", "parquet") else format
    importers = [name for name, entry in FORMATS.items() if entry.parts]
    if kind not in importers:
        raise InputError(f"format '{format}' cannot be imported; {nearest(format, importers)}")
    paths = [Path(files)] if isinstance(files, str | Path) else [Path(f) for f in files]
    if not paths:
        raise InputError(f"import {format}: no files given")
    data: dict[str, Any] = {"format": kind} | options
    if len(paths) == 1 and paths[0].is_dir():
        data["dir"] = str(paths[0])
    else:
        data |= {"dir": str(paths[0].parent), "files": _parts_of(kind, paths)}
    return load_recording(validate(RecordingConfig, data, f"import {format}"), Path())


def load_recording(config: RecordingConfig, folder: str | Path = ".") -> Any:
    """The `Recording` that a ``[recording]`` table describes; ``dir`` is relative to ``folder``, the scenario's.

    The latest few are kept in memory, as flying and sensing both ask for them.
    """
    root = Path(folder) / config.dir
    named = [root / f for f in config.files.values()] or [root]
    watched = [p for place in named for p in (_within(place, config.format) if place.is_dir() else [place])]
    state = tuple((str(p), p.stat().st_mtime_ns, p.stat().st_size) for p in watched if p.is_file())
    return _load(config.model_dump_json(exclude_unset=True), str(folder), state)


def _within(folder: Path, format: str) -> list[Path]:
    """Files of a folder that a recording may be made of; data sets keep theirs in folders of their own, beside images."""
    inner = {"kitti": ("data/*.txt", "*.txt", "oxts/*.txt", "oxts/data/*.txt"), "euroc": ("*/*.csv", "*/*/*.csv")}
    return sorted(path for pattern in ("*", *inner.get(format, ())) for path in folder.glob(pattern))


@functools.lru_cache(maxsize=2)
def _load(config_json: str, folder: str, state: tuple[tuple[str, int, int], ...]) -> Any:
    from testbed.formats import importers

    return importers.load(RecordingConfig.model_validate_json(config_json, strict=False), Path(folder))


def _parts_of(kind: str, paths: Sequence[Path]) -> dict[str, str]:
    parts, out = PARTS[kind], {}
    if len({p.parent for p in paths}) > 1:
        raise InputError(f"import {kind}: the files lie in several folders; put them into one")
    for path in paths:
        if not path.is_file():
            raise InputError(f"{path}: no such file or folder")
        part = parts[0] if len(parts) == 1 else _part_of(path, parts)
        if part is None or part in out:
            raise InputError(
                f"{path}: cannot tell which part this is; name the files {', '.join(p + '*' for p in parts)}"
            )
        out[part] = path.name
    return out


def _part_of(path: Path, parts: Sequence[str]) -> str | None:
    """By the beginning of a file's name, or by its ending."""
    if path.suffix.lower().lstrip(".") in parts:
        return path.suffix.lower().lstrip(".")
    return next((part for part in parts if path.name.lower().startswith(part)), None)


def export_trajectory(
    trajectory: Trajectory,
    path: str | Path,
    format: str = "",
    solution: NavSolution | None = None,
    outages: Sequence[tuple[float, float]] = (),
) -> None:
    """Write a flight as ``parquet``, ``csv``, ``navego`` or ``kml`` (default: by the file's ending).

    ``solution`` and ``outages`` are for KML: the estimated track coloured by its error, and the outages marked.
    """
    path = Path(path)
    writers: dict[str, Callable[[], None]] = {
        "parquet": lambda: trajectory.save(path),
        "csv": lambda: _table().write_frame(trajectory.to_frame(), path),
        "navego": lambda: _navego().save_trajectory(trajectory, path),
        "kml": lambda: _kml().save_track(path, trajectory, solution, outages),
    }
    _write(format or _by_suffix(path, writers), writers)


def export_log(log: SensorLog, path: str | Path, format: str = "csv", reference: Trajectory | None = None) -> None:
    """Write a log (and ``reference`` beside it) as a folder of ``csv``, ``parquet`` or ``navego`` files."""
    writers: dict[str, Callable[[], None]] = {
        "parquet": lambda: _table().save_log(log, path, "parquet", reference),
        "csv": lambda: _table().save_log(log, path, "csv", reference),
        "navego": lambda: _navego().save_log(log, path, reference),
    }
    _write(format, writers)


def _write(format: str, writers: Mapping[str, Callable[[], None]]) -> None:
    if format not in writers:
        raise InputError(f"format '{format}' cannot be exported here; {nearest(format, writers)}")
    writers[format]()


def _by_suffix(path: Path, writers: Mapping[str, Any]) -> str:
    for name in writers:
        if FORMATS[name].suffix == path.suffix:
            return name
    raise InputError(f"{path}: cannot tell the format from the ending; give one of {', '.join(writers)}")


def _table() -> Any:
    from testbed.formats import table

    return table


def _navego() -> Any:
    from testbed.formats import navego_export

    return navego_export


def _kml() -> Any:
    from testbed.formats import kml

    return kml


def __getattr__(name: str) -> Any:
    if name == "Recording":
        from testbed.formats.recording import Recording

        return Recording
    raise AttributeError(f"module 'testbed.formats' has no attribute '{name}'")
