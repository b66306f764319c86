"""What every table of a scenario or catalogue shares: strict pydantic models, and errors that say what would be right.

Unknown keys, strings in place of numbers, NaN and infinities are refused. `validate` names the file and the key.
"""

from __future__ import annotations

import json
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from testbed.errors import InputError, closest, nearest


class Table(BaseModel):
    """Base of every configuration table."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


JSBSIM = "jsbsim"
"""Tag of a union's member that is taken where nobody writes a tag; so no message shows it."""

Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises InputError when it is missing or not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None


def validate(model: type[Model], data: Mapping[str, Any], source: str, folder: Path | None = None) -> Model:
    """Build ``model`` from plain data, or raise one InputError that lists each wrong key of ``source``.

    Relative file names in the data start from ``folder``.
    """
    try:
        return model.model_validate(data, context={} if folder is None else {"folder": folder})
    except ValidationError as error:
        problems = [dict(problem) for problem in error.errors()]
        told = [_explain(model, problem) for problem in _without_consequences(model, problems)]
        raise InputError("\n".join(f"{source}: {problem}" for problem in told)) from None


def _without_consequences(model: type[BaseModel], problems: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Without the keys that are missing only because they were misspelt, as another problem says."""
    meant = {
        (*problem["loc"][:-1], closest(str(problem["loc"][-1]), _fields_at(model, problem["loc"][:-1])))
        for problem in problems
        if problem["type"] == "extra_forbidden"
    }
    return [p for p in problems if not (p["type"] == "missing" and p["loc"] in meant)]


def _explain(model: type[BaseModel], problem: dict[str, Any]) -> str:
    loc, kind = problem["loc"], problem["type"]
    shown = ".".join(str(part) for part in loc if part != JSBSIM) or "(top level)"
    if kind == "extra_forbidden":
        fields = _fields_at(model, loc[:-1])
        return f"'{shown}' is not a known key; {nearest(str(loc[-1]), fields)}"
    message = problem["msg"].removeprefix("Value error, ")
    if kind == "missing":
        return f"'{shown}' is missing"
    if kind == "union_tag_not_found":
        return f"'{shown}': the key {problem['ctx']['discriminator']} is missing"
    if kind == "union_tag_invalid":
        context = problem["ctx"]
        key = context["discriminator"].strip(chr(39))
        key = "type" if key.endswith("()") else key  # found by a function, as the tag may be left out
        valid = [name.strip(" '") for name in context["expected_tags"].split(",")]
        return f"'{shown}': unknown {key} '{context['tag']}'; {nearest(context['tag'], valid)}"
    got = problem.get("input")
    value = f", got {got!r}" if isinstance(got, str | int | float | bool) else ""
    if kind in ("float_type", "int_type") and isinstance(got, str):
        value += "; numbers stand without quotes"
    return f"'{shown}': {message[0].lower()}{message[1:]}{value}"


def _fields_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Names that are valid at a place inside a model, for the hint after an unknown key."""
    current: list[Any] = [model]
    for part in loc:
        following: list[Any] = []
        for kind in current:
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                if part in kind.model_fields:
                    following += _unwrap(kind.model_fields[str(part)].annotation)
                else:
                    following.append(kind)  # the tag of a union, already among the candidates
        tagged = [k for k in current if _is_tagged(k, part)]
        current = tagged or following or current
    models = [kind for kind in current if isinstance(kind, type) and issubclass(kind, BaseModel)]
    return [name for kind in models for name in kind.model_fields]


def _is_tagged(kind: Any, part: int | str) -> bool:
    """True where ``kind`` is the member of a discriminated union that the tag ``part`` names."""
    if not (isinstance(kind, type) and issubclass(kind, BaseModel) and "type" in kind.model_fields):
        return False
    return part in typing.get_args(kind.model_fields["type"].annotation)


def _unwrap(annotation: Any) -> list[Any]:
    """The model classes inside list[...], unions and Annotated."""
    origin = typing.get_origin(annotation)
    if origin is None:
        return [annotation]
    if origin is typing.Annotated:
        return _unwrap(typing.get_args(annotation)[0])
    if origin in (list, tuple, dict, typing.Union, types.UnionType):
        return [kind for arg in typing.get_args(annotation) for kind in _unwrap(arg)]
    return []


def dump_toml(data: Mapping[str, Any], prefix: str = "") -> str:
    """Plain data as TOML text: values first, then tables, then lists of tables."""
    lines: list[str] = []
    nested: list[str] = []
    for key, value in data.items():
        name = f"{prefix}{_toml_key(key)}"
        if isinstance(value, Mapping):
            body = dump_toml(value, f"{name}.")
            nested.append(f"\n[{name}]\n{body}" if value else f"\n[{name}]\n")
        elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
            nested += [f"\n[[{name}]]\n{dump_toml(item, f'{name}.')}" for item in value]
        else:
            lines.append(f"{_toml_key(key)} = {_toml_value(value)}\n")
    return "".join(lines + nested)


def _toml_key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else json.dumps(key)


def _toml_value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_toml_key(k)} = {_toml_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return str(value).lower() if isinstance(value, bool) else repr(value)
