"""Statistics over Monte Carlo runs: intervals, tests of means, consistency bounds, error envelopes.

Bootstrap: Efron & Tibshirani, *An Introduction to the Bootstrap*, with the percentiles expanded for small samples as in
Hesterberg, *What Teachers Should Know About the Bootstrap*, The American Statistician 69 (2015), 4.2. Chi-square bounds:
Bar-Shalom, Li & Kirubarajan, 5.4.2. Rows are runs, columns are cells (estimator, window, metric); NaN is a missing run.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np
from scipy.special import chdtri, ndtr, stdtr, stdtrit

from testbed.base.streams import stream
from testbed.data.records import Array

DRAWS = 2000
"""Bootstrap resamples. One set of resampled runs serves all cells, so comparisons stay paired."""
LEVEL = 0.95
_BLOCK_BYTES = 4_000_000


def describe(values: Array, seed: int = 0) -> dict[str, Array]:
    """(runs, cells) to ``n, mean, std, median, p05, p95, ci_low, ci_high`` per cell; the interval is of the mean.

    A cell that is the same in all runs has no interval: nothing varied that it depends on.
    """
    finite = np.isfinite(values)
    n = finite.sum(axis=0)
    clean = np.where(finite, values, np.nan)
    out = {
        name: np.full(values.shape[1], np.nan) for name in ("mean", "std", "median", "p05", "p95", "ci_low", "ci_high")
    }
    some = n > 0
    if some.any():
        part = clean[:, some]
        out["mean"][some] = np.nanmean(part, axis=0)
        out["p05"][some], out["median"][some], out["p95"][some] = _quantiles(part, (0.05, 0.5, 0.95))
        several = n > 1
        out["std"][several] = np.nanstd(clean[:, several], axis=0, ddof=1)
        spread = several.copy()
        spread[some] &= np.nanmax(part, axis=0) > np.nanmin(part, axis=0)
        if spread.any():
            out["ci_low"][spread], out["ci_high"][spread] = mean_intervals(clean[:, spread], seed)
    return {"n": n} | out


def mean_intervals(values: Array, seed: int = 0) -> tuple[Array, Array]:
    """95 % bootstrap interval of each column's mean; every column has at least two finite values."""
    return expanded(bootstrap_means(values, seed), np.isfinite(values).sum(axis=0))


def bootstrap_means(values: Array, seed: int = 0) -> Array:
    """(DRAWS, cells) means of resampled runs: one draw of runs for all columns; NaN where a resample missed them all."""
    runs, cells = values.shape
    finite = np.isfinite(values)
    filled, complete = np.where(finite, values, 0.0), bool(finite.all())
    weights = finite.astype(np.float64)
    out = np.empty((DRAWS, cells))
    start = 0
    for counts in _resamples(runs, seed):
        with np.errstate(invalid="ignore"):
            out[start : start + len(counts)] = counts @ filled / (runs if complete else counts @ weights)
        start += len(counts)
    return out


