"""python-ins as a peer where it fails by itself: across the date line and over a gap of the IMU."""

from __future__ import annotations

from dataclasses import replace

import formats_flight
import numpy as np
import pytest

from testbed.data.records import NavSolution, SensorLog
from testbed.data.registry import make_estimator

pytest.importorskip("pyins")


def moved(log: SensorLog, east: float) -> SensorLog:
    """The same log, ``east`` rad further east."""
    lon = (log.gnss.lon + east + np.pi) % (2 * np.pi) - np.pi
    initial = (log.initial.lon + east + np.pi) % (2 * np.pi) - np.pi
    return replace_log(log, initial=replace(log.initial, lon=initial), gnss=replace(log.gnss, lon=lon))


def replace_log(log: SensorLog, **changes) -> SensorLog:
    return SensorLog(**({"imu": log.imu, "initial": log.initial, "gnss": log.gnss, "name": log.name} | changes))


def run(log: SensorLog) -> NavSolution:
    return make_estimator("pyins").run(log)


def test_the_date_line_changes_nothing() -> None:
    """Gravity and the Earth's rate do not depend on the longitude: the track is the same, shifted, to rounding (1e-9 rad is 6 mm)."""
    log = formats_flight.make_log(formats_flight.make_trajectory(20.0))
    shift = np.pi - log.gnss.lon[len(log.gnss.t) // 2]  # the flight crosses it half-way
    here, there = run(log), run(moved(log, shift))
    assert np.ptp(there.lon) > 6.0
    back = (there.lon - shift - here.lon + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(back).max() < 1e-9
    assert np.abs(there.lat - here.lat).max() < 1e-9


def test_a_gap_of_the_imu_is_bridged() -> None:
    """Half a second without samples in an even turn: the mean across it is that of the turn, and costs less than a fix's noise."""
    trajectory = formats_flight.make_trajectory(30.0)
    log = formats_flight.make_log(trajectory)
    keep = (log.imu.t < 15.0) | (log.imu.t > 15.5)
    imu = replace(log.imu, t=log.imu.t[keep], gyro=log.imu.gyro[keep], accel=log.imu.accel[keep])
    whole, gappy = run(log), run(replace_log(log, imu=imu))
    assert np.array_equal(gappy.t, imu.t)
    k = np.searchsorted(whole.t, gappy.t - 1e-9)
    assert np.abs(gappy.lat - whole.lat[k]).max() * 6.37e6 < 0.5
    assert np.abs(gappy.v_n - whole.v_n[k]).max() < 0.2
