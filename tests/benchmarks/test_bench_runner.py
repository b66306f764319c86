"""Speed of the runner beside the estimators: scoring a solution, storing and reading a run, the statistics of a batch."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent.parent))

pytest.importorskip("pytest_benchmark")

from testbed import metrics, statistics, store, units
from testbed.records import NavSolution, Trajectory
from testbed.windows import Window

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
        t[1:], *noisy, v_n[1:], q[1:], std=np.ones((SAMPLES, 15)), covariance_t=t[1:][snapshots], covariance=covariance
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
    benchmark(metrics.score, *flight, windows)


def test_encode_a_run_of_four_estimators(benchmark, unit):
    benchmark(store.encode, unit)


def test_decode_a_run_of_four_estimators(benchmark, unit):
    benchmark(store.decode, store.encode(unit))


def test_describe_1000_runs_of_500_cells(benchmark):
    values = np.random.default_rng(2).normal(size=(1000, 500))
    benchmark(statistics.describe, values)


def test_paired_improvement_of_1000_runs(benchmark):
    a, b = np.random.default_rng(3).gamma(4.0, size=(2, 1000))
    benchmark(statistics.improvement, a, b)
