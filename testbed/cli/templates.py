"""Starting points: ``testbed new estimator|c-filter|octave-filter|policy|scenario|aircraft NAME`` writes one that works as it is.

The files under ``templates/`` are themselves valid; only the names in them are replaced. An aircraft starts as a copy of
a shipped one.
"""

from __future__ import annotations

import keyword
import re
import shutil
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from testbed.base.errors import InputError, nearest

TEMPLATES = Path(__file__).parents[1] / "templates"
NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*([_-][A-Za-z0-9]+)*")


def new_file(kind: str, name: str, folder: Path = Path(), like: str | None = None) -> Path:
    """Write the starting file of a ``kind`` (one of `KINDS`, or aircraft) into ``folder`` and return its path.

    An aircraft is a folder, a copy of the shipped aircraft ``like``. Raises InputError for an unknown kind, a name that
    is malformed or taken, and a file that exists.
    """
    if kind not in STARTED:
        raise InputError(f"no starting file for '{kind}'; {nearest(kind, STARTED)}")
    if not NAME.fullmatch(name):
        raise InputError(f"'{name}': a name is letters and digits, words joined by '-' or '_', for example my-{kind}")
    if kind == "aircraft":
        return _aircraft(folder / name, like or "aerosonde")
    if like is not None:
        raise InputError(f"--like is for an aircraft; the starting file of a new {kind} is always the same")
    file_name, text = KINDS[kind](name)
    path = folder / file_name
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(f"{path}: exists already; give another name") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def _module(kind: str, name: str) -> tuple[str, str]:
    """A plug-in: its file's name, and the template of its kind under the name and a class of that name."""
    from testbed.data.registry import list_estimators

    module = name.replace("-", "_")
    if name in list_estimators():
        raise InputError(f"'{name}' is an estimator already; give another name")
    if not Path(f"{module}.py").exists() and find_spec(module) is not None:
        raise InputError(f"{module}.py would hide the Python module '{module}'; give another name")
    text = (TEMPLATES / f"{kind}.py").read_text(encoding="utf-8")
    title = "".join(word[0].upper() + word[1:] for word in re.split("[_-]", name))
    if keyword.iskeyword(title) or re.search(rf"\b{title}\b", text):
        title += kind.title()
    return f"{module}.py", text.replace(f"my-{kind}", name).replace(f"My{kind.title()}", title)


def _scenario(name: str) -> tuple[str, str]:
    from testbed.scenario import list_scenarios

    if name in list_scenarios():
        raise InputError(f"'{name}' is a shipped scenario; give another name")
    return f"{name}.toml", (TEMPLATES / "scenario.toml").read_text(encoding="utf-8").replace("my-scenario", name)


def _program(suffix: str, name: str) -> tuple[str, str]:
    """A filter in another language, which answers the logs of ``testbed sense --runs``."""
    text = (TEMPLATES / f"filter{suffix}").read_text(encoding="utf-8")
    return f"{name}{suffix}", text.replace("my-filter", name)


KINDS: dict[str, Callable[[str], tuple[str, str]]] = {
    "estimator": partial(_module, "estimator"),
    "c-filter": partial(_program, ".c"),
    "octave-filter": partial(_program, ".m"),
    "policy": partial(_module, "policy"),
    "scenario": _scenario,
}
STARTED = (*KINDS, "aircraft")
"""What ``testbed new`` writes."""


def _aircraft(path: Path, like: str) -> Path:
    from testbed.base.resources import aircraft_root
    from testbed.flight.aircraft import list_aircraft

    if like not in list_aircraft():
        raise InputError(f"--like {like}: no such aircraft; {nearest(like, list_aircraft())}")
    try:
        shutil.copytree(aircraft_root() / like, path)
    except FileExistsError:
        raise InputError(f"{path}: exists already; give another name") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def command_for(kind: str, path: Path, name: str) -> str:
    """What to type next."""
    if kind == "aircraft":
        return f"testbed fly SCENARIO --set flight.aircraft=./{path}"
    if kind == "scenario":
        return f"testbed run {path}"
    if path.suffix in (".c", ".m"):
        return "testbed sense SCENARIO --runs N, and what the first lines of the file say"
    return f"testbed run quickstart --plugin {path} --estimators {name},indirect-kf --runs 5"
