"""Flying against the bare JSBSim loop: the same aircraft, loaded and started alike, and as many steps of the same length."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from testbed.flight import driver, truth
from testbed.flight.aircraft import load_aircraft
from testbed.flight.simulator import Simulator

sys.path.insert(0, str(Path(__file__).parents[1]))
from flights import flight, turn

CRUISE = {"aerosonde": (30.0, 500.0), "transport": (170.0, 3000.0), "agile": (220.0, 3000.0)}


def _script(name):
    speed, alt = CRUISE[name]
    return flight(name, speed, turn(20.0, 300.0), alt=alt)


@pytest.mark.parametrize("name", list(CRUISE))
def test_fly(benchmark, name):
    aircraft, folder = load_aircraft(name)
    config = _script(name)
    driver.fly_script(config, aircraft, folder, 0)
    benchmark.group = f"fly {name}, 300 s at 100 Hz"
    recording = benchmark.pedantic(driver.fly_script, (config, aircraft, folder, 0), rounds=7)
    benchmark.extra_info["steps"] = recording.steps


@pytest.mark.parametrize("name", list(CRUISE))
def test_bare_jsbsim(benchmark, name):
    aircraft, folder = load_aircraft(name)
    config = _script(name)
    steps = driver.fly_script(config, aircraft, folder, 0).steps

    def bare():
        simulator = Simulator(config, aircraft, folder, 0.005, 0)
        for throttle in simulator.throttles:
            throttle(aircraft.autopilot.throttle_trim)
        run = simulator.run
        for _ in range(steps):
            run()

    benchmark.group = f"fly {name}, 300 s at 100 Hz"
    benchmark.extra_info["steps"] = steps
    benchmark.pedantic(bare, rounds=7, warmup_rounds=1)


def test_spline_truth(benchmark):
    aircraft, folder = load_aircraft("aerosonde")
    flown = driver.fly_script(_script("aerosonde"), aircraft, folder, 0)
    benchmark.group = "spline truth, 300 s at 100 Hz"
    benchmark.extra_info["samples"] = len(flown.state)
    benchmark(truth.make_trajectory, flown.state[:, :3], flown.state[:, 3:], 100.0, flown.start)
