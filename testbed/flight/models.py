"""What a JSBSim model may bring along: before JSBSim reads a model, its files are looked through.

A model (JSBSim's XML, reference manual 2.0) may name files to write and sockets to open: ``<output>`` and ``<input>``
right below ``fdm_config``, or below the root of a file that it includes; inside of flight-control components the same
words are ordinary signals. A user's model with them is refused; JSBSim's own are copied without them.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat

from pydantic import Field, model_validator

from testbed.base.errors import InputError, shown
from testbed.base.resources import cache_root
from testbed.base.schema import Table

OPENING = ("input", "output")
"""Elements that open files and sockets where they are direct children of a file's root."""
MOST_FILES, MOST_BYTES = 200, 20_000_000
"""An aircraft's folder: the largest of the jsbsim package has 16 files and 46 kB."""
_DRIVE = re.compile("[A-Za-z]:")


class ModelPaths(NamedTuple):
    """Where JSBSim looks: the folder that holds ``MODEL.xml``, and those of engines and systems."""

    model: Path
    engines: Path
    systems: Path


def files_of(folder: Path) -> list[Path]:
    """The files of an aircraft's folder. Raises InputError where it is none: no ``aircraft.toml``, or far too much in it."""
    try:
        if not (folder / "aircraft.toml").is_file():
            raise InputError(f"{folder}: not an aircraft: it has no aircraft.toml")
        files, size = [], 0
        for file in folder.rglob("*"):
            if not file.is_file():
                continue
            files.append(file)
            size += file.stat().st_size
            if len(files) > MOST_FILES or size > MOST_BYTES:
                raise InputError(
                    f"{folder}: not an aircraft's folder: it holds more than {MOST_FILES} files or {MOST_BYTES // 10**6} MB"
                )
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise InputError(f"{shown(str(folder))}: not an aircraft: {getattr(error, 'strerror', error)}") from None
    return sorted(files)


def check_model(folder: Path, model: str) -> None:
    """Raise InputError for a user's model that is no XML, opens files or sockets, or reaches out of its folder."""
    home, files = folder.resolve(), files_of(folder)
    if folder / f"{model}.xml" not in files:
        raise InputError(f"{folder / 'aircraft.toml'}: 'model.jsbsim': there is no {folder / f'{model}.xml'}")
    included: set[str] = set()
    waiting = [file for file in files if file.suffix.lower() == ".xml"]
    looked: set[Path] = set()
    while waiting:
        file = waiting.pop()
        if file in looked:
            continue
        looked.add(file)
        if not file.resolve().is_relative_to(home):
            raise InputError(f"{file}: a link that leaves the aircraft's folder")
        included |= _check_file(file)
        # JSBSim adds .xml only to a name without an ending: a file of another ending counts once it is included
        waiting += [file for file in files if file.name in included]


def _check_file(file: Path) -> set[str]:
    """Refuse what `check_model` says in one file; names of the files that it includes."""
    root = parse(file)
    for child in root:
        if child.tag in OPENING:
            raise InputError(
                f"{file}: <{child.tag}> below <{root.tag}> would open files or sockets; remove it (flights are saved by testbed fly)"
            )
    names = set()
    for element in root.iter():
        name = (element.get("file") or "").strip()
        if not name:
            continue
        parts = re.split(r"[/\\]", name)
        if ".." in parts or not parts[0] or _DRIVE.match(name):
            raise InputError(f"{file}: <{element.tag} file={shown(name)}> leaves the aircraft's folder")
        names.add(parts[-1])
    return names


def parse(file: Path) -> ElementTree.Element:
    """The root of an XML file. Raises InputError for what is no XML, or declares a document type (entities that explode)."""
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()

    def refuse(*_: object) -> None:
        raise InputError(f"{file}: it declares a document type (<!DOCTYPE ...>), which no model needs; remove it")

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(file.read_bytes(), True)
        root: ElementTree.Element = builder.close()
    except expat.ExpatError as error:
        raise InputError(f"{file}: not valid XML: {error}") from None
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    return root


