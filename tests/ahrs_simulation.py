"""A log whose linear accelerations and magnetic disturbances are what the 12-state model of `ahrs-kf` says they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimators.methods.ahrs_kf import AhrsKf
from testbed.data.records import ImuSamples, InitialState, MagSamples, SensorLog
from testbed.data.specs import ImuSpec, MagSpec, TriadSpec
from testbed.physics.earth import gravity
from testbed.physics.rotations import quat_conjugate, quat_multiply, quat_normalize, quat_to_matrix, rotvec_to_quat

RATE_HZ = 50.0
FIELD_N = (27.0, 2.0, 40.0)
LATITUDE, HEIGHT = 0.62, 1000.0


class Simulated(NamedTuple):
    """The log, the true attitude (N,4) at its samples, and the filter whose assumptions it meets."""

    log: SensorLog
    q_nb: np.ndarray
    estimator: AhrsKf


def simulate(seed: int, duration_s: float = 60.0, still: bool = False, noise: float = 1.0) -> Simulated:
    """Swing the body about all axes (or not at all), with errors drawn from the filter's model; ``noise`` 0 has none."""
    rng = np.random.default_rng(seed)
    dt, n = 1.0 / RATE_HZ, round(duration_s * RATE_HZ)
    gyro_spec = TriadSpec(white_noise=np.radians(0.05), rate_random_walk=np.radians(2.5e-4), correlation_time_s=1e9)
    imu_spec = ImuSpec("simulated", RATE_HZ, gyro_spec, TriadSpec(white_noise=5e-4))
    mag_spec = MagSpec(
        "simulated", RATE_HZ, noise_sigma=0.05, declination=float(np.arctan2(FIELD_N[1], FIELD_N[0])), field_n=FIELD_N
    )
    estimator = AhrsKf(
        linear_accel_mps2=1.0,
        linear_accel_time_s=2.0,
        mag_disturbance_ut=0.5,
        mag_disturbance_time_s=500.0,
        gyro_noise_scale=1.0,
        gyro_bias_scale=1.0,
        accel_noise_scale=1.0,
        mag_noise_scale=1.0,
        gyro_scale=0.0,
        accel_noise_mps2=0.0,
        field_noise_ut=0.0,
    )
    std = np.concatenate(
        [np.full(6, 1e-3), np.radians([1.0, 1.0, 3.0]), np.full(3, 1e-6), np.full(3, np.radians(0.02))]
    )
    q, bias = np.array([1.0, 0.0, 0.0, 0.0]), std[12] * noise * rng.standard_normal(3)
    start = quat_multiply(rotvec_to_quat(std[6:9] * noise * rng.standard_normal(3)), q)
    initial = InitialState(0.0, LATITUDE, 0.9, HEIGHT, np.zeros(3), np.array(start), np.zeros(3), np.zeros(3), std)
    t = np.arange(1, n + 1) * dt
    empty = SensorLog(
        ImuSamples(t, np.zeros((n, 3)), np.zeros((n, 3)), imu_spec),
        initial,
        mag=MagSamples(t, np.zeros((n, 3)), mag_spec),
    )
    noises = estimator.figures(empty)
    accel, disturbance = noise * rng.standard_normal(3), 0.5 * noise * rng.standard_normal(3)
    gyro, force, field, truth = (np.empty((n, w)) for w in (3, 3, 3, 4))
    down = np.array([0.0, 0.0, gravity(LATITUDE, HEIGHT)])
    for k in range(n):
        rate = np.zeros(3) if still else np.array([0.2 * np.sin(0.3 * t[k]), 0.1 * np.cos(0.2 * t[k]), 0.15])
        q = np.array(quat_normalize(quat_multiply(q, rotvec_to_quat(rate * dt))))
        draws = noise * rng.standard_normal((6, 3))
        bias = bias + np.sqrt(noises.bias_variance) * draws[0]
        accel = noises.accel_decay * accel + np.sqrt(noises.accel_growth) * draws[1]
        disturbance = noises.mag_decay * disturbance + np.sqrt(noises.mag_growth) * draws[2]
        c_nb = np.array(quat_to_matrix(q))
        truth[k] = q
        gyro[k] = rate + bias + np.sqrt(noises.gyro_variance) * draws[3]
        force[k] = accel - c_nb.T @ down + np.sqrt(noises.accel_variance) * draws[4]
        field[k] = c_nb.T @ FIELD_N + disturbance + np.sqrt(noises.mag_variance) * draws[5]
    log = SensorLog(ImuSamples(t, gyro, force, imu_spec), initial, mag=MagSamples(t, field, mag_spec))
    return Simulated(log, truth, estimator)


def body_errors(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(N,3) correction in b that the estimate lacks, rad."""
    from testbed.physics.rotations import quat_to_rotvec

    return np.array([quat_to_rotvec(quat_multiply(quat_conjugate(a), b)) for a, b in zip(estimate, truth, strict=True)])
