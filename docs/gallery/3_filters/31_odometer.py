"""
What an odometer is worth
=========================

A minute without GNSS on a rover, with and without the speed of its wheel.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

trajectory = testbed.fly("rover")
log, _ = testbed.sense("rover", trajectory, seed=0)
figure, axis = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
rows = {
    "gnss": {},
    "gnss and odometer": {"aiding": ("gnss", "odometer"), "states": ("accel-bias", "gyro-bias", "odometer-scale")},
}
for label, params in rows.items():
    errors = testbed.solution_errors(trajectory, testbed.make_estimator("eskf", **params).run(log), log)
    axis.semilogy(errors["time_s"], np.hypot(errors["north_m"], errors["east_m"]), label=label)
axis.axvspan(*log.gnss.outages[0], color="0.93", zorder=0)
axis.set(xlabel="time, s", ylabel="horizontal error, m", xlim=(180, 280))
axis.legend()
