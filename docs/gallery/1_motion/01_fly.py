"""
A flight
========

A scenario is flown by JSBSim. The trajectory is the truth that every estimator is scored against: time, place, velocity and
attitude, and the exact mean angular rate and specific force of every IMU interval.
"""

import testbed

trajectory = testbed.fly("quickstart")
print(trajectory)

# %%
# Every record draws itself.

trajectory.plot()
