"""ArduPilot flight logs (DataFlash .bin, indexed by pymavlink): IMU, GNSS, magnetometer, barometer, and the reference.

Messages, fields and units: LogStructure.h of ArduPilot's AP_InertialSensor (IMU), AP_GPS (GPS, GPA), AP_Compass (MAG),
AP_Baro (BARO), AP_NavEKF3 (XKF1, XKQ) and AP_AHRS (POS, ATT). Frames are the bench's own (FRD, NED). Time is seconds
since the start of the autopilot. Of several sensors the first is used, and that is told.

IMU messages are values at their time, after the autopilot's filter: the means between two are those of the trapezoid rule.
In a simulator's log the reference is SIM and SIM2, which are true; else it is EKF3, an estimate, not truth. A fix is
stamped when it arrives, which GPS1_DELAY_MS, where it is set, accounts for.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, BaroSamples, GnssFixes, ImuSamples, MagSamples
from testbed.data.specs import BaroSpec, GnssSpec, MagSpec
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import (
    check_finite,
    check_place,
    check_time,
    interval_means,
    library,
    merged_motion,
    only_file,
    quiet,
    rate_of,
)
from testbed.formats.rtklib import GPS_EPOCH, LEAP_SECONDS
from testbed.formats.ulog import DEFAULT_IMU, LEAST_STD, LEVEL_FIELD
from testbed.physics.rotations import eulers_to_quats

IMU = replace(DEFAULT_IMU, name="ArduPilot autopilot IMU")
"""EKF3's defaults are EKF2's of PX4 (EK3_GYRO_P_NSE 0.015 rad/s, EK3_ACC_P_NSE 0.35 m/s²): one filter is the other's offspring."""
KINDS = {
    "b": "i1",
    "h": "i2",
    "i": "i4",
    "q": "i8",
    "B": "u1",
    "H": "u2",
    "I": "u4",
    "Q": "u8",
    "e": "f2",
    "f": "f4",
    "d": "f8",
}
"""Letters of `struct` as numpy's."""
INSTANCES = ("I", "C")
"""Fields that number a sensor or a core of the filter."""

Table = dict[str, Array]


def read(config: RecordingConfig, folder: Path) -> Raw:
    """Sample tables of one .bin file (part ``log``; default: the only one in the folder)."""
    path = only_file(folder / config.dir, config.files, "log", (".bin",))
    log = _Log(path)
    raw = Raw(name=path.stem, places=dict.fromkeys(("imu", "gnss", "mag", "baro", "reference"), str(path)))
    raw.notes = log.notes  # which grow while messages are read
    sampling = config.sampling if "sampling" in config.model_fields_set else "instant"
    us, gyro, accel = _imu(log)
    raw.t_start, t, gyro, accel = interval_means(us, gyro, accel, sampling)
    raw.imu = ImuSamples(t, gyro, accel, replace(IMU, rate_hz=rate_of(t)))
    raw.stated = {"imu", "baro"}
    undulation = _gnss(log, raw)
    raw.mag, raw.baro = _mag(log), _baro(log)
    raw.motion = _reference(log, undulation)
    east = log.parameters.get("COMPASS_DEC", 0.0)
    if raw.mag is not None and east != 0.0:  # 0 is what stands there before the autopilot knows its place
        field = (LEVEL_FIELD * np.cos(east), LEVEL_FIELD * np.sin(east), MagSpec.field_n[2])
        raw.mag = replace(raw.mag, spec=replace(raw.mag.spec, declination=east, field_n=field))
        raw.stated.add("mag")
    return raw


