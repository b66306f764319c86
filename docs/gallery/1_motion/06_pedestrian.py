"""
A walk
======

Every step bounces a unit at the waist; its rhythm is in the specific force.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.signal import welch

import testbed

trajectory = testbed.fly("pedestrian")
frequency, power = welch(trajectory.f_b, fs=1.0 / trajectory.dt, nperseg=2048, axis=0)
figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
axis.loglog(frequency[1:], np.sqrt(power[1:]), label=["forward", "right", "down"])
axis.axvline(1.9, color="0.6", ls=":")
axis.text(2.0, 1e-6, "steps", color="0.4")
axis.set(xlabel="frequency, Hz", ylabel="specific force, m/s²/√Hz", xlim=(0.05, 20))
axis.legend()
