"""Recorded data as tables: a folder of CSV or Parquet files, with the unit of each column at the end of its name.

Files ``imu``, ``gnss``, ``mag``, ``baro``, ``reference`` (.csv or .parquet); only ``imu`` is required. Columns, in any
order and any unit that `testbed.data.column_units` lists (further columns are ignored):

- imu: ``time_s, gyro_x_radps, gyro_y.., gyro_z.., accel_x_mps2, accel_y.., accel_z..`` in b (forward-right-down)
- gnss: ``time_s, lat_deg, lon_deg, alt_m`` of the antenna, as an option ``v_north_mps, v_east_mps, v_down_mps`` (or
  ``speed_mps, course_deg``) and the
  receiver's 1 sigma ``std_north_m, std_east_m, std_down_m, std_v_north_mps, std_v_east_mps, std_v_down_mps``
- mag: ``time_s, mag_x_ut, mag_y.., mag_z..``; baro: ``time_s, pressure_pa``
- reference: ``time_s``, place and velocity as in gnss, and ``roll_deg, pitch_deg, yaw_deg`` or ``q_nb_0 .. q_nb_3``

Separators are commas, semicolons, tabs or blanks; beside anything but commas a decimal comma is read as one. The columns of a
file without a header are called 1, 2, ... in a mapping. Files with other names are read with a mapping, ``"wx" = "gyro_x_dps"`` (a leading minus turns the sign). Times that
count from an epoch (above 10⁷ s) are counted from the first whole second of the IMU, and so are dates after ISO 8601 (UTC
where they name no zone) in a column ``time_s``. ``log.json``, which `save_log`
writes, holds the specifications and the initial state; without it they come from the scenario and from alignment.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.errors import InputError, closest, nearest, shown
from testbed.base.files import from_json
from testbed.data import column_units, specs
from testbed.data.records import Array, SensorLog, Trajectory
from testbed.formats.recording import check_finite, check_folder, check_place, check_time, existing
from testbed.formats.table_files import read_frame
from testbed.physics.rotations import eulers_to_quats
from testbed.sensors.registry import SENSORS

if TYPE_CHECKING:
    import pandas as pd

_XYZ, _NED = "xyz", ("north", "east", "down")
_PLACE = {"lat": "angle", "lon": "angle", "alt": "length"} | {f"v_{a}": "speed" for a in _NED}
EULER = dict.fromkeys(("roll", "pitch", "yaw"), "angle")
QUATERNION = {f"q_nb_{i}": "number" for i in range(4)}
_STD = {f"std_{a}": "length" for a in _NED} | {f"std_v_{a}": "speed" for a in _NED}
SOLUTION_STD = {
    f"std_{what}_{a}": quantity
    for what, quantity in (("position", "length"), ("velocity", "speed"), ("attitude", "angle"))
    for a in _NED
}
"""Of a solution's error states, as `NavSolution` names them."""
STD, VELOCITY = tuple(_STD), tuple(f"v_{a}" for a in _NED)

REQUIRED: dict[str, dict[str, str]] = {
    "imu": {"time": "time"}
    | {f"gyro_{a}": "angular rate" for a in _XYZ}
    | {f"accel_{a}": "acceleration" for a in _XYZ},
    **{
        kind: {"time": "time"} | {stem: q for column in sensor.columns for stem, q in column.stems().items()}
        for kind, sensor in SENSORS.items()
    },
    "reference": {"time": "time"} | _PLACE,
    "solution": {"time": "time", "lat": "angle", "lon": "angle", "alt": "length"},
}
"""Part -> stem of each column -> quantity."""
REQUIRED["gnss"] = {stem: quantity for stem, quantity in REQUIRED["gnss"].items() if stem not in VELOCITY}
OPTIONAL: dict[str, dict[str, str]] = {
    "gnss": _STD | dict.fromkeys((*VELOCITY, "speed"), "speed") | {"course": "angle"},
    "reference": EULER | QUATERNION,
    "solution": EULER | QUATERNION | dict.fromkeys(VELOCITY, "speed") | SOLUTION_STD,
}
STORED = "log.json"
ROUNDED_DEG = 1.0
"""Between an attitude twice written: Euler angles in whole degrees are half a degree off about each axis."""
EPOCH = 1e7