class _Log:
    """Messages of a file as tables of columns. Raises InputError that names what is wrong with the file."""

    def __init__(self, path: Path) -> None:
        module = library("pymavlink.DFReader", "pymavlink", "ardupilot", "ArduPilot logs")
        self.path, self.letters = path, module.FORMAT_TO_STRUCT
        self.notes: list[str] = []
        try:
            with quiet():
                self.reader = module.DFReader_binary(str(path))
                self.parameters = self._parameters()
        except InputError:
            raise
        except Exception as error:  # pymavlink raises anything from struct.error to a bare Exception on damaged files
            raise InputError(
                f"{path}: not a readable DataFlash log, corrupt or truncated ({type(error).__name__}: {error})"
            ) from None
        formats, counts = self.reader.formats, self.reader.counts
        known = sum(counts[kind] * formats[kind].len for kind in formats)
        if lost := max(0, self.reader.data_len - known):
            self.notes.append(
                f"{path}: {lost} of {self.reader.data_len} bytes are no whole messages, and are passed over"
            )

    def place(self, name: str) -> str:
        return f"{self.path}: {name}"

    def _rows(self, name: str) -> tuple[Any, Any] | None:
        """The format of a message and its rows as a structured array."""
        kind = self.reader.name_to_id.get(name)
        if kind is None or not self.reader.counts[kind]:
            return None
        form = self.reader.formats[kind]
        fields = [(str(k), _numpy_kind(self.letters[letter][0])) for k, letter in enumerate(form.format)]
        kind_of_row = np.dtype(fields)
        if kind_of_row.itemsize != form.len - 3 or len(fields) != len(form.columns):
            raise InputError(f"{self.place(name)}: its format ({form.format}) does not fit its length ({form.len})")
        content = np.frombuffer(self.reader.data_map, dtype=np.uint8)
        starts = np.asarray(self.reader.offsets[kind], dtype=np.int64) + 3
        starts = starts[starts + kind_of_row.itemsize <= len(content)]
        windows = np.lib.stride_tricks.sliding_window_view(content, kind_of_row.itemsize)
        return form, np.ascontiguousarray(windows[starts]).view(kind_of_row)[:, 0]

    def table(self, name: str, fields: tuple[str, ...], optional: tuple[str, ...] = ()) -> Table | None:
        """Columns (float64, in the units of the format) of the first instance of a message; None where there are no rows."""
        found = self._rows(name)
        if found is None:
            return None
        form, rows = found
        place = {column: k for k, column in enumerate(form.columns)}
        if missing := [field for field in fields if field not in place]:
            raise InputError(f"{self.place(name)} has no field {', '.join(missing)}; it has {', '.join(form.columns)}")
        for field in INSTANCES:
            if field in place:
                instances = rows[str(place[field])]
                first = instances.min()
                if (instances != first).any():
                    self.notes.append(
                        f"{self.place(name)}: {field} = {first} is used, the others ({len(np.unique(instances)) - 1}) are not"
                    )
                rows = rows[instances == first]
        out = {}
        for field in [f for f in (*fields, *optional) if f in place]:
            _, factor, _ = self.letters[form.format[place[field]]]
            values = rows[str(place[field])]
            if values.dtype.kind == "S":
                raise InputError(f"{self.place(name)}.{field} is text, expected a number")
            # by division, as 1e-7 is no number of two's powers and 1e7 is
            out[field] = values.astype(np.float64) / round(1.0 / factor) if factor else values.astype(np.float64)
        return out

    def stamped(self, name: str, fields: tuple[str, ...], optional: tuple[str, ...] = ()) -> Table | None:
        """`table` with its times ``t`` in s; rows that repeat a time are left out."""
        out = self.table(name, ("TimeUS", *fields), optional)
        if out is None:
            return None
        us = out.pop("TimeUS")
        keep = np.concatenate([[True], np.diff(us) != 0.0])
        return {"t": check_time(us[keep] * 1e-6, f"{self.place(name)}.TimeUS")} | {k: v[keep] for k, v in out.items()}

    def _parameters(self) -> dict[str, float]:
        found = self._rows("PARM")
        if found is None:
            return {}
        form, rows = found
        if not {"Name", "Value"} <= set(form.columns):
            return {}
        names, values = (rows[str(form.columns.index(key))] for key in ("Name", "Value"))
        return {name.decode("ascii", "replace"): float(value) for name, value in zip(names, values, strict=True)}

    def parameter(self, *names: str) -> float:
        """The first of several names of a parameter that the log has; 0 where it has none."""
        return next((self.parameters[name] for name in names if name in self.parameters), 0.0)


def _numpy_kind(letter: str) -> str:
    return f"S{letter[:-1]}" if letter.endswith("s") else f"<{KINDS[letter]}"


def _columns(table: Table, names: tuple[str, ...], place: str) -> Array:
    return check_finite(np.column_stack([table[name] for name in names]), f"{place}.{names[0]}")


def _imu(log: _Log) -> tuple[Array, Array, Array]:
    gyro, accel = ("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ")
    table = log.stamped("IMU", (*gyro, *accel))
    if table is None or len(table["t"]) < 4:
        raise InputError(
            f"{log.path}: has {0 if table is None else len(table['t'])} IMU messages, at least 4 are needed"
        )
    return table["t"], _columns(table, gyro, log.place("IMU")), _columns(table, accel, log.place("IMU"))


