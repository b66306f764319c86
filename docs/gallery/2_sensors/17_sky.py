"""
Satellites over a street
========================

GNSS down to the satellites: between walls, those near the horizon are lost.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

trajectory = testbed.fly("city-partial")
log, _ = testbed.sense("city-partial", trajectory, seed=1)
raw = log.gnss_raw
figure, axes = plt.subplots(1, 2, figsize=(7.5, 4.0), subplot_kw={"projection": "polar"}, layout="constrained")
for axis, (title, first, last) in zip(axes, (("open", 0.0, 60.0), ("street", 60.0, 150.0)), strict=True):
    rows = (raw.t >= first) & (raw.t < last)
    dots = axis.scatter(
        raw.azimuth[rows], 90.0 - np.degrees(raw.elevation[rows]), c=raw.cn0[rows], s=45, vmin=25, vmax=50
    )
    axis.set_theta_zero_location("N")
    axis.set_theta_direction(-1)
    axis.set(rlim=(0, 90), title=title)
figure.colorbar(dots, ax=axes, label="C/N0, dB-Hz", shrink=0.7)
