"""Levenberg-Marquardt training of an `Mlp`: damped normal equations, early stopping on rows held back.

Equations: Hagan & Menhaj (1994), IEEE Trans. Neural Networks 5(6); the loop is in `mlp_kernels`.
Inputs and targets are in the caller's units; the errors returned are too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.learning.networks.mlp import Array, Mlp, new_mlp
from testbed.base.errors import InputError

REASONS = ("epochs", "goal", "flat", "damped-out", "early-stop")
"""Why a training ended, by the codes of `mlp_kernels`."""


@dataclass(frozen=True)
class Training:
    """How to train. ``decay`` weighs the squared weights against the squared normalised errors."""

    epochs: int = 200
    patience: int = 6
    """Epochs in a row without a new best on the held-back rows."""
    validation_share: float = 0.15
    """Rows held back, drawn at random from the seed; 0 trains on all rows to the end."""
    whole_groups: bool = False
    """Hold back whole groups of rows, where the caller names groups: rows of one time series are alike, and some of them kept
    back from the others do not show that a network has learnt the series by heart."""
    goal: float = 0.0
    """Mean square normalised error that is good enough."""
    decay: float = 0.0
    tolerance: float = 1e-7
    """Relative fall of the cost in one epoch below which training ends."""
    damping: float = 1e-3
    damping_max: float = 1e10

    def __post_init__(self) -> None:
        if self.epochs < 0 or self.patience < 1 or not 0.0 <= self.validation_share < 1.0 or self.decay < 0.0:
            raise InputError(
                f"Training: epochs {self.epochs} (>= 0), patience {self.patience} (>= 1), "
                f"validation_share {self.validation_share} (0 up to 1), decay {self.decay} (>= 0)"
            )


@dataclass(frozen=True)
class Trained:
    """A trained network and how it went. RMSEs are in the unit of the targets; validation is NaN without such rows."""

    network: Mlp
    epochs: int
    training_rmse: float
    validation_rmse: float
    reason: str


def train(
    x: Array,
    y: Array,
    neurons: int = 11,
    seed: int = 0,
    how: Training | None = None,
    start: Mlp | None = None,
    groups: NDArray[np.int64] | None = None,
) -> Trained:
    """Train a network on ``x`` (N,n), ``y`` (N,): a new one, or ``start`` further (keeping its normalisation).

    ``groups`` (N,) numbers the group of each row, for ``how.whole_groups``. The same data and seed give the same network, bit for bit. Raises InputError for data of the wrong shape or with
    values that are not finite.
    """
    from estimators.learning.networks import mlp_kernels

    how = how or Training()
    x, y = np.ascontiguousarray(x, dtype=float), np.ascontiguousarray(y, dtype=float)
    if x.ndim != 2 or y.shape != x.shape[:1] or not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(f"train: inputs {x.shape} and targets {y.shape} must be finite (N,n) and (N,)")
    network = start or new_mlp(x, y, neurons, seed)
    inputs, targets = network.normalise_inputs(x), network.normalise_outputs(y)
    held_back = rows_held_back(len(y), seed, how, groups)
    weights, epochs, error, check, reason = mlp_kernels.train(
        network.weights, network.neurons, inputs[~held_back], targets[~held_back], inputs[held_back], targets[held_back],
        mlp_kernels.Settings(**{name: getattr(how, name) for name in mlp_kernels.Settings._fields}),
    )  # fmt: skip
    scale = float(network.output_scaling[1])
    check_rmse = scale * float(np.sqrt(check)) if held_back.any() else float("nan")
    return Trained(
        replace(network, weights=weights), epochs, scale * float(np.sqrt(error)), check_rmse, REASONS[reason]
    )


def rows_held_back(count: int, seed: int, how: Training, groups: NDArray[np.int64] | None = None) -> NDArray[np.bool_]:
    """Mask (``count``,) of the rows that stop the training: drawn one by one, or as whole groups where there are several.

    Of groups at least one, so that there is something to stop by; a single group is held back row by row.
    """
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence((seed, 1))))
    names = np.unique(groups) if groups is not None and how.whole_groups else np.empty(0)
    if groups is None or len(names) < 2 or how.validation_share == 0.0:
        mask = np.zeros(count, dtype=bool)
        mask[rng.permutation(count)[: int(how.validation_share * count)]] = True
        return mask
    chosen = rng.permutation(names)[: max(1, int(how.validation_share * len(names)))]
    return np.asarray(np.isin(groups, chosen))
