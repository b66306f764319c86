"""The sensors of a result as data-sheet tables, from the SI specifications that ``details/info.json`` carries.

Units as data sheets print them: °/s, °/h, °/√h, mg, m/s/√h. Figures that are zero or without limit are left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from testbed.report.labels import MISSING, number
from testbed.report.results import Result
from testbed.report.tables import Cell, Column, Table
from testbed.sensors.registry import SAMPLES

DEGREE = math.degrees(1.0)
MILLI_G = 1e3 / 9.80665
# key of the specification: name, (factor, unit) of the gyroscope, (factor, unit) of the accelerometer
TRIAD: dict[str, tuple[str, tuple[float, str], tuple[float, str]]] = {
    "range": ("Range, ±", (DEGREE, "°/s"), (MILLI_G / 1e3, "g")),
    "turn_on_bias": ("Turn-on bias, 1σ", (DEGREE, "°/s"), (MILLI_G, "mg")),
    "bias_instability": ("Bias instability", (3600 * DEGREE, "°/h"), (MILLI_G, "mg")),
    "correlation_time_s": ("Its correlation time", (1.0, "s"), (1.0, "s")),
    "white_noise": ("Angle or velocity random walk", (60 * DEGREE, "°/√h"), (60.0, "m/s/√h")),
    "rate_random_walk": ("Rate random walk", (216e3 * DEGREE, "°/h/√h"), (60.0, "m/s²/√h")),
    "scale_factor": ("Scale factor, 1σ", (100.0, "%"), (100.0, "%")),
    "misalignment": ("Misalignment, 1σ", (DEGREE, "°"), (DEGREE, "°")),
    "nonorthogonality": ("Axis to axis, 1σ", (DEGREE, "°"), (DEGREE, "°")),
    "nonlinearity": ("Nonlinearity", (100.0, "%"), (100.0, "%")),
    "g_sensitivity": ("Sensitivity to acceleration", (9.80665 * DEGREE, "°/s/g"), (1.0, "")),
    "bias_temperature": ("Bias over temperature", (DEGREE, "°/s/K"), (MILLI_G, "mg/K")),
    "scale_temperature": ("Scale over temperature", (100.0, "%/K"), (100.0, "%/K")),
    "bandwidth_hz": ("Bandwidth", (1.0, "Hz"), (1.0, "Hz")),
    "resolution": ("Resolution", (DEGREE, "°/s"), (MILLI_G, "mg")),
}


def sensor_tables(result: Result) -> list[Table]:
    """One table per sensor that the run had."""
    tables = []
    for sensor, spec in result.info.get("sensors", {}).items():
        known = SAMPLES.get(sensor)
        kind = "Inertial sensors" if sensor == "imu" else known.title if known else sensor
        title = ", ".join(filter(None, (kind, str(spec.get("name", "")))))
        rate = [("Rate", [Cell(f"{number(spec['rate_hz'])} Hz")])] if "rate_hz" in spec else []
        if sensor == "imu":
            rows = [("Rate", [*rate[0][1], *rate[0][1]])] if rate else []
            rows += _triads(spec.get("gyro", {}), spec.get("accel", {}))
            columns = [Column("Gyroscope"), Column("Accelerometer")]
        else:
            rows = rate + [
                (name, [Cell(text)])
                for key, (name, factor, unit) in (known.rows if known else {}).items()
                if (text := _text(spec, key, factor, unit))
            ]
            columns = [Column("Value")]
        tables.append(Table(f"sensor-{sensor}", title, columns, rows, corner="Quantity"))
    return tables


def _triads(gyro: Mapping[str, Any], accel: Mapping[str, Any]) -> list[tuple[str, list[Cell]]]:
    rows = []
    for key, (name, of_gyro, of_accel) in TRIAD.items():
        texts: tuple[str, ...] = _text(gyro, key, *of_gyro), _text(accel, key, *of_accel)
        if key == "correlation_time_s":
            texts = tuple(t if s.get("bias_instability") else "" for t, s in zip(texts, (gyro, accel), strict=True))
        if any(texts):
            rows.append((name, [Cell(text or MISSING) for text in texts]))
    return rows


def _text(spec: Mapping[str, Any], key: str, factor: float, unit: str) -> str:
    """The figure with its unit; empty when it is zero, absent or without limit."""
    value = spec.get(key)
    values: list[Any] = list(value) if isinstance(value, (list, tuple)) else [value]
    if any(v is None or not math.isfinite(v) for v in values) or not any(values):
        return ""
    return f"{', '.join(number(factor * v) for v in values)} {unit}".strip()
