"""
A mission of a ground station
=============================

A plan of QGroundControl with legs, loiters and changes of speed, flown by the small UAV.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed
from testbed.physics.earth import metres_per_radian

trajectory = testbed.fly("field-mission")
per_north, per_east = metres_per_radian(trajectory.lat[0], trajectory.h[0])
north = (trajectory.lat - trajectory.lat[0]) * per_north
east = (trajectory.lon - trajectory.lon[0]) * per_east
figure, axis = plt.subplots(figsize=(6.0, 5.0), layout="constrained")
dots = axis.scatter(east[::20], north[::20], c=np.linalg.norm(trajectory.v_n, axis=1)[::20], s=4)
axis.set(xlabel="East, m", ylabel="North, m", aspect="equal")
figure.colorbar(dots, label="speed over ground, m/s")
