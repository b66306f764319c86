"""INSLIB's 15-state filter on a log, in a process of its own: ``python inslib_process.py LOG.npz``.

Prints, as JSON, the microseconds per IMU sample (least of three passes) of its C code called through its Python binding, and
the final velocity. The bench shares no process with it: INSLIB's licence is the AGPL.
"""

import json
import sys
import time

import numpy as np
from INSLIB import Config, Ins


def run(log):
    """One pass over the log."""
    config = Config(auto_init=False, auto_zupt_disable=True, gnss_init_dwell_disable=True, gnss_stop_disable=True)
    config.rpy_init_rad, config.init_vel_ned = tuple(log["rpy"]), tuple(log["v_n"][0])
    config.gnss_min_delay_ms = -1
    filter_ = Ins(config)
    t_us = np.round(1e6 * log["t"]).astype(int).tolist()
    dt = np.diff(log["t"], prepend=log["t_start"]).tolist()
    gyro, accel, lla, v_n = (log[name].tolist() for name in ("gyro", "accel", "lla", "v_n"))
    due = np.searchsorted(log["t"], log["t_fix"] - 1e-6).tolist()
    # the library takes spectral densities, whatever the word "variance" in its interface
    imu_density = [(float(x),) * 3 for x in (log["accel_density"], log["gyro_density"])]
    fix_variance, velocity_variance = (float(log["fix_variance"]),) * 3, (float(log["velocity_variance"]),) * 3
    fix = 0
    start = time.perf_counter()
    for k, now in enumerate(t_us):
        filter_.imu(now, dt[k], accel[k], gyro[k], *imu_density)
        if fix < len(due) and k == due[fix]:
            filter_.gnss_pos_llh(lla[fix], fix_variance)
            filter_.gnss_vel(v_n[fix], velocity_variance)
            fix += 1
        filter_.update()
    return (time.perf_counter() - start) / len(t_us), filter_.velocity_ned()


if __name__ == "__main__":
    arrays = dict(np.load(sys.argv[1]))
    passes = [run(arrays) for _ in range(3)]
    print(json.dumps({"us_per_sample": 1e6 * min(seconds for seconds, _ in passes), "v_n": passes[-1][1]}))