class Tables:
    """The tables of a folder, columns in the bench's units by their stems (``time``, ``gyro_x``, ``lat`` ...)."""

    def __init__(
        self,
        folder: Path,
        files: Mapping[str, str],
        columns: Mapping[str, str | dict[str, str]],
        only: Sequence[str] | None = None,
    ) -> None:
        """``only`` names the parts that are read; all that are there by default."""
        check_folder(folder)
        _check_mapping(columns, folder)
        self.folder = folder
        self.parts: dict[str, dict[str, Array]] = {}
        base: int | None = None
        found = {part: path for part, path in _find(folder, files).items() if only is None or part in only}
        if "imu" not in found and (only is None or "imu" in only):
            existing(folder / "imu.csv", "imu")
        self.places = {part: str(path) for part, path in found.items()}
        names: dict[str, list[str]] = {}
        for part, path in found.items():
            self.parts[part], base, names[part] = _read_part(path, part, _mapping_of(part, columns), base)
        self.base = base or 0
        """The whole second that times are counted from: 0, or since an epoch."""
        self.notes = _idle_mapping(columns, names, folder)
        """What was left aside, in sentences."""

    def block(self, part: str, stems: tuple[str, ...] | list[str]) -> Array:
        """(N,k) of the named columns."""
        return np.column_stack([self.parts[part][stem] for stem in stems])

    def quaternions(self, part: str = "reference") -> Array:
        """q_nb (N,4) of a part, from its quaternion or its Euler angles."""
        table = self.parts[part]
        if all(name in table for name in QUATERNION):
            q = self.block(part, list(QUATERNION))
            norm = np.linalg.norm(q, axis=1, keepdims=True)
            if (np.abs(norm - 1.0) > 1e-2).any():
                raise InputError(
                    f"{self.places[part]}: q_nb at sample {int(np.argmax(np.abs(norm - 1)))} is no unit quaternion"
                )
            q = np.where(np.abs(norm - 1.0) < 1e-12, q, q / norm)
            self._compare_angles(part, q)
            return q
        if all(name in table for name in EULER):
            return eulers_to_quats(self.block(part, list(EULER)))
        raise InputError(f"{self.places[part]}: needs roll_deg, pitch_deg, yaw_deg or q_nb_0 .. q_nb_3")

    def _compare_angles(self, part: str, q_nb: Array) -> None:
        """Note Euler angles that are not those of the quaternion beside them."""
        if not all(name in self.parts[part] for name in EULER):
            return
        other = eulers_to_quats(self.block(part, list(EULER)))
        apart = 2.0 * np.arccos(np.minimum(np.abs(np.einsum("ki,ki->k", q_nb, other)), 1.0))
        middle = float(np.degrees(np.median(apart)))
        if middle > ROUNDED_DEG:
            self.notes.append(
                f"{self.places[part]}: roll, pitch and yaw are another attitude than q_nb beside them, {middle:.4g}° apart in"
                " the middle; q_nb is used"
            )

    def stored(self) -> dict[str, Any]:
        """Content of log.json, or an empty table."""
        path = self.folder / STORED
        if not path.is_file():
            return {}
        try:
            content = from_json(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from None
        if not isinstance(content, dict):
            raise InputError(f"{path}: holds no table")
        return content


def read_mapping(path: Path) -> dict[str, str | dict[str, str]]:
    """The ``[columns]`` table of a mapping file."""
    from testbed.base.schema import read_toml

    content = read_toml(path)
    columns = content.get("columns")
    if not isinstance(columns, dict) or set(content) != {"columns"}:
        raise InputError(f'{path}: a mapping file has one table [columns] with lines such as "wx" = "gyro_x_dps"')
    return columns


def save_log(log: SensorLog, folder: str | Path, kind: str = "csv", reference: Trajectory | None = None) -> None:
    """Write the tables (``kind`` csv or parquet) and log.json; numbers with all their digits."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    frames = log.frames()
    if log.gnss is not None and log.gnss.std is not None:
        columns = [f"std_{a}_m" for a in _NED] + [f"std_v_{a}_mps" for a in _NED]
        frames["gnss"] = frames["gnss"].rename(columns={f"std_{i}": name for i, name in enumerate(columns)})
    if reference is not None:
        quaternion = {f"q_nb_{i}": reference.q_nb[:, i] for i in range(4)}
        frames["reference"] = reference.to_frame().assign(**quaternion)
    for name, frame in frames.items():
        write_frame(frame, folder / f"{name}.{kind}")
    stored: dict[str, Any] = {"name": log.name, "run": log.run}
    for part, samples in [("imu", log.imu), *log.aiding.items()]:
        if hasattr(samples, "spec"):
            stored[part] = specs.to_dict(samples.spec)
    if log.gnss is not None:
        stored["outages"] = [list(o) for o in log.gnss.outages]
    stored["initial"] = {k: v.tolist() if isinstance(v, np.ndarray) else float(v) for k, v in vars(log.initial).items()}
    (folder / STORED).write_text(json.dumps(stored, indent=1), encoding="utf-8")


def write_frame(frame: pd.DataFrame, path: Path) -> None:
    """One table as CSV (shortest digits that read back exactly) or Parquet, by the file's ending."""
    if path.suffix == ".parquet":
        frame.to_parquet(path, index=False)
    else:
        frame.to_csv(path, index=False, lineterminator="\n")


def _find(folder: Path, files: Mapping[str, str]) -> dict[str, Path]:
    for key in files:
        if key not in REQUIRED:
            raise InputError(f"files: '{key}' is no part of a table recording; {nearest(key, REQUIRED)}")
    found: dict[str, Path] = {}
    for part in REQUIRED:
        if part == "solution" and part not in files:
            continue
        if part in files:
            found[part] = existing(folder / files[part], part)
            continue
        present = [p for p in (folder / f"{part}.csv", folder / f"{part}.parquet") if p.exists()]
        for path in present:
            existing(path, part)
        if len(present) > 1:
            raise InputError(f"{folder}: both {present[0].name} and {present[1].name} are there; name one under files")
        if present:
            found[part] = present[0]
    return found


def _check_mapping(columns: Mapping[str, str | dict[str, str]], folder: Path) -> None:
    stems = {stem for part in (REQUIRED, OPTIONAL) for table in part.values() for stem in table}
    for source, target in columns.items():
        if isinstance(target, dict):
            if source not in REQUIRED:
                raise InputError(
                    f"{folder}: columns.{source} is no part of a table recording; {nearest(source, REQUIRED)}"
                )
            _check_mapping(target, folder)
        elif not isinstance(target, str) or _stem(target.lstrip("-"), stems) is None:
            known = {
                f"{stem}_{unit}"
                for part in REQUIRED.values()
                for stem, q in part.items()
                for unit in column_units.UNITS[q]
            }
            raise InputError(
                f'{folder}: columns: "{source}" = "{target}" is no documented column; {nearest(str(target), known)}'
            )


def _idle_mapping(
    columns: Mapping[str, str | dict[str, str]], names: Mapping[str, list[str]], folder: Path
) -> list[str]:
    """Sentences on what a mapping maps and no file has: a mistyped name, or a sensor that was not recorded."""
    notes = []
    for source, target in columns.items():
        inner = target if isinstance(target, dict) else {source: target}
        present = names.get(source, []) if isinstance(target, dict) else [n for part in names.values() for n in part]
        where = f"{source} has no column" if isinstance(target, dict) else "no file has a column"
        for name, wanted in inner.items():
            if name not in present:
                near = closest(name, set(present))
                hint = f"; did you mean '{near}'?" if near else ""
                notes.append(f'{folder}: the mapping "{name}" = "{wanted}" has no effect: {where} {name}{hint}')
    return notes


def _mapping_of(part: str, columns: Mapping[str, str | dict[str, str]]) -> dict[str, str]:
    out = {source: target for source, target in columns.items() if isinstance(target, str)}
    own = columns.get(part, {})
    return out | (own if isinstance(own, dict) else {})


def _stem(column: str, stems: set[str] | dict[str, str]) -> str | None:
    if column in stems:
        return column
    stem = column.rpartition("_")[0]
    return stem if stem in stems else None


def _read_part(
    path: Path, part: str, mapping: dict[str, str], base: int | None
) -> tuple[dict[str, Array], int, list[str]]:
    """Columns of one file in the bench's units, by stem; the whole second that times are counted from; the columns' names."""
    frame = read_frame(path)
    wanted = REQUIRED[part] | OPTIONAL.get(part, {})
    out: dict[str, Array] = {}
    names, unread = [str(name) for name in frame.columns], []
    for name in frame.columns:
        target = mapping.get(str(name), str(name))
        sign = -1.0 if target.startswith("-") else 1.0
        stem = _stem(target.lstrip("-"), wanted)
        if stem is None:
            unread.append(str(name))
            continue
        place = f"{path}: column '{name}'"
        if stem in out:
            raise InputError(f"{place}: a second column for {stem}")
        try:
            _, factor = column_units.split(target.lstrip("-"), wanted[stem])
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        if stem == "time":
            values, factor = _ticks(frame[name], factor, place)
            out[stem], base = _time(values, factor, base, place)
            continue
        values = _numbers(frame[name], place)
        out[stem] = check_finite(values.astype(np.float64) * (sign * factor) if sign * factor != 1.0 else values, place)
    missing = [stem for stem in REQUIRED[part] if stem not in out]
    if missing:
        unit = next(iter(column_units.UNITS[REQUIRED[part][missing[0]]]))
        example = f"{missing[0]}_{unit}"
        raise InputError(
            f"{path}: no column for {', '.join(missing)} (such as {example}); {_candidates(example, unread, names)} Other"
            ' names are read with a mapping, a TOML file with [columns] and lines such as wx = "gyro_x_dps" (--map FILE)'
        )
    if "lat" in out:
        check_place(out["lat"], out["lon"], str(path))
    return out, base or 0, names


def _candidates(wanted: str, unread: list[str], names: list[str]) -> str:
    """Which column may be the wanted one: of those that nothing reads, the nearest, however it is written."""
    plain = {re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_"): name for name in unread}
    if (near := closest(wanted, plain)) is not None:
        return f"is it the column '{plain[near]}'?"
    if unread:
        return f"columns that are not read: {', '.join(shown(name) for name in unread[:12])}."
    return f"it has {', '.join(names[:12])}, which are all read."


def _ticks(column: pd.Series, factor: float, place: str) -> tuple[Array, float]:
    """Times as numbers and their unit, s: as they stand, or nanoseconds since 1970 of dates after ISO 8601 (UTC where none is said)."""
    import pandas as pd

    dates = column
    if not pd.api.types.is_datetime64_any_dtype(column):
        if pd.api.types.is_numeric_dtype(column):
            return _numbers(column, place), factor
        dates = pd.to_datetime(column, format="ISO8601", utc=True, errors="coerce")
        if dates.isna().all():
            return _numbers(column, place), factor
    if (bad := dates.isna()).any():
        k = int(np.argmax(bad.to_numpy()))
        raise InputError(f"{place}: sample {k} is {shown(column.iloc[k])}, expected a date as in the other rows")
    return pd.to_datetime(dates, utc=True).dt.as_unit("ns").astype("int64").to_numpy(), 1e-9


def _numbers(column: pd.Series, place: str) -> Array:
    import pandas as pd

    if pd.api.types.is_datetime64_any_dtype(column):
        raise InputError(f"{place}: holds dates, expected numbers")
    if not pd.api.types.is_numeric_dtype(column) or pd.api.types.is_bool_dtype(column):
        numbers = pd.to_numeric(column, errors="coerce")
        bad = numbers.isna() & column.notna()
        if bad.any():
            k = int(np.argmax(bad.to_numpy()))
            raise InputError(f"{place}: sample {k} is {shown(column.iloc[k])}, expected a number")
        column = numbers
    return column.to_numpy()


def _time(values: Array, factor: float, base: int | None, place: str) -> tuple[Array, int]:
    """Seconds from ``base``, which the first file sets; whole numbers of ticks are subtracted before scaling."""
    check_finite(values * factor, place)
    if not len(values):
        return values.astype(np.float64), base or 0
    if base is None:
        first = float(values[0]) * factor
        base = int(first) if first > EPOCH else 0
    ticks = round(base / factor)
    counted = values - (ticks if values.dtype.kind in "iu" else float(ticks))
    return check_time(counted.astype(np.float64) * factor if factor != 1.0 else counted.astype(np.float64), place), base
