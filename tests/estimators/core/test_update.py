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
