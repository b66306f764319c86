"""How slow a row says that it is, and how many runs of each track it has by that.

No cell follows from these numbers, as each says which runs it is of: when they change, only what is missing is computed.
"""

from __future__ import annotations

LEAST_US = {"fast": 0.0, "slow": 20.0, "very slow": 200.0}
"""Microseconds per IMU sample from which on a row is so slow; a seed of all tracks of a very slow one takes minutes."""
SEEDS = {"fast": 100, "slow": 10, "very slow": 3}
"""Of a row: a hundred halve the interval of 25 and are a night's work for nobody; ten of a slow row cost as much as 100 of a
fast one that is ten times as fast; three are the fewest with two degrees of freedom."""
QUICK_SEEDS = {"fast": 3, "slow": 1, "very slow": 0}
"""Three for the same reason; one shows that a slow row runs, and a very slow one alone would take most of the ten minutes."""


def speed_of(us: float) -> str:
    """How slow so many microseconds per IMU sample are."""
    return [name for name, least in LEAST_US.items() if us >= least][-1]


def seeds_of(speed: str, quick: bool) -> int:
    """How many runs of each track a row has. By what it declares, not by what is measured, so that no clock decides a byte."""
    return (QUICK_SEEDS if quick else SEEDS)[speed]
