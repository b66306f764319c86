"""What each key of a scenario means: read from where it is declared, so that no second list can fall behind.

The meaning is a key's ``description``, or the string below its declaration (PEP 257's attribute docstring); the range is
that of its type, the example a line of a scenario that is shipped.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from testbed.base.errors import InputError, closest
from testbed.base.schema import unwrap

UNITS = {
    "celsius": "°C", "db": "dB", "deg": "°", "dps": "°/s", "g": "g", "hz": "Hz", "kg": "kg", "m": "m", "mg": "mg", "mps": "m/s",
    "mps2": "m/s²", "pct": "%", "s": "s", "ut": "µT",
}  # fmt: skip
"""Unit that the last part of a key's name stands for."""
BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
LENGTHS = {"min_length": "at least", "max_length": "at most"}
FREE = ("profiles", "variants")
"""Tables of overlays: what is inside them is a scenario's own keys again."""


@dataclass(frozen=True)
class Key:
    """One key: its dotted ``path`` without the places in lists, and what is declared of it."""

    path: str
    table: type[BaseModel]
    field: FieldInfo

    @property
    def name(self) -> str:
        """The last part of its path."""
        return self.path.rpartition(".")[2]

    @property
    def meaning(self) -> str:
        """What stands below its declaration; for a table, the first paragraph of the table's own description."""
        text = self.field.description or declared(self.table).get(self.name, "")
        tables = [kind for kind in unwrap(self.field.annotation) if _is_table(kind)]
        if self.name == "type" and not text:
            return "Says that it is of this kind: " + (inspect.getdoc(self.table) or "").split("\n\n")[0]
        if not text and tables:
            text = " ".join(f"{inspect.getdoc(kind) or ''}".split("\n\n")[0] for kind in tables)
        return " ".join(text.split())

    @property
    def unit(self) -> str:
        """From the end of its name, where the name says one."""
        return UNITS.get(self.name.rpartition("_")[2], "") if "_" in self.name else ""

    @property
    def default(self) -> str:
        """As it would stand in a file."""
        if self.field.is_required():
            return "none: it must be given"
        value = self.field.get_default(call_default_factory=True)
        if value is None:
            return "left out"
        return "a table of its own defaults" if isinstance(value, BaseModel) else toml_value(value)

    @property
    def takes(self) -> str:
        """The kind of value and its range."""
        return _kind(self.field.annotation, self.field.metadata)


@cache
def declared(table: type[BaseModel]) -> dict[str, str]:
    """Name -> the string below its declaration, of a table's keys, inherited ones included."""
    found: dict[str, str] = {}
    for kind in reversed(table.__mro__):
        if not (_is_table(kind) and kind is not BaseModel):
            continue
        try:
            body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
        except OSError:  # made at run time
            continue
        assert isinstance(body, ast.ClassDef)
        for here, below in zip(body.body, body.body[1:], strict=False):
            text = below.value if isinstance(below, ast.Expr) else None
            if isinstance(here, ast.AnnAssign) and isinstance(here.target, ast.Name) and isinstance(text, ast.Constant):
                found[here.target.id] = inspect.cleandoc(str(text.value))
    return found


def keys(model: type[BaseModel], path: str = "", above: tuple[type[BaseModel], ...] = ()) -> Iterator[Key]:
    """Every key of a table and of the tables in it, in the order of declaration."""
    for name, field in model.model_fields.items():
        here = f"{path}.{name}" if path else name
        yield Key(here, model, field)
        for kind in unwrap(field.annotation):
            if _is_table(kind) and kind not in above:
                yield from keys(kind, here, (*above, model))


