"""The state in which a filter starts: truth plus the alignment errors of the scenario, and their standard deviations.

Attitude errors are rotation vectors in n (rad): ``roll_pitch_deg`` about north and east, ``yaw_deg`` about down. Biases
are as `testbed.data.records` defines them: measured = true + bias.
"""

from __future__ import annotations

import math

import numpy as np

from testbed.data.records import Array, InitialState, Trajectory
from testbed.data.specs import ImuSpec, TriadSpec
from testbed.physics.earth import G0, metres_per_radian
from testbed.physics.interpolate import point_state
from testbed.physics.rotations import quat_multiply, rotvec_to_quat
from testbed.sensors.config import InitialConfig
from testbed.sensors.draws import Draws

SMALLEST_STD = np.repeat([1e-4, 1e-5, 1e-7, 1e-8, 1e-10], 3)
"""Of perfect knowledge (m, m/s, rad, m/s², rad/s): a covariance must not be singular."""


def draw_initial(
    config: InitialConfig, trajectory: Trajectory, imu: ImuSpec, true_bias: dict[str, Array], draws: Draws
) -> InitialState:
    """Mean drawn around the state of the IMU at the start. ``true_bias`` is that of ``gyro`` and ``accel`` at the start."""
    q_true = trajectory.q_nb[0]
    lat, lon, h, v_n = point_state(trajectory, trajectory.t[:1], np.array(imu.lever_arm_b))
    std = np.maximum(_std(config, imu), SMALLEST_STD)
    error = np.zeros(15) if config.perfect else _std(config, imu) * draws.alignment("initial").standard_normal(15)
    north, east = metres_per_radian(lat[0], h[0])
    known_accel = config.perfect or config.accel_bias_mg is not None
    known_gyro = config.perfect or config.gyro_bias_dps is not None
    return InitialState(
        t=float(trajectory.t[0]),
        lat=float(lat[0] + error[0] / north),
        lon=float(lon[0] + error[1] / east),
        h=float(h[0] - error[2]),
        v_n=v_n[0] + error[3:6],
        q_nb=np.array(quat_multiply(rotvec_to_quat(error[6:9]), q_true)),
        accel_bias=true_bias["accel"] + error[9:12] if known_accel else np.zeros(3),
        gyro_bias=true_bias["gyro"] + error[12:15] if known_gyro else np.zeros(3),
        std=std,
    )


def _std(config: InitialConfig, imu: ImuSpec) -> Array:
    if config.perfect:
        return np.zeros(15)
    tilt, yaw = math.radians(config.roll_pitch_deg), math.radians(config.yaw_deg)
    accel = _bias_std(imu.accel) if config.accel_bias_mg is None else config.accel_bias_mg * 1e-3 * G0
    gyro = _bias_std(imu.gyro) if config.gyro_bias_dps is None else math.radians(config.gyro_bias_dps)
    groups = [config.position_m] * 3 + [config.velocity_mps] * 3 + [tilt, tilt, yaw] + [accel] * 3 + [gyro] * 3
    return np.array(groups)


def _bias_std(spec: TriadSpec) -> float:
    return math.hypot(spec.turn_on_bias, spec.gauss_markov_sigma())
