"""The studies of the reports, which are scripts and no package: `study("kfann_fed")` is one of them as a module."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

PLACES = [str(Path(__file__).resolve().parents[1] / "reports" / folder) for folder in ("studies", "")]


def study(name: str) -> ModuleType:
    """With the other studies on the path, as ``reports/make.py`` has them."""
    sys.path.extend(place for place in PLACES if place not in sys.path)
    return importlib.import_module(name)
