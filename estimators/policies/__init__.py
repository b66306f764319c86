"""Policies: what happens at an update besides the Kalman filter's own arithmetic.

A policy is ``judge(memory, residual, s, r, h, p) -> fading``, a plain function that numba can compile. It sees the innovation
(m,), its covariance ``s`` (m,m) = H P H' + R, the noise variances ``r`` (m,), which it may change, H (m,n) and P, and keeps
what it likes in ``memory``, an array of its own per aiding. It returns 1 for an update, 0 to reject the measurement, or
more to multiply P by that factor first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.registry import note_part

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Policy:
    """A policy under the name that a composition calls it by."""

    name: str
    judge: Callable[..., float] | None
    memory: Callable[..., Array]
    """``memory(rows, **options)``: its array at the start, for measurements of ``rows`` channels. Raises InputError."""
    summary: str = ""


POLICIES: dict[str, Policy] = {}


def add_policy(policy: Policy) -> Policy:
    """Make a policy known by its name; also for a plug-in's own."""
    POLICIES[policy.name] = policy
    note_part(policy.name)
    return policy


def fraction(name: str, value: Any) -> float:
    """A number between 0 and 1. Raises InputError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < 1.0:
        raise InputError(f"{name} = {value!r}: must be a number between 0 and 1")
    return float(value)


def positive(name: str, value: Any) -> float:
    """A number above 0. Raises InputError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < np.inf:
        raise InputError(f"{name} = {value!r}: must be a positive number")
    return float(value)


add_policy(Policy("plain", None, lambda rows: np.zeros(0), "the Kalman update"))
