"""Ranks of search algorithms with their uncertainty: sums of ranks over statistics and quantities, resampled over the searches' seeds.

A paper ranks algorithms by few searches of each; another seed is another rank. Intervals are percentiles of a bootstrap (Efron
& Tibshirani, *An Introduction to the Bootstrap*, 13.3) over the seeds of each algorithm, drawn independently of one another;
of a minimum or maximum it knows only the values that were found. Ranks count from 1, the lowest value; ties share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array
from testbed.scoring.statistics import LEVEL

if TYPE_CHECKING:
    import pandas as pd

STATISTICS = ("min", "max", "mean", "variance")
"""Over the searches of an algorithm, as the tables of such papers have them."""
DRAWS = 2000
"""Resamples: the ends of a 95 % interval then stand within one per cent of probability (binomial, two sigma)."""
Rows = Sequence[tuple[str, str]]
"""(quantity, statistic) whose ranks are added."""


def rank_table(lines: pd.DataFrame, parts: Mapping[str, Rows], seed: int = 0) -> pd.DataFrame:
    """Columns part, rows, algorithm, rank_sum, low, high, place, place_low, place_high; intervals of 95 %.

    ``lines``: a row per search, with ``algorithm`` and a column per quantity; every algorithm needs the same number of them, at
    least 2. ``parts``: what each sum of ranks runs over. Raises InputError where the searches do not suffice.
    """
    import pandas as pd

    algorithms = list(dict.fromkeys(lines["algorithm"]))
    quantities = list(dict.fromkeys(q for rows in parts.values() for q, _ in rows))
    groups = [lines.loc[lines["algorithm"] == a, quantities].to_numpy(dtype=float) for a in algorithms]
    counts = {len(group) for group in groups}
    if len(algorithms) < 2 or len(counts) != 1 or min(counts) < 2:
        told = ", ".join(f"{a} {len(group)}" for a, group in zip(algorithms, groups, strict=True))
        raise InputError(f"ranks need two algorithms or more with the same number of searches, at least 2; got {told}")
    values = np.stack(groups)
    drawn = resampled(values, DRAWS, seed)
    out = []
    for part, rows in parts.items():
        chosen = [(quantities.index(q), STATISTICS.index(s)) for q, s in rows]
        own, others = (_sums(array, chosen) for array in (statistics(values)[None], drawn))
        places, other_places = ranks(own)[0], ranks(others)
        tail = 50.0 * (1.0 - LEVEL)
        ends, place_ends = (np.percentile(array, [tail, 100.0 - tail], axis=0) for array in (others, other_places))
        for k, algorithm in enumerate(algorithms):
            out.append((part, len(rows), algorithm, own[0, k], *ends[:, k], places[k], *place_ends[:, k]))
    columns = ["part", "rows", "algorithm", "rank_sum", "low", "high", "place", "place_low", "place_high"]
    return pd.DataFrame(out, columns=columns)


def statistics(values: Array) -> Array:
    """(..., quantities, 4): `STATISTICS` of values (..., searches, quantities)."""
    found = values.min(axis=-2), values.max(axis=-2), values.mean(axis=-2), values.var(axis=-2, ddof=1)
    return np.stack(found, axis=-1)


def resampled(values: Array, draws: int, seed: int) -> Array:
    """(draws, algorithms, quantities, 4): statistics of resamples of values (algorithms, searches, quantities)."""
    rng = np.random.default_rng(seed)
    size = values.shape[1]
    picks = rng.integers(0, size, (draws, len(values), size))
    return np.stack(
        [statistics(own[picks[:, k]]) for k, own in enumerate(values)],
        axis=1,
    )


def ranks(values: Array) -> Array:
    """Ranks along the last axis, the lowest first; those that tie share the mean of their places."""
    less = (values[..., None, :] < values[..., :, None]).sum(axis=-1)
    equal = (values[..., None, :] == values[..., :, None]).sum(axis=-1)
    out: Array = less + 0.5 * (equal + 1.0)
    return out


def _sums(found: Array, chosen: Sequence[tuple[int, int]]) -> Array:
    """(draws, algorithms): sums of ranks over the chosen (quantity, statistic) of (draws, algorithms, quantities, 4)."""
    total: Array = sum((ranks(found[:, :, q, s]) for q, s in chosen), start=np.zeros(found.shape[:2]))
    return total
