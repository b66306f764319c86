"""Who may import whom: no cycles, the bench knows no estimator, and estimators know the bench's basic modules alone."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BASIC = {"base", "physics", "data", "features", "kernels"}
"""Packages of ``testbed`` that an estimator may import; ``features`` for its training."""


def modules() -> dict[str, Path]:
    found = {}
    for package in ("testbed", "estimators"):
        for path in (ROOT / package).rglob("*.py"):
            if "templates" not in path.parts:
                found[".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")] = path
    return found


def imported(path: Path, known: dict[str, Path]) -> Iterator[str]:
    """Modules that a file imports anywhere, within functions too, but not for the annotations alone."""
    tree = ast.parse(path.read_text())
    checks = [node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)]
    left_out = {id(node) for check in checks for node in ast.walk(check)}
    for node in ast.walk(tree):
        if id(node) in left_out:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in known else node.module


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    known = modules()
    return {name: set(imported(path, known)) - {name} for name, path in known.items()}


def test_no_module_imports_itself_by_a_detour(graph):
    """What is left when modules that import nothing of the rest are taken away, again and again, are cycles."""
    left = dict(graph)
    while free := [name for name, needs in left.items() if not needs & left.keys()]:
        for name in free:
            del left[name]
    while free := [name for name in left if not any(name in needs for needs in left.values())]:
        for name in free:
            del left[name]
    assert not left, f"on or between cycles: {sorted(left)}"


def test_the_bench_imports_no_estimator(graph):
    for name, needs in graph.items():
        if name.split(".")[0] == "testbed":
            assert not [need for need in needs if need.split(".")[0] == "estimators"], name


def test_estimators_import_the_basic_modules_of_the_bench(graph):
    for name, needs in graph.items():
        if name.split(".")[0] == "estimators":
            bench = {need.split(".")[1] for need in needs if need.startswith("testbed.")}
            assert not bench - BASIC, f"{name} imports {sorted(bench - BASIC)} of testbed"


def test_scipy_stats_is_left_alone():
    """Its import takes longer than the rest of a report; quantiles are in `scipy.special`."""
    paths = [path for package in ("testbed", "estimators") for path in (ROOT / package).rglob("*.py")]
    assert not [path for path in paths if re.search(r"^\s*(from|import) scipy\.stats", path.read_text(), re.M)]
