"""Ranking of candidate inputs: most relevance to the output, least redundancy among themselves (MRMR).

``all``: J(Xi) = I(Xi; Y) - 1/(n-1) sum of I(Xi; Xk) over all other candidates, as the NARX thesis (2021) has it.
``greedy``: Peng, Long & Ding (2005), IEEE Trans. PAMI 27(8): the sum runs over the inputs chosen so far. In nats.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from testbed.base.errors import InputError
from testbed.features.information import Array, mutual_information, mutual_information_knn


@dataclass(frozen=True)
class Ranked:
    """One candidate: ``score`` = ``relevance`` - ``redundancy``, nats."""

    name: str
    score: float
    relevance: float
    redundancy: float


def rank_mrmr(
    candidates: Array,
    output: Array,
    names: Sequence[str] | None = None,
    method: Literal["all", "greedy"] = "greedy",
    estimate: Literal["histogram", "knn"] = "histogram",
) -> list[Ranked]:
    """Candidates (N,n) against ``output`` (N,), best first.

    With ``all``, an input that has a duplicate pays for it whichever of the two is kept, so that an irrelevant input
    can pass both; ``greedy`` lets the first of them in and rejects the second.
    """
    candidates = np.asarray(candidates, dtype=float)
    count = candidates.shape[1] if candidates.ndim == 2 else 0
    names = list(names) if names is not None else [f"x{i}" for i in range(count)]
    if count == 0 or len(names) != count:
        raise InputError(f"MRMR: candidates {candidates.shape} and {len(names)} names do not match")
    if method not in ("all", "greedy") or estimate not in ("histogram", "knn"):
        raise InputError(f"MRMR: method '{method}' (all, greedy), estimate '{estimate}' (histogram, knn)")
    information: Callable[[Array, Array], float]
    information = mutual_information if estimate == "histogram" else mutual_information_knn
    relevance = np.array([information(column, output) for column in candidates.T])
    shared = np.zeros((count, count))
    for i in range(count):
        for k in range(i):
            shared[i, k] = shared[k, i] = information(candidates[:, i], candidates[:, k])
    if method == "all":
        redundancy = shared.sum(axis=1) / max(1, count - 1)
        order = [int(i) for i in np.argsort(redundancy - relevance, kind="stable")]
    else:
        order, redundancy = _greedy(relevance, shared)
    return [
        Ranked(names[i], float(relevance[i] - redundancy[i]), float(relevance[i]), float(redundancy[i])) for i in order
    ]


def _greedy(relevance: Array, shared: Array) -> tuple[list[int], Array]:
    """Order of choice, and for each candidate its mean information shared with those chosen before it."""
    order: list[int] = []
    redundancy = np.zeros(len(relevance))
    left = list(range(len(relevance)))
    while left:
        for i in left:
            redundancy[i] = shared[i, order].mean() if order else 0.0
        best = max(left, key=lambda i: relevance[i] - redundancy[i])
        order.append(best)
        left.remove(best)
    return order, redundancy
