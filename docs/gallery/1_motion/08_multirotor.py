"""
A quadrotor
===========

Take-off, hover, waypoints, circles and landing, with the speed of the motors.
"""

import matplotlib.pyplot as plt

import testbed

trajectory = testbed.fly("multirotor")
figure, (upper, lower) = plt.subplots(2, 1, sharex=True, figsize=(7.5, 4.5), layout="constrained")
upper.plot(trajectory.t, trajectory.h - trajectory.h[0])
upper.set(ylabel="height, m")
lower.plot(trajectory.t[::10], trajectory.extra["engine_rpm"][::10], lw=0.5)
lower.set(xlabel="time, s", ylabel="motor speed, rpm")
