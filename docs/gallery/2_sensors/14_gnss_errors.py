"""
Errors of GNSS receivers
========================

A receiver without a model of its own has errors that last, as receivers do; a white error is the friendlier assumption of
many papers.
"""

import matplotlib.pyplot as plt

import testbed
from testbed.physics.earth import metres_per_radian
from testbed.physics.interpolate import state_at

trajectory = testbed.fly("quickstart")
figure, axes = plt.subplots(1, 2, figsize=(7.5, 3.8), sharex=True, sharey=True, layout="constrained")
for axis, model in zip(axes, ("module-class", "Garmin16x"), strict=True):
    changes = {"sensors.gnss.model": model, "sensors.gnss.outages": []}
    log, _ = testbed.sense(testbed.load_scenario("quickstart", overrides=changes), trajectory, seed=3)
    lat, lon, height, *_ = state_at(trajectory, log.gnss.t)
    per_north, per_east = metres_per_radian(lat[0], height[0])
    axis.plot((log.gnss.lon - lon) * per_east, (log.gnss.lat - lat) * per_north, ".-", ms=3, lw=0.3)
    axis.set(title=model, xlabel="East error, m", aspect="equal")
axes[0].set_ylabel("North error, m")
