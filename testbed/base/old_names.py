"""Modules that plug-ins of 0.1 import under the names they had; kept for one version, with a warning that names the new place."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "testbed.earth": "testbed.physics.earth",
    "testbed.errors": "testbed.base.errors",
    "testbed.interpolate": "testbed.physics.interpolate",
    "testbed.metrics": "testbed.scoring.metrics",
    "testbed.records": "testbed.data.records",
    "testbed.registry": "testbed.data.registry",
    "testbed.rotations": "testbed.physics.rotations",
    "testbed.specs": "testbed.data.specs",
    "testbed.streams": "testbed.base.streams",
    "estimators.indirect_kf": "estimators.methods.indirect_kf",
    "estimators.ins": "estimators.methods.ins",
    "estimators.strapdown": "estimators.core.strapdown",
}


class OldNames(MetaPathFinder, Loader):
    """Finds a module under its old name: one whose contents are those of the module at its new place."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        new = MOVED[module.__name__]
        message = f"'{module.__name__}' has moved to '{new}'; the old name goes with the next version"
        warnings.warn(message, FutureWarning, stacklevel=2)  # frames of the import system do not count
        found = vars(import_module(new))
        vars(module).update({key: value for key, value in found.items() if not key.startswith("__")})


def keep() -> None:
    """Let old names be found after all others, once."""
    if not any(isinstance(finder, OldNames) for finder in sys.meta_path):
        sys.meta_path.append(OldNames())
