"""
More states
===========

A filter is composed of blocks by name. With the whole data sheet switched on, scale factors and misalignment are real. A filter
that does not know them is overconfident: its error leaves the band of three sigma. One that carries them is honest.
"""

import matplotlib.pyplot as plt

import testbed

scenario = testbed.load_scenario("quickstart", variant="uncalibrated")
trajectory = testbed.fly(scenario)
log, _ = testbed.sense(scenario, trajectory, seed=4)
biases = ("accel-bias", "gyro-bias")
more = ("accel-scale", "gyro-scale", "accel-misalignment", "gyro-misalignment")
figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
for label, states in (("15 states", biases), ("33 states", biases + more)):
    solution = testbed.make_estimator("eskf", states=states).run(log)
    errors = testbed.solution_errors(trajectory, solution, log)
    (line,) = axis.plot(errors["time_s"], errors["roll_deg"], label=label)
    sigma = 3.0 * errors["sigma_roll_deg"]
    axis.fill_between(errors["time_s"], -sigma, sigma, color=line.get_color(), alpha=0.15)
axis.set(xlabel="time, s", ylabel="roll error, °", ylim=(-3, 3))
axis.legend()
