"""Random streams of the sensors: one per step of a sensor, so that no step changes what another one draws.

Streams are those of `testbed.base.streams`; a step that a Monte Carlo does not vary draws in every run what run 0 draws.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from testbed.base.streams import stream

VARIED = ("noise", "turn_on", "alignment", "outages")
"""What may differ between the runs of a Monte Carlo."""


@dataclass(frozen=True)
class Draws:
    """The streams of one Monte Carlo run."""

    seed: int
    run: int = 0
    vary: Collection[str] = VARIED

    def noise(self, name: str) -> np.random.Generator:
        """For what changes from sample to sample."""
        return self._stream("noise", name)

    def turn_on(self, name: str) -> np.random.Generator:
        """For what is constant from switch-on: biases, scale factors, misalignments."""
        return self._stream("turn_on", name)

    def alignment(self, name: str) -> np.random.Generator:
        """For the errors of the initial state."""
        return self._stream("alignment", name)

    def outages(self, name: str) -> np.random.Generator:
        """For the times of outages and bursts."""
        return self._stream("outages", name)

    def _stream(self, kind: str, name: str) -> np.random.Generator:
        return stream(self.seed, self.run if kind in self.vary else 0, name)
