"""Lag space of a dynamic system from Lipschitz quotients of its recorded inputs and outputs.

He & Asada (1993), *A new method for identifying orders of input-output models for nonlinear dynamic systems*, Proc. ACC:
with a variable missing the largest quotients |dy| / |dx| grow without bound; with one too many they stay. Signals are
scaled to unit standard deviation first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from testbed.base.errors import InputError
from testbed.features.information import Array


@dataclass(frozen=True)
class LagCurve:
    """``lags`` (L,) and the Lipschitz ``index`` (L,) with that many lags of every signal."""

    lags: Array
    index: Array

    def order(self, flat: float = 0.2) -> int:
        """The first lag after which the curve is flat: one more lag lowers the index by less than the fraction ``flat``.

        Where it never gets flat, the last lag.
        """
        fall = 1.0 - self.index[1:] / self.index[:-1]
        flat_from = np.flatnonzero(fall < flat)
        return int(self.lags[flat_from[0]] if len(flat_from) else self.lags[-1])


def lipschitz_index(x: Array, y: Array, share: float = 0.015) -> float:
    """Index of regressors ``x`` (N,m) for the output ``y`` (N,): geometric mean of sqrt(m) q over the largest quotients.

    As many quotients as ``share`` of N (the source: 0.01 to 0.02). All pairs are compared, O(N²).
    """
    from testbed.features.kernels import log_largest_quotients

    x, y = np.ascontiguousarray(x, dtype=float), np.ascontiguousarray(y, dtype=float)
    if x.ndim != 2 or y.shape != x.shape[:1] or len(y) < 50 or not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(
            f"Lipschitz index: needs finite regressors (N,m) and output (N,), N >= 50; has {x.shape}, {y.shape}"
        )
    if not 0.0 < share <= 1.0:
        raise InputError(f"Lipschitz index: share is {share}, expected above 0 and up to 1")
    largest = log_largest_quotients(x, y, max(1, round(share * len(y))))
    return float(np.sqrt(x.shape[1]) * np.exp(largest.mean()))


def lag_curve(
    u: Array | None, y: Array, max_lag: int = 6, share: float = 0.015, samples: int = 2000, present_input: bool = False
) -> LagCurve:
    """Index against the number of lags of output ``y`` (N,) and inputs ``u`` (N,m) or None, for lags 1..max_lag.

    The regressors at lag L are y(t-1)..y(t-L) and u(t-1)..u(t-L), with u(t) before them if ``present_input``. At most
    ``samples`` times, evenly spaced, are compared; each lag uses the same ones.
    """
    y = np.asarray(y, dtype=float)
    signals = y[:, None] if u is None else np.column_stack([y, np.asarray(u, dtype=float)])
    if len(y) < max_lag + 50 or max_lag < 2:
        raise InputError(f"lag curve: {len(y)} samples are too few for {max_lag} lags (at least 2)")
    deviation = signals.std(axis=0)
    signals = (signals - signals.mean(axis=0)) / np.where(deviation > 0.0, deviation, 1.0)
    times = np.unique(np.linspace(max_lag, len(y) - 1, min(samples, len(y) - max_lag)).astype(int))
    index = []
    for lag in range(1, max_lag + 1):
        columns = [signals[times - i] for i in range(1, lag + 1)]
        if present_input:
            columns.insert(0, signals[times, 1:])
        index.append(lipschitz_index(np.hstack(columns), signals[times, 0], share))
    return LagCurve(np.arange(1, max_lag + 1, dtype=float), np.array(index))
