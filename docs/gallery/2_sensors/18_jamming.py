"""
Jamming
=======

A jammer comes near and leaves: C/N0 falls, satellites are lost, and come back one by one.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

log, _ = testbed.sense("jamming", testbed.fly("jamming"), seed=1)
raw = log.gnss_raw
figure, (upper, lower) = plt.subplots(2, 1, sharex=True, figsize=(7.5, 4.5), layout="constrained")
for satellite in np.unique(raw.sv):
    rows = raw.sv == satellite
    upper.plot(raw.t[rows], raw.cn0[rows], ".", ms=2)
upper.set(ylabel="C/N0, dB-Hz")
counts, edges = np.histogram(raw.t, bins=np.arange(0.0, raw.t[-1], 1.0))
lower.stairs(counts / raw.spec.rate_hz, edges)
lower.set(xlabel="time, s", ylabel="satellites, mean of 1 s", ylim=(0, None))
