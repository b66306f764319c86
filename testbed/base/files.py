"""How the bench writes: a file is written beside its place and renamed, so that a kill or a full disk leaves whole files only.

Folders of output that hold more than one file: `testbed.montecarlo.folders`.
"""

from __future__ import annotations

import errno
import io
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from testbed.base.errors import InputError, TestbedError

_FULL = (errno.ENOSPC, errno.EDQUOT)
_TEMPORARY = re.compile(r"\.(.+)\.\d+\.tmp")


class StoreError(TestbedError):
    """A file could not be written (disk full, permissions)."""


@contextmanager
def writing(out: str | Path, again: str = "run the same command again") -> Iterator[None]:
    """Turn the operating system's refusals into a message that says how to go on."""
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            reason = f"the disk is full; free some space, then {again}"
        else:
            where = f" {error.filename}" if error.filename else ""
            reason = f"cannot write{where}: {error.strerror or error}; once that is mended, {again}"
        raise StoreError(f"{out}: {reason}") from error


def write_atomic(path: Path, content: bytes, again: str = "run the same command again") -> None:
    """Write a whole file or none. Raises StoreError when the disk does not take it."""
    with writing(path, again), beside(path) as temporary:
        temporary.write_bytes(content)


def as_json(data: object) -> bytes:
    """JSON as the bench writes it."""
    return (json.dumps(data, indent=1, ensure_ascii=False) + "\n").encode()


def from_json(content: str | bytes) -> Any:
    """What JSON of any origin says. Raises ValueError for all that is none, nesting without end included."""
    try:
        return json.loads(content)
    except RecursionError:
        raise ValueError("nested too deep") from None


def write_json(path: Path, data: object) -> None:
    """`write_atomic` of JSON."""
    write_atomic(path, as_json(data))


@contextmanager
def beside(path: str | Path) -> Iterator[Path]:
    """A name beside ``path`` that takes its place when the block ends well and is removed when it does not."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_with(path: Path, write: Callable[[Any], object]) -> None:
    """`write_atomic` of what ``write(buffer)`` makes, for libraries that want a file."""
    buffer = io.BytesIO()
    write(buffer)
    write_atomic(path, buffer.getvalue())


def left_over(path: Path) -> str | None:
    """The name for which ``path`` was written beside, where a kill left it; None for any other file."""
    match = _TEMPORARY.fullmatch(path.name)
    return match.group(1) if match else None


def remove(paths: Iterable[Path], again: str = "run the same command again") -> None:
    """Delete files that may be gone already. Raises StoreError naming the first that cannot be."""
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise StoreError(f"{path}: cannot be deleted ({error.strerror}); once that is mended, {again}") from None


def check_place(out: Path) -> None:
    """Raise InputError where no folder ``out`` can be."""
    place = next((p for p in (out, *out.parents) if os.path.lexists(p)), out)
    if place.is_symlink() and not place.exists():
        raise InputError(f"{place}: is a link that leads nowhere; give another --out")
    if place.exists() and not place.is_dir():
        raise InputError(f"{place}: is a file, not a folder for results; give another --out")
