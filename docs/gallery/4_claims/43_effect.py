"""
A claim, measured
=================

By how many per cent is one method better? Runs are paired by seed, and the interval decides.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed
from testbed.scoring.effects import effect

names = ("update-ins", "indirect-kf", "direct-ekf")
trajectory = testbed.fly("quickstart")
rmse = {name: [] for name in names}
for run in range(16):
    log, _ = testbed.sense("quickstart", trajectory, run=run)
    for name in names:
        errors = testbed.solution_errors(trajectory, testbed.make_estimator(name).run(log), log)
        rmse[name].append(np.sqrt(np.mean(errors["roll_deg"] ** 2)))
figure, axis = plt.subplots(figsize=(7.0, 2.4), layout="constrained")
pairs = [("indirect-kf", "update-ins"), ("direct-ekf", "indirect-kf")]
for row, (better, than) in enumerate(pairs):
    found = effect(np.array(rmse[better]), np.array(rmse[than]), seed=1)
    axis.plot([found.low, found.high], [row, row], lw=4, solid_capstyle="butt")
    axis.plot(found.percent, row, "ko")
axis.axvline(0.0, color="0.5", ls=":")
axis.set_yticks(range(len(pairs)), [f"{a} against {b}" for a, b in pairs])
axis.set(xlabel="improvement of the roll RMSE, %", ylim=(-0.6, 1.6))
