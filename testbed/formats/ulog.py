"""PX4 flight logs (ULog, read by pyulog): IMU, GNSS, magnetometer, barometer, and PX4's own estimate as the reference.

Fields and units: PX4-Autopilot message definitions (SensorCombined, VehicleImu, SensorGps, VehicleMagnetometer,
SensorBaro, VehicleAirData, VehicleAttitude, VehicleGlobalPosition, VehicleLocalPosition), old and new layout. Frames
are the bench's own (FRD, NED). Time counts from the last IMU sample before the first three-dimensional fix.

In a simulator's log the reference is the ``_groundtruth`` topics; else it is PX4's EKF2, an estimate, not truth.
Heights are above the ellipsoid where the GNSS gives both heights, else above mean sea level.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, BaroSamples, GnssFixes, ImuSamples, MagSamples
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec, TriadSpec
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import check_finite, check_place, check_time, library, merged_motion, only_file, quiet

IMU_TOPICS, GNSS_TOPICS = ("sensor_combined", "vehicle_imu"), ("vehicle_gps_position", "sensor_gps")
MAG_TOPICS, BARO_TOPICS = ("vehicle_magnetometer", "sensor_mag"), ("vehicle_air_data", "sensor_baro")
REFERENCE_TOPICS = ("vehicle_attitude", "vehicle_global_position", "vehicle_local_position")
TOPICS = [
    *IMU_TOPICS,
    *GNSS_TOPICS,
    *MAG_TOPICS,
    *BARO_TOPICS,
    *(t + s for t in REFERENCE_TOPICS for s in ("", "_groundtruth")),
]

DEFAULT_IMU = ImuSpec(
    name="PX4 autopilot IMU",
    gyro=TriadSpec(turn_on_bias=0.02, bias_instability=1e-4, white_noise=1e-3),
    accel=TriadSpec(turn_on_bias=0.2, bias_instability=5e-3, white_noise=0.022),
)
"""Assumed where the scenario names no IMU: EKF2's default noise (0.015 rad/s, 0.35 m/s² per sample at 250 Hz, with the
airframe's vibration) as densities, its initial accelerometer bias, and a turn-on gyro bias of 1 °/s."""
LEAST_STD = np.array([0.1, 0.1, 0.1, 0.05, 0.05, 0.05])
"""Receivers state less than they deliver: floor of the GNSS sigmas, m and m/s."""
COVERAGE = 0.9
"""Share of the time that integrated samples must cover; topics logged at a reduced rate leave gaps."""
LEVEL_FIELD = 20.0
"""µT: horizontal field of `testbed.data.specs.MagSpec`, turned by the log's declination."""
EARTH_RADIUS = 6371000.0
"""m: the sphere of PX4's local projection (its ``map_projection``)."""

Topic = dict[str, Array]


def read(config: RecordingConfig, folder: Path) -> Raw:
    """Sample tables of one .ulg file (part ``log``; default: the only one in the folder)."""
    return read_file(only_file(folder / config.dir, config.files, "log", (".ulg",)), config.allow_truncated)


def read_file(path: Path, allow_truncated: bool = False) -> Raw:
    """Sample tables of a .ulg file. Raises InputError that names what is wrong with it."""
    log = _open(path, allow_truncated)
    topics = {(data.name, data.multi_id): data.data for data in log.data_list}
    imu_us, gyro, accel = _imu(path, topics)
    gnss_us, gnss = _gnss(path, topics, dict(log.initial_parameters))
    first = max(int(np.searchsorted(imu_us, gnss_us[0], side="right")) - 1, 0)
    if len(imu_us) - first < 4:
        raise InputError(f"{path}: the IMU ends {(gnss_us[0] - imu_us[-1]) * 1e-6:.3g} s before the first GNSS fix")
    clock = _Clock(imu_us[first])
    raw = Raw(name=path.stem, places=dict.fromkeys(("imu", "gnss", "mag", "baro", "reference"), str(path)))
    t = clock.seconds(imu_us[first + 1 :])
    rate = float(np.round(1.0 / np.median(np.diff(t)), 3))
    raw.imu = ImuSamples(t, gyro[first + 1 :], accel[first + 1 :], replace(DEFAULT_IMU, rate_hz=rate))
    keep = gnss_us >= imu_us[first]
    raw.gnss = GnssFixes(
        clock.seconds(gnss_us[keep]),
        **{k: gnss[k][keep] for k in ("lat", "lon", "h", "v_n", "std")},
        spec=gnss["spec"],
    )
    raw.gnss_position_only = gnss["position_only"]
    raw.utc = None if gnss["utc"] is None else gnss["utc"] - float(clock.seconds(gnss_us[:1])[0])
    raw.mag, raw.baro = _mag(path, topics, clock), _baro(path, topics, clock)
    raw.motion = _reference(path, topics, clock, gnss["undulation"])
    raw.stated = {"imu", "gnss", "baro"}
    declination = float(log.initial_parameters.get("EKF2_MAG_DECL", 0.0))
    if raw.mag is not None and declination != 0.0:  # PX4 keeps there what its world map says, and 0 before it has a fix
        east = np.radians(declination)
        field = (LEVEL_FIELD * np.cos(east), LEVEL_FIELD * np.sin(east), MagSpec.field_n[2])
        raw.mag = replace(raw.mag, spec=replace(raw.mag.spec, declination=float(east), field_n=field))
        raw.stated.add("mag")
    return raw


