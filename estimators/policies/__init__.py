"""Policies: what happens at an update besides the Kalman filter's own arithmetic.

A policy is ``judge(memory, residual, s, r, h, p) -> fading``, a plain function that numba can compile. It sees the innovation
(m,), its covariance ``s`` (m,m) = H P H' + R, the noise variances ``r`` (m,), which it may change, H (m,n) and P, and keeps
what it likes in ``memory``, an array of its own per aiding. It returns 1 for an update, 0 to reject the measurement, or
more to multiply P by that factor first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import InputError, nearest

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Policy:
    """A policy under the name that a composition calls it by."""

    name: str
    judge: Callable[..., float] | None
    memory: Callable[..., Array]
    """memory(rows, **options): its array at the start, for measurements of ``rows`` channels. Raises InputError."""
    summary: str = ""


POLICIES: dict[str, Policy] = {}


def add_policy(policy: Policy) -> Policy:
    """Make a policy known by its name; also for a plug-in's own."""
    POLICIES[policy.name] = policy
    return policy


def find_policy(name: str) -> Policy:
    """The policy of this name. Raises InputError with the nearest name."""
    from estimators.policies import adaptive, gate, robust

    assert adaptive and gate and robust
    if name not in POLICIES:
        raise InputError(f"no policy is called '{name}'; {nearest(name, POLICIES)}")
    return POLICIES[name]


def chosen_policy(setting: str | Mapping[str, Any]) -> tuple[Policy, dict[str, Any]]:
    """Policy and options behind a scenario's setting: a name, or a table whose only, or first, key is the name.

    ``"gate"``, ``{gate = 0.999}`` (the option that the policy is named after), ``{huber = {k = 1.345}}``.
    """
    if isinstance(setting, str):
        return find_policy(setting), {}
    if not isinstance(setting, Mapping) or len(setting) != 1:
        raise InputError(f"policy = {setting!r}: expected a name, or a table such as {{ gate = 0.999 }}")
    ((name, options),) = setting.items()
    if isinstance(options, Mapping):
        return find_policy(name), dict(options)
    return find_policy(name), {name.replace("-", "_"): options}


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
