"""Flights made of known phases (constant velocity, coordinated turn, speed change), and faults put into their logs.

Roll, speed and yaw are smooth functions of time; truth is the strapdown integral of their IMU means. SI units.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimators.core.strapdown import integrate
from testbed.data.records import Phase, SensorLog, Trajectory
from testbed.physics import earth
from testbed.physics.rotations import (
    eulers_to_quats,
    quat_conjugate,
    quat_multiply,
    quat_rotate_inverse,
    quat_to_rotvec,
)

LAT, LON, H = np.radians(45.0), np.radians(10.0), 1000.0
RAMP_S = 2.0
SCRIPT = (
    ("cv", 30.0, 0.0, 0.0),
    ("ct", 30.0, np.radians(25.0), 0.0),
    ("cv", 30.0, 0.0, 0.0),
    ("accelerated", 20.0, 0.0, 2.0),
    ("cv", 30.0, 0.0, 0.0),
    ("ct", 30.0, np.radians(-25.0), 0.0),
    ("accelerated", 20.0, 0.0, -2.0),
)
"""Phase (name of the motion model that describes it), length (s), bank (rad), acceleration along track (m/s²)."""


def phased_flight(script: tuple = SCRIPT, rate: float = 100.0, speed: float = 150.0) -> Trajectory:
    """Level flight through ``script``; bank and acceleration change within `RAMP_S` at the start of each phase."""
    ends = np.cumsum([row[1] for row in script])
    t = np.arange(round(ends[-1] * rate) + 1) / rate
    knots = np.concatenate([[(end - row[1]) + RAMP_S, end] for end, row in zip(ends, script, strict=True)])
    bank = np.interp(t, knots, np.repeat([row[2] for row in script], 2))
    push = np.interp(t, knots, np.repeat([row[3] for row in script], 2))
    along = speed + np.concatenate([[0.0], np.cumsum(0.5 * (push[1:] + push[:-1]) / rate)])
    gravity = earth.gravity(LAT, H)
    turn = gravity * np.tan(bank) / along
    yaw = 0.7 + np.concatenate([[0.0], np.cumsum(0.5 * (turn[1:] + turn[:-1]) / rate)])
    v_n = along[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(t))])
    q_nb = eulers_to_quats(np.column_stack([bank, np.zeros(len(t)), yaw]))
    gyro, accel = np.empty((len(t), 3)), np.empty((len(t), 3))
    for k in range(1, len(t)):
        rates = earth.transport_rate_n(LAT, H, *v_n[k, :2])
        ie = earth.earth_rate_n(LAT)
        turning = np.cross(2.0 * np.array(ie) + rates, v_n[k])
        frame = quat_rotate_inverse(q_nb[k], np.array(ie) + rates)
        gyro[k] = rate * np.array(quat_to_rotvec(quat_multiply(quat_conjugate(q_nb[k - 1]), q_nb[k]))) + frame
        specific = rate * (v_n[k] - v_n[k - 1]) + turning - [0.0, 0.0, gravity]
        middle = quat_to_middle(q_nb[k - 1], q_nb[k])
        accel[k] = quat_rotate_inverse(middle, specific)
    gyro[0], accel[0] = gyro[1], accel[1]
    lla, v, q = np.empty((len(t), 3)), np.empty((len(t), 3)), np.empty((len(t), 4))
    zero = np.zeros(3)
    integrate(0.0, t[1:], gyro[1:], accel[1:], LAT, LON, H, v_n[0], q_nb[0], zero, zero, lla[1:], v[1:], q[1:])
    lla[0], v[0], q[0] = (LAT, LON, H), v_n[0], q_nb[0]
    phases = tuple(Phase(row[0], end - row[1], end) for end, row in zip(ends, script, strict=True))
    return Trajectory(t, *lla.T, v, q, accel, gyro, phases=phases)


def quat_to_middle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion halfway between two close ones."""
    middle = a + b
    return middle / np.linalg.norm(middle)


def with_biases(log: SensorLog, accel: float, gyro: float, drift_share: float = 0.01) -> SensorLog:
    """The log of a filter that expects turn-on biases of these sigmas (m/s², rad/s) and in-run drift of a share of them."""
    spec = log.imu.spec
    accel_spec = replace(spec.accel, turn_on_bias=accel, bias_instability=drift_share * accel)
    gyro_spec = replace(spec.gyro, turn_on_bias=gyro, bias_instability=drift_share * gyro)
    std = log.initial.std.copy()
    std[9:12], std[12:15] = accel, gyro
    imu = replace(log.imu, spec=replace(spec, accel=accel_spec, gyro=gyro_spec))
    return replace(log, imu=imu, initial=replace(log.initial, std=std))


def with_accel_fault(log: SensorLog, start: float, end: float, size: float) -> SensorLog:
    """The accelerometer x axis reads ``size`` (m/s²) too much from ``start`` to ``end`` (s)."""
    accel = log.imu.accel.copy()
    accel[(log.imu.t > start) & (log.imu.t <= end), 0] += size
    return replace(log, imu=replace(log.imu, accel=accel))
