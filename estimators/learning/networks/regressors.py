"""What can stand in for the MLP: RBF network, random forest and support vector regression (both from scikit-learn).

Each maps inputs (N,n) to one target (N,), both in the caller's units; inputs and targets are scaled to [-1, 1] first.
scikit-learn comes with the extra ``learn``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from estimators.learning.networks.levenberg_marquardt import Training, train
from estimators.learning.networks.mlp import Array, centre_and_span
from testbed.base.errors import InputError, TestbedError, nearest

Predictor = Callable[[Array], Array]
"""Inputs (N,n) to outputs (N,)."""

REGRESSORS = ("mlp", "random-forest", "rbf", "svr")


def fit_regressor(kind: str, x: Array, y: Array, neurons: int, seed: int, how: Training) -> Predictor:
    """Train a regressor by name on ``x`` (N,n), ``y`` (N,). ``neurons`` is also the number of RBF centres."""
    if kind == "mlp":
        return train(x, y, neurons, seed, how).network.predict
    makers = {"random-forest": _random_forest, "rbf": _radial_basis, "svr": _support_vectors}
    if kind not in makers:
        raise InputError(f"no regressor '{kind}': {nearest(kind, REGRESSORS)}")
    (centre, span), (middle, height) = centre_and_span(x), centre_and_span(y)
    model = makers[kind](neurons, seed)
    model.fit((x - centre) / span, (y - middle) / height)
    return lambda rows: np.asarray(model.predict((rows - centre) / span), dtype=float) * height + middle


def _random_forest(neurons: int, seed: int) -> Any:
    """Breiman (2001), 25 trees, leaves of at least 5 samples."""
    return _sklearn("ensemble").RandomForestRegressor(n_estimators=25, min_samples_leaf=5, random_state=seed, n_jobs=1)


def _support_vectors(neurons: int, seed: int) -> Any:
    """Epsilon-SVR with a Gaussian kernel, scikit-learn's defaults (C = 1, epsilon = 0.1 of half the target range)."""
    return _sklearn("svm").SVR(kernel="rbf")


def _radial_basis(neurons: int, seed: int) -> Any:
    """Moody & Darken (1989): Gaussian units on k-means centres, linear output by least squares."""
    return RadialBasisNetwork(neurons, seed)


class RadialBasisNetwork:
    """Gaussian units as wide as the mean distance between a centre and its nearest neighbour."""

    def __init__(self, units: int, seed: int) -> None:
        self.units, self.seed = units, seed

    def fit(self, x: Array, y: Array) -> None:
        """Place the centres, then solve for the output weights."""
        from scipy.cluster.vq import kmeans2

        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed)))
        self.centres = kmeans2(x, self.units, minit="++", rng=rng)[0]
        distances = np.linalg.norm(self.centres[:, None] - self.centres[None], axis=2)
        self.width = float(np.sort(distances, axis=1)[:, min(1, self.units - 1)].mean()) or 1.0
        self.output = np.linalg.lstsq(self._design(x), y, rcond=1e-10)[0]

    def predict(self, x: Array) -> Array:
        """Outputs (N,) for ``x`` (N,n)."""
        return np.asarray(self._design(x) @ self.output)

    def _design(self, x: Array) -> Array:
        squares = ((x[:, None] - self.centres[None]) ** 2).sum(axis=2)
        return np.column_stack([np.exp(-0.5 * squares / self.width**2), np.ones(len(x))])


def _sklearn(module: str) -> Any:
    import importlib

    try:
        return importlib.import_module(f"sklearn.{module}")
    except ImportError:
        raise TestbedError("this regressor needs scikit-learn: install the extra 'learn'") from None
