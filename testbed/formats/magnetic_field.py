"""The local magnetic field of a recording: what the scenario states, else norm and dip as measured at the start.

Indoors and beside iron a world model is off by more than a magnetometer's own errors, and a filter that compares with it
takes the difference for tilt. Norm and dip need no heading: they come from the levelled start. Fields in µT, n and b.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from testbed.base.errors import InputError, shown
from testbed.data.records import Array, MagSamples, SensorLog
from testbed.data.specs import MagSpec
from testbed.formats.kinematics import accumulated, from_rotvec, multiply
from testbed.physics.rotations import quats_to_matrices

KEYS = ("field_ut", "declination_deg")
"""Of ``[recording.mag]``, beside the catalogue's."""
NORM_SHARE = 0.05
"""A mean norm that is further off than this is told: 5 % of the norm beside the right dip are 2 to 3° of inclination."""


def stated_field(table: dict[str, Any], mag: MagSamples) -> MagSamples:
    """The magnetometer with the field (north, east, down) or the declination that a table states, which lose their keys."""
    field, declination = (table.pop(key, None) for key in KEYS)
    if field is not None and declination is not None:
        raise InputError("[recording.mag] field_ut states the declination, too; leave out declination_deg")
    if declination is not None:
        angle = _numbers(declination, 1, "declination_deg", "degrees east, -180 to 180")[0]
        if not -180.0 <= angle <= 180.0:
            raise InputError(f"[recording.mag] declination_deg is {shown(declination)}, expected -180 to 180")
        return with_declination(mag, float(np.radians(angle)))
    if field is None:
        return mag
    north, east, down = _numbers(field, 3, "field_ut", "[north, east, down] in µT")
    if np.hypot(north, east) < 1.0:
        raise InputError(
            f"[recording.mag] field_ut is {shown(field)}: at least 1 µT must be horizontal, as headings need"
        )
    spec = replace(mag.spec, field_n=(north, east, down), declination=float(np.arctan2(east, north)))
    return replace(mag, spec=spec)


def _numbers(value: Any, count: int, key: str, wanted: str) -> list[float]:
    values = value if isinstance(value, list | tuple) else [value]
    good = len(values) == count and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    if not good or not np.isfinite(values).all():
        raise InputError(f"[recording.mag] {key} is {shown(value)}, expected {wanted}")
    return [float(v) for v in values]


def with_declination(mag: MagSamples, declination: float) -> MagSamples:
    """The magnetometer with its field turned about down to a declination (rad)."""
    horizontal = float(np.hypot(*mag.spec.field_n[:2]))
    field = (horizontal * float(np.cos(declination)), horizontal * float(np.sin(declination)), mag.spec.field_n[2])
    return replace(mag, spec=replace(mag.spec, declination=declination, field_n=field))


def is_stated(spec: MagSpec, by_files: bool) -> bool:
    """Whether files state the local field: one that is not the default's, or the default's beside figures of their own.

    A reader that knows a declination alone, or a frame, leaves the rest of the specification empty or as it assumes it.
    """
    default = MagSpec()
    if (float(np.hypot(*spec.field_n[:2])), spec.field_n[2]) != (default.field_n[0], default.field_n[2]):
        return True
    return by_files and replace(spec, name=default.name, rate_hz=default.rate_hz) != default


def measured(log: SensorLog, seconds: float) -> tuple[SensorLog, list[str]]:
    """The log with norm and dip as its first ``seconds`` show them beside the initial attitude, and the sentence for it."""
    if log.mag is None or not len(log.mag.t):
        return log, []
    field = _field_at_start(log, seconds)
    norm, dip = float(np.linalg.norm(field)), float(np.arctan2(field[2], np.hypot(field[0], field[1])))
    spec = replace(log.mag.spec, field_n=(norm * float(np.cos(dip)), 0.0, norm * float(np.sin(dip))))
    mag = with_declination(replace(log.mag, spec=spec), log.mag.spec.declination)
    told = (
        f"the magnetic field is that of the first {seconds:g} s, {norm:.1f} µT with a dip of {np.degrees(dip):.1f}°;"
        " [recording.mag] field_ut states another"
    )
    return replace(log, aiding={**log.aiding, "mag": mag}), [told]


def _field_at_start(log: SensorLog, seconds: float) -> Array:
    """Mean field in n (3,): each sample turned back by the gyros, and by the initial attitude."""
    assert log.mag is not None
    imu, start = log.imu, log.initial
    stop = max(1, int(np.searchsorted(imu.t, start.t + seconds, side="right")))
    steps = np.diff(np.concatenate([[start.t], imu.t[:stop]]))[:, None]
    turns = from_rotvec(steps * (imu.gyro[:stop] - start.gyro_bias))
    q = multiply(start.q_nb[None], accumulated(turns))
    rows = np.flatnonzero(log.mag.t <= start.t + seconds)
    rows = rows if len(rows) else np.zeros(1, dtype=np.int64)
    grid = np.concatenate([[start.t], imu.t[:stop]])
    place = np.clip(np.searchsorted(grid, log.mag.t[rows] - 1e-9), 0, stop)
    turned: Array = np.einsum("kij,kj->ki", quats_to_matrices(q[place]), log.mag.field[rows])
    return turned.mean(axis=0)


def norm_note(log: SensorLog) -> list[str]:
    """A sentence where the mean norm of the samples is not that of the field that the filters compare with."""
    if log.mag is None or not len(log.mag.t):
        return []
    found, wanted = float(np.linalg.norm(log.mag.field, axis=1).mean()), float(np.linalg.norm(log.mag.spec.field_n))
    if abs(found - wanted) <= NORM_SHARE * wanted:
        return []
    return [
        f"the magnetometer's mean norm is {found:.1f} µT, {100.0 * (found / wanted - 1.0):+.0f} % from the {wanted:.1f} µT"
        " that filters compare with: calibrate it, or state [recording.mag] field_ut"
    ]
