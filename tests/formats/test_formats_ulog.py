"""PX4 logs: a synthetic flight written message by message after the ULog format comes back in the bench's units."""

from __future__ import annotations

from pathlib import Path

import formats_flight
import numpy as np
import pytest
import ulog_writer

from testbed.base.errors import InputError
from testbed.data.records import SensorLog, Trajectory
from testbed.data.registry import make_estimator
from testbed.formats import import_log
from testbed.scoring.metrics import error_series

pytest.importorskip("pyulog")

FLOAT = 2.0**-23
"""Relative rounding of the log's single precision."""


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return formats_flight.make_trajectory(60.0)


@pytest.fixture(scope="module")
def log(trajectory: Trajectory) -> SensorLog:
    return formats_flight.make_log(trajectory)


def write(path: Path, topics: dict, parameters: dict[str, float] | None = None) -> Path:
    ulog_writer.write(
        path, topics, parameters or {"EKF2_GPS_POS_X": 0.3, "EKF2_GPS_POS_Z": -0.1, "EKF2_GPS_DELAY": 20.0}
    )
    return path


@pytest.mark.parametrize(("imu", "gps"), [("sensor_combined", "sensor_gps"), ("vehicle_imu", "vehicle_gps_position")])
def test_topics_old_and_new_come_back(
    imu: str, gps: str, trajectory: Trajectory, log: SensorLog, tmp_path: Path
) -> None:
    read = import_log("ulog", write(tmp_path / "flight.ulg", formats_flight.ulog_topics(trajectory, log, imu, gps)))
    start = log.gnss.t[0]  # time counts from the first fix, which is also on the IMU grid here
    n = len(read.log.imu.t)
    assert np.abs(read.log.imu.t + start - log.imu.t[-n:]).max() < 1e-6
    assert np.abs(read.log.imu.accel - log.imu.accel[-n:]).max() < 20.0 * 2.0 * FLOAT
    assert np.abs(read.log.imu.gyro - log.imu.gyro[-n:]).max() < 2.0 * FLOAT
    m = len(read.log.gnss.t)
    assert m == len(log.gnss.t) - 1
    resolution = np.radians(1e-7) if gps == "vehicle_gps_position" else 1e-15
    assert np.abs(read.log.gnss.lat - log.gnss.lat[-m:]).max() <= resolution
    assert np.abs(read.log.gnss.h - log.gnss.h[-m:]).max() <= 1e-3
    assert np.abs(read.log.mag.field - log.mag.field[-len(read.log.mag.t) :]).max() < 100.0 * FLOAT
    assert np.abs(read.log.baro.pressure - log.baro.pressure[-len(read.log.baro.t) :]).max() < 1e5 * FLOAT
    assert read.log.gnss.spec.lever_arm_b == pytest.approx((0.3, 0.0, -0.1))
    assert read.log.gnss.spec.latency_s == pytest.approx(0.02)
    r = read.reference
    k = np.searchsorted(trajectory.t, r.t + start - 1e-6)
    assert np.abs(r.h - trajectory.h[k]).max() < 600.0 * FLOAT + 1e-3
    assert np.abs(r.v_n - trajectory.v_n[k]).max() < 30.0 * (0.12 * 0.01) ** 2 + 1e-4


