"""Candidates side by side in vector lanes: the same as one by one, whoever stands beside whom, and nobody infects another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from synthetic import sensor_log, weaving_flight
from test_tuning_objective import EIGHTEEN, objective

from estimators.methods.indirect_kf import IndirectKf
from testbed.data.records import SensorLog, Trajectory
from testbed.kernels.lanes import WIDTH, aligned, load, store
from testbed.scenario.windows import Window
from testbed.scoring.metrics import error_series
from testbed.tuning.config import RMSE_METRICS
from testbed.tuning.objective import DEVIANCE, Recording, deviance
from testbed.tuning.space import make_space


def flight(lever: bool = True) -> tuple[SensorLog, Trajectory]:
    """20 s at 50 Hz; an antenna 1 m away, and fixes that fall between two IMU samples, some of them lost."""
    truth = weaving_flight(20.0, rate=50.0)
    log = sensor_log(
        truth, std=(10.0, 0.2, 0.05), gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, outages=((8.0, 11.0),)
    )
    assert log.gnss is not None
    spec = replace(log.gnss.spec, lever_arm_b=(1.0, 0.3, -0.5) if lever else (0.0, 0.0, 0.0), latency_s=0.013)
    return replace(log, gnss=replace(log.gnss, spec=spec)), truth


def candidates(count: int) -> list[IndirectKf]:
    """Spread over three decades of variance either way; the first is the data sheet."""
    space = make_space("indirect-kf", EIGHTEEN)
    x = np.random.default_rng(5).uniform(-3.0, 3.0, (count, 18))
    x[0] = 0.0
    return [IndirectKf(**space.decode(row)) for row in x]


@pytest.fixture(scope="module")
def score():
    return IndirectKf.searcher(*flight())


def scored_run(candidate: IndirectKf, log: SensorLog, truth: Trajectory, stride: int) -> tuple[np.ndarray, float]:
    """RMSE (9,) of every ``stride``-th row of a run of the single filter, and the deviance of its innovations."""
    solution, rows = candidate.run(log), np.arange(stride - 1, len(log.imu.t), stride)
    series = error_series(truth, solution).values[rows]
    return np.sqrt(np.mean(series**2, axis=0)), deviance(solution.innovations["gnss"])


def test_batch_is_the_scalar_filter(score):
    """Other order of sums, same numbers. A latitude in radians resolves a nanometre: 1000 steps of that are parts in 1e8 of a metre."""
    made = candidates(11)
    rmse, deviances = score.batch(made)
    one_by_one = [scored_run(candidate, *flight(), 10) for candidate in made]
    np.testing.assert_allclose(rmse, [r for r, _ in one_by_one], rtol=1e-7, atol=0.0)
    np.testing.assert_allclose(deviances, [d for _, d in one_by_one], rtol=1e-8)


def test_without_lever_arm():
    score = IndirectKf.searcher(*flight(lever=False), stride=1)
    made = candidates(2)
    rmse, deviances = score.batch(made)
    expected = scored_run(made[1], *flight(lever=False), 1)
    np.testing.assert_allclose(rmse[1], expected[0], rtol=1e-7)
    np.testing.assert_allclose(deviances[1], expected[1], rtol=1e-8)


def test_neither_place_nor_company_matters(score):
    """Bit for bit: alone, in a full group, in the remainder of a population, in the opposite order."""
    made = candidates(2 * WIDTH + 3)
    rmse, deviance = score.batch(made)
    back_rmse, back_deviance = score.batch(made[::-1])
    np.testing.assert_array_equal(back_rmse[::-1], rmse)
    np.testing.assert_array_equal(back_deviance[::-1], deviance)
    for k in (0, WIDTH - 1, 2 * WIDTH + 2):
        alone_rmse, alone_deviance = score.batch([made[k]])
        np.testing.assert_array_equal(alone_rmse[0], rmse[k])
        np.testing.assert_array_equal(alone_deviance[0], deviance[k])


def test_a_diverged_lane_stays_alone(score):
    """Process noise whose square overflows makes infinity and NaN; its neighbours do not notice."""
    made = candidates(WIDTH)
    rmse, deviance = score.batch(made)
    broken = [replace(made[3], process_noise=(1e200,) * 12) if k == 3 else made[k] for k in range(WIDTH)]
    broken_rmse, broken_deviance = score.batch(broken)
    assert not np.isfinite(broken_rmse[3]).all()
    others = np.arange(WIDTH) != 3
    np.testing.assert_array_equal(broken_rmse[others], rmse[others])
    np.testing.assert_array_equal(broken_deviance[others], deviance[others])


def test_population_gives_the_same_bytes_for_any_number_of_threads():
    log, truth = flight()
    recordings = [
        Recording(case, 0, log, truth, None, (Window("all", ((-1.0, 20.0),)),), 1e5) for case in ("one", "two")
    ]
    x = np.random.default_rng(6).uniform(-3.0, 3.0, (WIDTH + 5, 18))
    for metrics in (RMSE_METRICS, [DEVIANCE]):
        alone = np.concatenate([objective(recordings, metrics)(row) for row in x])
        for jobs in (1, 2, 3):
            with objective(recordings, metrics, jobs=jobs) as made:
                np.testing.assert_array_equal(made(x), alone)


@njit
def _functions(table):
    x = load(table, 0)
    store(table, 1, np.sin(x))
    store(table, 2, np.cos(x))
    store(table, 3, 1.0 - np.sqrt(x**2 + 3.0) / (-x - 4.0) * 2.0)


def test_functions_of_lanes():
    """Sine and cosine over all latitudes to two units in the last place of 1; the four operations exactly as numpy's."""
    table = aligned(4)
    for low in np.linspace(-0.5 * np.pi, 0.5 * np.pi - 0.1, 20):
        x = table[0] = np.linspace(low, low + 0.1, WIDTH)
        _functions(table)
        np.testing.assert_allclose(table[1], np.sin(x), rtol=0.0, atol=4e-16)
        np.testing.assert_allclose(table[2], np.cos(x), rtol=0.0, atol=4e-16)
        np.testing.assert_array_equal(table[3], 1.0 - np.sqrt(x * x + 3.0) / (-x - 4.0) * 2.0)
