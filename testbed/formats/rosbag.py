"""Bags of ROS 1 and ROS 2 (.bag, .db3, .mcap, or the folder of a ROS 2 bag), read by rosbags.

Messages: sensor_msgs Imu, NavSatFix, MagneticField and FluidPressure, nav_msgs Odometry as the reference. Of several topics
of a type the one with the most messages is used, and that is told; ``topics`` names another. Samples are at their header's
stamps, seconds from the first whole one of the IMU; where the headers hold none, at the times of the bag.

Axes are those of REP 103 and REP 145: sensors forward-left-up, the world east-north-up. Where a sensor is turned in its
vehicle, ``mounting_deg`` says so: transforms (tf) are not read. A NavSatFix has no velocity. An odometry counts from where it
began: it is placed on the fixes, by their mean offset, and turned to them where they show that its x axis is not east.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from testbed.base.errors import InputError, nearest
from testbed.data.records import Array, BaroSamples, GnssFixes, ImuSamples, MagSamples
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec
from testbed.formats.config import RecordingConfig
from testbed.formats.frames import FLIP, attitudes, ned_of
from testbed.formats.kinematics import from_rotvec, multiply
from testbed.formats.raw import Raw
from testbed.formats.recording import (
    check_finite,
    check_place,
    check_time,
    interval_means,
    library,
    only_file,
    placed,
    rate_of,
)
from testbed.physics import earth
from testbed.physics.rotations import quats_to_matrices

SUFFIXES = (".bag", ".mcap", ".db3")
TYPES = {
    "imu": "sensor_msgs/msg/Imu",
    "gnss": "sensor_msgs/msg/NavSatFix",
    "mag": "sensor_msgs/msg/MagneticField",
    "baro": "sensor_msgs/msg/FluidPressure",
    "reference": "nav_msgs/msg/Odometry",
}
"""Part -> message type, as rosbags calls it for both versions."""
SECOND = 1_000_000_000
TURNED_SIGMAS, TURNED = 3.0, np.radians(1.0)
"""An odometry is turned to the fixes where they show an angle beyond these: its own heading is hardly better than 1°."""


class Topic(NamedTuple):
    """Stamps (N,) int64, ns, in rising order, and the numbers (N,k) of a topic's messages."""

    name: str
    stamps: Array
    values: Array


def read(config: RecordingConfig, folder: Path) -> Raw:
    """Sample tables of one bag (part ``bag``; default: the folder itself, or the only bag in it)."""
    path = _bag(folder / config.dir, config)
    raw = Raw(name=path.stem)
    topics = _topics(path, config, raw)
    if "imu" not in topics:
        raise InputError(f"{path}: has no messages of the type {TYPES['imu']}")
    base = int(topics["imu"].stamps[0]) // SECOND
    if base > 0:
        raw.utc = float(base)
    raw.places = {part: f"{path}: {topic.name}" for part, topic in topics.items()}
    times = {
        part: check_time((topic.stamps - base * SECOND) * 1e-9, f"{raw.places[part]}: time")
        for part, topic in topics.items()
    }
    for part, topic in topics.items():
        if part != "gnss":  # whose covariances may be anything where they are unknown
            check_finite(topic.values, raw.places[part])
    if len(times["imu"]) < 4:
        raise InputError(f"{raw.places['imu']}: has {len(times['imu'])} messages, at least 4 are needed")
    sampling = config.sampling if "sampling" in config.model_fields_set else "instant"
    gyro, accel = (topics["imu"].values[:, k : k + 3] * FLIP for k in (0, 3))
    raw.t_start, t, gyro, accel = interval_means(times["imu"], gyro, accel, sampling)
    raw.imu = ImuSamples(t, gyro, accel, ImuSpec("unknown", rate_of(t)))
    if "gnss" in topics:
        _fixes(raw, times["gnss"], topics["gnss"].values)
    if "mag" in topics:
        spec = MagSpec("unknown", rate_of(times["mag"]))
        raw.mag = MagSamples(times["mag"], 1e6 * topics["mag"].values * FLIP, spec)  # tesla in the bag
    if "baro" in topics:
        raw.baro = BaroSamples(times["baro"], topics["baro"].values[:, 0], BaroSpec("unknown", rate_of(times["baro"])))
    if "reference" in topics:
        _odometry(raw, times["reference"], topics["reference"].values)
    return raw


def _bag(root: Path, config: RecordingConfig) -> Path:
    path = root / config.files["bag"] if "bag" in config.files else root
    if (path / "metadata.yaml").is_file():
        return path
    return only_file(root, config.files, "bag", SUFFIXES)


