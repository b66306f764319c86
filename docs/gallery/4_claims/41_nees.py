"""
NEES over time
==============

Normalised error squared of a consistent filter, mean over runs, within the bounds that a chi-square distribution allows.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2

import testbed
from testbed.scoring.error_series import truth_at

RUNS = 12
trajectory = testbed.fly("quickstart")
nees = []
for run in range(RUNS):
    log, _ = testbed.sense("quickstart", trajectory, run=run)
    solution = testbed.make_estimator("indirect-kf").run(log)
    rows = np.searchsorted(solution.t, solution.covariance_t)
    error = solution.v_n[rows] - truth_at(trajectory, solution.t[rows])[3]
    nees.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(solution.covariance[:, 3:6, 3:6]), error))
figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
axis.plot(solution.covariance_t, np.mean(nees, axis=0))
for bound in chi2.ppf((0.025, 0.975), 3 * RUNS) / RUNS:
    axis.axhline(bound, color="0.5", ls=":")
axis.set(xlabel="time, s", ylabel=f"NEES of the velocity, mean of {RUNS} runs", ylim=(0, 8))
