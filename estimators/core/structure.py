"""What the blocks of a filter are to its loop: their order, which states wait for a measurement, which are integrals."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from estimators.blocks import Block
from estimators.core.propagate import NAV, eager_states

WAITING, NOT_KEPT = 3, 4
"""Groups of blocks that stand last: nothing needs them between measurements, and a solution has the first of them."""


def group(block: Block) -> int:
    """Place of a block's kind in the order: adds to specific force, to angular rate, integrals, all others."""
    found = ("accel", "gyro", "").index(block.adds_to)
    if found < 2 or block.chain:
        return found
    return WAITING if block.kept else NOT_KEPT


def spans(blocks: Sequence[Block]) -> NDArray[np.int64]:
    """First and last + 1 sensor-error state that add to specific force, then to angular rate."""
    ends = np.cumsum([sum(len(b.states) for b in blocks if b.adds_to == kind) for kind in ("accel", "gyro")])
    return np.array([0, ends[0], ends[0], ends[1]], dtype=np.int64)


def eager(blocks: Sequence[Block]) -> int:
    """Error states that every sample carries: those of navigation, what adds to the IMU, integrals, and what fills up."""
    tied = NAV + sum(len(b.states) for b in blocks if group(b) < WAITING)
    return eager_states(NAV + sum(len(b.states) for b in blocks), tied)


def not_kept(blocks: Sequence[Block]) -> int:
    """How many states, which are the last, a solution does not have."""
    return sum(len(b.states) for b in blocks if group(b) == NOT_KEPT)


def chain(blocks: Sequence[Block]) -> NDArray[np.int64]:
    """(c,2) pairs of sensor-error states of which the first is the integral of the second."""
    pairs, first = [], 0
    for block in blocks:
        pairs += [(first + i, first + j) for i, j in block.chain]
        first += len(block.states)
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def estimated(blocks: Sequence[Block], consider: Collection[str]) -> NDArray[np.float64]:
    """(n,) 1, or 0 of a state of the blocks that are considered."""
    return np.concatenate([np.ones(NAV), *(np.full(len(b.states), float(b.name not in consider)) for b in blocks)])
