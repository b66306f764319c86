"""
Outliers and policies
=====================

Eight bursts of a second, each wrong by thirty metres, as multipath is. A policy says what happens at an update: nothing, a gate, robust weights.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

outliers = {"count": 8, "duration_s": 1.0, "offset_m": 30.0}
scenario = testbed.load_scenario("quickstart", overrides={"sensors.gnss.outliers": outliers})
trajectory = testbed.fly(scenario)
log, _ = testbed.sense(scenario, trajectory, seed=0)
figure, axis = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
for policy in ("plain", "gate", "huber", "igg-iii"):
    solution = testbed.make_estimator("eskf", policy=policy).run(log)
    errors = testbed.solution_errors(trajectory, solution, log)
    axis.semilogy(errors["time_s"], np.hypot(errors["north_m"], errors["east_m"]), lw=0.8, label=policy)
axis.set(xlabel="time, s", ylabel="horizontal error, m", ylim=(1e-2, None))
axis.legend(ncols=4)
