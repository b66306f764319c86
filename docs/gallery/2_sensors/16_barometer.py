"""
Height of a barometer
=====================

Pressure through the standard atmosphere, beside the receiver's height and the truth.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed
from testbed.physics.atmosphere import isa_height

scenario = testbed.load_scenario("quickstart", overrides={"sensors.baro.model": "ADIS16448"})
trajectory = testbed.fly(scenario)
log, _ = testbed.sense(scenario, trajectory, seed=0)
figure, axis = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
for name, t, height in (("GNSS", log.gnss.t, log.gnss.h), ("barometer", log.baro.t, isa_height(log.baro.pressure))):
    axis.plot(t, height - np.interp(t, trajectory.t, trajectory.h), ".", ms=2, label=name)
axis.set(xlabel="time, s", ylabel="height minus truth, m")
axis.legend()
