"""The core needs no torch: every row loads without it, and training says which extra brings it before anything is flown."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys

import pytest

from testbed.base.errors import MissingExtra
from testbed.scenario import load_scenario
from testbed.training.train import train

LOAD_ALL = """
import sys
sys.modules["torch"] = None
from testbed.data.registry import estimator_class, list_estimators, make_estimator
for name in list_estimators():
    estimator_class(name)
make_estimator("ahrs-lstm")
"""


def test_no_requirement_of_the_core_is_torch():
    core = [r for r in importlib.metadata.requires("navigation-testbed") or [] if "extra ==" not in r]
    assert core and not [r for r in core if re.match(r"torch\b", r)]


def test_no_package_of_the_core_brings_what_documents_and_tests():
    """Of all that the core's requirements require in turn, none is Sphinx, pytest or torch."""
    todo, seen = ["navigation-testbed"], set()
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        try:
            wanted = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:  # only for another platform or Python
            continue
        todo += [re.match(r"[\w.-]+", r)[0].lower() for r in wanted if "extra ==" not in r]
    assert {"numpy", "scipy", "llvmlite"} < seen
    assert not seen & {"sphinx", "pytest", "torch", "numpydoc", "babel"}


def test_every_estimator_loads_without_torch():
    done = subprocess.run([sys.executable, "-c", LOAD_ALL], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_training_names_the_extra_before_it_flies(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch", None)  # an import of it fails, and no spec is found
    told: list[str] = []
    with pytest.raises(MissingExtra, match=r"training ahrs-lstm needs the package torch.*\[learn\]"):
        train(load_scenario("ahrs-lstm-2022", profile="smoke"), tmp_path / "training", tell=told.append)
    assert not told and not (tmp_path / "training").exists()
