"""
Filter and smoother
===================

Given the whole log, an outage is bridged from both ends.
"""

import matplotlib.pyplot as plt

import testbed

trajectory = testbed.fly("quickstart")
log, _ = testbed.sense("quickstart", trajectory, seed=0)
figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
for label, smooth in (("filter", False), ("smoother", True)):
    errors = testbed.solution_errors(trajectory, testbed.make_estimator("eskf", smooth=smooth).run(log), log)
    (line,) = axis.plot(errors["time_s"], errors["east_m"], label=label)
    sigma = 3.0 * errors["sigma_east_m"]
    axis.fill_between(errors["time_s"], -sigma, sigma, color=line.get_color(), alpha=0.15)
axis.set(xlabel="time, s", ylabel="East error, m", xlim=(70, 100), ylim=(-2, 2))
axis.legend()
