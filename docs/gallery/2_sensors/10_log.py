"""
What a filter may know
======================

``sense`` records a flight. The log holds samples and specifications, and no truth; what was drawn beside it is for scoring.
"""

import testbed

trajectory = testbed.fly("quickstart")
log, errors = testbed.sense("quickstart", trajectory, seed=0)
print(log)

# %%
# The break in the fixes is the outage of this scenario.

log.plot()
