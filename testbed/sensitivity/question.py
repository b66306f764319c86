"""What a sensitivity study is asked."""

from __future__ import annotations

from dataclasses import dataclass

from testbed.scoring.quantities import MAIN
from testbed.sensitivity.design import METHODS, MORRIS
from testbed.sensitivity.factors import Factor


@dataclass(frozen=True)
class Question:
    """What is asked: the influence of ``factors`` on ``metrics`` in ``windows``, by which methods, how closely."""

    factors: tuple[Factor, ...]
    metrics: tuple[str, ...] = (f"rmse_{MAIN[0]}",)
    windows: tuple[str, ...] = ("all",)
    methods: tuple[str, ...] = METHODS
    samples: int = 256
    """Base samples of Sobol, each of (figures + 2) points: the half width of a first-order index is then about 2 / sqrt(256), 0.12."""
    trajectories: int = 20
    """Of Morris, each of (figures + 1) points: the half width of a mean effect is then 2 / sqrt(20) of its scatter, 0.45 sigma."""
    runs: int = 8
    """Noise seeds, the same at every point. What they leave is told as a share of the variance, and lies in the intervals."""

    def groups(self, method: str) -> int:
        """How many groups of points a method draws."""
        return self.trajectories if method == MORRIS else self.samples
