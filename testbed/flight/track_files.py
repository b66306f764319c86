"""Files that say how a vehicle moved, read as a `Track`: times, places, and attitudes where there are some.

- CSV (commas or semicolons) and Parquet: ``time_s``; ``lat_deg, lon_deg, alt_m`` above the ellipsoid, or ``north_m, east_m,
  down_m`` (or ``up_m``) about an origin; as an option ``roll_deg, pitch_deg, yaw_deg`` or ``q_nb_0 .. q_nb_3``. Units as in
  `testbed.data.column_units`; bare names (``time, lat, lon, alt, yaw``) are taken as seconds, degrees and metres, and told.
- ``.mat``: NaveGo's struct ref. ``.gpx``: ``trkpt`` with ``time``. ``.kml``: ``gx:Track``.

Times are counted from the first row. Every refusal names the row, counted from 1 below the header.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError, nearest, shown
from testbed.data import column_units
from testbed.flight.own import TrajectoryConfig
from testbed.physics.rotations import eulers_to_quats

Array = NDArray[np.float64]
GEODETIC, LOCAL = ("lat", "lon", "alt"), ("north", "east", "down")
EULER, QUATERNION = ("roll", "pitch", "yaw"), tuple(f"q_nb_{i}" for i in range(4))
KINDS = (
    {"time": "time", "lat": "angle", "lon": "angle"}
    | dict.fromkeys(("alt", "up", *LOCAL), "length")
    | dict.fromkeys(EULER, "angle")
    | dict.fromkeys(QUATERNION, "number")
)
"""Stem of a column -> quantity."""
BARE = {
    "time": "time_s", "t": "time_s", "timestamp": "time_s", "seconds": "time_s",
    "lat": "lat_deg", "latitude": "lat_deg",
    "lon": "lon_deg", "lng": "lon_deg", "long": "lon_deg", "longitude": "lon_deg",
    "alt": "alt_m", "altitude": "alt_m", "height": "alt_m", "h": "alt_m", "ele": "alt_m", "elevation": "alt_m",
    "north": "north_m", "east": "east_m", "down": "down_m", "up": "up_m",
    "roll": "roll_deg", "pitch": "pitch_deg", "yaw": "yaw_deg", "heading": "yaw_deg",
}  # fmt: skip
"""Names without a unit, and what they are taken for."""
UNIT_QUATERNION = 1e-2
"""How far a quaternion's length may be from 1: rounded to two decimals it still is one."""


@dataclass(frozen=True)
class Track:
    """``t`` (N,) from 0, ``place`` (N,3) latitude, longitude (rad), height (m), or metres north, east, down where ``local``;
    ``q_nb`` (N,4) or None; ``source`` and ``first_line`` for messages; ``notes`` of what was taken for what."""

    t: Array
    place: Array
    q_nb: Array | None
    local: bool
    source: str
    first_line: int | None = None
    notes: tuple[str, ...] = ()
    recorded: bool = False
    """A recording's reference, for which ``[flight]`` has no keys."""

    def key(self, name: str) -> str:
        """The hint at a key that would allow what is refused."""
        return "" if self.recorded else f" (the key {name})"

    def row(self, k: int) -> str:
        """Name of row ``k`` in a message."""
        line = f", line {k + self.first_line} of the file" if self.first_line is not None else ""
        return f"row {k + 1} (t = {self.t[k]:.6g} s{line})"


def read_track(config: TrajectoryConfig) -> Track:
    """The track of a file. Raises InputError with file and row for what cannot be read."""
    path = Path(config.trajectory)
    readers = {".csv": _table, ".txt": _table, ".parquet": _table, ".mat": _navego, ".gpx": _gpx, ".kml": _kml}
    if not path.is_file():
        raise InputError(f"{path}: no such file (the key 'trajectory' names it)")
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: no format has this ending; a trajectory is one of {', '.join(readers)}")
    track = readers[path.suffix.lower()](path, config)
    for key, used in (("columns", readers[path.suffix.lower()] is _table), ("row_rate_hz", _may_lack_times(path))):
        if getattr(config, key) and not used:
            raise InputError(f"{path}: the key '{key}' is for tables, not for {path.suffix} files")
    return checked(track)


def _may_lack_times(path: Path) -> bool:
    return path.suffix.lower() in (".csv", ".txt", ".parquet")


