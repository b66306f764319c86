"""Flying against the bare JSBSim loop: the same aircraft, loaded and started alike, and as many steps of the same length."""

from __future__ import annotations

import statistics
import sys
import time
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


def _bare_loop(name, steps):
    """A function that loads and starts the aircraft and makes so many steps with its controls fixed."""
    aircraft, folder = load_aircraft(name)
    config = _script(name)

    def bare():
        simulator = Simulator(config, aircraft, folder, 1.0 / driver.STEP_HZ, 0)
        for throttle in simulator.throttles:
            throttle(aircraft.autopilot.throttle_trim)
        run = simulator.run
        for _ in range(steps):
            run()

    return bare


@pytest.mark.parametrize("name", list(CRUISE))
def test_fly(benchmark, name):
    """Each round comes right after a bare one: a machine whose speed wanders does not change the ratio of the two."""
    aircraft, folder = load_aircraft(name)
    config = _script(name)
    steps = driver.fly_script(config, aircraft, folder, 0).steps
    bare, times = _bare_loop(name, steps), []

    def bare_round():
        start = time.perf_counter()
        bare()
        times.append(time.perf_counter() - start)

    bare()
    benchmark.group = f"fly {name}, 300 s at 100 Hz"
    benchmark.pedantic(lambda: driver.fly_script(config, aircraft, folder, 0), setup=bare_round, rounds=9)
    benchmark.extra_info["steps"] = steps
    if benchmark.stats is not None:
        ratios = [flown / alone for flown, alone in zip(benchmark.stats.stats.data, times, strict=True)]
        benchmark.extra_info["over_bare"] = statistics.median(ratios)


@pytest.mark.parametrize("name", list(CRUISE))
def test_bare_jsbsim(benchmark, name):
    aircraft, folder = load_aircraft(name)
    steps = driver.fly_script(_script(name), aircraft, folder, 0).steps
    benchmark.group = f"fly {name}, 300 s at 100 Hz"
    benchmark.extra_info["steps"] = steps
    benchmark.pedantic(_bare_loop(name, steps), rounds=7, warmup_rounds=1)


def test_spline_truth(benchmark):
    aircraft, folder = load_aircraft("aerosonde")
    flown = driver.fly_script(_script("aerosonde"), aircraft, folder, 0)
    benchmark.group = "spline truth, 300 s at 100 Hz"
    benchmark.extra_info["samples"] = len(flown.v_n)
    benchmark(truth.make_trajectory, flown.v_n, flown.q_nb, 100.0, flown.start)
