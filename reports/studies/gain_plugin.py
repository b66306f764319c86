"""The plug-in of the league's row `gain-gru`, which lies in a folder and no package."""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType


def folder() -> Path:
    """Where plug-in and weights lie."""
    spec = find_spec("estimators.league")
    assert spec is not None and spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0]) / "gain-gru"


def plugin() -> ModuleType:
    """The plug-in as a module; its policy is known from then on."""
    if str(folder()) not in sys.path:
        sys.path.append(str(folder()))
    return importlib.import_module("gain_gru")
