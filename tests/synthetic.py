"""Analytic flights and logs for tests that need motion but no flight model.

A smooth manoeuvre (weaving turns, climbs, speed changes) gives IMU means; truth is their strapdown integral. SI units.
"""

from __future__ import annotations

import numpy as np

from estimators.core.strapdown import integrate
from testbed.data.records import GnssFixes, ImuSamples, InitialState, SensorLog, Trajectory
from testbed.data.specs import GnssSpec, ImuSpec, TriadSpec
from testbed.physics import earth
from testbed.physics.rotations import (
    eulers_to_quats,
    quat_conjugate,
    quat_multiply,
    quat_rotate_inverse,
    quat_to_rotvec,
    rotvec_to_quat,
)

LAT, LON, H = np.radians(35.0), np.radians(51.0), 1500.0


def weaving_flight(duration: float = 150.0, rate: float = 100.0, speed: float = 150.0, bank: float = 1.0) -> Trajectory:
    """Coordinated S-turns of amplitude ``bank`` (rad) with climbs and speed changes at about ``speed`` (m/s)."""
    t = np.arange(int(duration * rate) + 1) / rate
    roll = bank * np.sin(2.0 * np.pi * t / 40.0)
    pitch = 0.1 * np.sin(2.0 * np.pi * t / 25.0)
    along = speed * (1.0 + 0.1 * np.sin(2.0 * np.pi * t / 60.0))
    yaw = 0.7 + np.concatenate([[0.0], np.cumsum(9.81 * np.tan(0.5 * (roll[1:] + roll[:-1])) / speed / rate)])
    v_n = along[:, None] * np.column_stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])
    q_nb = eulers_to_quats(np.column_stack([roll, pitch, yaw]))
    gyro, accel = np.empty((len(t), 3)), np.empty((len(t), 3))
    gravity = np.array([0.0, 0.0, earth.gravity(LAT, H)])
    for k in range(1, len(t)):
        gyro[k] = rate * np.array(quat_to_rotvec(quat_multiply(quat_conjugate(q_nb[k - 1]), q_nb[k])))
        accel[k] = quat_rotate_inverse(q_nb[k], rate * (v_n[k] - v_n[k - 1]) - gravity)
    gyro[0], accel[0] = gyro[1], accel[1]
    lla, v, q = np.empty((len(t), 3)), np.empty((len(t), 3)), np.empty((len(t), 4))
    zero = np.zeros(3)
    integrate(0.0, t[1:], gyro[1:], accel[1:], LAT, LON, H, v_n[0], q_nb[0], zero, zero, lla[1:], v[1:], q[1:])
    lla[0], v[0], q[0] = (LAT, LON, H), v_n[0], q_nb[0]
    return Trajectory(t, *lla.T, v, q, accel, gyro)


def sensor_log(
    truth: Trajectory,
    seed: int = 0,
    outages: tuple[tuple[float, float], ...] = (),
    gyro_bias: float = 0.0,
    accel_noise: float = 0.02,
    gyro_noise: float = 2e-4,
    std: tuple[float, float, float] = (10.0, 0.2, 0.001),
    gnss_rate: float = 10.0,
    position_sigma: float = 10.0,
    velocity_sigma: float = 0.2,
) -> SensorLog:
    """White IMU noise (per sample), a bias on the three gyros (rad/s) that the filter is not told, white GNSS.

    The same seed gives the same draws whatever the outages. The initial state is drawn around truth with ``std``: position (m), velocity (m/s) and attitude (rad) per axis.
    """
    rng = np.random.default_rng(seed)
    n, root = len(truth.t) - 1, np.sqrt(1.0 / truth.dt)
    spec = ImuSpec(
        "test", 1.0 / truth.dt, TriadSpec(white_noise=gyro_noise / root), TriadSpec(white_noise=accel_noise / root)
    )
    gyro = truth.w_ib_b[1:] + gyro_bias + gyro_noise * rng.standard_normal((n, 3))
    accel = truth.f_b[1:] + accel_noise * rng.standard_normal((n, 3))
    rows = np.arange(0, n + 1, round(1.0 / gnss_rate / truth.dt))[1:]
    noise, noise_v = (
        position_sigma * rng.standard_normal((len(rows), 3)),
        velocity_sigma * rng.standard_normal((len(rows), 3)),
    )
    seen = np.ones(len(rows), dtype=bool)
    for start, end in outages:
        seen &= (truth.t[rows] < start) | (truth.t[rows] > end)
    rows, noise, noise_v = rows[seen], noise[seen], noise_v[seen]
    north, east = earth.metres_per_radian(truth.lat[rows], truth.h[rows])
    gnss = GnssFixes(
        truth.t[rows],
        truth.lat[rows] + noise[:, 0] / north,
        truth.lon[rows] + noise[:, 1] / east,
        truth.h[rows] - noise[:, 2],
        truth.v_n[rows] + noise_v,
        GnssSpec("test", gnss_rate, position_sigma, position_sigma, velocity_sigma=velocity_sigma),
        outages,
    )
    deviation = np.repeat(std, 3)
    draw = deviation * rng.standard_normal(9)
    q = quat_multiply(rotvec_to_quat(draw[6:9]), truth.q_nb[0])
    north, east = earth.metres_per_radian(truth.lat[0], truth.h[0])
    initial = InitialState(
        float(truth.t[0]),
        truth.lat[0] + draw[0] / north,
        truth.lon[0] + draw[1] / east,
        truth.h[0] - draw[2],
        truth.v_n[0] + draw[3:6],
        np.array(q),
        np.zeros(3),
        np.zeros(3),
        np.concatenate([deviation, np.zeros(6)]),
    )
    return SensorLog(ImuSamples(truth.t[1:], gyro, accel, spec), initial, gnss)
