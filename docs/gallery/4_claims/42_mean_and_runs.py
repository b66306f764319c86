"""
How many runs
=============

The interval of a mean against the number of runs: it narrows with the root.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed
from testbed.scoring.statistics import describe

trajectory = testbed.fly("quickstart")
values = []
for run in range(24):
    log, _ = testbed.sense("quickstart", trajectory, run=run)
    errors = testbed.solution_errors(trajectory, testbed.make_estimator("update-ins").run(log), log)
    values.append(np.sqrt(np.mean(errors["north_m"] ** 2 + errors["east_m"] ** 2)))
counts = np.arange(3, len(values) + 1)
found = [describe(np.array(values[:n])[:, None]) for n in counts]
mean, low, high = (np.array([each[key][0] for each in found]) for key in ("mean", "ci_low", "ci_high"))
figure, axis = plt.subplots(figsize=(7.0, 3.2), layout="constrained")
axis.plot(counts, mean)
axis.fill_between(counts, low, high, alpha=0.2)
axis.set(xlabel="runs", ylabel="mean of the horizontal RMSE, m")
