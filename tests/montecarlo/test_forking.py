"""Copies of the process: work dealt out is all done, an error in a copy is raised, and no copy is made where it would hang."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from testbed.base import child_processes as forking

linux = pytest.mark.skipif(sys.platform != "linux", reason="copies are made on Linux only")


def note(path: Path) -> None:
    path.write_text(str(os.getpid()))


@pytest.fixture
def alone(monkeypatch):
    """As in the command: no thread but this one, no library with threads of its own."""
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    monkeypatch.setattr(forking, "THREADED", ())


@linux
@pytest.mark.parametrize("processes", [1, 2, 3, 20])
def test_all_tasks_are_done_by_as_many_processes_as_wanted(tmp_path, alone, processes):
    paths = [tmp_path / str(k) for k in range(7)]
    forking.share([partial(note, path) for path in paths], processes)
    assert len({path.read_text() for path in paths}) == min(processes, 7)


@linux
def test_an_error_in_a_copy_is_raised_here(tmp_path, alone):
    with pytest.raises(FileNotFoundError, match="no-such-folder"):
        forking.share([partial(note, tmp_path / "a"), partial(note, tmp_path / "no-such-folder" / "b")], 2)
    assert (tmp_path / "a").exists()


def test_no_copy_is_made_beside_another_thread(tmp_path, monkeypatch):
    monkeypatch.setattr(forking, "THREADED", ())
    gate = threading.Event()
    thread = threading.Thread(target=gate.wait)
    thread.start()
    try:
        assert not forking.can_fork()
        forking.share([partial(note, tmp_path / name) for name in "ab"], 2)
    finally:
        gate.set()
        thread.join()
    assert {(tmp_path / name).read_text() for name in "ab"} == {str(os.getpid())}


@pytest.mark.parametrize("library", forking.THREADED)
def test_no_copy_is_made_with_a_library_whose_threads_would_not_live_on(monkeypatch, library):
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    monkeypatch.setitem(sys.modules, library, os)
    assert not forking.can_fork()


WAITING = """
import signal, sys, time
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background of a shell begins with it ignored
from testbed.base.child_processes import share
def wait(name):
    Path(sys.argv[1], name).touch()
    time.sleep(30.0)
share([lambda name=name: wait(name) for name in "abcd"], 2)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="copies are made on Linux")
def test_an_interrupt_of_this_process_ends_its_copies(tmp_path):
    """A signal to the process alone, as of a job's end: nobody waits for what the copies have begun, half a minute each."""
    process = subprocess.Popen([sys.executable, "-c", WAITING, str(tmp_path)], stderr=subprocess.DEVNULL)
    try:
        while len(list(tmp_path.iterdir())) < 2 and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.wait(25.0) != 0
    finally:
        process.kill()
        process.wait()
    assert len(list(tmp_path.iterdir())) == 2
