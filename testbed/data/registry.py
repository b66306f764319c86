"""Estimators by name: entry points of the group ``testbed.estimators``, and single files given with ``--plugin``.

An estimator is any class with a ``name`` and ``run(log) -> NavSolution``; its constructor's keywords are its parameters.
"""

from __future__ import annotations

import copy
import dataclasses
import importlib.util
import inspect
import re
import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.errors import OWN, InputError, nearest, shown
from testbed.data.estimator import Estimator

if TYPE_CHECKING:
    from testbed.data.records import SensorLog

GROUP = "testbed.estimators"
SHIPPED = "estimators"
"""The package of those that ship."""


_plugins: dict[str, type] = {}
_parts: list[str] = []


@cache
def _entries() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def list_estimators() -> list[str]:
    """Names that `make_estimator` knows, sorted."""
    return sorted(set(_entries()) | set(_plugins))


def estimator_class(name: str) -> type:
    """The class behind a name. Raises InputError with the nearest name when there is none."""
    if name in _plugins:
        return _plugins[name]
    if name not in _entries():
        raise InputError(f"unknown estimator '{name}'; {nearest(name, list_estimators())}; {OWN}")
    loaded: type = _entries()[name].load()
    return loaded


def make_estimator(name: str, **params: Any) -> Estimator:
    """Build an estimator. Raises InputError for an unknown name or parameter."""
    kind = estimator_class(name)
    known = parameter_names(kind)
    for key in params:
        if known is not None and key not in known:
            raise InputError(f"estimator '{name}' has no parameter '{key}'; {nearest(key, known)}")
    _check_kinds(name, kind, params)
    try:
        made: Estimator = kind(**params)
    except (TypeError, ValueError) as error:
        raise InputError(f"estimator '{name}': {error}") from None
    return made


def log_for(estimator: Estimator, log: SensorLog) -> SensorLog:
    """What an estimator is handed: the log, or a copy for one that does not ship, whose changes in place nobody after it may see."""
    ships = type(estimator).__module__.partition(".")[0] == SHIPPED
    return log if ships else copy.deepcopy(log)


def _check_kinds(name: str, kind: type, params: Mapping[str, Any]) -> None:
    """Refuse text for a number and the like, where the default of a parameter tells what it is; a list may stand for a number."""
    for key, parameter in inspect.signature(kind).parameters.items():
        usual, given = parameter.default, params.get(key)
        if (
            given is None
            or not isinstance(usual, bool | int | float | str)
            or parameter.annotation in (Any, object, "Any", "object")
        ):
            continue
        number = not isinstance(usual, bool | str)
        if isinstance(given, str | bool) if number else not isinstance(given, type(usual)):
            what = "a number" if number else "a text" if isinstance(usual, str) else "true or false"
            raise InputError(f"estimator '{name}': '{key}' should be {what} like {usual!r}, got {shown(given)}")


def parameter_names(kind: type) -> list[str] | None:
    """Declared parameters of an estimator class; None where its constructor takes any keyword."""
    if dataclasses.is_dataclass(kind):
        return [f.name for f in dataclasses.fields(kind) if f.init]
    parameters = inspect.signature(kind).parameters.values()
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        return None
    return [p.name for p in parameters]


def describe_parameters(name: str) -> list[tuple[str, str, str, str]]:
    """A row per parameter of an estimator: name, default, range that a tuner may search, meaning.

    The meaning is ``metadata={"help": ...}`` of the field, else the sentence of the class's docstring that has the parameter
    in double backquotes.
    """
    kind = estimator_class(name)
    fields = {f.name: f for f in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else {}
    space: Mapping[str, tuple[float, float, str]] = getattr(kind, "parameter_space", {})
    rows = []
    for key, parameter in inspect.signature(kind).parameters.items():
        given = fields.get(key)
        default = parameter.default
        if given is not None and given.default_factory is not dataclasses.MISSING:
            default = given.default_factory()
        shown = "must be given" if default is parameter.empty else _shown(default)
        help_ = given.metadata.get("help", "") if given is not None else ""
        rows.append((key, shown, _range(space.get(key)), help_ or _sentence(kind, key)))
    known = [row[0] for row in rows]
    return rows + [(key, "", _range(limits), "") for key, limits in space.items() if key not in known]


def _shown(value: Any) -> str:
    """A default as a scenario would have it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_shown, value))}]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {_shown(v)}" for k, v in value.items()) + " }" if value else "{}"
    return f'"{value}"' if isinstance(value, str) else "none" if value is None else str(value)


def _range(limits: tuple[float, float, str] | None) -> str:
    return "" if limits is None else f"{limits[0]:g} to {limits[1]:g} ({limits[2]})"


def _sentence(kind: type, key: str) -> str:
    """What the docstrings of a class and its parents say first about a parameter."""
    for parent in kind.__mro__:
        text = " ".join((parent.__dict__.get("__doc__") or "").split())
        for sentence in re.split(r"(?<=[.;]) (?=``|[A-Z])", text):
            if f"``{key}``" in sentence:
                return re.sub(r"^(``\w+``(, | and )?)+: ", "", sentence).rstrip(".;").replace("``", "")
    return ""


def note_part(name: str) -> None:
    """Say that a part from which filters are composed was made known: what a plug-in may hold instead of an estimator."""
    _parts.append(name)


def load_plugin(path: str | Path) -> list[str]:
    """Load a Python file that the user named and register every estimator class in it; returns their names.

    A file that only makes parts of filters known (`note_part`) is one, too. Raises InputError for one with neither.
    """
    path = Path(path).resolve()
    if not path.is_file():
        raise InputError(f"{path}: no such plug-in file")
    module_name = f"testbed_plugin_{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: not a Python file; a plug-in ends in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    parts = len(_parts)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise InputError(f"{path}: the plug-in does not import: {type(error).__name__}: {error}") from error
    found: dict[str, type] = {
        kind.name: kind  # type: ignore[attr-defined]
        for kind in vars(module).values()
        if inspect.isclass(kind)
        and isinstance(getattr(kind, "name", None), str)
        and callable(getattr(kind, "run", None))
        if kind.__module__ == module_name
    }
    if not found and len(_parts) == parts:
        raise InputError(
            f"{path}: no estimator in it; it needs a class with a 'name' and a method run(log), or a part of a filter that it"
            " makes known, such as add_policy(...)"
        )
    for name in found:
        if name in _entries():
            raise InputError(f"{path}: '{name}' is the name of an estimator that ships; give yours another")
    _plugins.update(found)
    return sorted(found)