def checked(track: Track) -> Track:
    """Finite numbers, increasing times, latitudes on the Earth, unit quaternions."""
    columns = [track.t[:, None], track.place] + ([track.q_nb] if track.q_nb is not None else [])
    finite = np.isfinite(np.hstack(columns)).all(axis=1)
    if not finite.all():
        k = int(np.argmin(finite))
        raise InputError(f"{track.source}: {track.row(k)} has a cell that is empty or no finite number")
    if len(track.t) < 4:
        raise InputError(f"{track.source}: {len(track.t)} rows; a trajectory needs at least 4")
    if not (rising := np.diff(track.t) > 0.0).all():
        k = int(np.argmin(rising)) + 1
        raise InputError(f"{track.source}: {track.row(k)} is not later than the row before it ({track.t[k - 1]:.6g} s)")
    if not track.local:
        lat, lon = np.abs(track.place[:, 0]), np.abs(track.place[:, 1])
        if (beyond := (lat > 0.5 * np.pi + 1e-12) | (lon > 2.0 * np.pi + 1e-12)).any():
            k = int(np.argmax(beyond))
            where = np.degrees(track.place[k, :2])
            raise InputError(
                f"{track.source}: {track.row(k)}: latitude {where[0]:.6g}° and longitude {where[1]:.6g}° are no place on the "
                "Earth (degrees for radians?)"
            )
    if track.q_nb is None:
        return track
    length = np.linalg.norm(track.q_nb, axis=1)
    if (wrong := np.abs(length - 1.0) > UNIT_QUATERNION).any():
        k = int(np.argmax(wrong))
        raise InputError(f"{track.source}: {track.row(k)}: its quaternion has length {length[k]:.4g}, not 1")
    q = track.q_nb / length[:, None]
    turned = np.cumprod(np.where(np.einsum("ki,ki->k", q[1:], q[:-1]) < 0.0, -1.0, 1.0))
    q[1:] *= turned[:, None]
    return replace(track, q_nb=q)


def _table(path: Path, config: TrajectoryConfig) -> Track:
    frame, first_line = _frame(path)
    columns, notes = _columns(path, frame, config)
    if "time" in columns:
        if config.row_rate_hz is not None:
            raise InputError(f"{path}: the file has times; remove row_rate_hz")
        t = columns["time"]
    elif config.row_rate_hz is not None:
        t = np.arange(len(frame)) / config.row_rate_hz
    else:
        raise InputError(f"{path}: no column for time_s; say row_rate_hz = 1.0 for a file of one row per second")
    if "up" in columns and "down" not in columns:
        columns["down"] = -columns.pop("up")
    local = all(name in columns for name in LOCAL)
    names = LOCAL if local else GEODETIC
    if not local and "alt" not in columns and config.alt_m is not None:
        columns["alt"] = np.full(len(frame), config.alt_m)
    if missing := [name for name in names if name not in columns]:
        unit = {"lat": "lat_deg", "lon": "lon_deg", "alt": "alt_m (or the key alt_m of the scenario)"}
        raise InputError(
            f"{path}: no column for {', '.join(unit[name] for name in missing)}; it has {', '.join(map(str, frame))}; "
            'name them so, or with columns = { "NAME" = "lat_deg" }'
        )
    return Track(
        t - t[0] if len(t) else t,
        np.column_stack([columns[name] for name in names]),
        _attitude(path, columns),
        local,
        str(path),
        first_line,
        notes,
    )


def _attitude(path: Path, columns: dict[str, Array]) -> Array | None:
    if all(name in columns for name in QUATERNION):
        return np.column_stack([columns[name] for name in QUATERNION])
    given = [name for name in (*EULER, *QUATERNION) if name in columns]
    if not given:
        return None
    if missing := [f"{name}_deg" for name in EULER if name not in columns]:
        raise InputError(
            f"{path}: an attitude of {', '.join(given)} alone; it lacks {', '.join(missing)} (a constant column will do), "
            "or leave attitude out"
        )
    return eulers_to_quats(np.column_stack([columns[name] for name in EULER]))


def _columns(path: Path, frame: Any, config: TrajectoryConfig) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Columns in the bench's units by stem; and what is worth telling."""
    if unknown := [name for name in config.columns if name not in list(frame)]:
        raise InputError(f"{path}: 'columns' names '{unknown[0]}'; {nearest(unknown[0], map(str, frame))}")
    out: dict[str, Array] = {}
    assumed, idle = [], []
    for name in frame:
        target = config.columns.get(name)
        if target is None and str(name).lower() in BARE:
            target = BARE[str(name).lower()]
            assumed.append(f"{name} as {target}")
        target = target or str(name)
        sign, target = (-1.0, target[1:]) if target.startswith("-") else (1.0, target)
        stem = target if target in QUATERNION else target.rpartition("_")[0]
        if stem not in KINDS:
            if name in config.columns:
                known = [*BARE.values(), *QUATERNION]
                raise InputError(
                    f'{path}: columns: "{name}" = "{target}" is no documented column; {nearest(target, known)}'
                )
            idle.append(str(name))
            continue
        if stem in out:
            raise InputError(
                f"{path}: column '{name}' is a second one for {stem}; keep one, or say which under 'columns'"
            )
        try:
            _, factor = column_units.split(target, KINDS[stem])
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        values = _numbers(path, str(name), frame[name], stem)
        out[stem] = values if sign * factor == 1.0 else sign * factor * values
    notes = [f"{path.name}: takes {', '.join(assumed)}"] if assumed else []
    notes += [f"{path.name}: does not use {', '.join(idle)}"] if idle else []
    return out, tuple(notes)


