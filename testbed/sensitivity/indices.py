"""Indices of a plan's outcomes, with intervals.

Sobol: first order after Saltelli et al., Comput. Phys. Commun. 181 (2010) 259-270, table 2 (b); total order after Jansen, ibid. (f).
Morris: mean ``mu``, mean size ``mu_star`` (Campolongo et al., Environ. Model. Softw. 22 (2007) 1509) and standard deviation
``sigma`` of the elementary effects, in units of the metric per whole range of the figure.

Outcomes are ``y`` (groups, size, seeds): a plan's groups, their points, and the noise seeds that all points share. Intervals
have a half width of 1.96 standard deviations over resamples of groups and seeds, both at once: they hold what another plan and
other noise would change.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from testbed.base.streams import stream
from testbed.data.records import Array
from testbed.sensitivity.design import MORRIS, Design

RESAMPLES = 1000
"""The half width of an interval then has an error of 1 / sqrt(2 * 1000), 2 %."""
_Z = 1.959964
"""95 % of a normal distribution."""
Estimates = dict[str, Array]
Rows = NDArray[np.intp]


def indices(design: Design, y: Array, seed: int) -> tuple[Estimates, Estimates]:
    """Indices by name, (d,) each, and the half widths of their 95 % intervals, for outcomes ``y`` (groups, size, seeds).

    A group that holds a value that is not finite is left out. NaN where fewer than two groups are left.
    """
    whole = np.isfinite(y).all(axis=(1, 2))
    steps = design.points.reshape(design.groups, design.size, -1)[whole]
    estimate = _morris(steps) if design.method == MORRIS else _sobol
    y = y[whole]
    if len(y) < 2:
        empty = {name: np.full(design.points.shape[1], np.nan) for name in names(design.method)}
        return empty, empty
    found = estimate(y.mean(axis=2), np.arange(len(y)))
    rng = stream(seed, 0, "sensitivity.resamples")
    drawn: dict[str, list[Array]] = {name: [] for name in found}
    for _ in range(RESAMPLES):
        rows, seeds = rng.integers(len(y), size=len(y)), rng.integers(y.shape[2], size=y.shape[2])
        share = np.bincount(seeds, minlength=y.shape[2]) / y.shape[2]
        for name, values in estimate((y @ share)[rows], rows).items():
            drawn[name].append(values)
    return found, {name: _Z * np.std(values, axis=0, ddof=1) for name, values in drawn.items()}


def names(method: str) -> tuple[str, ...]:
    """The indices of a method."""
    return ("mu", "mu_star", "sigma") if method == MORRIS else ("S1", "ST")


def _sobol(y: Array, _: Rows) -> Estimates:
    """From ``y`` (groups, d + 2): A, A with one column of B each, B."""
    y = y - y.mean()  # or the first order of a metric far from zero drowns in its mean
    a, ab, b = y[:, :1], y[:, 1:-1], y[:, -1:]
    variance = np.concatenate([a, b]).var()
    if variance == 0.0:
        zero = np.zeros(ab.shape[1])
        return {"S1": zero, "ST": zero}
    return {"S1": (b * (ab - a)).mean(axis=0) / variance, "ST": 0.5 * ((a - ab) ** 2).mean(axis=0) / variance}


def _morris(steps: Array) -> Callable[[Array, Rows], Estimates]:
    """The estimator for trajectories through the points ``steps`` (groups, d + 1, d)."""
    moved = np.diff(steps, axis=1)
    which = np.abs(moved).argmax(axis=2)
    length = np.take_along_axis(moved, which[:, :, None], axis=2)[:, :, 0]

    def estimate(y: Array, rows: Rows) -> Estimates:
        effects = np.empty((len(rows), steps.shape[2]))
        np.put_along_axis(effects, which[rows], np.diff(y, axis=1) / length[rows], axis=1)
        return {
            "mu": effects.mean(axis=0),
            "mu_star": np.abs(effects).mean(axis=0),
            "sigma": effects.std(axis=0, ddof=1),
        }

    return estimate


def noise_share(y: Array) -> float:
    """Share of the variance between the points' means over seeds that the choice of the seeds made; NaN for a single seed.

    The interplay of point and seed in a two-way table; what a seed adds to all points alike does not count, as it moves no index.
    """
    table = y.reshape(-1, y.shape[2])
    table = table[np.isfinite(table).all(axis=1)]
    n, seeds = table.shape
    if seeds < 2 or n < 2:
        return float("nan")
    means = table.mean(axis=1)
    rest = table - means[:, None] - table.mean(axis=0) + table.mean()
    between = float(means.var(ddof=1))
    own = float((rest**2).sum() / ((n - 1) * (seeds - 1))) / seeds
    return own / between if between > 0.0 else float("nan")
