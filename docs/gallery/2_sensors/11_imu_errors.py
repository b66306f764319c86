"""
Errors of an IMU
================

Samples minus truth: white noise around a bias that was drawn at turn-on and wanders.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

trajectory = testbed.fly("quickstart")
log, drawn = testbed.sense("quickstart", trajectory, seed=0)
true = np.column_stack([np.interp(log.imu.t, trajectory.t, axis) for axis in trajectory.w_ib_b.T])
error = np.degrees(log.imu.gyro - true)
figure, axes = plt.subplots(3, 1, sharex=True, figsize=(7.5, 5.0), layout="constrained")
for k, axis in enumerate(axes):
    axis.plot(log.imu.t, error[:, k], lw=0.3, color="0.6", label="error of the samples")
    axis.plot(drawn.t, np.degrees(drawn.gyro_bias[:, k]), color="C3", label="bias")
    axis.set_ylabel(f"gyro {'xyz'[k]}, °/s")
axes[0].legend(loc="upper right")
axes[-1].set_xlabel("time, s")
