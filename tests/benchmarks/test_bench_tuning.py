"""Cost of tuning: one evaluation of the two-IMU objective (437 s at 200 Hz, twice), and a population on one core and two.

Run with ``make bench``. Timings are printed, never asserted; ``seconds_per_evaluation`` projects to the 450,000 evaluations of
the paper's table.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

from estimators.methods.indirect_kf import IndirectKf
from testbed.kernels.lanes import WIDTH
from testbed.scenario import load_scenario
from testbed.tuning.config import tune_config
from testbed.tuning.objective import make_objective, record
from testbed.tuning.search import ALGORITHMS, Bounds, make_search
from testbed.tuning.speed import TABLE_EVALUATIONS

POPULATION = 50


@pytest.fixture(scope="module")
def study():
    scenario = load_scenario("ipo-2022")
    config = tune_config(scenario)
    return scenario, config, record(scenario, config, config.train_runs)


def test_bench_one_by_one(benchmark, study):
    """One candidate on one core, both IMUs one after the other, through the scalar loop."""
    searchers = [IndirectKf.searcher(r.log, r.trajectory) for r in study[2]]

    def run():
        for score in searchers:
            score(IndirectKf())

    run()
    benchmark.group = "evaluation of the two-IMU objective"
    benchmark.pedantic(run, rounds=5)
    report_evaluation(benchmark, 1)


def test_bench_side_by_side(benchmark, study):
    """As many candidates as lanes on one core: what one of them costs is ``seconds_per_evaluation``."""
    with make_objective(*study, jobs=1) as objective:
        x = np.random.default_rng(0).uniform(-1.0, 1.0, (WIDTH, 18))
        objective(x)
        benchmark.group = "evaluation of the two-IMU objective"
        benchmark.pedantic(objective, (x,), rounds=5)
    report_evaluation(benchmark, WIDTH)


def report_evaluation(benchmark, candidates):
    """Seconds of one evaluation, and hours of the paper's table at that speed."""
    if benchmark.stats is not None:
        seconds = benchmark.stats["min"] / candidates
        benchmark.extra_info["seconds_per_evaluation"] = seconds
        benchmark.extra_info["hours_for_the_table"] = seconds * TABLE_EVALUATIONS / 3600.0


@pytest.mark.parametrize("jobs", [1, 2])
def test_bench_population(benchmark, study, jobs):
    """50 candidates as a search asks for them."""
    if jobs > (os.cpu_count() or 1):
        pytest.skip("needs two cores")
    with make_objective(*study, jobs=jobs) as objective:
        x = np.random.default_rng(0).uniform(-1.0, 1.0, (POPULATION, 18))
        objective(x[:2])
        benchmark.group = f"population of {POPULATION}, two IMUs"
        benchmark.pedantic(objective, (x,), rounds=2)
    report_evaluation(benchmark, POPULATION)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_bench_algorithm(benchmark, name):
    """What an algorithm itself costs: 20 iterations of 50 in 18 dimensions on a function that costs nothing."""

    def run():
        search = make_search(name, Bounds(np.full(18, -3.0), np.full(18, 3.0)), POPULATION, 20, 0)
        while not search.done:
            search.tell((search.ask() ** 2).sum(axis=1))

    benchmark.group = "algorithms, 1000 evaluations"
    benchmark.pedantic(run, rounds=2)
