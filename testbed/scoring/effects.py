"""The effect of one method against another over paired runs: ratio of means, median of paired ratios, runaways.

Ratio of means and its standard error: Cochran, *Sampling Techniques* (3rd ed.), 6.4, the linearised ratio estimator;
its interval is the bootstrap of `testbed.scoring.statistics`. Median: order statistics of a binomial (David & Nagaraja,
*Order Statistics*, 7.1). Runaways: the modified z-score of Iglewicz & Hoaglin, *How to Detect and Handle Outliers* (1993).
Rows are runs; NaN is a run that a method did not finish. Effects in per cent, positive where the first method is lower.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, stdtr

from testbed.data.records import Array
from testbed.scoring.statistics import LEVEL, bootstrap_means, expanded

RUNAWAY_SCORE = 3.5
"""Modified z-score of a logarithm from which on Iglewicz & Hoaglin label a value: one in 2000 of a log-normal table."""
RUNAWAY_FACTOR = 3.0
"""A value below three times the median is no runaway, however narrow the others: one of 30 then moves a mean by 7 % at most."""
_NORMAL_MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""


@dataclass(frozen=True)
class Effect:
    """By how many per cent ``a`` is lower than ``b``: ``percent`` of the means with its 95 % interval, ``error`` its 1 sigma.

    ``n`` pairs differ from one another and have both values; ``median`` of the paired ratios, with its interval, also counts the
    runs that one of the two lost (``lost``), as infinitely worse. ``runaways`` are rows far above all others of their
    method, and ``trimmed`` is the effect without them (None where there are none).
    """

    percent: float
    low: float
    high: float
    error: float
    n: int
    median: float = math.nan
    median_low: float = math.nan
    median_high: float = math.nan
    lost: tuple[int, int] = (0, 0)
    runaways: tuple[int, ...] = ()
    trimmed: Effect | None = None

    @property
    def p_value(self) -> float:
        """Two-sided: the means are equal. NaN below two pairs."""
        return 2.0 * self._tail(abs(self.percent))

    def equality_p(self, margin: float) -> float:
        """Two one-sided tests (Schuirmann 1987): the larger p-value of "lower" and of "higher by ``margin`` % or more"."""
        return self._tail(margin - abs(self.percent))

    def inequality_p(self, margin: float) -> float:
        """Two-sided: the means differ by no more than ``margin`` %."""
        return min(1.0, 2.0 * self._tail(abs(self.percent) - margin))

    def _tail(self, distance: float) -> float:
        """Chance that Student's t comes as far above ``distance`` / ``error``."""
        if self.n < 2:
            return math.nan
        if self.error == 0.0:  # no scatter to measure by: the chance that all signs fell so
            return 0.5**self.n if distance > 0.0 else 0.5 if distance == 0.0 else 1.0
        return float(stdtr(self.n - 1, -distance / self.error))


def effect(a: Array, b: Array, seed: int = 0) -> Effect | None:
    """The effect over the runs that differ from one another; None where no run has both values, or ``b`` is zero.

    Equal pairs are one pair: copies of a run say nothing new. With a single pair interval and error are NaN.
    """
    rows = distinct_rows(np.column_stack([a, b]))
    a, b = a[rows], b[rows]
    with np.errstate(all="ignore"):  # what overflows or divides by zero comes out as inf or NaN, and is judged as that
        found = _effect(a, b, seed)
        if found is None:
            return None
        far = runaways(a) | runaways(b)
        trimmed = _effect(a[~far], b[~far], seed) if far.any() else None
    return Effect(**vars(found) | {"runaways": tuple(rows[far].tolist()), "trimmed": trimmed})


def distinct_rows(values: Array) -> NDArray[np.intp]:
    """Indices of the rows (runs) that are no copy of an earlier one, to the bit; ``values`` is (runs, cells)."""
    rows = np.ascontiguousarray(values, dtype=np.float64)
    if not rows.size:
        return np.arange(len(rows))
    whole = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    return np.sort(np.unique(whole, return_index=True)[1])


def runaways(values: Array) -> NDArray[np.bool_]:
    """Which runs of a method lie far above the others: by `RUNAWAY_SCORE` in the logarithm, and by `RUNAWAY_FACTOR`."""
    usable = np.isfinite(values) & (values > 0.0)
    out = np.zeros(len(values), dtype=bool)
    if usable.sum() > 2:
        logs = np.log(values[usable])
        above = logs - np.median(logs)
        scale = _NORMAL_MAD * np.median(np.abs(above))
        out[usable] = (above > RUNAWAY_SCORE * scale) & (above > math.log(RUNAWAY_FACTOR))
    return out


def _effect(a: Array, b: Array, seed: int) -> Effect | None:
    has_a, has_b = np.isfinite(a), np.isfinite(b)
    both = has_a & has_b
    x, y = a[both], b[both]
    n = len(x)
    if n == 0 or y.mean() == 0.0:
        return None
    ratio = x.mean() / y.mean()
    percent = float(100.0 * (1.0 - ratio))
    lost = int((has_b & ~has_a).sum()), int((has_a & ~has_b).sum())
    median = _median_effect(x, y, lost)
    if n < 2:
        return Effect(percent, math.nan, math.nan, math.nan, n, *median, lost)
    error = float(100.0 * (x - ratio * y).std(ddof=1) / (math.sqrt(n) * abs(y.mean())))
    means = bootstrap_means(np.column_stack([x, y]), seed)
    low, high = expanded(100.0 * (1.0 - means[:, :1] / means[:, 1:]), np.array([n]))
    return Effect(percent, float(low[0]), float(high[0]), error, n, *median, lost)


def _median_effect(x: Array, y: Array, lost: tuple[int, int]) -> tuple[float, float, float]:
    """Median of the paired ratios as an effect, and its 95 % interval (NaN below six runs, which have none)."""
    ordered = np.sort(np.concatenate([x / y, np.full(lost[0], np.inf), np.zeros(lost[1])]))
    n = len(ordered)
    upper, lower = ordered[n // 2], ordered[(n - 1) // 2]
    middle = upper if upper == lower else 0.5 * (upper + lower)
    rank = _median_rank(n)
    ends = (ordered[n - 1 - rank], ordered[rank]) if rank >= 0 else (math.nan, math.nan)
    low, high = (float(100.0 * (1.0 - end)) for end in ends)
    return float(100.0 * (1.0 - middle)), low, high


def _median_rank(n: int) -> int:
    """Largest k for which the k-th smallest and k-th largest of n (from 0) hold the median with 95 %; -1 where none does."""
    tail = 0.5 * (1.0 - LEVEL)
    if 0.5**n > tail:
        return -1
    k = 0
    while bdtr(k + 1, n, 0.5) <= tail:
        k += 1
    return k
