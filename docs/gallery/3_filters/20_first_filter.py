"""
A filter and its own sigma
==========================

Errors of a Kalman filter beside three times the sigma that it states, in one call. The grey bar is the GNSS outage.
"""

import testbed

trajectory = testbed.fly("quickstart")
log, errors = testbed.sense("quickstart", trajectory, seed=0)
solution = testbed.make_estimator("indirect-kf").run(log)
testbed.plot_errors(trajectory, solution, log)
