"""The measurement update against the matrix formulas of textbooks."""

import numpy as np
import pytest

from estimators.core.update import update, update_considering


@pytest.mark.parametrize("considered", [(), (1, 4)])
def test_the_scalars_in_turn_are_the_matrix_update(considered):
    """Any gain K: P = (I - K H) P (I - K H)' + K R K'. K = P H' S^-1, its rows of considered states zero (Schmidt); for one
    measurement, as several considered in turn are not the same filter as all at once."""
    rng = np.random.default_rng(1)
    a, n = rng.standard_normal((6, 6)), 6
    before, r = a @ a.T, np.array([0.3, 2.0])
    rows = 1 if considered else 2
    h, residual, x = rng.standard_normal((2, n))[:rows], np.array([0.7, -1.1])[:rows], np.zeros(n)
    s = h @ before @ h.T + np.diag(r[:rows])
    gain = before @ h.T @ np.linalg.inv(s)
    estimated = np.ones(n)
    estimated[list(considered)] = 0.0
    gain *= estimated[:, None]
    left = np.eye(n) - gain @ h
    p, scratch = before.copy(), (np.zeros((rows, 2)), np.zeros((4, n)))
    if considered:
        update_considering(x, p, residual, h, r[:rows], *scratch, estimated)
    else:
        update(x, p, residual, h, r[:rows], *scratch)
    assert np.allclose(p, left @ before @ left.T + gain @ np.diag(r[:rows]) @ gain.T, rtol=1e-12)
    assert np.allclose(x, gain @ residual, rtol=1e-12) and np.array_equal(p, p.T)
    assert np.array_equal(p[np.ix_(considered, considered)], before[np.ix_(considered, considered)])


def test_an_update_that_takes_off_eight_digits_leaves_a_covariance():
    """As a strongly tracking filter meets them: sigmas of 1e4 m against fixes of 1 m, states tied to a part in 1e6 of each other.

    Against the same sequence in exact fractions: each variance to a hundredth of itself.
    """
    rng = np.random.default_rng(3)
    n, m = 6, 3
    mixed = rng.normal(size=(n, n)) * np.array([1e4, 1e4, 1e3, 1.0, 1e-2, 1e-3])
    p0 = mixed @ mixed.T
    h = np.zeros((m, n))
    h[0, 0] = h[1, 1] = h[2, 2] = 1.0
    r = np.array([1.0, 1.0, 1e-2])
    p, x, scalars, scratch = p0.copy(), np.zeros(n), np.zeros((m, 2)), np.zeros((4, n))
    for _ in range(20):
        update(x, p, np.zeros(m), h, r, scalars, scratch)
    exact = [[Fraction(float(v)) for v in row] for row in p0]
    for _ in range(20):
        for a in range(m):
            s = exact[a][a] + Fraction(float(r[a]))
            column = [row[a] for row in exact]
            exact = [[exact[i][j] - column[i] * column[j] / s for j in range(n)] for i in range(n)]
    expected = np.array([float(exact[i][i]) for i in range(n)])
    np.testing.assert_allclose(np.diag(p), expected, rtol=1e-2)
    assert np.linalg.eigvalsh(p / np.sqrt(np.outer(np.diag(p), np.diag(p)))).min() > -1e-9
