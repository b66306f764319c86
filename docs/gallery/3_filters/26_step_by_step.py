"""
Step by step
============

The compiled filter, led by hand: look at its state and covariance between steps, or change them.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

log, _ = testbed.sense("quickstart", testbed.fly("quickstart"), seed=0)
filter_ = testbed.make_estimator("eskf").start(log)
times, sigmas = [], []
for k in range(len(log.imu.t)):
    while (waiting := filter_.predict(k)) is not None:
        filter_.update(*waiting)
    if k % 20 == 0:
        times.append(log.imu.t[k])
        sigmas.append(np.sqrt(np.diag(filter_.P)[12:15]))
figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
axis.semilogy(times, np.degrees(sigmas) * 3600.0, label=["x", "y", "z"])
axis.set(xlabel="time, s", ylabel="sigma of the gyro bias, °/h")
axis.legend()
