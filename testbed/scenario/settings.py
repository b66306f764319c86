"""Single settings over a scenario's tables: dotted keys, their values in TOML, and the merging of tables."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from testbed.base.errors import InputError, nearest, shown
from testbed.base.schema import DEEPEST, parse_toml


def merge(base: Mapping[str, Any], overlay: Mapping[str, Any]) -> dict[str, Any]:
    """Tables are merged key by key; every other value, lists included, is replaced."""
    out = dict(base)
    for key, value in overlay.items():
        both = isinstance(value, Mapping) and isinstance(out.get(key), Mapping)
        out[key] = merge(out[key], value) if both else value
    return out


def changed_rows(rows: list[Any], changes: Mapping[str, Any], where: str) -> list[Any]:
    """Estimators with an overlay's table of changes laid over them: its keys are labels, or names of rows without one.

    Raises InputError for a row that is not there: in an overlay that is a slip, or a list that another overlay has shortened.
    """
    labels = [str(row.get("label") or row.get("name")) if isinstance(row, Mapping) else "" for row in rows]
    out = list(rows)
    for label, change in changes.items():
        if label not in labels:
            raise InputError(f"{where}: 'estimators' has no row '{label}'; {nearest(label, labels)}")
        if not isinstance(change, Mapping):
            raise InputError(f"{where}: 'estimators.{label}' should be a table of settings, got {shown(change)}")
        out[labels.index(label)] = merge(out[labels.index(label)], change)
    return out


def set_key(data: dict[str, Any], key: str, value: Any, source: str) -> None:
    """Set a dotted key in place, for example ``sensors.gnss.outages`` or ``flight.manoeuvres.0.bank_deg``.

    A row of a list is meant by its position from 0, an estimator also by its label or name (``estimators.imm.params.beta``); an
    estimator that has no row yet gets one.
    """
    *parents, last = key.split(".")
    node: Any = data
    if len(parents) >= DEEPEST:
        raise InputError(f"{source}: cannot set {shown(key)}: no key lies more than {DEEPEST} tables deep")
    for part in parents:
        node = node[_position(node, part, key, source)] if isinstance(node, list) else node.setdefault(part, {})
        if not isinstance(node, dict | list):
            raise InputError(f"{source}: cannot set '{key}': '{part}' is a single value")
    node[_position(node, last, key, source) if isinstance(node, list) else last] = value


def _position(node: list[Any], part: str, key: str, source: str) -> int:
    number = position_of(part)
    if key.startswith("estimators.") and key.split(".")[1] == part and number is None:
        rows = [str(row.get("label") or row.get("name")) for row in node if isinstance(row, dict)]
        if part not in rows:
            node.append({"name": part})
            return len(node) - 1
        return rows.index(part)
    if number is None or number >= len(node):
        raise InputError(f"{source}: cannot set '{key}': '{part}' is not a position from 0 to {len(node) - 1}")
    return number


def position_of(text: str) -> int | None:
    """The number that ``text`` writes in plain digits; None for anything else (``str.isdigit`` takes a superscript two)."""
    return int(text) if re.fullmatch("[0-9]{1,9}", text) else None


def hides(key: str, earlier: str) -> bool:
    """Whether setting a dotted key leaves nothing of what an earlier one set: the same key, or one inside of it."""
    return f"{earlier}.".startswith(f"{key}.")


def check_once(settings: Mapping[str, Any], key: str, option: str) -> None:
    """Raise InputError where ``settings`` (dotted keys) give what ``option`` gives as well, by itself or in its table."""
    table, _, last = key.rpartition(".")
    beside = settings.get(table)
    if key in settings or (isinstance(beside, Mapping) and last in beside):
        raise InputError(f"{option}: '{key}' is given as a setting as well, two values for one thing; give one of them")


def parse_setting(text: str) -> tuple[str, Any]:
    """``KEY=VALUE`` of ``--set``, the value in TOML; a bare word counts as a string."""
    key, separator, value = text.partition("=")
    if not separator or not key:
        raise InputError(f"--set {text}: expected KEY=VALUE, for example monte_carlo.runs=50")
    return key.strip(), parse_value(value)


def parse_value(text: str) -> Any:
    """A value as TOML writes it; what is no TOML, such as a bare word, counts as a string."""
    try:
        return parse_toml(f"value = {text}", "--set")["value"]
    except InputError:
        return text.strip()
