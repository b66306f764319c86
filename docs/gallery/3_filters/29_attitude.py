"""
Attitude filters
================

Gravity and magnetic field alone, on a quadrotor in gusts. Three turns of a circle, from 150 s on, accelerate it all the time,
which is the hardest that can happen to such a filter. ``ahrs-eskf`` takes the carrier for a hand unless it is told otherwise: at
0.5 m/s nothing can fly a circle, so it tilts; told the quadrotor's 6 m/s it holds.
"""

import matplotlib.pyplot as plt

import testbed

trajectory = testbed.fly("multirotor")
log, _ = testbed.sense("multirotor", trajectory, seed=0)
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(7.5, 4.5), layout="constrained")
rows = {
    "ahrs-kf": testbed.make_estimator("ahrs-kf"),
    "ahrs-eskf": testbed.make_estimator("ahrs-eskf"),
    "ahrs-eskf, 6 m/s": testbed.make_estimator("ahrs-eskf", velocity_mps=6.0),
}
for label, estimator in rows.items():
    errors = testbed.solution_errors(trajectory, estimator.run(log), log)
    for axis, column in zip(axes, ("roll_deg", "yaw_deg"), strict=True):
        axis.plot(errors["time_s"], errors[column], lw=0.7, label=label)
        axis.set_ylabel(column.replace("_deg", " error, °"))
axes[0].legend()
axes[-1].set_xlabel("time, s")
