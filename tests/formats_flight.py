"""A short flight in closed form for the tests of the formats: a climbing turn, and what sensors record on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from testbed.data.records import (
    BaroSamples,
    GnssFixes,
    ImuSamples,
    InitialState,
    MagSamples,
    Phase,
    SensorLog,
    Trajectory,
)
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec, TriadSpec
from testbed.physics import earth
from testbed.physics.rotations import eulers_to_quats, quats_to_matrices

GNSS = GnssSpec(
    "test gnss", 5.0, horizontal_sigma=1.5, vertical_sigma=2.5, velocity_sigma=0.05, lever_arm_b=(0.3, 0.0, -0.1)
)
IMU = ImuSpec(
    "test imu",
    100.0,
    TriadSpec(
        turn_on_bias=1e-3, bias_instability=3e-5, correlation_time_s=300.0, white_noise=2e-4, rate_random_walk=1e-6
    ),
    TriadSpec(turn_on_bias=0.03, bias_instability=1e-3, correlation_time_s=150.0, white_noise=1e-3, range=176.0),
)
FIELD_N = np.array([21.0, 1.5, 44.0])


def make_trajectory(duration: float = 40.0, rate: float = 100.0, speed: float = 30.0, turn: float = 0.12) -> Trajectory:
    """Constant speed, turn rate (rad/s) and climb of 1 m/s from 47° N 8.5° E; bank is that of a coordinated turn."""
    fine = 10
    t = np.arange(int(duration * rate) * fine + 1) / (rate * fine)
    yaw = 0.4 + turn * t
    v_n = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw), np.full_like(t, -1.0)])
    h = 500.0 + t
    lat, lon = np.full_like(t, np.radians(47.0)), np.full_like(t, np.radians(8.5))
    for _ in range(6):
        dlat, dlon, _ = earth.position_rates(lat, h, v_n[:, 0], v_n[:, 1], v_n[:, 2])
        lat = np.radians(47.0) + _integral(dlat, t)
        lon = np.radians(8.5) + _integral(dlon, t)
    roll = np.full_like(t, np.arctan(speed * turn / 9.81))
    q_nb = eulers_to_quats(np.column_stack([roll, np.full_like(t, 0.05), (yaw + np.pi) % (2 * np.pi) - np.pi]))
    s = slice(None, None, fine)
    f_b, w_ib_b = _imu_means(t, lat, h, v_n, q_nb, turn, fine)
    phases = (Phase("turn", 0.0, duration),)
    return Trajectory(
        t[s],
        lat[s],
        lon[s],
        h[s],
        v_n[s],
        q_nb[s],
        f_b,
        w_ib_b,
        {"airspeed_mps": np.full(len(t[s]), speed)},
        phases,
        "turn",
    )


def make_log(trajectory: Trajectory, noise: float = 1.0, seed: int = 1) -> SensorLog:
    """GNSS at 5 Hz with white noise, magnetometer and barometer at 10 Hz, and the exact IMU."""
    rng = np.random.default_rng(seed)
    r, g = trajectory, slice(20, None, 20)
    c = quats_to_matrices(r.q_nb)
    n = len(r.t[g])
    sigma = noise * np.array([1.5, 1.5, 2.5])
    lever = c[g] @ np.array(GNSS.lever_arm_b) + rng.standard_normal((n, 3)) * sigma
    per_lat, per_lon = earth.metres_per_radian(r.lat[g], r.h[g])
    v_n = r.v_n[g] + noise * 0.05 * rng.standard_normal((n, 3))
    gnss = GnssFixes(
        r.t[g],
        r.lat[g] + lever[:, 0] / per_lat,
        r.lon[g] + lever[:, 1] / per_lon,
        r.h[g] - lever[:, 2],
        v_n,
        GNSS,
        ((12.0, 14.0),),
    )
    gnss = replace(gnss, std=np.tile([1.5, 1.5, 2.5, 0.05, 0.05, 0.05], (n, 1)))
    m = slice(5, None, 10)
    mag = MagSamples(
        r.t[m],
        np.einsum("kji,j->ki", c[m], FIELD_N),
        MagSpec("test mag", 10.0, noise_sigma=0.3, declination=np.arctan2(1.5, 21.0)),
    )
    baro = BaroSamples(
        r.t[m], 101325.0 * (1.0 - 2.25577e-5 * r.h[m]) ** 5.25588, BaroSpec("test baro", 10.0, noise_sigma=3.0)
    )
    std = np.array([2.0, 2.0, 3.0, 0.1, 0.1, 0.1, 0.01, 0.01, 0.03, 0.03, 0.03, 0.03, 1e-3, 1e-3, 1e-3])
    initial = InitialState(0.0, r.lat[0], r.lon[0], r.h[0], r.v_n[0], r.q_nb[0], np.zeros(3), np.full(3, 1e-4), std)
    return SensorLog(ImuSamples(r.t[1:], r.w_ib_b[1:], r.f_b[1:], IMU), initial, gnss, mag, baro, "turn")


def _imu_means(t, lat, h, v_n, q_nb, turn, fine) -> tuple[np.ndarray, np.ndarray]:
    """Means over ``fine`` intervals (trapezoidal) of specific force and rate of a turn about the vertical, (N,3) each.

    By definition, in n: f = dv/dt + (2 w_ie + w_en) x v - g, w_ib = w_nb + w_ie + w_en; with a level turn rate about down
    w_nb = (0, 0, turn) and dv/dt = w_nb x v.
    """
    w_ie, w_en = (np.column_stack(w) for w in (earth.earth_rate_n(lat), _transport(lat, h, v_n)))
    w_nb = np.array([0.0, 0.0, turn])
    g = np.column_stack([0.0 * h, 0.0 * h, earth.gravity(lat, h)])
    f_n = np.cross(w_nb, v_n) + np.cross(2.0 * w_ie + w_en, v_n) - g
    c = quats_to_matrices(q_nb)
    means = []
    for in_n in (f_n, w_nb + w_ie + w_en):
        in_b = np.einsum("kji,kj->ki", c, in_n)
        steps = 0.5 * (in_b[1:] + in_b[:-1])
        mean = steps.reshape(-1, fine, 3).mean(axis=1)
        means.append(np.vstack([mean[:1], mean]))
    return means[0], means[1]


def _transport(lat, h, v_n) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return earth.transport_rate_n(lat, h, v_n[:, 0], v_n[:, 1])


def _integral(rate: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(0.5 * np.diff(t) * (rate[1:] + rate[:-1]))])


def swinging_turns(log: SensorLog) -> SensorLog:
    """Level flight at 30 m/s whose turn rate swings by ±0.12 rad/s in 7 s, banked as it must be; the rest as in ``log``.

    In closed form, flat and without the Earth's rate, which at 15 °/h is nothing beside 7 °/s.
    """
    t, fixes = log.imu.t, log.gnss.t
    rng = np.random.default_rng(3)

    def yaw(at: np.ndarray) -> np.ndarray:
        return 0.12 * 7.0 / (2.0 * np.pi) * (1.0 - np.cos(2.0 * np.pi * at / 7.0))

    rate = 0.12 * np.sin(2.0 * np.pi * t / 7.0)
    bank = np.arctan(30.0 * rate / 9.81)
    roll_rate = np.gradient(bank, t)
    gyro = np.column_stack([roll_rate, rate * np.sin(bank), rate * np.cos(bank)])
    accel = np.column_stack([0.0 * t, 0.0 * t, -9.81 / np.cos(bank)])
    v_n = np.column_stack([30.0 * np.cos(yaw(fixes)), 30.0 * np.sin(yaw(fixes)), 0.0 * fixes])
    fine = np.arange(0.0, t[-1] + 0.01, 0.01)
    north, east = (_integral(30.0 * f(yaw(fine)), fine) for f in (np.cos, np.sin))
    per_lat, per_lon = earth.metres_per_radian(np.radians(47.0), 500.0)
    lat = np.radians(47.0) + np.interp(fixes, fine, north) / per_lat
    lon = np.radians(8.5) + np.interp(fixes, fine, east) / per_lon
    v_n = v_n + 0.05 * rng.standard_normal(v_n.shape)
    gnss = replace(log.gnss, lat=lat, lon=lon, h=np.full(len(lat), 500.0), v_n=v_n, outages=())
    return SensorLog(replace(log.imu, gyro=gyro, accel=accel), log.initial, gnss, name="swinging")


def ulog_topics(trajectory: Trajectory, log: SensorLog, imu: str = "sensor_combined", gps: str = "sensor_gps") -> dict:
    """The log as PX4 topics, 10 s after boot; altitudes above mean sea level are 47 m less than above the ellipsoid."""

    def us(t: np.ndarray) -> np.ndarray:
        return np.round(t * 1e6).astype("u8") + 10_000_000

    r, g, k = trajectory, log.gnss, slice(None, None, 2)
    dt_us = np.round(np.diff(np.concatenate([[log.initial.t], log.imu.t])) * 1e6)
    topics: dict = {}
    if imu == "sensor_combined":
        rates = {"gyro_rad": log.imu.gyro, "accelerometer_m_s2": log.imu.accel}
        topics[imu] = {
            "timestamp": us(log.imu.t),
            "gyro_integral_dt": dt_us,
            "accelerometer_integral_dt": dt_us,
        } | rates
    else:
        seconds = dt_us[:, None] * 1e-6
        increments = {"delta_angle": log.imu.gyro * seconds, "delta_velocity": log.imu.accel * seconds}
        stamps = {"timestamp": us(log.imu.t) + 300, "timestamp_sample": us(log.imu.t)}
        topics[imu] = stamps | {"delta_angle_dt": dt_us, "delta_velocity_dt": dt_us} | increments
    velocity = {f"vel_{a}_m_s": g.v_n[:, i] for i, a in enumerate("ned")}
    quality = {"eph": 1.5, "epv": 2.5, "s_variance_m_s": 0.1, "fix_type": 3, "vel_ned_valid": 1}
    lat, lon = np.degrees(g.lat), np.degrees(g.lon)
    if gps == "sensor_gps":
        place = {"latitude_deg": lat, "longitude_deg": lon, "altitude_msl_m": g.h - 47.0, "altitude_ellipsoid_m": g.h}
    else:
        place = {
            "lat": np.round(lat * 1e7),
            "lon": np.round(lon * 1e7),
            "alt": np.round((g.h - 47.0) * 1e3),
            "alt_ellipsoid": np.round(g.h * 1e3),
        }
    topics[gps] = {"timestamp": us(g.t)} | velocity | quality | place
    topics["vehicle_magnetometer"] = {"timestamp": us(log.mag.t), "magnetometer_ga": log.mag.field / 100.0}
    topics["vehicle_air_data"] = {"timestamp": us(log.baro.t), "baro_pressure_pa": log.baro.pressure}
    topics["vehicle_attitude"] = {"timestamp": us(r.t[k]), "q": r.q_nb[k]}
    world = {"lat": np.degrees(r.lat[k]), "lon": np.degrees(r.lon[k]), "alt": r.h[k] - 47.0}
    topics["vehicle_global_position"] = {"timestamp": us(r.t[k])} | world
    topics["vehicle_local_position"] = {"timestamp": us(r.t[k])} | {f"v{a}": r.v_n[k, i] for i, a in enumerate("xyz")}
    return topics
