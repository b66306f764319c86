"""Flights for tightly coupled filters: S-turns of 30 degrees at 35 m/s, with a partial outage of the satellites."""

from __future__ import annotations

from functools import cache

import numpy as np
from synthetic import weaving_flight

from testbed.base.schema import validate
from testbed.physics import earth
from testbed.sensors import sense_flight
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SensorsConfig

WHITE = ["orbit_clock", "iono", "tropo", "multipath"]
INITIAL = {"position_m": 5.0, "velocity_mps": 0.2, "roll_pitch_deg": 0.5, "yaw_deg": 1.0}
GYROS_KNOWN = INITIAL | {"gyro_bias_dps": 0.05}
"""After a calibration on the ground. From a gyro bias of half a degree a second, which nothing has told a filter yet, attitude
errors grow to ten degrees within seconds, and their squares, which no covariance has, add a tenth to its NEES for 20 s."""
CALIBRATED = ["scale_factor", "misalignment", "nonlinearity", "g_sensitivity", "bandwidth", "quantisation"]
"""What a filter with biases alone has no state for; a delay of a millisecond in the IMU is 3 cm on the way."""
FAST_LOOP = {"dll_bandwidth_hz": 5.0, "cn0_zenith_dbhz": 54.0}
"""A code loop whose noise is forgotten from one epoch to the next, with the signal that keeps it as large as before."""


@cache
def flight(duration_s):
    return weaving_flight(duration_s, 100.0, 35.0, 0.52)


def record(run, duration_s=150.0, keep=None, window=(90.0, 150.0), white=True, initial=INITIAL, **gnss):
    """Log, truth and drawn errors of a run; ``keep`` satellites stay in the ``window``."""
    satellites = {"sky_seed": run} | ({"disable": WHITE} if white else {}) | gnss.pop("satellites", {})
    if keep is not None:
        satellites["keep"] = [{"start_s": window[0], "end_s": window[1], "highest": keep}]
    table = {
        "imu": {"model": "ADIS16448", "disable": CALIBRATED},
        "gnss": {"model": "module-class", "mode": "satellites", "satellites": satellites}
        | (FAST_LOOP if white else {})
        | gnss,
    }
    sensors = validate(SensorsConfig, table, "s")
    truth = flight(duration_s)
    log, errors = sense_flight(sensors, validate(InitialConfig, initial, "i"), truth, 1, run)
    return log, truth, errors


def errors_of(solution, truth):
    """(N,3) m north, east, down."""
    k = np.searchsorted(truth.t, solution.t - 1e-6)
    there = truth.lat[k], truth.lon[k], truth.h[k]
    return np.column_stack(earth.position_difference(solution.lat, solution.lon, solution.h, *there))
