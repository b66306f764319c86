"""The parts that a composition may name: every block, aiding and policy that ships, and what plug-ins add."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from estimators.aiding import AIDINGS, Aiding, baro, body, gnss, gravity, mag, ranges
from estimators.blocks import BLOCKS, Block, imu, satellites, sensors
from estimators.policies import POLICIES, Policy, adaptive, gate, robust
from testbed.base.errors import InputError, nearest

SHIPPED = (baro, body, gnss, gravity, mag, ranges, imu, satellites, sensors, adaptive, gate, robust)
"""Modules of parts; importing them makes their parts known."""


def find_block(name: str) -> Block:
    """The block of this name. Raises InputError with the nearest name."""
    if name not in BLOCKS:
        raise InputError(f"no block of states is called '{name}'; {nearest(name, BLOCKS)}")
    return BLOCKS[name]


def find_aiding(name: str) -> Aiding:
    """The aiding of this name. Raises InputError with the nearest name."""
    if name not in AIDINGS:
        raise InputError(f"no aiding is called '{name}'; {nearest(name, AIDINGS)}")
    return AIDINGS[name]


def find_policy(setting: str | Mapping[str, Any]) -> tuple[Policy, dict[str, Any]]:
    """Policy and options behind a scenario's setting: a name, or a table whose only key is the name.

    ``"gate"``, ``{ gate = 0.999 }`` (the option that the policy is named after), ``{ huber = { k = 1.345 } }``. Raises
    InputError for anything else.
    """
    if not isinstance(setting, str) and not (isinstance(setting, Mapping) and len(setting) == 1):
        raise InputError(f"policy = {setting!r}: expected a name, or a table such as {{ gate = 0.999 }}")
    name, options = (setting, {}) if isinstance(setting, str) else next(iter(setting.items()))
    if name not in POLICIES:
        raise InputError(f"no policy is called '{name}'; {nearest(name, POLICIES)}")
    return POLICIES[name], dict(options) if isinstance(options, Mapping) else {name.replace("-", "_"): options}
