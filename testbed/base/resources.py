"""Where the bench finds its own data (aircraft, scenarios) and where it keeps what it made (cache).

In a checkout the data folders stand beside the package; in a wheel they lie inside it, under ``_data``.
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def _data_root(name: str) -> Path:
    inside = _PACKAGE / "_data" / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def aircraft_root() -> Path:
    """Folder with one folder per shipped aircraft."""
    return _data_root("aircraft")


def scenario_root() -> Path:
    """Folder with the shipped scenario files."""
    return _data_root("scenarios")


def has_package(name: str) -> bool:
    """Whether a package of an extra can be imported; it is not imported."""
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # a module without a specification stands in its place
        return False


def cache_root() -> Path:
    """The user's cache folder for flights and trained networks; the variable TESTBED_CACHE overrides it."""
    if override := os.environ.get("TESTBED_CACHE"):
        return Path(override)
    import platformdirs

    return Path(platformdirs.user_cache_dir("navigation-testbed"))
