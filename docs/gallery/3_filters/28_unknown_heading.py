"""
Starting without a heading
==========================

A standard deviation above 60° means that nothing is known. The filter starts from eight headings; innovations pick.
"""

import matplotlib.pyplot as plt

import testbed

scenario = testbed.load_scenario("quickstart", overrides={"initial.yaw_deg": 103.9})
trajectory = testbed.fly(scenario)
figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
for seed in range(4):
    log, _ = testbed.sense(scenario, trajectory, seed=seed)
    errors = testbed.solution_errors(trajectory, testbed.make_estimator("indirect-kf").run(log), log)
    axis.plot(errors["time_s"], errors["yaw_deg"], label=f"seed {seed}")
axis.set(xlabel="time, s", ylabel="yaw error, °", xlim=(0, 30))
axis.legend()
