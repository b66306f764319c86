"""What stands in the table: an entry, read from the ``entry.toml`` of its folder, or from a file of several ``[[entries]]``.

An entry says who it is and how it is run, by exactly one of a plug-in, a named estimator, a composition of ``eskf``, or a
command that answers files with files.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from testbed.base.errors import InputError, nearest
from testbed.base.resources import has_package
from testbed.base.schema import LONGEST_NAME, Table, read_toml, validate
from testbed.data.registry import list_estimators
from testbed.league.suite import Class

FILE = "entry.toml"
GROUP = "testbed.league"
"""Entry points that name packages with rows: a folder with ``entry.toml`` for each, and files of ``[[entries]]``."""
TIMEOUT_S = 300.0
"""3 ms per sample of the longest log: so far from what a row needs that no busy machine decides whether it answers."""


class PluginTable(Table):
    """``[plugin]``: a Python file with an estimator class."""

    file: str
    """In the entry's folder."""
    estimator: str = ""
    """Its name; may be left out where the file has one estimator alone."""
    params: dict[str, Any] = {}
    """Of its constructor."""


class NamedTable(Table):
    """``[entry-point]``: an estimator that is installed."""

    estimator: str
    """As ``testbed list estimators`` shows it."""
    params: dict[str, Any] = {}
    """Of its constructor."""


class AnswersTable(Table):
    """``[answers]``: a program that reads logs and writes answers."""

    command: list[str] = Field(min_length=1)
    """With {log} and {out}, or with {run} and, where it does not print its answer, {answer}."""
    build: list[str] = []
    """Done once before."""

    @model_validator(mode="after")
    def _says_where(self) -> AnswersTable:
        text = "\0".join(self.command)
        whole, single = ("{log}" in text, "{out}" in text), "{run}" in text
        if single and any(whole):
            raise ValueError("command has both {run} and {log} or {out}: either one log each time, or a folder of all")
        if not single and not all(whole):
            raise ValueError(
                "command needs {log} and {out} (folders of all logs and answers), or {run} (the folder of one log)"
            )
        return self


class EntryTable(Table):
    """An entry as its author writes it."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=LONGEST_NAME)
    """Letters, digits, point, underscore, hyphen."""
    version: str = Field(min_length=1)
    """Of the method."""
    source: str = Field(min_length=1)
    """Address or citation."""
    licence: str = Field(min_length=1)
    """Of the method's code."""
    division: Literal["closed", "open"]
    """closed: the given sensors and specification, only the method differs; open: anything that the log allows."""
    filters: Class = Field(alias="class")
    """position or attitude."""
    speed: Literal["fast", "slow", "very slow"] = "fast"
    """fast: below 20 µs per IMU sample, and 100 seeds; slow: below 200 µs, and 10 seeds; very slow: 3 seeds."""
    needs: list[str] = []
    """Programs, and modules as python:NAME, without which the row is left out."""
    timeout_s: float = Field(default=TIMEOUT_S, gt=0.0, le=3600.0)
    """Longest time for one log."""
    notes: str = ""
    """Remark below the table."""
    plugin: PluginTable | None = None
    named: NamedTable | None = Field(default=None, alias="entry-point")
    eskf: dict[str, Any] | None = None
    """``[eskf]``: the parameters of the composition."""
    answers: AnswersTable | None = None

    @model_validator(mode="after")
    def _one_way(self) -> EntryTable:
        ways = ("plugin", "entry-point", "eskf", "answers")
        given = [
            way
            for way, table in zip(ways, (self.plugin, self.named, self.eskf, self.answers), strict=True)
            if table is not None
        ]
        if len(given) != 1:
            found = " and ".join(f"[{way}]" for way in given) or "none"
            raise ValueError(f"give exactly one of [plugin], [entry-point], [eskf] and [answers], not {found}")
        return self


