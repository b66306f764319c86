"""Input selection: information against closed forms, MRMR and Lipschitz index against systems whose inputs are known."""

from __future__ import annotations

import numpy as np
import pytest

from testbed.base.errors import InputError
from testbed.features import lag_curve, lipschitz_index, mutual_information, mutual_information_knn, rank_mrmr


def gaussian_pair(correlation: float, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(samples)
    return x, correlation * x + np.sqrt(1.0 - correlation**2) * rng.standard_normal(samples)


@pytest.mark.parametrize("estimate", [mutual_information, mutual_information_knn])
@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_information_of_two_gaussians(estimate, correlation):
    """I = -ln(1 - rho²)/2 (Cover & Thomas, ex. 8.5.1).

    The log-likelihood ratio has a standard deviation of rho, so 3 rho/√N is sampling error; cells of finite width lose
    up to (width/sigma)²/24 per signal, times 1/(1-rho²) within the ridge: 0.02 at 22 bins over 7 sigma and rho = 0.9.
    """
    if estimate is mutual_information_knn:
        pytest.importorskip("sklearn")
    samples = 5000
    expected = -0.5 * np.log(1.0 - correlation**2)
    values = [estimate(*gaussian_pair(correlation, samples, seed)) for seed in range(4)]
    assert np.mean(values) == pytest.approx(expected, abs=3.0 * correlation / np.sqrt(4 * samples) + 0.045)


def test_information_is_symmetric_and_sees_what_correlation_does_not():
    rng = np.random.default_rng(3)
    x = rng.standard_normal(4000)
    y = x**2 + 0.1 * rng.standard_normal(4000)
    assert abs(np.corrcoef(x, y)[0, 1]) < 0.1
    assert mutual_information(x, y) > 1.0
    assert mutual_information(x, y) == pytest.approx(mutual_information(y, x), rel=1e-12)


def redundant_system(seed: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Three true inputs, noisy copies of the first two, three irrelevant ones; the output is nonlinear in b and c."""
    rng = np.random.default_rng(seed)
    true = rng.standard_normal((4000, 3))
    copies = true[:, :2] + 0.3 * rng.standard_normal((4000, 2))
    y = true[:, 0] + 0.27 * true[:, 1] ** 3 + 0.8 * np.tanh(2.0 * true[:, 2]) + 0.1 * rng.standard_normal(4000)
    return (
        np.hstack([true, copies, rng.standard_normal((4000, 3))]),
        y,
        ["a", "b", "c", "copy_a", "copy_b", "n1", "n2", "n3"],
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("estimate", ["histogram", "knn"])
def test_mrmr_finds_the_true_inputs(seed, estimate):
    if estimate == "knn":
        pytest.importorskip("sklearn")
    ranked = rank_mrmr(*redundant_system(seed), method="greedy", estimate=estimate)
    assert {r.name for r in ranked[:3]} == {"a", "b", "c"}
    assert ranked[0].name == "a"


def test_mrmr_over_all_candidates_keeps_originals_before_their_copies():
    """The printed formula charges an original for its copy, so only the order within a pair is certain."""
    order = [r.name for r in rank_mrmr(*redundant_system(0), method="all")]
    assert order.index("a") < order.index("copy_a") and order.index("b") < order.index("copy_b")
    assert order[0] == "a"


def test_mrmr_score_is_the_printed_formula():
    x, y, names = redundant_system(1)
    first = next(r for r in rank_mrmr(x, y, names, method="all") if r.name == "b")
    others = [mutual_information(x[:, 1], x[:, k]) for k in range(8) if k != 1]
    assert first.score == pytest.approx(mutual_information(x[:, 1], y) - sum(others) / 7, rel=1e-12)


def narendra(samples: int, seed: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Narendra & Parthasarathy (1990), example 2: of order 2 in y and 1 in u."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1.0, 1.0, samples), np.zeros(samples)
    for k in range(1, samples - 1):
        a, b = y[k], y[k - 1]
        y[k + 1] = a * b * (a + 2.5) / (1.0 + a * a + b * b) + u[k] + noise * rng.standard_normal()
    return u, y


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_lipschitz_index_finds_the_order_of_narendras_plant(noise):
    for seed in range(3):
        curve = lag_curve(*narendra(3000, seed, noise))
        assert curve.order() == 2
        assert curve.index[0] > 10.0 * curve.index[1], "with y(t-2) missing the quotients are unbounded"


def test_lipschitz_index_of_a_linear_map_is_its_slope():
    """For y = 3 x every quotient is 3, and m = 1."""
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (300, 1))
    assert lipschitz_index(x, 3.0 * x[:, 0]) == pytest.approx(3.0, rel=1e-9)


def test_lipschitz_takes_the_largest_quotients():
    rng = np.random.default_rng(2)
    x, y = rng.standard_normal((120, 2)), rng.standard_normal(120)
    i, j = np.tril_indices(120, -1)
    quotients = np.sort(np.abs(y[i] - y[j]) / np.linalg.norm(x[i] - x[j], axis=1))[::-1][:12]
    expected = np.sqrt(2.0) * np.exp(np.log(quotients).mean())
    assert lipschitz_index(x, y, share=0.1) == pytest.approx(expected, rel=1e-9)


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="two finite signals"):
        mutual_information(np.zeros(100), np.zeros(99))
    with pytest.raises(InputError, match="do not match"):
        rank_mrmr(np.zeros((100, 3)), np.zeros(100), ["a"])
    with pytest.raises(InputError, match="too few"):
        lag_curve(None, np.zeros(20))
