"""
A sweep
=======

Two settings, several runs at each point. While there are fixes, the receiver sets the floor and the IMU hardly matters.
"""

import matplotlib.pyplot as plt
import numpy as np

import testbed

figure, axis = plt.subplots(figsize=(7.0, 3.4), layout="constrained")
rates = (1.0, 2.0, 5.0, 10.0)
for model in ("ADIS16405", "ADIS16448", "ADIS16488"):
    means = []
    for rate in rates:
        changes = {"sensors.imu.model": model, "sensors.gnss.rate_hz": rate}
        scenario = testbed.load_scenario("quickstart", overrides=changes)
        trajectory = testbed.fly(scenario)
        found = []
        for run in range(3):
            log, _ = testbed.sense(scenario, trajectory, run=run)
            errors = testbed.solution_errors(trajectory, testbed.make_estimator("indirect-kf").run(log), log)
            found.append(np.sqrt(np.mean(errors["north_m"] ** 2)))
        means.append(np.mean(found))
    axis.loglog(rates, means, "o-", label=model)
axis.set(xlabel="rate of the fixes, Hz", ylabel="North RMSE, m")
axis.legend()
