"""Aidings: what the samples of other sensors say about a filter's state.

An aiding is the sensor whose samples it takes, how they become measurements with noise variances, and
``measure(state, imu, parameters, z, residual, h)``, a plain function that numba can compile: it writes ``residual`` (m,) = z
minus what the state predicts, and into ``h`` (m,n), zero before, the derivative of that prediction by the error state, taken
for "truth minus estimate". ``state``: lat, lon, h, v_n, q_nb, then the sensor-error states; ``imu`` (6,): angular rate and
specific force without their estimated errors. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.data.registry import note_part

Array = NDArray[np.float64]
Columns = Mapping[str, int]
"""First column in ``h`` of each block that the filter carries."""
ABSENT = -1.0
"""Stands for the column of a block that the filter does not carry."""


class Measurements(NamedTuple):
    """The samples of a sensor as a filter uses them."""

    t: Array
    """(M,) times that they describe."""
    z: Array
    """(M,m)"""
    r: Array
    """(M,m) noise variances."""
    parameters: Array
    """(p,) that ``measure`` gets beside each of them."""
    mix: Array | None = None
    """(M,m,m) where the noise is correlated: unit lower triangles L, the noise's covariance is then L diag(r) L'."""


@dataclass(frozen=True)
class Aiding:
    """An aiding under the name that a composition calls it by."""

    name: str
    sensor: str
    """Name of the samples in the log."""
    channels: tuple[str, ...]
    """Names and units of the m measurements."""
    measure: Callable[..., None]
    samples: Callable[..., Measurements]
    """``samples(log, columns, **options)``. Raises InputError where the log lacks the sensor."""
    needs: tuple[str, ...] = ()
    """Blocks without which it makes no sense."""
    summary: str = ""
    in_lanes: bool = False
    """Whether runs may be filtered side by side (`testbed.kernels.tables`): ``measure`` does not branch on numbers, and the
    times of its measurements follow from the times of the log, not from what was felt."""


AIDINGS: dict[str, Aiding] = {}


def add_aiding(aiding: Aiding) -> Aiding:
    """Make an aiding known by its name."""
    AIDINGS[aiding.name] = aiding
    note_part(aiding.name)
    return aiding
