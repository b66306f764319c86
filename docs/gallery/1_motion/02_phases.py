"""
Manoeuvres and load factor
==========================

A trajectory knows which manoeuvre was flown when. Here: the load factor, with a band for each manoeuvre.
"""

import matplotlib.pyplot as plt

import testbed
from testbed.physics.earth import G0

trajectory = testbed.fly("quickstart")
figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
axis.plot(trajectory.t, -trajectory.f_b[:, 2] / G0, lw=0.7)
for number, phase in enumerate(trajectory.phases):
    axis.axvspan(phase.start, phase.end, color="0.9" if number % 2 else "0.97", zorder=0)
    axis.text(
        0.5 * (phase.start + phase.end),
        2.25,
        phase.name.replace("_", " "),
        ha="center",
        va="top",
        rotation=90,
        fontsize=8,
    )
axis.set(xlabel="time, s", ylabel="load factor, g", xlim=(0, trajectory.t[-1]), ylim=(0.4, 2.3))
