"""Blocks: sensor-error states that a filter may carry beside position, velocity and attitude.

A block is names, what is known of its states at the start, the noise that drives them, how fast they return to a mean, and
``couple(aux, imu, accel, gyro)``, a plain function that numba can compile: it writes into ``accel`` and ``gyro`` (k,3) what
one unit of each of its k states adds to specific force (m/s²) and angular rate (rad/s) along b; ``aux`` (k,) are the states,
``imu`` (6,) the sample, angular rate first.
Sensor-error states are "measured minus true", SI units and radians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.data.records import SensorLog
from testbed.data.registry import note_part

Array = NDArray[np.float64]


class Process(NamedTuple):
    """What a log's specification promises about the k states of a block: first-order Markov processes."""

    start: Array
    """(k,) mean at the start."""
    covariance: Array
    """(k,k) at the start."""
    drive: Array
    """(k,) spectral densities of the driving noise."""
    decay: Array
    """(k,) inverse correlation times, 1/s; 0: a random walk, or a constant without ``drive``."""
    centre: Array
    """(k,) what the states return to."""


def constant(std: Array) -> Process:
    """States that are drawn once with standard deviations ``std`` (k,) around zero."""
    zero = np.zeros(len(std))
    return Process(zero, np.diag(np.square(std)), zero, zero, zero)


@dataclass(frozen=True)
class Block:
    """A block under the name that a composition calls it by."""

    name: str
    states: tuple[str, ...]
    process: Callable[[SensorLog], Process]
    """What the log says of the states. Raises InputError where the log lacks the sensor."""
    adds_to: Literal["accel", "gyro", ""] = ""
    """Which triad the states add to."""
    couple: Callable[..., None] | None = None
    follows_imu: bool = False
    """Whether ``couple`` depends on the sample and must be called with each of them."""
    in_lanes: bool = False
    """Whether such a ``couple`` takes `testbed.kernels.tables`, too: it does not branch on numbers."""
    summary: str = ""
    chain: tuple[tuple[int, int], ...] = ()
    """Pairs of states of which the first is the integral of the second; both keep their value otherwise."""
    kept: bool = True
    """Whether a solution has the states; of a nuisance, and one for each satellite, it has not."""
    named: Callable[[SensorLog], tuple[str, ...]] | None = None
    """Names of the states where the log decides how many there are (one per satellite); ``states`` is then empty."""

    def on(self, log: SensorLog) -> Block:
        """The block with the states that it has on this log."""
        return self if self.named is None else replace(self, states=self.named(log))


BLOCKS: dict[str, Block] = {}


def add_block(block: Block) -> Block:
    """Make a block known by its name."""
    BLOCKS[block.name] = block
    note_part(block.name)
    return block


def per_axis(pattern: str, axes: Any = "xyz") -> tuple[str, ...]:
    """Names of states by axis."""
    return tuple(pattern.format(axis) for axis in axes)
