"""Folders that a verb writes whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from testbed.base.errors import InputError
from testbed.base.files import check_place, writing


def check_free(out: Path) -> None:
    """Raise InputError where ``out`` is anything but a folder that can be made, or an empty one."""
    check_place(out)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out}: already exists and is not an empty folder; give another --out")


@contextmanager
def fresh_folder(out: Path) -> Iterator[Path]:
    """A temporary folder that takes the place of ``out`` at the end; on an error nothing half-written remains."""
    check_free(out)
    place = out.resolve()  # a link is followed, and . has a name
    with writing(out):
        place.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
        try:
            yield scratch
            check_free(out)  # somebody else may have been quicker
            if place.exists():  # stays, and so does who stands in it
                for path in sorted(scratch.iterdir()):
                    path.rename(place / path.name)
                scratch.rmdir()
            else:
                scratch.chmod(0o777 & ~_umask())
                scratch.rename(place)
        except BaseException:
            shutil.rmtree(scratch, ignore_errors=True)
            raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
