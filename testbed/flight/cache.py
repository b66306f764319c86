"""The flight cache: Parquet files named by the hash of all that determines a flight.

That is the configuration, the files of the aircraft, the version of JSBSim, and the version of this code.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from importlib.metadata import version
from pathlib import Path

from testbed.errors import InputError
from testbed.flight.config import FlightConfig
from testbed.flight.models import files_of
from testbed.records import Trajectory
from testbed.resources import cache_root

CODE_VERSION = 3
"""Raise it with every change of this package that changes a flight."""


def path_of(config: FlightConfig, folder: Path, seed: int) -> Path:
    """Where the flight of ``config`` is, or would be, kept."""
    digest = hashlib.sha256()
    key = {
        "code": CODE_VERSION,
        "jsbsim": version("jsbsim"),
        "config": config.model_dump(mode="json") | {"aircraft": folder.name},
        "seed": seed if config.wind.turbulence != "none" else 0,
    }
    digest.update(json.dumps(key, sort_keys=True).encode())
    digest.update(content_of(folder))
    return cache_root() / "flights" / f"{digest.hexdigest()[:32]}.parquet"


def content_of(folder: Path) -> bytes:
    """Names and bytes of the files in an aircraft's folder, in one string. Raises InputError where it is none."""
    names = ((os.fsencode(file.relative_to(folder).as_posix()), file) for file in files_of(folder))
    return b"".join(name + b"\0" + file.read_bytes() for name, file in names)


def load(path: Path) -> Trajectory | None:
    """The cached flight, or None. A damaged file counts as none."""
    try:
        return Trajectory.load(path) if path.exists() else None
    except InputError:
        return None


def store(trajectory: Trajectory, path: Path) -> None:
    """Write beside and rename, so that no reader ever sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(suffix=".tmp", dir=path.parent)
    os.close(handle)
    try:
        trajectory.save(name)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