def _frame(path: Path) -> tuple[Any, int | None]:
    """The table, and the line of a text file in which its first row stands."""
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    try:
        if path.suffix.lower() == ".parquet":
            table, first = pa.parquet.read_table(path), None
        else:
            with path.open(encoding="utf-8", errors="replace") as text:
                head = text.readline()
            delimiter = ";" if head.count(";") > head.count(",") else ","
            table, first = pa.csv.read_csv(path, parse_options=pa.csv.ParseOptions(delimiter=delimiter)), 2
        names = [name.strip() for name in table.column_names]
        return table.rename_columns(names).to_pandas(), first
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable table ({str(error).splitlines()[0]})") from None


def _numbers(path: Path, name: str, column: Any, stem: str) -> Array:
    """A column as floats; dates count in seconds. Raises InputError with the row of what is no number."""
    import pandas as pd

    if pd.api.types.is_datetime64_any_dtype(column):
        if stem != "time":
            raise InputError(f"{path}: column '{name}' holds dates, expected numbers")
        return (column - column.iloc[0]).dt.total_seconds().to_numpy(dtype=float)
    numbers = pd.to_numeric(column, errors="coerce")
    if (bad := (numbers.isna() & column.notna()).to_numpy()).any():
        k = int(np.argmax(bad))
        raise InputError(f"{path}: row {k + 1}, column '{name}': {shown(column.iloc[k])} is no number")
    values = numbers.to_numpy()
    # whole ticks of an epoch are counted from the first row before they are rounded to floats
    return np.asarray(values - values[0] if stem == "time" and len(values) else values, dtype=np.float64)


def _navego(path: Path, config: TrajectoryConfig) -> Track:
    from testbed.formats.navego import Struct

    ref = Struct(path, "ref")
    t = ref.time()
    place = np.column_stack([ref.series(name) for name in ("lat", "lon", "h")])
    euler = [ref.series(name) for name in EULER] if all(ref.has(name) for name in EULER) else None
    q_nb = eulers_to_quats(np.column_stack(euler)) if euler else None
    return Track(t - t[0], place, q_nb, False, str(path))


def _gpx(path: Path, config: TrajectoryConfig) -> Track:
    """``trkpt lat lon`` with ``ele`` and ``time`` of GPX 1.0 and 1.1."""
    from testbed.flight.models import parse

    points = [e for e in parse(path).iter() if _tag(e) == "trkpt"]
    rows, stamps = [], []
    for k, point in enumerate(points, 1):
        inside = {_tag(e): (e.text or "").strip() for e in point}
        if not inside.get("time"):
            raise InputError(f"{path}: row {k}: the track point has no <time>")
        height = inside.get("ele") or config.alt_m
        if height is None:
            raise InputError(f"{path}: row {k}: the track point has no <ele>; say alt_m in the scenario")
        rows.append((point.get("lat"), point.get("lon"), height))
        stamps.append(inside["time"])
    return _geodetic(path, stamps, rows)


def _kml(path: Path, config: TrajectoryConfig) -> Track:
    """``gx:Track``: ``when`` and ``gx:coord`` (longitude, latitude, height)."""
    from testbed.flight.models import parse

    root = parse(path)
    stamps = [
        (e.text or "").strip() for track in root.iter() if _tag(track) == "Track" for e in track if _tag(e) == "when"
    ]
    coords = [
        (e.text or "").split() for track in root.iter() if _tag(track) == "Track" for e in track if _tag(e) == "coord"
    ]
    if not stamps or len(stamps) != len(coords):
        raise InputError(
            f"{path}: {len(stamps)} times (<when>) and {len(coords)} places (<gx:coord>) in a <gx:Track>; a line without "
            "times says nothing of the motion"
        )
    for k, coord in enumerate(coords, 1):
        if len(coord) < 2 or (len(coord) == 2 and config.alt_m is None):
            raise InputError(f"{path}: row {k}: a <gx:coord> holds longitude, latitude and height")
    return _geodetic(path, stamps, [(c[1], c[0], c[2] if len(c) > 2 else config.alt_m) for c in coords])


def _geodetic(path: Path, stamps: Sequence[str], rows: Sequence[tuple[Any, Any, Any]]) -> Track:
    """A track of dates and of degrees and metres, all as text."""
    if not rows:
        raise InputError(f"{path}: has no track points")
    t = np.empty(len(rows))
    place = np.empty((len(rows), 3))
    first: datetime | None = None
    for k, (stamp, row) in enumerate(zip(stamps, rows, strict=True)):
        try:
            when = datetime.fromisoformat(stamp)
            when = when if when.tzinfo else when.replace(tzinfo=UTC)
            place[k] = [float(value) for value in row]
        except (ValueError, TypeError):
            raise InputError(f"{path}: row {k + 1}: {shown(stamp)}, {shown(str(row))}: no date and place") from None
        first = first or when
        t[k] = (when - first).total_seconds()
    place[:, :2] = np.radians(place[:, :2])
    height = "heights of GPX and KML are above mean sea level and are taken as above the ellipsoid, up to 100 m away"
    return Track(t, place, None, False, str(path), None, (f"{path.name}: {height}",))


def _tag(element: Any) -> str:
    """Name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2].rpartition(":")[2]