def _resamples(runs: int, seed: int) -> Iterable[Array]:
    """How often each run is in each of `DRAWS` resamples, in blocks (size, runs)."""
    block = max(1, min(DRAWS, _BLOCK_BYTES // (8 * runs)))
    return _kept_resamples(runs, seed) if block == DRAWS else _drawn_resamples(runs, seed, block)


@lru_cache(maxsize=2)
def _kept_resamples(runs: int, seed: int) -> list[Array]:
    """Of few runs: hundreds of effects of one batch ask for the same."""
    return list(_drawn_resamples(runs, seed, DRAWS))


def _drawn_resamples(runs: int, seed: int, block: int) -> Iterator[Array]:
    rng = stream(seed, 0, "bootstrap")
    for start in range(0, DRAWS, block):
        size = min(block, DRAWS - start)
        drawn = rng.integers(0, runs, (size, runs)) + runs * np.arange(size)[:, None]
        yield np.bincount(drawn.ravel(), minlength=size * runs).reshape(size, runs).astype(np.float64)


def holm(p_values: Array) -> Array:
    """Holm's step-down adjusted p-values (Holm 1979); NaN stays NaN and does not count."""
    out = np.full(len(p_values), np.nan)
    known = np.flatnonzero(np.isfinite(p_values))
    order = known[np.argsort(p_values[known], kind="stable")]
    factors = len(order) - np.arange(len(order))
    out[order] = np.minimum(1.0, np.maximum.accumulate(p_values[order] * factors))
    return out


def difference_p(a: Array, b: Array, paired: bool) -> float:
    """Two-sided p-value of equal means: Student's t of the paired differences, or Welch's (1947) of independent samples."""
    parts = [a - b] if paired else [a, b]
    variances = np.array([part.var(ddof=1) / len(part) for part in parts])
    distance, error = abs(a.mean() - b.mean()), float(np.sqrt(variances.sum()))
    if error == 0.0:  # no scatter to measure by: the chance that the signs, or the labels, fell so
        return 1.0 if distance == 0.0 else 2.0 / (2.0 ** len(a) if paired else comb(len(a) + len(b), len(a)))
    dof = variances.sum() ** 2 / sum(v**2 / (len(part) - 1) for v, part in zip(variances, parts, strict=True))
    return float(2.0 * stdtr(dof, -distance / error))


def difference_interval(a: Array, b: Array, paired: bool, seed: int = 0) -> tuple[float, float]:
    """95 % bootstrap interval of ``mean a - mean b``: of the paired differences, or of independent samples."""
    if paired:
        low, high = mean_intervals((a - b)[:, None], seed)
    else:
        spread = bootstrap_means(a[:, None], seed) - bootstrap_means(b[:, None], seed + 1)
        low, high = expanded(spread, np.array([min(len(a), len(b))]))
    return float(low[0]), float(high[0])


def normality_p(values: Array) -> float:
    """p-value of D'Agostino and Pearson's test (Biometrika 60, 1973) that values (n,) are normal, by skewness and kurtosis.

    Skewness as D'Agostino (Biometrika 57, 1970), kurtosis as Anscombe and Glynn (Biometrika 70, 1983); n from 20 on. As
    `scipy.stats.normaltest`, whose import takes longer than the rest of a report.
    """
    n = len(values)
    centred = values - values.mean()
    variance = (centred**2).mean()
    skewness, kurtosis = (centred**3).mean() / variance**1.5, (centred**4).mean() / variance**2

    spread = 3.0 * (n * n + 27 * n - 70) * (n + 1) * (n + 3) / ((n - 2.0) * (n + 5) * (n + 7) * (n + 9))
    w2 = np.sqrt(2.0 * (spread - 1.0)) - 1.0
    scaled = skewness * np.sqrt((n + 1) * (n + 3) / (6.0 * (n - 2))) * np.sqrt(0.5 * (w2 - 1.0))
    of_skewness = np.arcsinh(scaled) / np.sqrt(0.5 * np.log(w2))

    x = kurtosis - 3.0 * (n - 1) / (n + 1)
    x /= np.sqrt(24.0 * n * (n - 2) * (n - 3) / ((n + 1.0) ** 2 * (n + 3) * (n + 5)))
    third = (
        6.0 * (n * n - 5 * n + 2) / ((n + 7.0) * (n + 9)) * np.sqrt(6.0 * (n + 3) * (n + 5) / (n * (n - 2.0) * (n - 3)))
    )
    a = 6.0 + 8.0 / third * (2.0 / third + np.sqrt(1.0 + 4.0 / third**2))
    root = np.cbrt((1.0 - 2.0 / a) / (1.0 + x * np.sqrt(2.0 / (a - 4.0))))
    of_kurtosis = (1.0 - 2.0 / (9.0 * a) - root) / np.sqrt(2.0 / (9.0 * a))
    return float(np.exp(-0.5 * (of_skewness**2 + of_kurtosis**2)))


def chi_square_bounds(dof: Array) -> tuple[Array, Array]:
    """Two-sided 95 % bounds of a chi-square variable with ``dof`` degrees of freedom (array)."""
    tail = (1.0 - LEVEL) / 2.0
    return np.asarray(chdtri(dof, 1.0 - tail)), np.asarray(chdtri(dof, tail))


@dataclass
class ConsistencySum:
    """NEES or NIS summed over runs at each time of a grid: ``value``, degrees of freedom, number of samples; all (T,)."""

    value: Array
    dof: Array
    count: Array
    runs: int = 0

    @classmethod
    def zero(cls, points: int) -> ConsistencySum:
        """Nothing yet, at so many times."""
        return cls(np.zeros(points), np.zeros(points), np.zeros(points))

    def add(self, value: Array, dof: Array, count: Array) -> None:
        """Add a run; times where it has no finite value stay out."""
        used = np.isfinite(value) & (dof > 0)
        self.value[used] += value[used]
        self.dof[used] += dof[used]
        self.count[used] += count[used]
        self.runs += 1

    def summary(self, times: Array, settled_s: float) -> dict[str, float]:
        """Mean, bounds and share of time inside them of the run-averaged statistic after ``settled_s``.

        ``dof``, ``mean`` and the bounds are those of one sample (the bounds: of the average over runs, and over the
        samples that the grid pools, in the middle of the times).
        """
        used = (self.dof > 0) & (times > settled_s)
        if not used.any():
            nothing = dict.fromkeys(("mean", "lower", "upper", "share_inside"), np.nan)
            return {"dof": np.nan, "n_runs": self.runs} | nothing
        value, total = self.value[used], self.dof[used]
        lower, upper = chi_square_bounds(total)
        inside = (value >= lower) & (value <= upper)
        dof = float(total.sum() / self.count[used].sum())
        return {
            "dof": dof,
            "n_runs": self.runs,
            "mean": float(value.sum() / total.sum() * dof),
            "lower": float(np.median(lower / total) * dof),
            "upper": float(np.median(upper / total) * dof),
            "share_inside": float(inside.mean()),
        }


def envelope(errors: Array, sigmas: Array | None = None) -> dict[str, Array]:
    """(runs, times) errors, and the filters' own 1-sigma, to ``mean, p05, p95, rms, sigma`` per time."""
    some = np.isfinite(errors).any(axis=0)
    out = {name: np.full(errors.shape[1], np.nan) for name in ("mean", "p05", "p95", "rms", "sigma")}
    part = errors[:, some].astype(np.float64)
    if part.shape[1]:
        out["mean"][some] = np.nanmean(part, axis=0)
        out["rms"][some] = np.sqrt(np.nanmean(part**2, axis=0))
        out["p05"][some], out["p95"][some] = _quantiles(part, (0.05, 0.95))
    if sigmas is not None:
        told = np.isfinite(sigmas).any(axis=0)
        out["sigma"][told] = np.sqrt(np.nanmean(sigmas[:, told].astype(np.float64) ** 2, axis=0))
    return out


def _quantiles(values: Array, levels: tuple[float, ...]) -> Array:
    """np.nanquantile along axis 0, which is slow, unless nothing is missing."""
    if np.isfinite(values).all():
        return np.quantile(values, levels, axis=0)
    ordered = np.sort(values, axis=0)  # NaN last
    n = np.isfinite(values).sum(axis=0)
    return np.stack([_interpolated(ordered, level * (n - 1)) for level in levels])


def expanded(means: Array, n: Array) -> tuple[Array, Array]:
    """Percentiles of bootstrap means (draws, cells), expanded so that the interval has Student's width for ``n`` runs."""
    ordered = np.sort(means, axis=0)
    drawn = np.isfinite(ordered).sum(axis=0)
    tail = ndtr(-np.sqrt(n / (n - 1.0)) * stdtrit(n - 1.0, 0.5 + LEVEL / 2.0))
    return _interpolated(ordered, tail * (drawn - 1)), _interpolated(ordered, (1.0 - tail) * (drawn - 1))


def _interpolated(ordered: Array, position: Array) -> Array:
    """Value at a fractional row of each column."""
    low = np.clip(np.floor(position).astype(int), 0, len(ordered) - 1)
    high = np.minimum(low + 1, len(ordered) - 1)
    part = position - low
    columns = np.arange(ordered.shape[1])
    below, above = ordered[low, columns], ordered[high, columns]
    return np.where(part > 0, below + part * (above - below), below)
