"""Folders of output: what in them is the bench's own, who writes to them, and whether it is still what was written.

``manifest.json`` lists every file that the bench wrote beside it, with the SHA-256 of its content (null while it is being
written). Only these are ever replaced or deleted; a folder without such a manifest is used only when it is empty.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from testbed.base.checksums import DamagedError, digest, file_digest, read_json, sealed_json
from testbed.base.errors import InputError
from testbed.base.files import check_place, left_over, remove, write_atomic, writing

MANIFEST = "manifest.json"
LOCK = ".lock"
USERS = ("findings.md",)
"""Files of the user that a report shows: they may stand in a folder before there is a result."""
_held: set[Path] = set()


def read_manifest(folder: str | Path, kind: str) -> dict[str, Any] | None:
    """The manifest of a folder of this kind, or None where there is none. Raises DamagedError for a damaged one."""
    path = Path(folder) / MANIFEST
    if not path.is_file():
        return None
    manifest = read_json(path)
    if manifest.get("kind") != kind:
        return None
    files = manifest.get("files")
    if files is not None and not (
        isinstance(files, dict) and all(_inside(n) and isinstance(d, str | None) for n, d in files.items())
    ):
        raise DamagedError(f"{path}: damaged ('files' is no list of names and hashes)")
    return manifest


def tables_that_differ(here: Mapping[str, Any], there: Mapping[str, Any]) -> list[str]:
    """Of two scenarios (content or hash of each table by its name) the tables that are not the same, as messages name them."""
    return [f"[{key}]" for key in dict.fromkeys([*here, *there]) if here.get(key) != there.get(key)]


def _inside(name: str) -> bool:
    """Whether a listed name stays in its folder: a manifest must not lead the bench to files elsewhere."""
    return not Path(name).is_absolute() and ".." not in Path(name).parts and "\0" not in name


def check_own(out: Path, kind: str, among: bool = False) -> dict[str, Any] | None:
    """The manifest of ``out`` where it is a folder of this kind, None where it is free. Raises InputError for anything else.

    ``among``: a folder that has no manifest at all is free too, whatever else stands there.
    """
    check_place(out)
    manifest = read_manifest(out, kind) if out.is_dir() else None
    if manifest is not None and manifest.get("files") is None and manifest.get("identity") is None:
        manifest = None  # a look-alike: the bench never wrote such a manifest
    free = among and not (out / MANIFEST).exists()
    if manifest is None and not free and out.is_dir() and (other := _foreign(out)):
        raise InputError(
            f"{out}: is not empty and holds no {kind} ({other} stands there); give another --out, or move it away"
        )
    return manifest


def _foreign(out: Path) -> str | None:
    """A file of a folder that shows that it is somebody else's."""
    names = sorted(path.name for path in out.iterdir() if left_over(path) != MANIFEST)
    return next((name for name in names if name not in (LOCK, *USERS)), None)


