"""What every table of a scenario or catalogue shares: strict pydantic models, and errors that say what would be right.

Unknown keys, strings in place of numbers, NaN and infinities are refused. `validate` names the file and the key.
"""

from __future__ import annotations

import datetime
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from testbed.base.errors import InputError, closest, nearest, shown


class Table(BaseModel):
    """Base of every configuration table."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


LONGEST_NAME = 100
"""Characters of a name: with what is added to it, it still fits a file's name of 255 bytes."""


def _printable(value: str) -> str:
    if not value.isprintable():
        raise ValueError("a name is one line of printable characters")
    return value


Name = Annotated[str, Field(max_length=LONGEST_NAME), AfterValidator(_printable)]
"""What names a row, a window or a manoeuvre in tables, figures and file names."""

JSBSIM = "jsbsim"
"""Tag of a union's member that is taken where nobody writes a tag; so no message shows it."""

OWN_TRACK = "trajectory"
"""Tag of the member that is taken where the key of this name stands; no message shows it either."""

Model = TypeVar("Model", bound=BaseModel)


DEEPEST = 32
"""Tables within tables that are read; the deepest key that means something (``variants.x.sensors...``) stands 8 deep."""
INT64 = range(-(2**63), 2**63)
"""The integers that TOML promises to carry."""
TOO_LARGE = "an integer has at most 64 bits"


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises InputError when it is missing or not TOML that the bench can use."""
    try:
        text = path.read_bytes().decode()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start} of the file)") from None
    except ValueError as error:  # a name with a zero byte
        raise InputError(f"{shown(str(path))}: no such file ({error})") from None
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """TOML text as plain data. Raises InputError, which begins with ``source``, for what is no TOML or beyond any table.

    Beyond: integers of more than 64 bits, dates, and nesting deeper than `DEEPEST`.
    """
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{source}: not valid TOML: nested too deep") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: not valid TOML: {error}") from None
    except ValueError:  # Python converts at most 4300 digits
        raise InputError(f"{source}: not valid TOML: {TOO_LARGE}") from None
    _check_plain(data, source)
    return data


def _check_plain(data: dict[str, Any], source: str) -> None:
    """Raise InputError for a value that no table has a use for, with its place; without recursion."""
    waiting: list[tuple[str, Any, int]] = [("", data, 0)]
    while waiting:
        place, value, depth = waiting.pop()
        if depth > DEEPEST:
            raise InputError(f"{source}: '{place}' lies more than {DEEPEST} tables and lists deep")
        if isinstance(value, dict):
            waiting += [(f"{place}.{key}" if place else key, item, depth + 1) for key, item in value.items()]
        elif isinstance(value, list):
            waiting += [(f"{place}.{k}", item, depth + 1) for k, item in enumerate(value)]
        elif isinstance(value, int) and value not in INT64:
            raise InputError(f"{source}: '{place}': {TOO_LARGE}")
        elif isinstance(value, datetime.date | datetime.time):
            raise InputError(f"{source}: '{place}': no key takes a date or a time; a text stands in quotes")


def is_file(path: Path) -> bool:
    """Whether there is such a file; a name that no file can have (too long, a zero byte) is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


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
    tagged = [1] if loc[:1] == ("flight",) and loc[1:2] in ((JSBSIM,), (OWN_TRACK,)) else []
    place = ".".join(str(part) for k, part in enumerate(loc) if k not in tagged) or "(top level)"
    if kind == "extra_forbidden":
        fields = _fields_at(model, loc[:-1])
        return f"'{place}' is not a known key; {nearest(str(loc[-1]), fields)}"
    message = problem["msg"].removeprefix("Value error, ")
    if kind == "missing":
        return f"'{place}' is missing"
    if kind == "union_tag_not_found":
        return f"'{place}': the key {problem['ctx']['discriminator']} is missing"
    if kind == "union_tag_invalid":
        context = problem["ctx"]
        key = context["discriminator"].strip(chr(39))
        key = "type" if key.endswith("()") else key  # found by a function, as the tag may be left out
        valid = [name.strip(" '") for name in context["expected_tags"].split(",")]
        return f"'{place}': unknown {key} {shown(context['tag'])}; {nearest(context['tag'], valid)}"
    got = problem.get("input")
    if kind in ("dict_type", "model_type", "model_attributes_type"):
        return f"'{place}' should be a table, got {shown(got)}"
    value = f", got {shown(got)}" if isinstance(got, str | int | float | bool) else ""
    if kind in ("float_type", "int_type") and isinstance(got, str):
        value += "; numbers stand without quotes"
    return f"'{place}': {message[0].lower()}{message[1:]}{value}"


def _fields_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Names that are valid at a place inside a model, for the hint after an unknown key."""
    current: list[Any] = [model]
    for part in loc:
        following: list[Any] = []
        for kind in current:
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                if (field := _keys(kind).get(str(part))) is not None:
                    following += unwrap(field.annotation)
                else:
                    following.append(kind)  # the tag of a union, already among the candidates
        tagged = [k for k in current if _is_tagged(k, part)]
        current = tagged or following or current
    models = [kind for kind in current if isinstance(kind, type) and issubclass(kind, BaseModel)]
    return [name for kind in models for name in _keys(kind)]


def _keys(kind: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of a model by the keys that a file has them under."""
    return {field.alias or name: field for name, field in kind.model_fields.items()}


def _is_tagged(kind: Any, part: int | str) -> bool:
    """True where ``kind`` is the member of a discriminated union that the tag ``part`` names."""
    if not (isinstance(kind, type) and issubclass(kind, BaseModel) and "type" in kind.model_fields):
        return False
    return part in typing.get_args(kind.model_fields["type"].annotation)


def unwrap(annotation: Any) -> list[Any]:
    """The model classes inside list[...], unions and Annotated."""
    origin = typing.get_origin(annotation)
    if origin is None:
        return [annotation]
    if origin is typing.Annotated:
        return unwrap(typing.get_args(annotation)[0])
    if origin in (list, tuple, dict, typing.Union, types.UnionType):
        return [kind for arg in typing.get_args(annotation) for kind in unwrap(arg)]
    return []


def dump_toml(data: Mapping[str, Any]) -> str:
    """Plain data as TOML text that reads back as the same data."""
    import tomli_w

    return tomli_w.dumps(data)
