"""
Correlations
============

What a filter knows at the end of a flight, as correlations between its states: tilt and accelerometer bias go together.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

log, _ = testbed.sense("quickstart", testbed.fly("quickstart"), seed=0)
solution = testbed.make_estimator("eskf").run(log)
sigma = np.sqrt(np.diag(solution.covariance[-1]))
names = [name.rpartition("_")[0].replace("_", " ") for name in solution.states]
figure, axis = plt.subplots(figsize=(6.5, 5.5), layout="constrained")
image = axis.imshow(solution.covariance[-1] / np.outer(sigma, sigma), cmap="RdBu_r", vmin=-1.0, vmax=1.0)
axis.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
axis.set_yticks(range(len(names)), names, fontsize=7)
figure.colorbar(image, label="correlation")
