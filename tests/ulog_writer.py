"""Writes a small PX4 ULog for tests, message by message, after the ULog file format of the PX4 documentation.

Independent of pyulog, so that importer and reader are tested against the format itself. Layouts of the messages are
those of PX4-Autopilot's msg folder, cut to the fields that matter. Little-endian, time in microseconds.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

TYPES = {
    "uint64_t": "u8",
    "uint32_t": "u4",
    "uint16_t": "u2",
    "uint8_t": "u1",
    "int32_t": "i4",
    "float": "f4",
    "double": "f8",
    "bool": "u1",
}

LAYOUTS = {
    "sensor_combined": [
        ("uint64_t", "timestamp", 0),
        ("float", "gyro_rad", 3),
        ("uint32_t", "gyro_integral_dt", 0),
        ("int32_t", "accelerometer_timestamp_relative", 0),
        ("float", "accelerometer_m_s2", 3),
        ("uint32_t", "accelerometer_integral_dt", 0),
    ],
    "vehicle_imu": [
        ("uint64_t", "timestamp", 0),
        ("uint64_t", "timestamp_sample", 0),
        ("float", "delta_angle", 3),
        ("float", "delta_velocity", 3),
        ("uint16_t", "delta_angle_dt", 0),
        ("uint16_t", "delta_velocity_dt", 0),
    ],
    "vehicle_gps_position": [
        ("uint64_t", "timestamp", 0),
        ("int32_t", "lat", 0),
        ("int32_t", "lon", 0),
        ("int32_t", "alt", 0),
        ("int32_t", "alt_ellipsoid", 0),
        *(("float", name, 0) for name in ("s_variance_m_s", "eph", "epv", "vel_n_m_s", "vel_e_m_s", "vel_d_m_s")),
        ("uint8_t", "fix_type", 0),
        ("bool", "vel_ned_valid", 0),
    ],
    "sensor_gps": [
        ("uint64_t", "timestamp", 0),
        *(("double", name, 0) for name in ("latitude_deg", "longitude_deg", "altitude_msl_m", "altitude_ellipsoid_m")),
        *(("float", name, 0) for name in ("s_variance_m_s", "eph", "epv", "vel_n_m_s", "vel_e_m_s", "vel_d_m_s")),
        ("uint8_t", "fix_type", 0),
        ("bool", "vel_ned_valid", 0),
    ],
    "vehicle_magnetometer": [("uint64_t", "timestamp", 0), ("float", "magnetometer_ga", 3)],
    "vehicle_air_data": [("uint64_t", "timestamp", 0), ("float", "baro_pressure_pa", 0)],
    "sensor_baro": [("uint64_t", "timestamp", 0), ("float", "pressure", 0)],
    "vehicle_attitude": [("uint64_t", "timestamp", 0), ("float", "q", 4)],
    "vehicle_global_position": [
        ("uint64_t", "timestamp", 0),
        ("double", "lat", 0),
        ("double", "lon", 0),
        ("float", "alt", 0),
    ],
    "vehicle_local_position": [
        ("uint64_t", "timestamp", 0),
        *(("float", name, 0) for name in ("x", "y", "z", "vx", "vy", "vz")),
        *(("bool", name, 0) for name in ("xy_global", "z_global")),
        ("double", "ref_lat", 0),
        ("double", "ref_lon", 0),
        ("float", "ref_alt", 0),
    ],
}


def write(path: Path, topics: dict[str, dict[str, np.ndarray]], parameters: dict[str, float] | None = None) -> None:
    """Write ``topics``: name to columns (``timestamp`` and fields, (N,) or (N,3)); messages are ordered by time."""
    content = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))
    content += _message("B", bytes(40))
    for name, value in (parameters or {}).items():
        key = f"float {name}".encode()
        content += _message("P", bytes([len(key)]) + key + struct.pack("<f", value))
    for name in topics:
        fields = "".join(f"{kind}{f'[{size}]' if size else ''} {field};" for kind, field, size in LAYOUTS[name])
        content += _message("F", f"{name}:{fields}".encode())
    for number, name in enumerate(topics):
        content += _message("A", struct.pack("<BH", 0, number) + name.encode())
    stamped: list[tuple[int, bytes]] = []
    for number, (name, columns) in enumerate(topics.items()):
        rows = _rows(LAYOUTS[name], columns)
        times = np.asarray(columns["timestamp"]).astype(int)
        stamped += [
            (t, _message("D", struct.pack("<H", number) + row.tobytes())) for t, row in zip(times, rows, strict=True)
        ]
    stamped.sort(key=lambda item: item[0])
    path.write_bytes(bytes(content) + b"".join(message for _, message in stamped))


def _message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def _rows(layout: list[tuple[str, str, int]], columns: dict[str, np.ndarray]) -> np.ndarray:
    dtype = np.dtype(
        [(field, "<" + TYPES[kind], (size,)) if size else (field, "<" + TYPES[kind]) for kind, field, size in layout]
    )
    out = np.zeros(len(columns["timestamp"]), dtype)
    for name, values in columns.items():
        out[name] = values
    return out
