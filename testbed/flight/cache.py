"""The flight cache: Parquet files named by the hash of all that determines a flight.

That is the configuration, the files of the aircraft, the version of JSBSim, and the version of this code.
"""

from __future__ import annotations

import hashlib
import json
import os
from importlib.metadata import version
from pathlib import Path
from typing import Any

from testbed.base.errors import InputError, tell_user
from testbed.base.files import StoreError
from testbed.base.resources import cache_root
from testbed.data.columns import read_header
from testbed.data.records import Trajectory
from testbed.flight.config import FlightConfig
from testbed.flight.models import files_of

CODE_VERSION = 5
"""Raise it with every change of this package that changes a flight."""
FORMAT = 2
"""Of the files: since the second they carry the hashes of their content and of their flight."""


def flown_by() -> dict[str, Any]:
    """What makes a flight beside its configuration: this code and JSBSim. Whatever was learned or stored from flights of
    another maker is none of this one's."""
    return {"code": CODE_VERSION, "jsbsim": version("jsbsim")}


def path_of(config: FlightConfig, folder: Path, seed: int) -> Path:
    """Where the flight of ``config`` is, or would be, kept."""
    digest = hashlib.sha256()
    key = {
        **flown_by(),
        "format": FORMAT,
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
    """The cached flight, or None. A damaged file, or one of another flight, counts as none, and the user is told."""
    if not path.exists():
        return None
    try:
        trajectory, header = Trajectory.load(path), read_header(path)
        if header.get("flight") != path.stem:
            raise InputError(f"{path}: holds another flight")
    except InputError as error:
        tell_user(f"{error}; the flight is flown again")
        return None
    return trajectory


def store(trajectory: Trajectory, path: Path) -> None:
    """Keep a flight. A cache that cannot be written costs time, not results: the user is told, and that is all."""
    try:
        trajectory.save(path, flight=path.stem)
    except StoreError as error:
        tell_user(f"{error.args[0].partition(';')[0]}; the flight is not kept (TESTBED_CACHE names another folder)")