class Folder:
    """A folder of output that this process alone writes to, from `open` to `close` (or for a ``with`` block)."""

    again = "run the same command again"
    """How to go on after a full disk."""

    def __init__(self, out: Path, manifest: dict[str, Any]) -> None:
        self.out, self.manifest = out, manifest
        self._lock: _Lock | None = None

    @classmethod
    def open(cls, out: str | Path, kind: str, among: bool = False) -> Self:
        """Make a folder, or reopen one of this kind. Raises InputError for a busy one, and for a foreign one unless ``among``
        files of others is meant.
        """
        out = Path(out)
        check_own(out, kind, among)
        lock = _Lock(out, cls.again)
        try:
            manifest = check_own(out, kind, among)  # as it is now that nobody else writes
        except BaseException:
            lock.release()
            raise
        folder = cls(out, manifest if manifest is not None else {"kind": kind, "files": {}})
        folder._lock = lock
        folder._tidy(folder.files)
        return folder

    def _tidy(self, names: Iterable[str]) -> None:
        """Remove what a kill left beside the bench's own files of these names, and of the manifest."""
        own = {self.out / name for name in (*names, MANIFEST)}
        for place in {path.parent for path in own}:
            if place.is_dir():
                remove([p for p in place.iterdir() if (base := left_over(p)) and place / base in own], self.again)

    @property
    def files(self) -> dict[str, str | None]:
        """Name -> hash of what the bench wrote; None while it is being written."""
        files: dict[str, str | None] = self.manifest.setdefault("files", {})
        return files

    def save(self, **values: Any) -> None:
        """Write the manifest, with these entries changed."""
        self.manifest |= values
        write_atomic(self.out / MANIFEST, sealed_json(self.manifest), self.again)

    def claim(self, names: Iterable[str], hashes: Mapping[str, str] | None = None) -> None:
        """List files before they are written. Raises InputError when one of them is there and is not the bench's own."""
        names = list(names)
        for name in names:
            if name not in self.files and os.path.lexists(self.out / name):
                raise InputError(
                    f"{self.out / name}: is in the way and was not written by the bench ({MANIFEST} does not list it); "
                    "move it away, or give another --out"
                )
        self.files.update({name: (hashes or {}).get(name) for name in names})
        self.save()

    def write(self, name: str, content: bytes) -> None:
        """Write a claimed file atomically; `save` keeps its hash."""
        if self.files.get(name, "") not in (None, digest(content)):
            self.claim([name])  # so that a kill between file and manifest leaves no wrong hash
        write_atomic(self.out / name, content, self.again)
        self.files[name] = digest(content)

    def write_all(self, contents: Mapping[str, bytes]) -> None:
        """Claim and write files of known content."""
        self.claim(contents, {name: digest(content) for name, content in contents.items()})
        for name, content in contents.items():
            self.write(name, content)

    def finish(self, name: str) -> None:
        """Take the hash of a claimed file that another function wrote."""
        self.files[name] = file_digest(self.out / name)

    def delete(self, names: Iterable[str]) -> None:
        """Delete the bench's own files of these names, what a kill left of them, and folders that are empty then."""
        names = [name for name in names if name in self.files]
        paths = [self.out / name for name in names]
        remove(paths, self.again)
        self._tidy(names)
        folders = {path.parent for path in paths}
        for folder in sorted(folders - {self.out}, key=lambda p: -len(p.parts)):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()

    def forget(self, names: Iterable[str]) -> None:
        """`delete`, and list them no longer."""
        names = list(names)
        self.delete(names)
        for name in names:
            self.files.pop(name, None)

    def check(self, name: str) -> Path:
        """The path of a file once its content has the hash that the manifest lists (if it lists one)."""
        path, wanted = self.out / name, (self.manifest.get("files") or {}).get(name)
        if wanted is not None:
            if not path.is_file():
                raise DamagedError(f"{path}: is missing, although {MANIFEST} lists it")
            if file_digest(path) != wanted:
                raise DamagedError(f"{path}: damaged or edited (its content does not have the hash in {MANIFEST})")
        return path

    def close(self) -> None:
        """Let others write."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Lock:
    """A lock of the operating system on a file of the folder: it ends with its process, however that ends.

    POSIX record locks are not handed on to the copies of a process, so the workers of a killed batch do not hold it.
    """

    def __init__(self, out: Path, again: str) -> None:
        place = out.resolve()
        if place in _held:
            raise InputError(f"{out}: this process is writing to it already; give another --out")
        self._made = not out.exists()
        with writing(out, again):
            out.mkdir(parents=True, exist_ok=True)
            self._path, self._place, self._descriptor = place / LOCK, place, -1
            while self._descriptor < 0:
                self._try(out)
        _held.add(place)

    def _try(self, out: Path) -> None:
        """Take the lock; without success when its holder deleted the file in between."""
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            _lock(descriptor)
        except BlockingIOError:
            holder = os.read(descriptor, 20).decode("ascii", "replace").strip()
            os.close(descriptor)
            process = f" (process {holder})" if holder else ""
            raise InputError(
                f"{out}: another run{process} is writing to it; wait until it has ended, or give another --out"
            ) from None
        except BaseException:
            os.close(descriptor)
            raise
        try:
            same = os.path.samestat(os.fstat(descriptor), os.stat(self._path))
        except FileNotFoundError:
            same = False
        if not same:
            os.close(descriptor)
            return
        try:
            os.truncate(descriptor, 0)
            os.write(descriptor, f"{os.getpid()}\n".encode())
        except OSError:
            pass  # the process number is for the message only; a full disk is told by what matters
        self._descriptor = descriptor

    def release(self) -> None:
        """Give the lock back; a folder that was made for it and stayed empty goes."""
        _held.discard(self._place)
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)
        if self._made and self._place.is_dir() and not any(self._place.iterdir()):
            self._place.rmdir()


def _lock(descriptor: int) -> None:
    """An exclusive lock, or BlockingIOError. Without the module fcntl (Windows) nothing is locked."""
    try:
        import fcntl
    except ImportError:
        return
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except PermissionError as error:  # EACCES stands for EAGAIN on some systems
        raise BlockingIOError from error
