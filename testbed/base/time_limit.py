"""Limits on what an estimator may take: time, and threads of the numerical libraries.

Seconds of a clock that nobody sets. In a main thread a signal ends even a sleep; elsewhere an exception is injected at the next
bytecode. Native code that ignores both is ended by the parent process, see `testbed.montecarlo.executors`.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
"""Environment variables that numerical libraries read when they load."""


class TimeLimitError(BaseException):
    """An estimator took too long. Not an Exception, so that a plug-in's ``except Exception`` does not swallow it."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeLimitError inside the block once it has taken ``seconds``."""
    if threading.current_thread() is threading.main_thread() and hasattr(signal, "setitimer"):
        yield from _by_signal(seconds)
    else:
        yield from _by_injection(seconds)


def _by_signal(seconds: float) -> Iterator[None]:
    def expire(_number: int, _frame: Any) -> None:
        raise TimeLimitError

    previous = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)


def _by_injection(seconds: float) -> Iterator[None]:
    target, lock, finished = ctypes.c_ulong(threading.get_ident()), threading.Lock(), False

    def expire() -> None:
        with lock:
            if not finished:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(target, ctypes.py_object(TimeLimitError))

    timer = threading.Timer(seconds, expire)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        with lock:
            finished = True
        timer.cancel()


@contextmanager
def single_threaded() -> Iterator[None]:
    """One thread for BLAS, OpenMP and torch inside the block, loaded already or not: results must not depend on cores."""
    pools: Any = None
    try:
        from threadpoolctl import threadpool_limits

        pools = threadpool_limits(1)
    except ImportError:
        pass
    torch = sys.modules.get("torch")
    threads = torch.get_num_threads() if torch is not None else 0
    if torch is not None:
        torch.set_num_threads(1)
    try:
        with thread_environment():
            yield
    finally:
        if pools is not None:
            pools.restore_original_limits()
        if torch is not None:
            torch.set_num_threads(threads)


@contextmanager
def thread_environment() -> Iterator[None]:
    """Processes that are started and libraries that are loaded inside the block use one thread."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
