"""From tables (`testbed.formats.table`) to samples: specifications and initial state of ``log.json`` where there is one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data import specs
from testbed.data.records import Array, BaroSamples, GnssFixes, ImuSamples, InitialState, MagSamples, SensorLog
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import interval_means
from testbed.formats.table import STD, VELOCITY, Tables, read_mapping
from testbed.sensors.registry import SENSORS

EARLIEST_UTC, LATEST_UTC = 9.46e8, 4.1e9
"""Unix times of the years 2000 and 2100: times between them are taken as dates."""
KINDS: dict[str, type] = {"imu": ImuSpec} | {kind: sensor.spec for kind, sensor in SENSORS.items()}


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The tables that ``config`` describes; ``folder`` is the scenario's."""
    columns = read_mapping(folder / config.mapping) if config.mapping else {}
    return samples_of(Tables(folder / config.dir, config.files, columns | config.columns), config.sampling)


def samples_of(tables: Tables, sampling: str) -> Raw:
    """The samples of a folder of tables."""
    stored, parts = tables.stored(), tables.parts
    raw = Raw(name=stored.get("name") or tables.folder.name, places=dict(tables.places))
    spec = {kind: _stored_spec(stored, kind, tables.folder) for kind in KINDS}
    raw.stated = {kind for kind, value in spec.items() if value is not None}
    raw.initial = _stored_initial(stored, tables.folder)
    t = parts["imu"]["time"]
    if len(t) < 3:
        raise InputError(f"{tables.folder}: imu has {len(t)} samples, at least 3 are needed")
    gyro, accel = (
        tables.block("imu", [f"gyro_{a}" for a in "xyz"]),
        tables.block("imu", [f"accel_{a}" for a in "xyz"]),
    )
    rate = spec["imu"] or ImuSpec("unknown", rate_hz=float(np.round(1.0 / np.median(np.diff(t)), 6)))
    raw.t_start, t, gyro, accel = interval_means(t, gyro, accel, sampling)
    if raw.initial is not None:
        raw.t_start = raw.initial.t
    raw.imu = ImuSamples(t, gyro, accel, rate)
    raw.utc = float(tables.base) if EARLIEST_UTC < tables.base < LATEST_UTC else None
    _add_aiding(raw, tables, spec, _stored_outages(stored, tables.folder))
    raw.notes += tables.notes
    return raw


def at_rest(path: Path, mapping: Path | None = None) -> SensorLog:
    """The IMU of a table (a file, or ``imu.csv`` or ``imu.parquet`` of a folder) as a log that knows nothing of the sensor."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    files = {} if path.is_dir() else {"imu": path.name}
    tables = Tables(path if path.is_dir() else path.parent, files, read_mapping(mapping) if mapping else {}, ("imu",))
    raw = samples_of(tables, "interval")
    assert raw.imu is not None
    steps = float(raw.imu.t[-1] - raw.imu.t[0]) / (len(raw.imu.t) - 1)
    imu = replace(raw.imu, spec=ImuSpec("unknown", rate_hz=1.0 / steps))
    one = np.array([1.0, 0.0, 0.0, 0.0])
    initial = InitialState(raw.t_start, 0.0, 0.0, 0.0, np.zeros(3), one, np.zeros(3), np.zeros(3), np.ones(15))
    return SensorLog(imu, initial, name=path.name)


def _add_aiding(raw: Raw, tables: Tables, spec: dict[str, Any], outages: tuple[tuple[float, float], ...]) -> None:
    parts = tables.parts
    if (g := parts.get("gnss")) is not None:
        std = _stated_std(raw, tables)
        velocity = [key for key in VELOCITY if key in g]
        if velocity and len(velocity) < 3:
            raise InputError(f"{raw.place('gnss')}: has {', '.join(velocity)}, but not all of {', '.join(VELOCITY)}")
        level = not velocity and "speed" in g and "course" in g
        raw.gnss_position_only, raw.gnss_level_velocity = not velocity and not level, level
        v_n = tables.block("gnss", list(VELOCITY)) if velocity else np.zeros((len(g["time"]), 3))
        if level:
            v_n[:, 0], v_n[:, 1] = g["speed"] * np.cos(g["course"]), g["speed"] * np.sin(g["course"])
        raw.gnss = GnssFixes(
            g["time"], g["lat"], g["lon"], g["alt"], v_n, spec["gnss"] or GnssSpec("unknown"), outages, std
        )
        if std is not None:
            raw.stated.add("gnss")
    if "mag" in parts:
        field = tables.block("mag", ["mag_x", "mag_y", "mag_z"])
        raw.mag = MagSamples(parts["mag"]["time"], field, spec["mag"] or MagSpec("unknown"))
    if "baro" in parts:
        raw.baro = BaroSamples(parts["baro"]["time"], parts["baro"]["pressure"], spec["baro"] or BaroSpec("unknown"))
    for kind in set(parts) & set(SENSORS) - {"gnss", "mag", "baro"}:
        unknown = SENSORS[kind].spec(name="unknown")
        raw.others[kind] = SENSORS[kind].from_stems(parts[kind], spec[kind] or unknown)
    if (r := parts.get("reference")) is not None:
        if len(r["time"]) < 3:
            raise InputError(f"{tables.folder}: reference has {len(r['time'])} rows, at least 3 are needed")
        v_n = tables.block("reference", ["v_north", "v_east", "v_down"])
        raw.motion = (r["time"], r["lat"], r["lon"], r["alt"], v_n, tables.quaternions())


def _stated_std(raw: Raw, tables: Tables) -> Array | None:
    """(M,6) standard deviations of the fixes; of a receiver without velocities, its three and no more."""
    g = tables.parts["gnss"]
    named = [key for key in STD if key in g]
    if not named:
        return None
    position_only = not any(key in g for key in (*VELOCITY, "speed"))
    wanted = STD[:3] if position_only else STD
    if missing := [key for key in wanted if key not in g]:
        raise InputError(f"{raw.place('gnss')}: has {', '.join(named)}, but not {', '.join(missing)}")
    if position_only:
        return np.column_stack([tables.block("gnss", list(wanted)), np.full((len(g["time"]), 3), np.inf)])
    return tables.block("gnss", list(wanted))


def _stored_spec(stored: dict[str, Any], kind: str, folder: Path) -> Any:
    try:
        return specs.from_dict(KINDS[kind], stored[kind]) if kind in stored else None
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{folder / 'log.json'}: {kind}: {error}") from None


def _stored_initial(stored: dict[str, Any], folder: Path) -> InitialState | None:
    if "initial" not in stored:
        return None
    try:
        values: dict[str, Any] = {
            k: np.array(v) if isinstance(v, list) else float(v) for k, v in stored["initial"].items()
        }
        if np.ndim(values.get("t", 0.0)):
            raise ValueError("t must be a number of seconds")
        return InitialState(**values)
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{folder / 'log.json'}: initial: {error}") from None


def _stored_outages(stored: dict[str, Any], folder: Path) -> tuple[tuple[float, float], ...]:
    try:
        pairs = tuple((float(a), float(b)) for a, b in stored.get("outages", []))
    except (TypeError, ValueError):
        pairs = ((np.inf, -np.inf),)
    if not all(np.isfinite(pair).all() and pair[0] <= pair[1] for pair in pairs):
        raise InputError(f"{folder / 'log.json'}: outages: should be pairs [from, to] in seconds")
    return pairs
