"""Child processes that begin as copies of this one: modules imported, kernels loaded, flights in memory.

A copy starts in milliseconds where a fresh interpreter needs two seconds of imports. It is made only where that is safe.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import connection, get_context, parent_process

THREADED = ("torch", "sklearn", "distributed")
"""Libraries whose own threads, once started, do not live on in a copy, which then waits for them."""


def can_fork() -> bool:
    """Whether a copy of this process would work: on Linux, from the only Python thread, with none of `THREADED` loaded."""
    alone = threading.active_count() == 1 and threading.current_thread() is threading.main_thread()
    return sys.platform == "linux" and alone and not any(name in sys.modules for name in THREADED)


@contextmanager
def quietly() -> Iterator[None]:
    """Without Python's warning of threads at a fork: what is left after `can_fork` is BLAS and Arrow, which look after it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*fork.*", category=DeprecationWarning)
        yield


def share(tasks: Sequence[Callable[[], object]], processes: int) -> None:
    """Do all tasks in this process and copies of it, each taking the next that nobody has begun; give the longest first.

    One after the other where it cannot be copied. A task counts for what it leaves on the disk. What fails in a copy is done
    again here, so that its error is raised.
    """
    processes = min(processes, len(tasks))
    if processes < 2 or not can_fork():
        for task in tasks:
            task()
        return
    context = get_context("fork")
    begun, done = context.Value("i", processes), context.Array("b", len(tasks), lock=False)

    def take(number: int) -> None:
        while number < len(tasks):
            tasks[number]()
            done[number] = 1
            with begun.get_lock():
                number = begun.value
                begun.value = number + 1

    with quietly():
        copies = [context.Process(target=_or_leave, args=(take, k)) for k in range(1, processes)]
        for copy in copies:
            copy.start()
    try:
        take(0)
    except KeyboardInterrupt:
        for copy in copies:  # that it reached them too is not said
            if copy.pid is not None:
                os.kill(copy.pid, signal.SIGINT)
        raise
    finally:
        for copy in copies:
            copy.join()
    for task, finished in zip(tasks, done, strict=True):
        if not finished:
            task()


def _or_leave(take: Callable[[int], object], first: int) -> None:
    """What a copy does; of what goes wrong it has no say."""
    try:
        take(first)
    except BaseException:
        os._exit(1)


def end_with_parent() -> None:
    """Have this worker end as soon as its parent process does: one that is killed cannot end its workers itself."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def end_with_standard_input() -> None:
    """Have this process end when its standard input does: a pipe from another program, which closes however that one dies.

    What runs here finds the input empty.
    """
    held = os.dup(0)
    empty = os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, 0)
    os.close(empty)
    threading.Thread(target=_wait_for_end, args=(held,), daemon=True).start()


def _wait_for_end(pipe: int) -> None:
    while os.read(pipe, 1):
        pass
    os._exit(1)


def _wait_for_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
