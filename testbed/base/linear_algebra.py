"""One kind of linear algebra on every x86 processor, so that one seed gives the same bytes on each.

OpenBLAS, which numpy and scipy carry, chooses its kernels by the processor, and kernels differ in the order in which they add.
That is parts in 1e16 of a product, parts in 1e11 of most metrics, and the third digit where a filter runs away. So the
kernels for AVX2 are asked for, which x86 processors have had since 2013. Wider ones gain nothing on matrices of 15 rows
(12 runs of ``imm-rstekf-2023``, three times in turn: 6.0 to 7.3 s with these, 6.2 to 6.4 s with those for AVX-512).
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

VARIABLE, KIND = "OPENBLAS_CORETYPE", "Haswell"
"""OpenBLAS's variable, read when it loads, and its name of the kernels for AVX2."""
MARK = "TESTBED_OPENBLAS_AS_LOADED"
"""Tells a worker that its parent has loaded OpenBLAS before `testbed`: both shall compute alike."""
PROCESSOR = Path("/proc/cpuinfo")
_FIRST = 8192
"""Bytes that hold the first core's entry."""


def choose_kernels(processor: Path = PROCESSOR) -> None:
    """Ask OpenBLAS for `KIND`, unless the user asked for another, it has loaded, or the processor has no AVX2 (or tells nothing)."""
    if VARIABLE in os.environ or MARK in os.environ:
        return
    if "numpy" in sys.modules:
        os.environ[MARK] = "1"
    elif has_avx2(processor):
        os.environ[VARIABLE] = KIND


def has_avx2(processor: Path = PROCESSOR) -> bool:
    """Whether Linux says that the processor has AVX2 and FMA."""
    try:
        with processor.open("rb") as file:
            words = file.read(_FIRST).split()
    except OSError:
        return False
    return {b"avx2", b"fma"} <= set(words)
