"""Statistics: intervals that cover as often as they say, paired improvements, chi-square bounds, memory on disk."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from testbed.montecarlo.store import ColumnStore
from testbed.scoring import statistics
from testbed.scoring.effects import effect

REPETITIONS = 500
SAMPLING_95 = 4 * np.sqrt(0.95 * 0.05 / REPETITIONS)
"""Four standard deviations of a coverage that is counted over the repetitions: 3.9 %."""


def test_intervals_of_the_mean_cover_the_truth_in_95_percent():
    values = np.random.default_rng(1).normal(3.0, 2.0, (60, REPETITIONS))
    low, high = statistics.mean_intervals(values)
    covered = np.mean((low <= 3.0) & (high >= 3.0))
    assert abs(covered - 0.95) <= 0.02


def test_intervals_cover_for_small_and_skewed_samples():
    values = np.random.default_rng(2).gamma(4.0, 0.25, (15, REPETITIONS))
    low, high = statistics.mean_intervals(values)
    assert abs(np.mean((low <= 1.0) & (high >= 1.0)) - 0.95) <= SAMPLING_95


def test_improvement_interval_covers_the_true_improvement():
    rng, covered = np.random.default_rng(3), 0
    for _ in range(REPETITIONS):
        common = rng.gamma(9.0, 1.0, 60)  # both filters suffer from the same sensors
        a, b = 0.7 * common + rng.normal(0, 0.5, 60), common + rng.normal(0, 0.5, 60)
        found = effect(a, b)
        covered += found.low <= 30.0 <= found.high
    assert abs(covered / REPETITIONS - 0.95) <= 0.02


def test_pairing_narrows_the_interval():
    rng = np.random.default_rng(4)
    common = rng.gamma(2.0, 5.0, 100)
    a, b = 0.8 * common + rng.normal(0, 0.1, 100), common
    paired = effect(a, b)
    shuffled = effect(a, rng.permutation(b))
    assert paired.high - paired.low < 0.1 * (shuffled.high - shuffled.low)
    assert abs(paired.percent - 20.0) < 4 * 0.1  # the noise leaves 0.1 % of the mean, 10, after 100 runs


def test_agrees_with_scipy_bootstrap():
    values = np.random.default_rng(5).gamma(2.0, 1.0, 400)
    ours = statistics.mean_intervals(values[:, None])
    scipys = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=9999, rng=np.random.default_rng(6))
    width = scipys.confidence_interval.high - scipys.confidence_interval.low
    # the 2.5 % quantile of 2000 draws has a standard error of about 3 % of the interval's width
    assert ours[0][0] == pytest.approx(scipys.confidence_interval.low, abs=0.1 * width)
    assert ours[1][0] == pytest.approx(scipys.confidence_interval.high, abs=0.1 * width)


def test_p_values_are_uniform_without_a_difference_and_small_with_one():
    rng = np.random.default_rng(7)
    pairs = rng.normal(size=(300, 2, 40))
    for paired in (True, False):
        p = np.array([statistics.difference_p(a, b, paired) for a, b in pairs])
        assert stats.kstest(p, "uniform").pvalue > 0.001
    a, b = pairs[0, 0], pairs[1, 0, :30]
    assert statistics.difference_p(a, pairs[0, 1], True) == pytest.approx(stats.ttest_rel(a, pairs[0, 1]).pvalue)
    assert statistics.difference_p(a, b, False) == pytest.approx(stats.ttest_ind(a, b, equal_var=False).pvalue)
    a = rng.normal(1.0, 0.1, 30)
    assert statistics.difference_p(a, a + 0.2 + rng.normal(0, 0.1, 30), True) < 1e-4
    assert statistics.difference_p(a, a, True) == 1.0


def test_describe_leaves_out_what_is_missing():
    values = np.array([[1.0, np.nan, 5.0], [2.0, np.nan, np.nan], [3.0, np.nan, np.nan]])
    table = statistics.describe(values)
    assert table["n"].tolist() == [3, 0, 1]
    assert table["mean"][[0, 2]].tolist() == [2.0, 5.0]
    assert table["median"][0] == 2.0 and table["std"][0] == 1.0
    assert np.isnan(table["mean"][1]) and np.isnan(table["ci_low"][2])
    some = np.array([[1.0, 4.0], [2.0, np.nan], [3.0, 8.0], [9.0, 9.0]])
    expected = np.nanquantile(some, [0.05, 0.5, 0.95], axis=0)
    assert np.allclose([statistics.describe(some)[k] for k in ("p05", "median", "p95")], expected)


def test_one_draw_serves_all_cells_so_blocks_do_not_matter():
    values = np.random.default_rng(8).normal(size=(30, 7))
    whole, part = statistics.mean_intervals(values), statistics.mean_intervals(values[:, 3:5])
    assert np.allclose(np.array(whole)[:, 3:5], part, rtol=1e-12)


def test_consistency_bounds_hold_95_percent_of_the_time_for_a_consistent_filter():
    rng, times = np.random.default_rng(9), np.arange(1.0, 1001.0)
    honest = statistics.ConsistencySum.zero(1000)
    proud = statistics.ConsistencySum.zero(1000)
    for _ in range(50):
        nees = rng.chisquare(3, 1000)
        honest.add(nees, np.full(1000, 3.0), np.ones(1000))
        proud.add(2.0 * nees, np.full(1000, 3.0), np.ones(1000))
    row = honest.summary(times, 0.0)
    assert abs(row["share_inside"] - 0.95) <= 4 * np.sqrt(0.95 * 0.05 / 1000)
    assert row["lower"] < row["mean"] < row["upper"]
    assert row["lower"] == pytest.approx(stats.chi2.ppf(0.025, 150) / 50)
    assert proud.summary(times, 0.0)["share_inside"] < 0.01


def test_envelope_of_known_noise():
    errors = np.random.default_rng(10).normal(1.0, 2.0, (4000, 5)).astype(np.float32)
    table = statistics.envelope(errors, np.full((4000, 5), 2.0, np.float32))
    se = 2.0 / np.sqrt(4000)
    assert np.allclose(table["mean"], 1.0, atol=5 * se)
    assert np.allclose(table["p95"], 1.0 + 2.0 * stats.norm.ppf(0.95), atol=5 * 2.2 * se)
    assert np.allclose(table["rms"], np.sqrt(5.0), atol=5 * se)
    assert np.allclose(table["sigma"], 2.0)


def test_column_store_returns_columns_of_rows_that_grew(tmp_path):
    store = ColumnStore(tmp_path / ".scratch" / "values")
    store.append(np.array([1.0, 2.0]))
    store.append(np.array([3.0, 4.0, 5.0]))
    assert np.array_equal(store.columns(1, 3), [[2.0, np.nan], [4.0, 5.0]], equal_nan=True)
    store.close()
    assert not list((tmp_path / ".scratch").iterdir())


@pytest.mark.parametrize("n", [20, 50, 1000])
def test_the_test_of_normality_is_scipys(n):
    from scipy.stats import normaltest

    rng = np.random.default_rng(n)
    for values in (rng.normal(3.0, 2.0, n), rng.uniform(size=n), rng.standard_t(5, n), rng.gamma(20.0, size=n)):
        assert statistics.normality_p(values) == pytest.approx(normaltest(values).pvalue, rel=1e-9)