def find(every: Sequence[Key], path: str) -> list[Key]:
    """The keys of ``every`` that a dotted path means: more than one where tables of a list differ by their type.

    Places in lists (``manoeuvres.2.bank_deg``, ``manoeuvres.*.bank_deg``) and overlays (``variants.NAME.``, ``profiles.NAME.``)
    may stand in it. Raises InputError with the nearest key for a path that there is not.
    """
    parts = [part for part in path.strip("[]. ").split(".") if part and not part.isdigit() and part != "*"]
    while len(parts) > 2 and parts[0] in FREE:
        parts = parts[2:]
    wanted = ".".join(parts)
    found = [key for key in every if key.path == wanted]
    if not found:
        ends = sorted({key.path for key in every if key.path.endswith(f".{wanted}")})
        if len(ends) == 1:
            return [key for key in every if key.path == ends[0]]
        if ends:
            raise InputError(f"'{path}' is the end of several keys: {', '.join(ends)}")
        guess = closest(wanted, sorted({k.path for k in every}))
        told = f"did you mean '{guess}'?" if guess else "'testbed explain' without a key lists the tables"
        raise InputError(f"'{path}' is not a key of a scenario; {told}")
    return found


def toml_value(value: Any) -> str:
    """A value as a scenario writes it."""
    from testbed.base.schema import dump_toml

    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json", exclude_none=True)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {toml_value(v)}" for k, v in value.items()) + " }" if value else "{}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return dump_toml({"x": value}).removeprefix("x = ").strip()


def examples(path: str, most: int = 3) -> list[tuple[str, str]]:
    """(name of a shipped scenario, value as it stands there) for a key's path without places in lists, all different."""
    found: dict[str, str] = {}
    for name, data in _shipped():
        for value in _values_at(data, path.split(".")):
            if not isinstance(value, dict) and not _has_tables(value):
                found.setdefault(toml_value(value), name)
    return [(name, value) for value, name in found.items()][:most]


@cache
def _shipped() -> list[tuple[str, dict[str, Any]]]:
    """Name and content of every shipped scenario."""
    from testbed.base.schema import read_toml
    from testbed.scenario import list_scenarios

    return [(name, read_toml(file)) for name, file in list_scenarios().items()]


def _values_at(data: Any, parts: list[str]) -> Iterator[Any]:
    if isinstance(data, list) and parts:
        for item in data:
            yield from _values_at(item, parts)
    elif not parts:
        yield data
    elif isinstance(data, dict) and parts[0] in data:
        yield from _values_at(data[parts[0]], parts[1:])


def _has_tables(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(item, dict) for item in value)


def _is_table(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _kind(annotation: Any, metadata: list[Any]) -> str:
    """A type of Python in the words of a scenario file."""
    if typing.get_origin(annotation) is typing.Annotated:
        inner, *more = typing.get_args(annotation)
        return _kind(inner, [*metadata, *(m for item in more for m in getattr(item, "metadata", [item]))])
    args = typing.get_args(annotation)
    origin = typing.get_origin(annotation)
    bounds = [
        f"{word} {getattr(item, name):g}"
        for item in metadata
        for name, word in BOUNDS.items()
        if getattr(item, name, None) is not None
    ]
    if origin is typing.Literal:
        return "one of " + ", ".join(toml_value(value) for value in args)
    if origin in (list, tuple):
        inner = next((_kind(kind, []) for kind in args if kind is not Ellipsis), "values")
        sizes = [
            f"{word} {getattr(item, name)}"
            for item in metadata
            for name, word in LENGTHS.items()
            if getattr(item, name, None) is not None
        ]
        fixed = len(args) if origin is tuple and Ellipsis not in args else None
        size = f" of {fixed}" if fixed else f" ({', '.join(sizes)})" if sizes else ""
        return f"a list{size}: {inner}"
    if origin is dict:
        return "a table of free names"
    if args:  # a union
        kinds = list(dict.fromkeys(_kind(kind, metadata) for kind in args if kind is not type(None)))
        return " or ".join(kinds)
    words = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    if _is_table(annotation):
        return "a table"
    return ", ".join([words.get(annotation, "a value"), *bounds])
