"""
A unit of one's own
===================

Figures of a data sheet in its own units make an entry of the catalogue. Half an hour at rest must give them back.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from testbed.sensors import static_log
from testbed.sensors.allan import allan_deviation, pooled

file = Path(tempfile.mkdtemp()) / "sensors.toml"
file.write_text("""[imu.mine]
source = "data sheet, typical figures"
rate_hz = 100.0
gyro_arw_dpsqrth = 0.3              # °/√h
gyro_bias_instability_dph = 8.0
gyro_correlation_time_s = 100.0
""")
log = static_log("mine", rate_hz=100.0, duration_s=1800.0, seed=1, file=str(file))
curve = pooled([allan_deviation(axis, 100.0) for axis in log.imu.gyro.T])
figure, axis = plt.subplots(figsize=(7.0, 4.0), layout="constrained")
axis.loglog(curve.tau, np.degrees(curve.deviation) * 3600.0, label="three axes pooled")
axis.loglog(curve.tau, 0.3 * 60.0 / np.sqrt(curve.tau), "k:", label="0.3 °/√h of the data sheet")
axis.set(xlabel="cluster time, s", ylabel="Allan deviation, °/h")
axis.legend()
