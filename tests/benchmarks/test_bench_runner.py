"""Speed of the runner beside the estimators: scoring, storing and reading a run, the statistics of a batch, the report.

A whole unit of work stands beside what its estimators alone take; the Parquet files beside the bare write of their bytes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent))

pytest.importorskip("pytest_benchmark")

from testbed.data.records import STATE_NAMES, NavSolution, Trajectory
from testbed.montecarlo import store
from testbed.montecarlo import work_unit as units
from testbed.scenario.windows import Window
from testbed.scoring import effects, metrics, statistics

SAMPLES = 15_000


@pytest.fixture(scope="module")
def flight():
    t = np.arange(SAMPLES + 1) / 100.0
    n, rng = len(t), np.random.default_rng(1)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    v_n = np.tile([50.0, 0.0, 0.0], (n, 1))
    truth = Trajectory(t, 0.8 + 8e-6 * t, 0.1 + 0 * t, 100 + 0 * t, v_n, q, np.zeros((n, 3)), np.zeros((n, 3)))
    noisy = [
        x[1:] + scale * rng.normal(size=x[1:].shape)
        for x, scale in ((truth.lat, 1e-7), (truth.lon, 1e-7), (truth.h, 1.0))
    ]
    snapshots = np.arange(99, SAMPLES, 100)
    covariance = np.tile(np.eye(15), (len(snapshots), 1, 1))
    solution = NavSolution(
        t[1:],
        *noisy,
        v_n[1:],
        q[1:],
        std=np.ones((SAMPLES, 15)),
        states=STATE_NAMES,
        covariance_t=t[1:][snapshots],
        covariance=covariance,
    )
    return truth, solution


@pytest.fixture(scope="module")
def unit(flight):
    truth, solution = flight
    windows = [Window("all", ((-1.0, 150.0),)), *(Window(f"w{k}", ((10.0 * k, 10.0 * k + 10.0),)) for k in range(8))]
    series = metrics.error_series(truth, solution)
    tests = metrics.consistency(series, solution)
    result = units.UnitResult(0)
    for row in ("a", "b", "c", "d"):
        result.outcomes.append(units.Outcome(row, "ok", "", 1.0, SAMPLES))
        result.rows += [(row, *r) for r in metrics.score_rows(series, tests, windows)]
        result.series |= {(row, name): s for name, s in units.time_series(series, solution, tests, truth).items()}
    return result


def test_score_15000_samples(benchmark, flight):
    windows = [Window("all", ((-1.0, 150.0),))]
    benchmark.extra_info["samples"] = SAMPLES
    benchmark(metrics.score, *flight, windows)


def test_subtract_and_square_15000_samples(benchmark, flight):
    """What no score can do without: the differences of nine columns, their squares and sums."""
    truth, solution = flight
    estimate = np.column_stack([solution.lat, solution.lon, solution.h, solution.v_n, solution.q_nb[:, 1:]])
    reference = np.column_stack([truth.lat, truth.lon, truth.h, truth.v_n, truth.q_nb[:, 1:]])[1:]
    benchmark.extra_info["samples"] = SAMPLES
    benchmark(lambda: np.square(estimate - reference).sum(axis=0))


def test_encode_a_run_of_four_estimators(benchmark, unit):
    benchmark(store.encode, unit)


def test_decode_a_run_of_four_estimators(benchmark, unit):
    benchmark(store.decode, store.encode(unit))


def test_describe_1000_runs_of_500_cells(benchmark):
    values = np.random.default_rng(2).normal(size=(1000, 500))
    benchmark(statistics.describe, values)


def test_paired_improvement_of_1000_runs(benchmark):
    a, b = np.random.default_rng(3).gamma(4.0, size=(2, 1000))
    benchmark(effects.effect, a, b)


@pytest.mark.parametrize("what", ["unit", "estimators"])
def test_unit_of_the_quickstart(benchmark, what):
    """One run of five estimators: sensing, estimating, scoring and encoding; and the estimators by themselves."""
    from testbed import pipeline
    from testbed.data.registry import make_estimator
    from testbed.montecarlo.executors import pack
    from testbed.scenario import load_scenario

    scenario = load_scenario("quickstart")
    bench = units.Bench(units.Setup(scenario))
    log, _ = pipeline.sense(scenario, bench.trajectory(1), run=1)
    estimators = [make_estimator(entry.name, **entry.params) for entry in scenario.estimators]
    work = {
        "unit": lambda: pack(bench.setup, bench.execute(1)),
        "estimators": lambda: [e.run(log) for e in estimators],
    }[what]
    benchmark.extra_info["samples"] = len(log.imu.t)
    benchmark.pedantic(work, rounds=5, warmup_rounds=1)


def test_save_a_trajectory_of_15000_samples(benchmark, flight, tmp_path):
    benchmark.extra_info["samples"] = SAMPLES
    benchmark(flight[0].save, tmp_path / "truth.parquet")


def test_load_a_trajectory_of_15000_samples(benchmark, flight, tmp_path):
    flight[0].save(tmp_path / "truth.parquet")
    benchmark.extra_info["samples"] = SAMPLES
    benchmark(Trajectory.load, tmp_path / "truth.parquet")


def test_write_the_bytes_of_15000_samples(benchmark, flight, tmp_path):
    """The same numbers as one block of memory to the same disk."""
    truth = flight[0]
    block = np.column_stack([truth.t, truth.lat, truth.lon, truth.h, truth.v_n, truth.q_nb, truth.f_b, truth.w_ib_b])
    benchmark.extra_info["samples"] = SAMPLES
    benchmark((tmp_path / "truth.bin").write_bytes, block.tobytes())


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    from testbed.montecarlo.runner import run
    from testbed.report.results import load_result
    from testbed.scenario import load_scenario

    out = tmp_path_factory.mktemp("report") / "quickstart"
    run(load_scenario("quickstart", profile="smoke"), out, jobs=1)
    return load_result(out)


@pytest.mark.parametrize("part", ["figures", "markdown", "html"])
def test_report_of_the_quickstart(benchmark, result, part):
    from testbed.report import figures, html, text

    def draw() -> None:
        for name, drawing in figures.drawings(result).items():
            figures.save(drawing, result.folder / f"{name}.png", svg=False)

    work = {
        "figures": draw,
        "markdown": lambda: text.markdown(result, {}),
        "html": lambda: html.page(result),
    }[part]
    benchmark.pedantic(work, rounds=3, warmup_rounds=1)
