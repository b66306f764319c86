"""Somebody else's code called: how long it took, and why it failed, in one line."""

from __future__ import annotations

import sysconfig
import time
import traceback
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import TestbedError
from testbed.base.time_limit import time_limit

FOREIGN = (str(Path(__file__).parents[1]), *(sysconfig.get_paths()[kind] for kind in ("stdlib", "purelib", "platlib")))
"""Folders of code that is no estimator's: an error that comes up there has its cause further out."""


def timed(work: Callable[[Any], Any], data: Any, limit: float | None) -> tuple[Any, float]:
    """What ``work`` makes of ``data`` within ``limit`` (s), and its seconds but for those in which kernels are compiled or loaded."""
    from numba.core import event

    guard: AbstractContextManager[Any] = time_limit(limit) if limit else nullcontext()
    compiling: list[float] = []
    with guard, np.errstate(all="ignore"), event.install_timer("numba:compiler_lock", compiling.append):
        start = time.perf_counter()
        done = work(data)
        seconds = time.perf_counter() - start
    return done, seconds - sum(compiling)


def reason_of(error: BaseException) -> str:
    """Type, message and place of an error in one line: the innermost place in an estimator; a user's mistake says its own."""
    text = f"{type(error).__name__}: {error}".strip().splitlines()[0][:300]
    frames = traceback.extract_tb(error.__traceback__)
    if not frames or isinstance(error, TestbedError):
        return text
    own = [frame for frame in frames if not frame.filename.startswith(FOREIGN)]
    place = own[-1] if own else frames[-1]
    return f"{text} ({Path(place.filename).name}:{place.lineno})"
