"""Mutual information of two signals, in nats: by histogram, or by nearest neighbours.

Histogram: Cover & Thomas, *Elements of Information Theory*, eq. 2.28, less the bias of Miller (1955) and Roulston (1999),
Physica D 125. Nearest neighbours: Kraskov, Stögbauer & Grassberger (2004), Phys. Rev. E 69, from scikit-learn.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError, TestbedError

Array = NDArray[np.float64]


def mutual_information(x: Array, y: Array, bins: int | None = None) -> float:
    """I(X; Y) of two (N,) signals by an equal-width histogram of ``bins`` x ``bins`` cells, never below zero.

    Without ``bins`` it is (N/10)^(1/2) held to 4..32: ten samples per occupied cell on average if they were spread
    evenly. The expected excess of a finite histogram, (cells - rows - columns + 1) / 2N of the occupied ones, is taken
    off.
    """
    x, y = _pair(x, y)
    bins = bins or default_bins(len(x))
    counts = np.histogram2d(x, y, bins)[0]
    share = counts / len(x)
    row, column = share.sum(axis=1), share.sum(axis=0)
    filled = share > 0.0
    value = float(np.sum(share[filled] * np.log(share[filled] / np.outer(row, column)[filled])))
    excess = (filled.sum() - (row > 0.0).sum() - (column > 0.0).sum() + 1) / (2.0 * len(x))
    return max(0.0, value - float(excess))


def default_bins(samples: int) -> int:
    """Bins per signal for a number of samples."""
    return int(np.clip(np.sqrt(samples / 10.0), 4, 32))


def mutual_information_knn(x: Array, y: Array, neighbours: int = 3, seed: int = 0) -> float:
    """I(X; Y) of two (N,) signals by nearest neighbours. Raises TestbedError without scikit-learn (extra ``learn``)."""
    try:
        from sklearn.feature_selection import mutual_info_regression
    except ImportError:
        raise TestbedError("the nearest-neighbour estimate needs scikit-learn: install the extra 'learn'") from None
    x, y = _pair(x, y)
    return float(mutual_info_regression(x[:, None], y, n_neighbors=neighbours, random_state=seed)[0])


def _pair(x: Array, y: Array) -> tuple[Array, Array]:
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if x.ndim != 1 or x.shape != y.shape or len(x) < 16 or not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(
            f"mutual information: needs two finite signals of one length >= 16, has {x.shape} and {y.shape}"
        )
    return x, y
