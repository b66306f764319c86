"""The interval over training seeds and noise seeds that the report of the end-to-end network gives."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

REPORTS = Path(__file__).resolve().parents[3] / "reports" / "studies"


@pytest.fixture(scope="module")
def study():
    sys.path.insert(0, str(REPORTS))
    try:
        spec = importlib.util.spec_from_file_location("ahrs_end_to_end", REPORTS / "ahrs_end_to_end.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(REPORTS))
    return module


def test_with_one_training_seed_it_is_the_t_interval_over_noise(study):
    values = np.random.default_rng(0).standard_normal((1, 8))
    low, mean, high = study.crossed_interval(values)
    expected = stats.t.interval(0.95, 7, values.mean(), stats.sem(values[0]))
    np.testing.assert_allclose([low, mean, high], [expected[0], values.mean(), expected[1]])


@pytest.mark.parametrize(("of_seed", "of_noise", "rest"), [(1.0, 0.2, 0.2), (0.2, 1.0, 0.2), (0.0, 0.0, 1.0)])
def test_it_holds_the_mean_as_often_as_it_says(study, of_seed, of_noise, rest):
    """2000 draws of five training and ten noise seeds: at least 95 %, less three sigma of that share (1.5 %)."""
    rng, inside = np.random.default_rng(4), 0
    for _ in range(2000):
        values = of_seed * rng.standard_normal((5, 1)) + of_noise * rng.standard_normal((1, 10))
        low, _, high = study.crossed_interval(values + rest * rng.standard_normal((5, 10)))
        inside += low < 0.0 < high
    assert inside / 2000 > 0.935


def test_improvements_are_those_of_rmse_and_of_its_square(study):
    """Errors of half the base in every run: 50 % of RMSE, 75 % of MSE, an interval of no width."""
    base = np.random.default_rng(1).uniform(1.0, 2.0, (1, 4, 3, 2))
    squares = {study.BASE: base, "half": np.repeat(base / 4.0, 3, axis=0)}
    rows = [row for row in study.comparison(squares) if row["estimator"] == "half"]
    assert len(rows) == 6
    for row in rows:
        assert [row[f"rmse_{key}"] for key in ("low", "below_pct", "high")] == pytest.approx([50.0] * 3)
        assert [row[f"mse_{key}"] for key in ("low", "below_pct", "high")] == pytest.approx([75.0] * 3)
        assert row["worse_than_base"] == 0 and row["training_seeds"] == 3
