"""
Allan deviation of three units
==============================

An hour at rest: noise falls with the root of the cluster time, and the bias' instability is the floor.
"""

import matplotlib.pyplot as plt
import numpy as np

from testbed.sensors import static_log
from testbed.sensors.allan import allan_deviation

figure, axis = plt.subplots(figsize=(7.0, 4.0), layout="constrained")
for model in ("ADIS16405", "ADIS16448", "ADIS16488"):
    log = static_log(model, rate_hz=50.0, duration_s=3600.0, seed=1)
    curve = allan_deviation(log.imu.gyro[:, 0], 50.0)
    axis.loglog(curve.tau, np.degrees(curve.deviation) * 3600.0, label=model)
axis.set(xlabel="cluster time, s", ylabel="Allan deviation of gyro x, °/h")
axis.grid(which="both", alpha=0.3)
axis.legend()
