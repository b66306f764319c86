"""
Attitude filters
================

Gravity and magnetic field alone, on a quadrotor in gusts. Three turns of a circle, from 150 s on, accelerate it all the time,
which is the hardest that can happen to such a filter.
"""

import matplotlib.pyplot as plt

import testbed

trajectory = testbed.fly("multirotor")
log, _ = testbed.sense("multirotor", trajectory, seed=0)
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7.5, 4.5), layout="constrained")
for name in ("ahrs-kf", "ahrs-eskf"):
    errors = testbed.solution_errors(trajectory, testbed.make_estimator(name).run(log), log)
    for axis, column in zip(axes, ("roll_deg", "yaw_deg"), strict=True):
        axis.plot(errors["time_s"], errors[column], lw=0.7, label=name)
        axis.set_ylabel(column.replace("_deg", " error, °"))
axes[0].legend()
axes[-1].set_xlabel("time, s")
