"""Random streams: one independent generator per (scenario seed, run, name).

A stream depends on nothing else, so adding a sensor, an estimator or a worker never changes another stream.
"""

from __future__ import annotations

import hashlib

import numpy as np


def stable_hash(name: str) -> int:
    """64-bit hash of a name that is the same in every process (Python's own ``hash`` is salted)."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")


def stream(seed: int, run: int, name: str) -> np.random.Generator:
    """The generator for ``name`` (for example ``"imu"``) in Monte Carlo run ``run`` of a scenario seeded ``seed``."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence((seed, run, stable_hash(name)))))
