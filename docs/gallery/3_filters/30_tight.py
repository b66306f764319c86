"""
Loosely and tightly coupled
===========================

Steep turns hide satellites. The receiver's fixes get worse or stop; a filter that takes the ranges goes on with those that are
left. Root mean square over four runs.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

trajectory = testbed.fly("bank-and-lose")
logs = [testbed.sense("bank-and-lose", trajectory, run=run)[0] for run in range(4)]
figure, axis = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
for label, name in (("loose", "indirect-kf"), ("tight", "tight-kf")):
    tables = [testbed.solution_errors(trajectory, testbed.make_estimator(name).run(log), log) for log in logs]
    squares = np.mean([table["north_m"] ** 2 + table["east_m"] ** 2 for table in tables], axis=0)
    axis.plot(tables[0]["time_s"], np.sqrt(squares), label=label)
for phase in trajectory.phases:
    if phase.name == "turn":
        axis.axvspan(phase.start, phase.end, color="0.93", zorder=0)
axis.set(xlabel="time, s (grey: steep turns)", ylabel="horizontal error, m", ylim=(0, None))
axis.legend()
