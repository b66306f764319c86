"""
The same script in calm and in rough air
========================================

``overrides`` changes single keys of a scenario, as ``--set`` does on the command line.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
bins = np.linspace(-20.0, -2.0, 120)
for turbulence in ("none", "light", "moderate"):
    scenario = testbed.load_scenario("quickstart", overrides={"flight.wind.turbulence": turbulence})
    trajectory = testbed.fly(scenario)
    axis.hist(trajectory.f_b[:, 2], bins=bins, histtype="step", density=True, label=turbulence)
axis.set(xlabel="specific force down, m/s²", ylabel="density", yscale="log")
axis.legend(title="turbulence")
