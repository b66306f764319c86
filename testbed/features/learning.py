"""What an estimator with networks lays before the choice of inputs (`testbed features`): candidates and targets.

Plain arrays in the estimator's own units; samples in rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from testbed.features.information import Array


@dataclass(frozen=True)
class LearningData:
    """What a network learns from: candidate inputs (N,n) by ``names``, and each target (N,) by its name."""

    names: tuple[str, ...]
    candidates: Array
    targets: Mapping[str, Array]
