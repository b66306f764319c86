"""
A rover that turns on the spot
==============================

Motion scripts drive what JSBSim does not fly. The odometer counts the pulses of a wheel that slips on gravel.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

trajectory = testbed.fly("rover")
log, _ = testbed.sense("rover", trajectory, seed=0)
figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
axis.plot(log.odometer.t, log.odometer.speed, lw=0.6, label="odometer")
axis.plot(trajectory.t, np.linalg.norm(trajectory.v_n, axis=1), label="over ground")
axis.set(xlabel="time, s", ylabel="speed, m/s", xlim=(0, 130))
axis.legend()