class _Clock:
    """Microseconds of the log to seconds of the recording."""

    def __init__(self, start_us: int) -> None:
        self.start = int(start_us)

    def seconds(self, us: Array) -> Array:
        return np.asarray((us.astype(np.int64) - self.start) * 1e-6, dtype=np.float64)


def _open(path: Path, allow_truncated: bool) -> Any:
    pyulog = library("pyulog", "pyulog", "formats", "PX4 logs")
    complete = _ends_on_message(path)
    try:
        with quiet():
            log = pyulog.ULog(str(path), TOPICS, True)
    except Exception as error:  # pyulog raises anything from TypeError to struct.error on damaged files
        raise InputError(
            f"{path}: not a readable ULog file, corrupt or truncated ({type(error).__name__}: {error})"
        ) from None
    if log.file_corruption:
        raise InputError(f"{path}: corrupt: a message inside of the log cannot be read")
    if not complete and not allow_truncated:
        raise InputError(
            f"{path}: truncated or corrupt: it does not end with a whole message; use what is there with allow_truncated = true"
        )
    return log


def _ends_on_message(path: Path) -> bool:
    """Whether the chain of message headers (size uint16, type byte) from byte 16 ends exactly at the end of the file."""
    content = path.read_bytes()
    place, end = 16, len(content)
    while place + 3 <= end:
        place += 3 + content[place] + 256 * content[place + 1]
    return place == end


def _topic(
    topics: Mapping[tuple[str, int], Topic], names: tuple[str, ...], fields: tuple[str, ...]
) -> tuple[str, Topic] | None:
    """The first topic (lowest instance) that has rows and all of ``fields``."""
    for name in names:
        for (found, _), data in sorted(topics.items(), key=lambda item: item[0][1]):
            if found == name and all(f in data for f in fields) and len(data["timestamp"]) > 1:
                return name, data
    return None


def _stamps(data: Topic, place: str) -> tuple[Array, Array]:
    """Microseconds (the raw data's own stamp where there is one) and the rows to keep: repeated stamps are dropped."""
    us = data["timestamp"].astype(np.int64)
    own = data.get("timestamp_sample")
    if own is not None and (own > 0).all():
        us = own.astype(np.int64)
    keep = np.concatenate([[True], np.diff(us) != 0])
    check_time((us[keep] - us[0]) * 1e-6, f"{place}.timestamp")
    return us[keep], keep


def _vector(data: Topic, field: str, place: str, keep: Array) -> Array:
    values = np.column_stack([data[f"{field}[{i}]"] for i in range(3)]).astype(np.float64)[keep]
    return check_finite(values, f"{place}.{field}")


def _imu(path: Path, topics: Mapping[tuple[str, int], Topic]) -> tuple[Array, Array, Array]:
    """Times (µs), gyro and accelerometer means over the interval before each time.

    Of the two topics the one with more samples among those whose integration intervals cover the time; both where
    neither does.
    """
    found = []
    combined = _topic(topics, ("sensor_combined",), ("gyro_rad[0]", "accelerometer_m_s2[0]"))
    if combined is not None:
        place, data = f"{path}: sensor_combined", combined[1]
        us, keep = _stamps(data, place)
        span = (
            data["gyro_integral_dt"].astype(np.float64)[keep]
            if "gyro_integral_dt" in data
            else np.diff(us, prepend=us[0]) * 1.0
        )
        found.append(
            (us, _vector(data, "gyro_rad", place, keep), _vector(data, "accelerometer_m_s2", place, keep), span)
        )
    integrated = _topic(
        topics, ("vehicle_imu",), ("delta_angle[0]", "delta_velocity[0]", "delta_angle_dt", "delta_velocity_dt")
    )
    if integrated is not None:
        place, data = f"{path}: vehicle_imu", integrated[1]
        us, keep = _stamps(data, place)
        dt = {f: data[f].astype(np.float64)[keep] for f in ("delta_angle_dt", "delta_velocity_dt")}
        for name, values in dt.items():
            if (values <= 0.0).any():
                raise InputError(
                    f"{place}.{name}: sample {int(np.argmin(values))} is {values.min():g} µs, expected more than 0"
                )
        gyro = _vector(data, "delta_angle", place, keep) / (dt["delta_angle_dt"] * 1e-6)[:, None]
        accel = _vector(data, "delta_velocity", place, keep) / (dt["delta_velocity_dt"] * 1e-6)[:, None]
        found.append((us, gyro, accel, dt["delta_angle_dt"]))
    if not found:
        raise InputError(f"{path}: has neither of the IMU topics {' and '.join(IMU_TOPICS)}")
    covering = [f for f in found if f[3][1:].sum() >= COVERAGE * (f[0][-1] - f[0][0])]
    best = max(covering or found, key=lambda f: len(f[0]))
    return best[0], best[1], best[2]


