"""Where numba keeps what it compiled: a folder whose name changes with the sources that compiled code is made of.

numba compiles a function anew when its own file changes, not when a function that it calls does, so a cache that outlives
an edit or an update answers with code of two versions. Here every state of the sources has a folder of its own, for the
kernels of plug-ins as well; `testbed` chooses it when it is imported, in workers too. A variable NUMBA_CACHE_DIR that the
user set is left alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path

VARIABLE, MARK = "NUMBA_CACHE_DIR", "TESTBED_NUMBA_CACHE_DIR"
"""numba's variable; and the value that this module gave it, so that a child tells it from the user's."""
PACKAGES = ("testbed", "estimators")
PLUGINS = ("estimators", "league")
"""Below lie rows of the league, each a plug-in in a folder of its own: nothing imports them, and numba looks at their files."""
KEPT = 3
"""Folders of earlier sources that stay, so that going back and forth between two of them costs nothing."""
IN_USE_S = 3600.0
"""A folder used within the last hour stays as well: a process of earlier sources may still compile."""
_KERNELS = re.compile(
    rb"^from (?:numba|testbed\.kernels)[\w.]* import [^\n]*\b(?:njit|cfunc|overload|intrinsic)\b"
    rb"|^from estimators\.core\.timeline import [^\n]*\binner\b",
    re.M,
)
_IS_PART = re.compile(r"estimators\.(?:aiding|blocks|policies)\b")
"""Plain functions that are compiled where they are used."""
_IMPORT = re.compile(rb"^from ((?:testbed|estimators)[\w.]*) import (\([^)]*\)|[^\n#]*)", re.M)


def use_folder() -> None:
    """Let numba keep compiled code in the folder of the present sources."""
    given = os.environ.get(VARIABLE)
    if given is not None and given != os.environ.get(MARK):
        return
    root = _root()
    folder = root / _key(root)
    os.environ[VARIABLE] = os.environ[MARK] = str(folder)
    if "numba" in sys.modules:  # it read the variable when it was imported
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    try:
        if folder.is_dir():
            os.utime(folder)
        else:
            folder.mkdir(parents=True, exist_ok=True)
            prune(root)
    except OSError:
        pass  # numba looks for a place of its own, or does without


def _root() -> Path:
    """Beside the package, as numba does by itself; else in the user's cache, apart for each installation."""
    package = Path(__file__).resolve().parent
    beside = package / "__pycache__"
    if os.access(beside if beside.is_dir() else package, os.W_OK):
        return beside / "kernels"
    from testbed.base.resources import cache_root

    return cache_root() / "kernels" / hashlib.sha256(str(package).encode()).hexdigest()[:12]


def news_of(start: float) -> Callable[[], str]:
    """What to tell of the kernels that any process compiled since ``start`` (s): how many, and the latest; "" of none.

    Looks at the folder at most once a second.
    """
    looked, told = 0.0, ""

    def news() -> str:
        nonlocal looked, told
        if time.monotonic() - looked > 1.0:
            looked = time.monotonic()
            try:
                entries = [(entry.stat().st_mtime, entry.name) for entry in Path(os.environ[VARIABLE]).glob("*/*.nbi")]
            except OSError:  # a folder of earlier sources that somebody removes
                return told
            fresh = sorted(entry for entry in entries if entry[0] > start)
            told = f"{len(fresh)} kernels compiled, last {kernel_of(fresh[-1][1])}" if fresh else ""
        return told

    return news


def kernel_of(file: str) -> str:
    """``walk`` of ``timeline.walk-111.py311.nbi``, as numba names its index of a function (module.function-line.version)."""
    return file.rsplit("-", 1)[0].split(".", 1)[1]


def prune(root: Path) -> None:
    """Remove folders but the `KEPT` newest and those in use."""
    folders = sorted((f for f in root.iterdir() if f.is_dir()), key=lambda f: f.stat().st_mtime, reverse=True)
    for folder in folders[KEPT:]:
        if time.time() - folder.stat().st_mtime > IN_USE_S:
            shutil.rmtree(folder, ignore_errors=True)


def _key(root: Path) -> str:
    """Hash of the sources; read again only when a file's time or size is not what it was."""
    files = _files()
    seen = [(name, (stat := path.stat()).st_mtime_ns, stat.st_size) for name, path in files.items()]
    signature = hashlib.sha256(repr(seen).encode()).hexdigest()
    note = root / "sources.json"
    try:
        known = json.loads(note.read_text(encoding="utf-8"))
        if known["signature"] == signature:
            return str(known["key"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    key = hash_of({name: path.read_bytes() for name, path in files.items()})
    try:
        root.mkdir(parents=True, exist_ok=True)
        scratch = root / f"sources.{os.getpid()}"
        scratch.write_text(json.dumps({"signature": signature, "key": key}), encoding="utf-8")
        os.replace(scratch, note)
    except OSError:
        pass
    return key


def _files() -> dict[str, Path]:
    """Modules of both packages by name, and the versions of the libraries that compiled code depends on."""
    out = {}
    home = Path(__file__).resolve().parent.parent
    for package in PACKAGES:
        for folder, folders, names in os.walk(home / package):
            parts = Path(folder).relative_to(home).parts
            folders[:] = sorted(f for f in folders if f != "__pycache__" and parts != PLUGINS)
            for name in sorted(n for n in names if n.endswith(".py")):
                module = parts if name == "__init__.py" else (*parts, name[:-3])
                out[".".join(module)] = Path(folder, name)
    for library, file in (("numba", "_version.py"), ("numpy", "version.py"), ("llvmlite", "_version.py")):
        found = find_spec(library)
        if found is not None and found.origin is not None and (path := Path(found.origin).with_name(file)).is_file():
            out[library] = path
    return out


def hash_of(sources: Mapping[str, bytes]) -> str:
    """Hash of the kernel sources among modules (name to text), and of what is no module of the two packages."""
    chosen = kernel_sources(sources) | {name for name in sources if name.split(".")[0] not in PACKAGES}
    total = hashlib.sha256()
    for name in sorted(chosen):
        total.update(name.encode() + b"\0" + sources[name] + b"\0")
    return total.hexdigest()[:16]


def kernel_sources(sources: Mapping[str, bytes]) -> set[str]:
    """Modules with compiled functions, and all that they import, as constants are compiled in.

    A change of any other module (reports, command line) leaves compiled code as it is.
    """
    found: set[str] = set()
    ahead = [name for name, text in sources.items() if _KERNELS.search(text) or _IS_PART.match(name)]
    while ahead:
        name = ahead.pop()
        if name not in found:
            found.add(name)
            ahead += [other for other in _imports(sources[name]) if other in sources]
    return found


def _imports(text: bytes) -> Iterable[str]:
    """Modules of the two packages that a text may import at its top."""
    for match in _IMPORT.finditer(text):
        package = match[1].decode()
        yield package
        yield from (f"{package}.{name}" for name in re.findall(r"\w+", match[2].decode()))