def _topics(path: Path, config: RecordingConfig, raw: Raw) -> dict[str, Topic]:
    """The messages that are used, by part. Raises InputError where the bag cannot be read."""
    highlevel = library("rosbags.highlevel", "rosbags", "rosbag", "bags of ROS")
    typesys = library("rosbags.typesys", "rosbags", "rosbag", "bags of ROS")
    try:
        with highlevel.AnyReader([path], default_typestore=typesys.get_typestore(typesys.Stores.LATEST)) as reader:
            chosen = _chosen(path, reader.connections, config, raw)
            parts = {connection.id: part for part, found in chosen.items() for connection in found}
            stamps: dict[str, list[tuple[int, int]]] = {part: [] for part in chosen}
            values: dict[str, list[Any]] = {part: [] for part in chosen}
            wanted = [connection for found in chosen.values() for connection in found]
            for connection, ns, content in reader.messages(wanted) if wanted else ():
                part = parts[connection.id]
                message = reader.deserialize(content, connection.msgtype)
                stamp = message.header.stamp
                stamps[part].append((stamp.sec * SECOND + stamp.nanosec, ns))
                values[part].append(ROWS[part](message))
    except InputError:
        raise
    except Exception as error:  # rosbags raises anything from struct.error to sqlite's errors on damaged files
        reason = (str(error).splitlines() or [""])[0]
        raise InputError(
            f"{path}: not a readable bag, corrupt or truncated ({type(error).__name__}: {reason})"
        ) from None
    return {
        part: _ordered(chosen[part][0].topic, np.array(stamps[part], dtype=np.int64), np.array(rows), raw)
        for part, rows in values.items()
        if rows
    }


def _chosen(path: Path, connections: list[Any], config: RecordingConfig, raw: Raw) -> dict[str, list[Any]]:
    """The connections of the topic of each part."""
    out: dict[str, list[Any]] = {}
    for part, kind in TYPES.items():
        counts: dict[str, int] = {}
        for connection in connections:
            if connection.msgtype == kind and connection.msgcount:
                counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        wanted = config.topics.get(part)
        if wanted is not None and wanted not in counts:
            raise InputError(f"{path}: has no topic '{wanted}' of the type {kind}; {nearest(wanted, counts)}")
        if not counts:
            continue
        topic = wanted or max(counts, key=lambda name: counts[name])
        if wanted is None and len(counts) > 1:
            others = ", ".join(sorted(set(counts) - {topic}))
            raw.notes.append(f"{path}: {topic} is used as {part}, {others} not; topics.{part} names another")
        out[part] = [c for c in connections if c.topic == topic and c.msgtype == kind]
    return out


def _ordered(name: str, stamps: Array, values: Array, raw: Raw) -> Topic:
    """Rows in the order of their headers' stamps, without those that repeat a time."""
    own = stamps[:, 0]
    if not own.any():
        raw.notes.append(f"{name}: its headers have no stamps; times are those of the bag")
        own = stamps[:, 1]
    order = np.argsort(own, kind="stable")
    keep = order[np.concatenate([[True], np.diff(own[order]) != 0])]
    if len(keep) < len(order):
        raw.notes.append(f"{name}: {len(order) - len(keep)} messages repeat a time, and are left out")
    return Topic(name, own[keep], values[keep])


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _imu_row(message: Any) -> tuple[float, ...]:
    return *_xyz(message.angular_velocity), *_xyz(message.linear_acceleration)


def _fix_row(message: Any) -> tuple[float, ...]:
    east, north, up = message.position_covariance[0], message.position_covariance[4], message.position_covariance[8]
    known = message.position_covariance_type
    return message.status.status, message.latitude, message.longitude, message.altitude, known, north, east, up


def _odometry_row(message: Any) -> tuple[float, ...]:
    pose, q = message.pose.pose, message.pose.pose.orientation
    return *_xyz(pose.position), q.w, q.x, q.y, q.z, *_xyz(message.twist.twist.linear)


ROWS = {
    "imu": _imu_row,
    "gnss": _fix_row,
    "mag": lambda message: _xyz(message.magnetic_field),
    "baro": lambda message: (message.fluid_pressure,),
    "reference": _odometry_row,
}
"""Part -> the numbers of a message."""


