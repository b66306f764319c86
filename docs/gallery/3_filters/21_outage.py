"""
Ten seconds without GNSS
========================

Three estimators through an outage. ``update-ins`` starts from the filter's last state and runs free without its biases; the two
that coast on their biases agree.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

trajectory = testbed.fly("quickstart")
log, _ = testbed.sense("quickstart", trajectory, seed=0)
figure, axis = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
for name, dash in (("update-ins", "-"), ("indirect-kf", "-"), ("direct-ukf", "--")):
    errors = testbed.solution_errors(trajectory, testbed.make_estimator(name).run(log), log)
    axis.semilogy(errors["time_s"], np.hypot(errors["north_m"], errors["east_m"]), ls=dash, label=name)
axis.axvspan(*log.gnss.outages[0], color="0.9", zorder=0)
axis.set(xlabel="time, s", ylabel="horizontal error, m", xlim=(70, 105), ylim=(1e-2, None))
axis.legend()
