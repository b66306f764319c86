"""
An estimator of one's own
=========================

A class with a ``name`` and ``run(log)``. This one carries the last fix on at its velocity: a row to beat.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed
from testbed import NavSolution


class GnssHold:
    name = "gnss-hold"

    def run(self, log):
        t, fixes = log.imu.t, log.gnss
        last = np.clip(np.searchsorted(fixes.t, t, side="right") - 1, 0, None)
        north, east, down = (t - fixes.t[last]) * fixes.v_n[last].T
        lat = fixes.lat[last] + north / 6.37e6
        lon = fixes.lon[last] + east / (6.37e6 * np.cos(lat))
        q_nb = np.tile(log.initial.q_nb, (len(t), 1))
        return NavSolution(
            t, lat, lon, fixes.h[last] - down, fixes.v_n[last], q_nb, states=testbed.data.records.POSITION_STATES
        )


trajectory = testbed.fly("quickstart")
log, _ = testbed.sense("quickstart", trajectory, seed=0)
figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
for estimator in (GnssHold(), testbed.make_estimator("indirect-kf")):
    errors = testbed.solution_errors(trajectory, estimator.run(log), log)
    axis.plot(errors["time_s"], errors["north_m"], lw=0.8, label=estimator.name)
axis.set(xlabel="time, s", ylabel="North error, m", ylim=(-15, 15))
axis.legend()