class Correction(Table):
    """``[[model.corrections]]``: an error of a model of the jsbsim package, put right in the copy that is loaded."""

    component: str = Field(min_length=1, description="Name of the flight-control component in the model's XML")
    input: str = Field(default="", description="The input as the model has it, or")
    output: str = Field(default="", description="the output")
    becomes: str = Field(min_length=1, description="The same as it should be")
    why: str = Field(min_length=1, description="What is wrong with it")

    @model_validator(mode="after")
    def _one_place(self) -> Correction:
        if bool(self.input) == bool(self.output):
            raise ValueError("give exactly one of input and output")
        return self


@contextmanager
def clean_copy(
    model: str, corrections: Sequence[Correction] = (), leave_out: Sequence[str] = ()
) -> Iterator[ModelPaths]:
    """A temporary copy of a model of the jsbsim package without what opens files and sockets; engines stay where they are.

    ``corrections`` are made in the copy, which lies in the cache folder: JSBSim's models are under the GPL, and none is
    shipped; systems whose files are in ``leave_out`` are taken out of it. Raises InputError for a correction that finds
    nothing to correct, and for a system that is not there, as in another version of the package.
    """
    package = importlib.util.find_spec("jsbsim")
    assert package is not None and package.origin is not None
    shipped = Path(package.origin).parent
    source = shipped / "aircraft" / model
    if not (source / f"{model}.xml").is_file():
        raise InputError(f"JSBSim has no model '{model}'")
    with _scratch() as place:
        copy = Path(place) / model
        shutil.copytree(source, copy)
        _correct(copy / f"{model}.xml", corrections)
        _leave_out(copy / f"{model}.xml", leave_out)
        for file in copy.rglob("*.xml"):
            root = parse(file)
            unwanted = [child for child in root if child.tag in OPENING]
            for child in unwanted:
                root.remove(child)
            if unwanted:
                file.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
        yield ModelPaths(copy, shipped / "engine", shipped / "systems")


@contextmanager
def _scratch() -> Iterator[str]:
    """A temporary folder in the cache folder, or where temporary folders are if that cannot be written."""
    home: Path | None = cache_root() / "models"
    try:
        assert home is not None
        home.mkdir(parents=True, exist_ok=True)
    except OSError:
        home = None
    with tempfile.TemporaryDirectory(prefix="testbed-model-", dir=home) as place:
        yield place


def _correct(file: Path, corrections: Sequence[Correction]) -> None:
    """Replace what ``corrections`` name of components. Raises InputError where one is not there once."""
    if not corrections:
        return
    root = parse(file)
    for wrong in corrections:
        parts = [e for e in root.iter() if e.get("name") == wrong.component]
        kind, name = ("input", wrong.input) if wrong.input else ("output", wrong.output)
        places = [e for part in parts for e in part.findall(kind) if (e.text or "").strip() == name]
        if len(places) != 1:
            raise InputError(
                f"{file.name} of this version of jsbsim has {len(places)} {kind}s '{name}' of '{wrong.component}', "
                f"not the one that 'model.corrections' puts right ({wrong.why})"
            )
        places[0].text = wrong.becomes
    file.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


def _leave_out(file: Path, systems: Sequence[str]) -> None:
    """Take systems out of a model, by the names of their files. Raises InputError where one is not there.

    JSBSim warns of each version of its format but 2.0, which is the only one that there is: a model says so from here on.
    """
    if not systems:
        return
    root = parse(file)
    root.set("version", "2.0")
    for name in systems:
        found = [child for child in root if child.tag == "system" and child.get("file") == name]
        if not found:
            raise InputError(
                f"{file.name} of this version of jsbsim has no system '{name}', which 'model.leave_out' names"
            )
        for child in found:
            root.remove(child)
    file.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
