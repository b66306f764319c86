"""One kind of linear algebra on every x86 processor: asked of OpenBLAS before it loads, and never against the user."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from testbed.base import linear_algebra as kind

KINDS = (
    "import os, threadpoolctl, scipy.linalg; "
    "print(*{p['architecture'] for p in threadpoolctl.threadpool_info() if p['internal_api'] == 'openblas'}, "
    "os.environ.get('OPENBLAS_CORETYPE'))"
)
"""Prints the kinds of OpenBLAS that are loaded, and which one was asked for."""
WORKER = (
    f"import subprocess, sys; subprocess.run([sys.executable, '-c', {f'import testbed, numpy; {KINDS}'!r}], check=True)"
)
needs_avx2 = pytest.mark.skipif(not kind.has_avx2(), reason="needs Linux on an x86 processor with AVX2")


def kinds(*statements: str, **variables: str) -> list[list[str]]:
    """What a new process prints, and its worker, as words of each line."""
    environment = {key: value for key, value in os.environ.items() if key not in (kind.VARIABLE, kind.MARK)} | variables
    command = [sys.executable, "-u", "-c", "; ".join(statements)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    return [line.split() for line in done.stdout.splitlines()]


@needs_avx2
def test_numpy_and_scipy_compute_by_the_kind_for_avx2_in_workers_too() -> None:
    assert kinds("import testbed, numpy", KINDS, WORKER) == [["Haswell", "Haswell"]] * 2


@needs_avx2
def test_the_users_kind_is_kept() -> None:
    assert kinds("import testbed, numpy", KINDS, OPENBLAS_CORETYPE="Sandybridge") == [["Sandybridge", "Sandybridge"]]


@needs_avx2
def test_a_worker_computes_as_a_parent_that_loaded_numpy_first() -> None:
    parent, worker = kinds("import numpy, testbed", KINDS, WORKER)
    assert parent == worker and parent[1] == "None"


def test_a_processor_without_avx2_or_of_another_system_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    old.write_text("model name : of 2011\nflags : fpu sse4_2 avx\n")
    new.write_text("model name : of 2015\nflags : fpu sse4_2 avx fma avx2\n")
    assert not kind.has_avx2(old) and not kind.has_avx2(tmp_path / "absent") and kind.has_avx2(new)
    variables: dict[str, str] = {}
    monkeypatch.setattr(os, "environ", variables)
    monkeypatch.delitem(sys.modules, "numpy", raising=False)
    kind.choose_kernels(old)
    assert not variables
    kind.choose_kernels(new)
    assert variables == {kind.VARIABLE: "Haswell"}
