"""Limits on what an estimator may take: time, and threads of the numerical libraries.

Wall-clock seconds. In a main thread a signal ends even a sleep; elsewhere an exception is injected at the next
bytecode. Native code that ignores both is ended by the parent process, see `testbed.executors`.
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

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
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
    signal.setitimer(signal.ITIMER_REAL, seconds, max(0.2, 0.1 * seconds))  # again, should a plug-in swallow the first
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
    """One thread for torch inside the block, as results must not depend on how many cores a worker sees."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        if (loaded := sys.modules.get("torch")) is not None:
            loaded.set_num_threads(1)
        return
    before = torch.get_num_threads()
    if before != 1:
        torch.set_num_threads(1)
    yield


@contextmanager
def thread_environment() -> Iterator[None]:
    """Processes that are started inside the block load their numerical libraries with one thread."""
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
