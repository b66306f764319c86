"""
Hard iron
=========

Where a level vehicle turns, a magnetometer's horizontal components lie on a circle; the vehicle's own field moves its centre.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

magnetometer = {"model": "ADIS16405", "turn_on_bias_mgauss": 50.0, "rate_hz": 10.0}
scenario = testbed.load_scenario(
    "rover", overrides={f"sensors.mag.{key}": value for key, value in magnetometer.items()}
)
log, _ = testbed.sense(scenario, testbed.fly(scenario), seed=2)
forward, right = log.mag.field[:, 0], log.mag.field[:, 1]
design = np.column_stack([2.0 * forward, 2.0 * right, np.ones(len(forward))])
x, y, _ = np.linalg.lstsq(design, forward**2 + right**2, rcond=None)[0]  # the circle that fits best
figure, axis = plt.subplots(figsize=(5.0, 4.5), layout="constrained")
axis.plot(forward, right, ".", ms=3)
axis.plot(0.0, 0.0, "k+", ms=12, label="no field")
axis.plot(x, y, "C3x", ms=9, label="centre of the circle")
axis.set(xlabel="field forward, µT", ylabel="field right, µT", aspect="equal", ylim=(-28.0, 34.0))
axis.legend(loc="upper center", ncols=2)