def _fixes(raw: Raw, t: Array, rows: Array) -> None:
    """Fixes of NavSatFix messages: status, latitude, longitude (deg), height, kind of covariance, variances N, E, U."""
    place = raw.places["gnss"]
    good = (rows[:, 0] >= 0) & np.isfinite(rows[:, 1:4]).all(axis=1)
    if not good.any():
        raise InputError(f"{place}: none of its {len(good)} messages has a fix")
    if not good.all():
        raw.notes.append(f"{place}: {int((~good).sum())} messages without a fix are left out")
    t, rows = t[good], rows[good]
    lat, lon = np.radians(rows[:, 1]), np.radians(rows[:, 2])
    check_place(lat, lon, place)
    std, spec = None, GnssSpec("unknown", rate_of(t))
    known = (rows[:, 4] > 0) & (rows[:, 5:8] > 0.0).all(axis=1) & np.isfinite(rows[:, 5:8]).all(axis=1)
    if known.all():
        std = np.hstack([np.sqrt(rows[:, 5:8]), np.full((len(t), 3), np.inf)])
        typical = np.median(std, axis=0)
        spec = replace(spec, horizontal_sigma=float(typical[:2].max()), vertical_sigma=float(typical[2]))
        raw.stated.add("gnss")
    elif known.any():
        raw.notes.append(
            f"{place}: {int((~known).sum())} of {len(t)} fixes state no covariance; those of all are left aside"
        )
    raw.gnss = GnssFixes(t, lat, lon, check_finite(rows[:, 3], place), np.zeros((len(t), 3)), spec, (), std)
    raw.gnss_position_only = True


def _odometry(raw: Raw, t: Array, rows: Array) -> None:
    """The reference: place (m, east-north-up from anywhere), quaternion, velocity along the body's axes."""
    place = raw.places["reference"]
    if raw.gnss is None:
        raw.notes.append(f"{place}: left aside, as without a NavSatFix nothing tells where on Earth it is")
        return
    norm = np.linalg.norm(rows[:, 3:7], axis=1, keepdims=True)
    if (np.abs(norm - 1.0) > 1e-2).any():
        raise InputError(
            f"{place}: the orientation of message {int(np.argmax(np.abs(norm - 1.0)))} is no unit quaternion"
        )
    ned, q_nb = ned_of(rows[:, :3]), attitudes(rows[:, 3:7] / norm)
    g = raw.gnss
    inside = (g.t >= t[0]) & (g.t <= t[-1])
    if inside.sum() < 2:
        raise InputError(f"{place}: {int(inside.sum())} fixes lie within its time, at least 2 are needed to place it")
    origin = (float(g.lat[inside][0]), float(g.lon[inside][0]), float(g.h[inside][0]))
    fixed = np.column_stack(earth.position_difference(g.lat[inside], g.lon[inside], g.h[inside], *origin))
    own = np.column_stack([np.interp(g.t[inside], t, ned[:, i]) for i in range(3)])
    angle, error = _turn(own, fixed, g, inside)
    if abs(angle) > max(TURNED_SIGMAS * error, TURNED):
        raw.notes.append(
            f"{place}: the fixes show its frame turned by {np.degrees(angle):.1f}° (± {np.degrees(error):.1g}°) from"
            " east-north-up; it is turned back"
        )
        back = from_rotvec(np.array([[0.0, 0.0, angle]]))
        ned, own = ned @ quats_to_matrices(back)[0].T, own @ quats_to_matrices(back)[0].T
        q_nb = multiply(back, q_nb)
    v_n = np.einsum("kij,kj->ki", quats_to_matrices(q_nb), rows[:, 7:10] * FLIP)
    raw.motion = (t, *placed(origin, ned + (fixed - own).mean(axis=0)), v_n, q_nb)


def _turn(own: Array, fixed: Array, gnss: GnssFixes, rows: Array) -> tuple[float, float]:
    """Angle about down, rad, that turns points ``own`` onto ``fixed`` (M,3) best, and its 1 sigma.

    Least squares in the plane: the argument of the mean of conj(own) fixed. Scatter of the points about the best fit or the
    fixes' own sigma, whichever is larger, over the spread of the way.
    """
    a, b = (points[:, 0] + 1j * points[:, 1] for points in (own - own.mean(axis=0), fixed - fixed.mean(axis=0)))
    spread = float(np.sqrt(np.sum(np.abs(a) ** 2)))
    if spread == 0.0:
        return 0.0, np.inf
    angle = float(np.angle(np.vdot(a, b)))
    scatter = float(np.sqrt(np.mean(np.abs(b - a * np.exp(1j * angle)) ** 2)))
    sigma = 0.0 if gnss.std is None else float(np.median(gnss.std[rows][:, :2]))
    return angle, max(scatter, sigma) / spread
