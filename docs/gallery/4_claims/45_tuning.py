"""
The valley of a tuning
======================

Error against a factor on the noise that drives the biases. Below the data sheet's value, 1, the valley is flat, as biases hardly
wander in two minutes; fifty times more of it costs. The grey lines are single runs.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

trajectory = testbed.fly("quickstart")
logs = [testbed.sense("quickstart", trajectory, run=run)[0] for run in range(4)]
factors = np.logspace(-2, 2, 13)
cost = []
for factor in factors:
    estimator = testbed.make_estimator("indirect-kf", gyro_bias_scale=factor, accel_bias_scale=factor)
    tables = [testbed.solution_errors(trajectory, estimator.run(log), log) for log in logs]
    cost.append([np.sqrt(np.mean(table["roll_deg"] ** 2)) for table in tables])
figure, axis = plt.subplots(figsize=(7.0, 3.2), layout="constrained")
axis.semilogx(factors, cost, color="0.75")
axis.semilogx(factors, np.mean(cost, axis=1), "o-")
axis.set(xlabel="factor on the noise that drives the biases", ylabel="roll RMSE, °")