def test_indirect_kf_runs_on_a_log(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """From levelling and course, the filter's errors after 20 s are below the noise of a single fix (1.5 m, 2.5 m)."""
    path = write(
        tmp_path / "flight.ulg",
        formats_flight.ulog_topics(trajectory, log),
        {"EKF2_GPS_POS_X": 0.3, "EKF2_GPS_POS_Z": -0.1},
    )
    read = import_log("ulog", path)
    errors = error_series(read.reference, make_estimator("indirect-kf").run(read.log))
    rmse = np.sqrt(np.mean(errors.values[errors.t > 20.0] ** 2, axis=0))
    assert (rmse[:3] < (1.5, 1.5, 2.5)).all()
    assert (rmse[3:6] < 0.1).all()
    assert (rmse[6:8] < 0.5).all()


def test_reference_from_local_position_alone(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """PX4's projection is that of a sphere; undone, 60 s of flight lie within a metre of the global position."""
    topics = formats_flight.ulog_topics(trajectory, log)
    world = topics.pop("vehicle_global_position")
    lat0, lon0 = 47.0, 8.5
    c1, dlon = np.radians(world["lat"]), np.radians(world["lon"] - lon0)
    c0 = np.radians(lat0)
    c = np.arccos(np.clip(np.sin(c0) * np.sin(c1) + np.cos(c0) * np.cos(c1) * np.cos(dlon), -1.0, 1.0))
    k = np.where(c < 1e-12, 1.0, c / np.sin(np.maximum(c, 1e-12))) * 6371000.0
    x = k * (np.cos(c0) * np.sin(c1) - np.sin(c0) * np.cos(c1) * np.cos(dlon))
    y = k * np.cos(c1) * np.sin(dlon)
    origin = {"ref_lat": lat0, "ref_lon": lon0, "ref_alt": 453.0, "xy_global": 1, "z_global": 1}
    topics["vehicle_local_position"] |= {"x": x, "y": y, "z": 453.0 - world["alt"]} | origin
    read = import_log("ulog", write(tmp_path / "flight.ulg", topics))
    k = np.searchsorted(trajectory.t, read.reference.t + log.gnss.t[0] - 1e-6)
    north = (read.reference.lat - trajectory.lat[k]) * 6.37e6
    assert np.abs(north).max() < 0.05
    assert np.abs(read.reference.h - trajectory.h[k]).max() < 0.05


def test_integrals_with_gaps_yield_to_the_complete_topic(
    trajectory: Trajectory, log: SensorLog, tmp_path: Path
) -> None:
    """vehicle_imu logged at a fifth of its rate covers a fifth of the time, so sensor_combined is used."""
    topics = formats_flight.ulog_topics(trajectory, log)
    sparse = formats_flight.ulog_topics(trajectory, log, "vehicle_imu")["vehicle_imu"]
    topics["vehicle_imu"] = {key: values[::5] for key, values in sparse.items()}
    read = import_log("ulog", write(tmp_path / "flight.ulg", topics))
    assert read.log.imu.spec.rate_hz == pytest.approx(100.0)


def test_old_barometer_in_mbar(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    topics = formats_flight.ulog_topics(trajectory, log)
    air = topics.pop("vehicle_air_data")
    topics["sensor_baro"] = {"timestamp": air["timestamp"], "pressure": air["baro_pressure_pa"] / 100.0}
    read = import_log("ulog", write(tmp_path / "flight.ulg", topics))
    assert read.log.baro.pressure == pytest.approx(log.baro.pressure[-len(read.log.baro.t) :], rel=1e-6)


def _without(topics: dict, name: str) -> dict:
    return {key: value for key, value in topics.items() if key != name}


def _nan(topics: dict) -> dict:
    topics["sensor_combined"]["gyro_rad"] = topics["sensor_combined"]["gyro_rad"].copy()
    topics["sensor_combined"]["gyro_rad"][1234, 1] = np.nan
    return topics


def _no_fix(topics: dict) -> dict:
    topics["sensor_gps"]["fix_type"] = 1
    return topics


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: _without(t, "sensor_combined"), ["neither of the IMU topics", "vehicle_imu"]),
        (lambda t: _without(t, "sensor_gps"), ["neither of the GNSS topics"]),
        (_nan, ["sensor_combined.gyro_rad", "sample 1234", "finite"]),
        (_no_fix, ["sensor_gps", "no three-dimensional fixes"]),
    ],
)
def test_unusable_logs_are_refused(
    change, words: list[str], trajectory: Trajectory, log: SensorLog, tmp_path: Path
) -> None:
    path = write(tmp_path / "flight.ulg", change(formats_flight.ulog_topics(trajectory, log)))
    with pytest.raises(InputError) as caught:
        import_log("ulog", path)
    assert all(word in str(caught.value) for word in ["flight.ulg", *words]), str(caught.value)


def test_truncated_and_corrupt_logs_are_refused(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    path = write(tmp_path / "flight.ulg", formats_flight.ulog_topics(trajectory, log))
    content = path.read_bytes()
    for damaged in (
        content[:-20],
        content[: len(content) // 2 + 1],
        content[:9],
        b"",
        b"PK\x03\x04" + content[4:],
        content[:9000] + bytes(400) + content[9400:],
    ):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"flight\.ulg"):
            import_log("ulog", path)
    path.write_bytes(content[: len(content) // 2 + 1])
    half = import_log("ulog", path, allow_truncated=True)
    assert 0.4 < half.log.imu.t[-1] / (trajectory.t[-1] - log.gnss.t[0]) < 0.6
