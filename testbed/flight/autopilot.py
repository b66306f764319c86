"""From an aircraft's autopilot settings to the array of gains that the autopilot's kernel indexes.

Angles of the file in degrees become radians; limits of the aircraft stand beside the gains.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.flight import autopilot_kernels as kernels
from testbed.flight.aircraft import Aircraft


def gain_array(aircraft: Aircraft, period: float) -> NDArray[np.float64]:
    """Gains and limits where the kernel looks for them; ``period`` is the time between ticks (s)."""
    a, limit = aircraft.autopilot, aircraft.limits
    out = np.zeros(kernels.GAINS)
    out[kernels.SPEED_NOMINAL] = a.speed_nominal_mps
    out[kernels.ROLL_ANGLE] = a.roll_angle
    out[kernels.ROLL_RATE] = a.roll_rate
    out[kernels.ROLL_RATE_INTEGRAL] = a.roll_rate_integral
    out[kernels.ROLL_RATE_FEEDFORWARD] = a.roll_rate_feedforward
    out[kernels.ROLL_RATE_LIMIT] = np.radians(a.roll_rate_limit_dps)
    out[kernels.PITCH_RATE] = a.pitch_rate
    out[kernels.PITCH_RATE_INTEGRAL] = a.pitch_rate_integral
    out[kernels.LOAD_FEEDFORWARD] = a.load_feedforward
    out[kernels.SIDESLIP] = a.sideslip
    out[kernels.YAW_RATE] = a.yaw_rate
    out[kernels.YAW_FEEDFORWARD] = a.yaw_feedforward
    out[kernels.HEADING_GAIN] = a.heading
    out[kernels.ALTITUDE_GAIN] = a.altitude
    out[kernels.CLIMB_GAIN] = a.climb
    out[kernels.CLIMB_INTEGRAL_GAIN] = a.climb_integral
    out[kernels.CLIMB_LIMIT] = limit.climb_max_mps
    out[kernels.CLIMB_ACCELERATION] = a.climb_acceleration_mps2
    out[kernels.SPEED_GAIN] = a.speed
    out[kernels.SPEED_INTEGRAL] = a.speed_integral
    out[kernels.THRUST_TO_WEIGHT] = a.thrust_to_weight
    out[kernels.THROTTLE_TRIM] = a.throttle_trim
    out[kernels.LOAD_FACTOR_MAX] = limit.load_factor_max
    out[kernels.LOAD_FACTOR_MIN] = limit.load_factor_min
    out[kernels.PERIOD] = period
    out[kernels.ALPHA_MAX] = np.radians(limit.alpha_max_deg)
    if (ground := aircraft.ground) is not None:
        out[kernels.PITCH_ANGLE_GAIN] = ground.pitch_angle
        out[kernels.PITCH_RATE_LIMIT] = np.radians(ground.pitch_rate_limit_dps)
        out[kernels.STEER_HEADING] = ground.steer_heading
        out[kernels.STEER_RATE] = ground.steer_rate
        out[kernels.STEER_FULL] = ground.steer_full_mps
    return out