@dataclass(frozen=True)
class Entry:
    """A row: its table, the folder that its files lie in, and where it was read."""

    table: EntryTable
    folder: Path
    place: str

    @property
    def name(self) -> str:
        """The name of its row."""
        return self.table.name

    def estimator(self) -> tuple[str, dict[str, Any]] | None:
        """Name and parameters of the estimator that a child makes; None of a program."""
        table = self.table
        if table.plugin is not None:
            return table.plugin.estimator, table.plugin.params
        if table.named is not None:
            return table.named.estimator, table.named.params
        return None if table.eskf is None else ("eskf", table.eskf)

    @property
    def how(self) -> str:
        """In a word, how it is run."""
        table = self.table
        if table.named is not None:
            return f"estimator {table.named.estimator}"
        return "files" if table.answers is not None else "plug-in" if table.plugin is not None else "eskf"

    @property
    def digest(self) -> str:
        """Hash of what determines its answers: how it is run, and every file of its folder where it has one of its own."""
        told = self.table.model_dump(mode="json", by_alias=True, exclude={"notes", "source", "licence", "division"})
        total = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
        for path in self.files():
            total.update(path.relative_to(self.folder).as_posix().encode() + b"\0" + path.read_bytes())
        return total.hexdigest()[:16]

    def files(self) -> list[Path]:
        """The files that go with it; none of a row that needs none."""
        if self.table.plugin is None and self.table.answers is None:
            return []
        found = (path for path in sorted(self.folder.rglob("*")) if path.is_file())
        return [path for path in found if "__pycache__" not in path.parts and not path.name.startswith(".")]

    def missing(self) -> str:
        """What of its needs this machine has not; empty where it has all."""
        lacking = [
            need
            for need in self.table.needs
            if not (has_package(need.removeprefix("python:")) if need.startswith("python:") else shutil.which(need))
        ]
        return ", ".join(lacking)


def read_entry(folder: Path) -> Entry:
    """The entry of a folder. Raises InputError that names the file and what is wrong."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; an entry is a folder with {FILE}")
    path = folder / FILE
    if not path.is_file():
        raise InputError(f"{folder}: is no entry of the league: it has no {FILE}")
    return _checked(read_toml(path), path, str(path))


def read_entries(path: Path) -> list[Entry]:
    """The entries of a file of several."""
    data = read_toml(path)
    rows = data.get("entries")
    if not isinstance(rows, list) or set(data) != {"entries"}:
        raise InputError(f"{path}: holds [[entries]] and nothing else")
    return [_checked(row, path, f"{path}: entry {k}") for k, row in enumerate(rows, 1)]


def shipped_entries() -> list[Entry]:
    """The rows of the installed packages: those of files first, then those of folders, by name."""
    found = []
    for folder in _packages():
        for path in sorted(folder.glob("*.toml")):
            found += read_entries(path)
        found += [read_entry(path.parent) for path in sorted(folder.glob(f"*/{FILE}"))]
    return found


def unique(entries: Sequence[Entry]) -> list[Entry]:
    """The entries. Raises InputError where two have one name."""
    seen: dict[str, Entry] = {}
    for entry in entries:
        if (other := seen.setdefault(entry.name, entry)) is not entry:
            raise InputError(f"{entry.place}: 'name': '{entry.name}' is the name of another row ({other.place})")
    return list(entries)


@cache
def _packages() -> list[Path]:
    """Folders of the packages with rows. They are found, not imported."""
    found = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        spec = find_spec(point.value)
        found += [Path(place) for place in (spec.submodule_search_locations or ())] if spec is not None else []
    return found


def _checked(data: Any, path: Path, place: str) -> Entry:
    """An entry whose files are there and whose estimator is known."""
    entry = Entry(validate(EntryTable, data, place), path.parent, place)
    table = entry.table
    if table.plugin is not None:
        _check_inside(entry, "plugin.file", table.plugin.file)
    if table.answers is not None:
        for key, command in (("command", table.answers.command), ("build", table.answers.build)):
            if command and command[0].startswith("./") and not table.answers.build:
                _check_inside(entry, f"answers.{key}", command[0])
    if table.named is not None and table.named.estimator not in (known := list_estimators()):
        hint = nearest(table.named.estimator, known)
        raise InputError(f"{place}: 'entry-point.estimator': no estimator '{table.named.estimator}'; {hint}")
    return entry


def _check_inside(entry: Entry, key: str, name: str) -> None:
    """Raise InputError where a file that an entry names is not in its folder."""
    path = (entry.folder / name).resolve()
    if not path.is_relative_to(entry.folder.resolve()):
        raise InputError(f"{entry.place}: '{key}': {name} lies outside of the entry's folder, which travels alone")
    if not path.is_file():
        raise InputError(f"{entry.place}: '{key}': no file {name} in {entry.folder}")