def _gnss(
    path: Path, topics: Mapping[tuple[str, int], Topic], parameters: Mapping[str, Any]
) -> tuple[Array, dict[str, Any]]:
    found = _topic(topics, GNSS_TOPICS, ("fix_type", "vel_n_m_s"))
    if found is None:
        raise InputError(f"{path}: has neither of the GNSS topics {' and '.join(GNSS_TOPICS)}")
    name, data = found
    place = f"{path}: {name}"
    us, keep = _stamps(data, place)
    good = data["fix_type"][keep] >= 3
    moving = data["vel_ned_valid"][keep] != 0 if "vel_ned_valid" in data else np.ones(len(good), dtype=bool)
    position_only = int((good & moving).sum()) < 2
    good = good if position_only else good & moving
    if good.sum() < 2:
        raise InputError(f"{place}: no three-dimensional fixes ({len(good)} messages)")
    rows = np.flatnonzero(keep)[good]

    def column(field: str) -> Array:
        return check_finite(data[field][rows].astype(np.float64), f"{place}.{field}")

    if "latitude_deg" in data:
        lat, lon = np.radians(column("latitude_deg")), np.radians(column("longitude_deg"))
        mean_sea, ellipsoid = column("altitude_msl_m"), column("altitude_ellipsoid_m")
    else:
        lat, lon = np.radians(column("lat") * 1e-7), np.radians(column("lon") * 1e-7)
        mean_sea = column("alt") * 1e-3
        ellipsoid = column("alt_ellipsoid") * 1e-3 if "alt_ellipsoid" in data else np.zeros_like(mean_sea)
    check_place(lat, lon, place)
    undulation = float(np.median(ellipsoid - mean_sea)) if ellipsoid.any() else 0.0
    eph, epv, speed = column("eph"), column("epv"), column("s_variance_m_s")
    std = np.maximum(np.column_stack([eph, eph, epv, speed, speed, speed]), LEAST_STD)
    typical = np.median(std, axis=0)
    x, y, z = (
        float(parameters.get(f"EKF2_GPS_POS_{a}", 0.0) - parameters.get(f"EKF2_IMU_POS_{a}", 0.0)) for a in "XYZ"
    )
    spec = GnssSpec(
        name=f"PX4 {name}",
        rate_hz=float(np.round(1e6 / np.median(np.diff(us[good])), 3)),
        horizontal_sigma=float(typical[0]),
        vertical_sigma=float(typical[2]),
        velocity_sigma=float(typical[3]),
        lever_arm_b=(x, y, z),
        latency_s=float(parameters.get("EKF2_GPS_DELAY", 0.0)) * 1e-3,
    )
    v_n = np.zeros((len(lat), 3)) if position_only else np.column_stack([column(f"vel_{a}_m_s") for a in "ned"])
    out = {
        "lat": lat,
        "lon": lon,
        "h": mean_sea + undulation,
        "v_n": v_n,
        "std": std,
        "spec": spec,
        "undulation": undulation,
        "position_only": position_only,
        "utc": _utc(data, rows[0]),
    }
    return us[good], out


def _utc(data: Topic, row: int) -> float | None:
    """Unix time of a fix, s; None where the receiver did not know it."""
    us = float(data["time_utc_usec"][row]) if "time_utc_usec" in data else 0.0
    return us * 1e-6 if us > 1e15 else None  # microseconds since 2001


def _mag(path: Path, topics: Mapping[tuple[str, int], Topic], clock: _Clock) -> MagSamples | None:
    """Calibrated field (gauss in the log) in µT."""
    found = _topic(topics, MAG_TOPICS, ("timestamp",))
    if found is None:
        return None
    name, data = found
    place = f"{path}: {name}"
    us, keep = _stamps(data, place)
    if "magnetometer_ga[0]" in data:
        gauss = _vector(data, "magnetometer_ga", place, keep)
    else:
        gauss = check_finite(np.column_stack([data[a] for a in "xyz"]).astype(np.float64)[keep], place)
    t = clock.seconds(us)
    rate = float(np.round(1.0 / np.median(np.diff(t)), 3))
    return MagSamples(t, 100.0 * gauss, MagSpec(name=f"PX4 {name}", rate_hz=rate, noise_sigma=0.5, turn_on_bias=5.0))


