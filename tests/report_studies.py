"""The studies of the reports, which are scripts and no package: `study("kfann_fed")` is one of them as a module."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

PLACE = str(Path(__file__).resolve().parents[1] / "reports" / "studies")


def study(name: str) -> ModuleType:
    """With the other studies on the path, as ``reports/make.py`` has them."""
    if PLACE not in sys.path:
        sys.path.append(PLACE)
    return importlib.import_module(name)