def _gnss(log: _Log, raw: Raw) -> float:
    """Put the fixes and the date into ``raw``; the undulation of the geoid, m, as far as the log tells it."""
    place = log.place("GPS")
    table = log.stamped("GPS", ("Status", "GMS", "GWk", "Lat", "Lng", "Alt", "Spd", "GCrs", "VZ"))
    if table is None:
        return 0.0
    if not (good := table["Status"] >= 3).any():
        raise InputError(f"{place}: no three-dimensional fixes (Status from 3 on) in {len(good)} messages")
    accuracy = log.stamped("GPA", ("HAcc", "VAcc", "SAcc"), ("VV", "SMS", "AEl"))
    std, t, undulation = None, table["t"], 0.0
    if accuracy is not None:
        row = np.clip(np.searchsorted(accuracy["t"], t - 1e-9), 0, len(accuracy["t"]) - 1)
        good &= np.abs(accuracy["t"][row] - t) < 1e-9
        horizontal, vertical, speed = (accuracy[key][row] for key in ("HAcc", "VAcc", "SAcc"))
        if (np.column_stack([horizontal, vertical, speed])[good] > 0.0).all():
            std = np.maximum(np.column_stack([horizontal, horizontal, vertical, speed, speed, speed]), LEAST_STD)[good]
        if "SMS" in accuracy:
            t = 1e-3 * accuracy["SMS"][row]
        if "AEl" in accuracy and (known := good & (accuracy["AEl"][row] > -1e6)).any():
            undulation = float(np.median((accuracy["AEl"][row] - table["Alt"])[known]))
        raw.gnss_level_velocity = "VV" in accuracy and not (accuracy["VV"][row][good] != 0).all()
    if not good.any():
        raise InputError(f"{log.place('GPA')}: belongs to none of the fixes (no times in common)")
    t = check_time(t[good], f"{place}: time of the fixes")
    lat, lon = np.radians(table["Lat"][good]), np.radians(table["Lng"][good])
    check_place(lat, lon, place)
    course = np.radians(table["GCrs"][good])
    v_n = np.column_stack([table["Spd"][good] * np.cos(course), table["Spd"][good] * np.sin(course), table["VZ"][good]])
    h = check_finite(table["Alt"][good] + undulation, f"{place}.Alt")
    raw.gnss = GnssFixes(t, lat, lon, h, check_finite(v_n, f"{place}.Spd"), _gnss_spec(log, t, std), (), std)
    if std is not None:
        raw.stated.add("gnss")
    week, ms = table["GWk"][good][0], table["GMS"][good][0]
    raw.utc = GPS_EPOCH + week * 604800.0 + 1e-3 * ms - LEAP_SECONDS - float(t[0]) if week > 0 else None
    return undulation


def _gnss_spec(log: _Log, t: Array, std: Array | None) -> GnssSpec:
    antenna = [log.parameter(f"GPS1_POS_{a}", f"GPS_POS1_{a}") - log.parameter(f"INS_POS1_{a}") for a in "XYZ"]
    delay = 1e-3 * log.parameter("GPS1_DELAY_MS", "GPS_DELAY_MS")
    spec = GnssSpec("ArduPilot GPS", rate_of(t), lever_arm_b=(antenna[0], antenna[1], antenna[2]), latency_s=delay)
    if std is None:
        return spec
    typical = np.median(std, axis=0)
    return replace(
        spec,
        horizontal_sigma=float(typical[0]),
        vertical_sigma=float(typical[2]),
        velocity_sigma=float(typical[3]),
    )


def _mag(log: _Log) -> MagSamples | None:
    """Corrected field (milligauss in the log) in µT."""
    axes = ("MagX", "MagY", "MagZ")
    table = log.stamped("MAG", axes)
    if table is None or len(table["t"]) < 2:
        return None
    spec = MagSpec("ArduPilot compass", rate_of(table["t"]), noise_sigma=0.5, turn_on_bias=5.0)
    return MagSamples(table["t"], 0.1 * _columns(table, axes, log.place("MAG")), spec)


def _baro(log: _Log) -> BaroSamples | None:
    table = log.stamped("BARO", ("Press",))
    if table is None or len(table["t"]) < 2:
        return None
    spec = BaroSpec("ArduPilot barometer", rate_of(table["t"]), noise_sigma=5.0, turn_on_bias=100.0, drift=1.0)
    return BaroSamples(table["t"], check_finite(table["Press"], f"{log.place('BARO')}.Press"), spec)


def _reference(log: _Log, undulation: float) -> tuple[Array, ...] | None:
    """t, lat, lon, h, v_n, q_nb: the simulator's, else those of EKF3; None where messages are missing."""
    angles, speeds = ("Roll", "Pitch", "Yaw"), ("VN", "VE", "VD")
    for names in (("SIM", "SIM", "SIM2"), ("XKF1", "POS", "XKF1")):
        attitude = log.stamped(names[0], angles)
        place = log.stamped(names[1], ("Lat", "Lng", "Alt"))
        velocity = log.stamped(names[2], speeds)
        if attitude is None or place is None or velocity is None:
            continue
        lat, lon = np.radians(place["Lat"]), np.radians(place["Lng"])
        check_place(lat, lon, log.place(names[1]))
        h = check_finite(place["Alt"], f"{log.place(names[1])}.Alt") + undulation
        q_nb = eulers_to_quats(np.radians(_columns(attitude, angles, log.place(names[0]))))
        v_n = _columns(velocity, speeds, log.place(names[2]))
        return merged_motion((attitude["t"], q_nb), (place["t"], lat, lon, h), (velocity["t"], v_n))
    return None