def _baro(path: Path, topics: Mapping[tuple[str, int], Topic], clock: _Clock) -> BaroSamples | None:
    """Pressure in Pa; old logs have sensor_baro in mbar, which a value below 2000 tells."""
    found = _topic(topics, BARO_TOPICS, ("timestamp",))
    if found is None:
        return None
    name, data = found
    place = f"{path}: {name}"
    us, keep = _stamps(data, place)
    field = "baro_pressure_pa" if "baro_pressure_pa" in data else "pressure"
    if field not in data:
        return None
    pressure = check_finite(data[field].astype(np.float64)[keep], f"{place}.{field}")
    t = clock.seconds(us)
    rate = float(np.round(1.0 / np.median(np.diff(t)), 3))
    scale = 100.0 if np.median(pressure) < 2000.0 else 1.0
    return BaroSamples(
        t, scale * pressure, BaroSpec(name=f"PX4 {name}", rate_hz=rate, noise_sigma=5.0, turn_on_bias=100.0, drift=1.0)
    )


def _reference(
    path: Path, topics: Mapping[tuple[str, int], Topic], clock: _Clock, undulation: float
) -> tuple[Array, ...] | None:
    """t, lat, lon, h, v_n, q_nb at the times of the attitude, from ground truth or EKF2; None where topics are missing."""
    for suffix in ("_groundtruth", ""):
        names = {key: f"vehicle_{key}{suffix}" for key in ("attitude", "global_position", "local_position")}
        attitude = _topic(topics, (names["attitude"],), ("q[0]",))
        place = _topic(topics, (names["global_position"],), ("lat", "lon", "alt"))
        local = _topic(topics, (names["local_position"],), ("vx", "vy", "vz"))
        if attitude is not None and local is not None:
            return _motion(path, names, attitude[1], place[1] if place else None, local[1], clock, undulation)
    return None


def _motion(
    path: Path,
    names: Mapping[str, str],
    attitude: Topic,
    place: Topic | None,
    local: Topic,
    clock: _Clock,
    undulation: float,
) -> tuple[Array, ...] | None:
    us, keep = _stamps(attitude, f"{path}: {names['attitude']}")
    q = np.column_stack([attitude[f"q[{i}]"] for i in range(4)]).astype(np.float64)[keep]
    q = check_finite(q / np.linalg.norm(q, axis=1, keepdims=True), f"{path}: {names['attitude']}.q")
    local_us, local_keep = _stamps(local, f"{path}: {names['local_position']}")
    local_t = clock.seconds(local_us)
    if place is not None:
        place_us, place_keep = _stamps(place, f"{path}: {names['global_position']}")
        place_t = clock.seconds(place_us)
        lat, lon = (np.radians(place[k][place_keep].astype(np.float64)) for k in ("lat", "lon"))
        h = place["alt"][place_keep].astype(np.float64)
    else:
        globally = _globally_known(local, local_keep)
        if not globally.any():
            return None
        place_t, local_rows = local_t[globally], np.flatnonzero(local_keep)[globally]
        lat, lon, h = _unproject(
            {k: local[k][local_rows].astype(np.float64) for k in ("x", "y", "z", "ref_lat", "ref_lon", "ref_alt")}
        )
    check_place(lat, lon, f"{path}: {names['global_position']}")
    v_n = np.column_stack([local[k][local_keep].astype(np.float64) for k in ("vx", "vy", "vz")])
    return merged_motion((clock.seconds(us), q), (place_t, lat, lon, h + undulation), (local_t, v_n))


def _globally_known(local: Topic, keep: Array) -> Array:
    known = np.ones(int(keep.sum()), dtype=bool)
    for flag in ("xy_global", "z_global"):
        if flag in local:
            known &= local[flag][keep] != 0
    return known


def _unproject(local: Topic) -> tuple[Array, Array, Array]:
    """Latitude, longitude (rad), height of PX4's local position: inverse azimuthal equidistant projection of a sphere."""
    north, east = local["x"] / EARTH_RADIUS, local["y"] / EARTH_RADIUS
    lat0, lon0 = np.radians(local["ref_lat"]), np.radians(local["ref_lon"])
    c = np.hypot(north, east)
    ratio = np.sinc(c / np.pi)
    lat = np.arcsin(np.clip(np.cos(c) * np.sin(lat0) + north * ratio * np.cos(lat0), -1.0, 1.0))
    lon = lon0 + np.arctan2(east * ratio, np.cos(lat0) * np.cos(c) - north * np.sin(lat0) * ratio)
    return lat, lon, local["ref_alt"] - local["z"]
