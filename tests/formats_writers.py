"""A short flight in the formats of other programs, written by the formats' own libraries or after their published layouts.

ArduPilot: pymavlink packs the messages, whose formats are those of ArduPilot's LogStructure.h (AP_InertialSensor, AP_GPS,
AP_Compass, AP_Baro, AP_NavEKF3, AP_AHRS, SITL). Bags: the writers of rosbags. NMEA and UBX: pynmeagps and pyubx2. EuRoC and
KITTI: text with the header of EuRoC's data.csv and the columns of KITTI's dataformat.txt.
"""

from __future__ import annotations

import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from testbed.data.records import SensorLog, Trajectory
from testbed.physics.rotations import quats_to_eulers, quats_to_matrices

BOOT_US = 10_000_000
UNDULATION = 47.0
START = datetime.datetime(2025, 7, 8, 12, 0, 0, tzinfo=datetime.UTC)
"""UTC at t = 0; 2025-07-08 is a Tuesday of the GPS week 2374."""
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLIP = np.array([1.0, -1.0, -1.0])

ARDUPILOT = {
    "PARM": ("QNff", "TimeUS,Name,Value,Default"),
    "IMU": ("QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "GPS": ("QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": ("QBCCCCfBIHeHH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,AEl,RTCMFU,RTCMFD"),
    "MAG": ("QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"),
    "BARO": ("QBffcfIffB", "TimeUS,I,Alt,Press,Temp,CRt,SMS,Offset,GndTemp,Health"),
    "XKF1": ("QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    "POS": ("QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "SIM": ("QccCfLLffff", "TimeUS,Roll,Pitch,Yaw,Alt,Lat,Lng,Q1,Q2,Q3,Q4"),
    "SIM2": ("Qdddffff", "TimeUS,PN,PE,PD,VN,VE,VD,As"),
}
"""Message -> its format letters and columns."""
PARAMETERS = {"GPS1_POS_X": 0.3, "GPS1_POS_Z": -0.1, "GPS1_DELAY_MS": 20.0, "COMPASS_DEC": 0.0713}


def ardupilot_messages(trajectory: Trajectory, log: SensorLog, simulated: bool = False) -> dict[str, list[tuple]]:
    """Rows of each message as the autopilot packs them; heights above mean sea level are `UNDULATION` lower."""

    def us(t: np.ndarray) -> list[int]:
        return [int(x) for x in np.round(t * 1e6).astype(int) + BOOT_US]

    r, g, k = trajectory, log.gnss, slice(None, None, 4)
    e7 = {name: np.round(np.degrees(x) * 1e7).astype(int) for name, x in (("lat", g.lat), ("lon", g.lon))}
    speed, course = np.hypot(*g.v_n[:, :2].T), np.degrees(np.arctan2(g.v_n[:, 1], g.v_n[:, 0])) % 360.0
    tow_ms = np.round((g.t + _gps_seconds()) * 1e3).astype(int)
    cm = np.round((g.h - UNDULATION) * 100).astype(int), np.round(g.h * 100).astype(int)
    imu = [
        (t, 0, *w, *f, 0, 0, 40.0, 1, 1, 1000, 1000)
        for t, w, f in zip(us(log.imu.t), log.imu.gyro, log.imu.accel, strict=True)
    ]
    gps = [
        (
            t,
            0,
            4,
            int(tow_ms[i]),
            2374,
            17,
            70,
            int(e7["lat"][i]),
            int(e7["lon"][i]),
            int(cm[0][i]),
            speed[i],
            course[i],
            g.v_n[i, 2],
            0.0,
            1,
        )
        for i, t in enumerate(us(g.t))
    ]
    gpa = [(t, 0, 90, 150, 250, 10, 0.0, 1, t // 1000, 200, int(cm[1][i]), 0, 0) for i, t in enumerate(us(g.t))]
    field = np.round(log.mag.field * 10.0).astype(int)
    mag = [(t, 0, *(int(x) for x in b), 5, 6, 7, 0, 0, 0, 1, t) for t, b in zip(us(log.mag.t), field, strict=True)]
    baro = [
        (t, 0, 0.0, p, 2500, 0.0, t // 1000, 0.0, 25.0, 1)
        for t, p in zip(us(log.baro.t), log.baro.pressure, strict=True)
    ]
    euler = np.degrees(quats_to_eulers(r.q_nb[k]))
    cdeg = np.column_stack([np.round(euler[:, :2] * 100), np.round(euler[:, 2] % 360.0 * 100)]).astype(int)
    place = [(int(a), int(b)) for a, b in np.round(np.degrees(np.column_stack([r.lat, r.lon])[k]) * 1e7)]
    msl = r.h[k] - UNDULATION
    stamps = us(r.t[k])
    out = {"PARM": [(0, name.encode(), value, 0.0) for name, value in PARAMETERS.items()]}
    out |= {"IMU": imu, "GPS": gps, "GPA": gpa, "MAG": mag, "BARO": baro}
    if simulated:
        out["SIM"] = [
            (t, *map(int, c), h, *p, 0.0, 0.0, 0.0, 0.0) for t, c, h, p in zip(stamps, cdeg, msl, place, strict=True)
        ]
        out["SIM2"] = [(t, 0.0, 0.0, 0.0, *v, 30.0) for t, v in zip(stamps, r.v_n[k], strict=True)]
    else:
        out["XKF1"] = [
            (t, 0, *map(int, c), *v, *[0.0] * 4, 0, 0, 0, 0) for t, c, v in zip(stamps, cdeg, r.v_n[k], strict=True)
        ]
        out["POS"] = [(t, *p, h, 0.0, 0.0) for t, p, h in zip(stamps, place, msl, strict=True)]
    return out


def _gps_seconds() -> float:
    """Seconds of the GPS week at t = 0: Tuesday noon, 18 s ahead of UTC."""
    return 2 * 86400.0 + 43200.0 + 18.0


def write_ardupilot(path: Path, messages: dict[str, list[tuple]]) -> Path:
    """The messages in the order of their times."""
    from pymavlink.DFReader import DFFormat, DFReader_binary

    form = DFFormat(0x80, "FMT", 89, "BBnNZ", "Type,Length,Name,Format,Columns")
    pack: Any = SimpleNamespace(formats={0x80: form})
    own = DFFormat(0x80, "FMT", 89, "BBnNZ", "Type,Length,Name,Format,Columns")
    content = [DFReader_binary.make_format_msgbuf(pack, own)]
    stamped = []
    for number, (name, rows) in enumerate(messages.items()):
        letters, columns = ARDUPILOT[name]
        kind = DFFormat(0x90 + number, name, 0, letters, columns)
        content.append(DFReader_binary.make_format_msgbuf(pack, kind))
        stamped += [(row[0], DFReader_binary.make_msgbuf(pack, kind, row)) for row in rows]
    stamped.sort(key=lambda item: item[0])
    path.write_bytes(b"".join([*content, *(message for _, message in stamped)]))
    return path


def enu_flu(q_nb: np.ndarray) -> np.ndarray:
    """Quaternions x, y, z, w of forward-left-up in east-north-up, by rotation matrices."""
    matrices = ENU_FROM_NED @ quats_to_matrices(q_nb) @ np.diag(FLIP)
    return Rotation.from_matrix(matrices).as_quat()


def local_enu(trajectory: Trajectory, rows: slice) -> np.ndarray:
    """Positions (N,3) of a flight in m, east-north-up from its start."""
    import pymap3d

    r = trajectory
    e, n, u = pymap3d.geodetic2enu(r.lat[rows], r.lon[rows], r.h[rows], r.lat[0], r.lon[0], r.h[0], deg=False)
    return np.column_stack([e, n, u])


def bag_messages(trajectory: Trajectory, log: SensorLog, turned: float = 0.0) -> list[tuple[str, str, float, dict]]:
    """Topic, type, time and content of each message; ``turned`` (rad) is how far the odometry's x axis is off east."""
    r, g, k = trajectory, log.gnss, slice(None, None, 4)
    out = [
        ("/imu/data", "sensor_msgs/msg/Imu", t, {"gyro": w * FLIP, "accel": f * FLIP})
        for t, w, f in zip(log.imu.t, log.imu.gyro, log.imu.accel, strict=True)
    ]
    out += [
        ("/fix", "sensor_msgs/msg/NavSatFix", t, {"place": (np.degrees(a), np.degrees(b), h), "status": 0})
        for t, a, b, h in zip(g.t, g.lat, g.lon, g.h, strict=True)
    ]
    out += [
        ("/imu/mag", "sensor_msgs/msg/MagneticField", t, {"field": 1e-6 * b * FLIP})
        for t, b in zip(log.mag.t, log.mag.field, strict=True)
    ]
    out += [
        ("/pressure", "sensor_msgs/msg/FluidPressure", t, {"pressure": p})
        for t, p in zip(log.baro.t, log.baro.pressure, strict=True)
    ]
    back = Rotation.from_euler("z", -turned)
    v_b = np.einsum("kji,kj->ki", quats_to_matrices(r.q_nb[k]), r.v_n[k]) * FLIP
    place = back.apply(local_enu(r, k)) + np.array([5.0, -7.0, 3.0])
    q = (back * Rotation.from_quat(enu_flu(r.q_nb[k]))).as_quat()
    out += [
        ("/odometry/filtered", "nav_msgs/msg/Odometry", t, {"place": p, "q": a, "v": v})
        for t, p, a, v in zip(r.t[k], place, q, v_b, strict=True)
    ]
    return sorted(out, key=lambda message: message[2])


def write_bag(path: Path, messages: list[tuple[str, str, float, dict]], kind: str, stamped: bool = True) -> Path:
    """``kind``: ros1 (a file), sqlite3 or mcap (folders)."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    if kind == "ros1":
        writer: Any = Writer1(path)
    else:
        writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3)
    with writer:
        connections: dict[str, Any] = {}
        for topic, name, t, content in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            ns = round((t + START.timestamp()) * 1e9)
            message = _message(store, name, ns if stamped else 0, content)
            serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
            writer.write(connections[topic], ns + 3_000_000, serialize(message, name))  # 3 ms until it is recorded
    return path


def _message(store: Any, name: str, ns: int, content: dict) -> Any:
    t = store.types
    time = t["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
    header: dict[str, Any] = {"stamp": time, "frame_id": ""}
    if "seq" in t["std_msgs/msg/Header"].__dataclass_fields__:
        header["seq"] = 0
    head = t["std_msgs/msg/Header"](**header)
    vector, point, quaternion = (t[f"geometry_msgs/msg/{kind}"] for kind in ("Vector3", "Point", "Quaternion"))
    unknown = np.zeros(9)
    if name.endswith("/Imu"):
        w, f = vector(*content["gyro"]), vector(*content["accel"])
        one = quaternion(0.0, 0.0, 0.0, 1.0)
        return t[name](head, one, unknown, w, unknown, f, unknown)
    if name.endswith("/NavSatFix"):
        status = t["sensor_msgs/msg/NavSatStatus"](status=content["status"], service=1)
        covariance = np.diag([1.5**2, 1.6**2, 2.5**2]).ravel()
        return t[name](head, status, *content["place"], covariance, content.get("known", 2))
    if name.endswith("/MagneticField"):
        return t[name](head, vector(*content["field"]), unknown)
    if name.endswith("/FluidPressure"):
        return t[name](head, content["pressure"], 0.0)
    pose = t["geometry_msgs/msg/Pose"](point(*content["place"]), quaternion(*content["q"]))
    twist = t["geometry_msgs/msg/Twist"](vector(*content["v"]), vector(0.0, 0.0, 0.0))
    pose = t["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
    twist = t["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36))
    return t[name](head, "base_link", pose, twist)


def table_of_imu(log: SensorLog, folder: Path, start: float) -> None:
    """imu.csv alone, its times counting from an epoch."""
    import pandas as pd

    from testbed.formats import export_log

    export_log(log, folder, "csv")
    for path in folder.iterdir():
        if path.name != "imu.csv":
            path.unlink()
    frame = pd.read_csv(folder / "imu.csv")
    frame["time_s"] += start
    frame.to_csv(folder / "imu.csv", index=False)


def nmea_sentences(log: SensorLog, sigmas: bool = True, date: bool = True) -> list[bytes]:
    """RMC, GGA and GST of each fix, to 1e-7 minutes, as receivers write them."""
    from pynmeagps import GET, NMEAMessage

    out = []
    for k, t in enumerate(log.gnss.t):
        g = log.gnss
        when = START + datetime.timedelta(seconds=float(t))
        place = {"lat": float(np.degrees(g.lat[k])), "lon": float(np.degrees(g.lon[k])), "NS": "N", "EW": "E"}
        speed, course = (
            np.hypot(*g.v_n[k, :2]) * 3600.0 / 1852.0,
            np.degrees(np.arctan2(g.v_n[k, 1], g.v_n[k, 0])) % 360.0,
        )
        moving = {"spd": round(float(speed), 4), "cog": round(float(course), 4), "status": "A", "posMode": "A"}
        day = {"date": when.date()} if date else {"date": ""}
        out.append(NMEAMessage("GN", "RMC", GET, time=when.time(), hpnmeamode=1, **place, **moving, **day))
        height = {"alt": round(float(g.h[k]) - UNDULATION, 3), "altUnit": "M", "sep": UNDULATION, "sepUnit": "M"}
        fix = {"quality": 1, "numSV": 9, "HDOP": 0.9}
        out.append(NMEAMessage("GN", "GGA", GET, time=when.time(), hpnmeamode=1, **place, **height, **fix))
        if sigmas:
            std = {"stdLat": 1.5, "stdLong": 1.6, "stdAlt": 2.5}
            out.append(NMEAMessage("GN", "GST", GET, time=when.time(), rangeRms=1.0, **std))
    return [message.serialize() for message in out]


def ubx_messages(log: SensorLog) -> list[bytes]:
    """A NAV-PVT of each fix, and a NAV-STATUS beside it, as receivers write them."""
    from pyubx2 import GET, UBXMessage

    out = []
    for k, t in enumerate(log.gnss.t):
        g = log.gnss
        ns = round(float(t) * 1e9)
        whole = START + datetime.timedelta(seconds=ns // 10**9)
        clock = {"year": whole.year, "month": whole.month, "day": whole.day, "hour": whole.hour, "min": whole.minute}
        clock |= {"second": whole.second, "nano": ns % 10**9, "validDate": 1, "validTime": 1, "fullyResolved": 1}
        place = {"lat": float(np.degrees(g.lat[k])), "lon": float(np.degrees(g.lon[k])), "height": round(g.h[k] * 1e3)}
        v = dict(zip(("velN", "velE", "velD"), (round(float(x) * 1e3) for x in g.v_n[k]), strict=True))
        accuracy = {"hAcc": 1500, "vAcc": 2500, "sAcc": 50, "hMSL": round((g.h[k] - UNDULATION) * 1e3)}
        fix = {"fixType": 3, "gnssFixOk": 1, "numSV": 14}
        out.append(UBXMessage("NAV", "NAV-PVT", GET, **clock, **place, **v, **accuracy, **fix).serialize())
        out.append(UBXMessage("NAV", "NAV-STATUS", GET, iTOW=1000 * k, gpsFix=3).serialize())
    return out


EUROC_IMU = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
EUROC_TRUTH = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1],"
    " v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1],"
    " b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)
TO_SENSOR = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
"""Forward-right-down to x up, y right, z forward."""


def write_euroc(folder: Path, trajectory: Trajectory, log: SensorLog, truth: bool = True) -> Path:
    """``mav0`` in ``folder``: the IMU along the axes of EuRoC's sensor, the ground truth in east-north-up."""
    start = int(START.timestamp()) * 10**9
    k, r = slice(None, None, 4), trajectory
    tables = {"imu0": (EUROC_IMU, log.imu.t, np.hstack([log.imu.gyro @ TO_SENSOR.T, log.imu.accel @ TO_SENSOR.T]))}
    if truth:
        q = Rotation.from_matrix(ENU_FROM_NED @ quats_to_matrices(r.q_nb[k]) @ TO_SENSOR.T).as_quat()[:, [3, 0, 1, 2]]
        values = np.hstack([local_enu(r, k), q, r.v_n[k] @ ENU_FROM_NED.T, np.zeros((len(q), 6))])
        tables["state_groundtruth_estimate0"] = (EUROC_TRUTH, r.t[k], values)
    for name, (head, t, values) in tables.items():
        place = folder / "mav0" / name
        place.mkdir(parents=True)
        rows = [
            ",".join([str(start + round(float(at) * 1e9)), *(repr(float(x)) for x in row)])
            for at, row in zip(t, values, strict=True)
        ]
        (place / "data.csv").write_text("\r\n".join([head, *rows]) + "\r\n")
    return folder


def write_kitti(folder: Path, trajectory: Trajectory, log: SensorLog) -> Path:
    """The ``oxts`` folder of a drive: the unit's solution is the flight, its inertial samples are those of the log."""
    place = folder / "oxts"
    (place / "data").mkdir(parents=True)
    r = trajectory
    rows = np.searchsorted(r.t, log.imu.t - 1e-6)
    euler = Rotation.from_quat(enu_flu(r.q_nb[rows])).as_euler("ZYX")[:, ::-1]  # roll, pitch, yaw
    yaw = quats_to_eulers(r.q_nb[rows])[:, 2]
    north, east, down = r.v_n[rows].T
    # forward and left lie parallel to the ground, up is perpendicular to it
    level = np.column_stack([north * np.cos(yaw) + east * np.sin(yaw), north * np.sin(yaw) - east * np.cos(yaw), -down])
    accel, gyro = log.imu.accel * FLIP, log.imu.gyro * FLIP
    lines = []
    for k, at in enumerate(log.imu.t):
        n = rows[k]
        values = [np.degrees(r.lat[n]), np.degrees(r.lon[n]), r.h[n], *euler[k], r.v_n[n, 0], r.v_n[n, 1], *level[k]]
        # forward, left, up are of the levelled vehicle; nothing reads them
        values += [*accel[k], 0.0, 0.0, 9.8, *gyro[k], 0.0, 0.0, 0.0, 0.05, 0.02]
        text = " ".join([*(repr(float(x)) for x in values), "4", "10", "4", "4", "0"])
        (place / "data" / f"{k:010d}.txt").write_text(text + "\n")
        when = START.replace(tzinfo=None) + datetime.timedelta(seconds=float(np.floor(at)))
        lines.append(f"{when:%Y-%m-%d %H:%M:%S}.{round((at - np.floor(at)) * 1e9):09d}")
    (place / "timestamps.txt").write_text("\n".join(lines) + "\n")
    return folder
