"""
Box plots over seeds
====================

``run`` does it all over many seeds and keeps every run's metrics; ``summary`` has means with their intervals.
"""

import tempfile

import matplotlib.pyplot as plt

import testbed

result = testbed.run(testbed.load_scenario("quickstart"), tempfile.mkdtemp(), runs=8, jobs=1)
rows = result.metrics.query("metric == 'rmse_position_3d_m' and window == 'all' and estimator != 'ins'")
groups = {name: group["value"].to_numpy() for name, group in rows.groupby("estimator", sort=False)}
figure, axis = plt.subplots(figsize=(7.0, 3.0), layout="constrained")
axis.boxplot(list(groups.values()), tick_labels=list(groups), orientation="horizontal")
axis.set(xlabel="RMSE of the 3-D position, m", xscale="log")
print(result.claims[["text", "measured_pct", "ci_low", "ci_high", "verdict"]].to_string(index=False))
