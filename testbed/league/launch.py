"""From the logs of a block to an entry's answers: a child of the bench for Python, a process of its own for all else.

What runs there is given the serialised logs and a copy of the entry's folder. Its environment names no cache, scenario, seed or
result of the bench; wilful cheating is against the rules, not impossible.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from testbed.base.errors import InputError
from testbed.base.files import write_json
from testbed.base.guarded import reason_of
from testbed.base.time_limit import THREAD_VARIABLES
from testbed.data.records import NavSolution, SensorLog
from testbed.formats.solutions import read_solution
from testbed.kernel_cache import VARIABLE
from testbed.league.child import COLD_S, from_arrays, reference_us
from testbed.league.entry import Entry
from testbed.league.suite import REFERENCE
from testbed.montecarlo.external import SUFFIXES, check_extent, run_name, write_log

KEPT = ("PATH", "LANG", "LC_ALL", "LC_CTYPE", "TZ", "LD_LIBRARY_PATH", "PYTHONPATH", "SYSTEMROOT")
"""What of the environment a program needs to start."""
GRACE_S = 30.0
"""A child ends itself at its time limit; one that is this late is in code that does not listen, and is killed."""
POLL_S = 0.05


@dataclass(frozen=True)
class Answer:
    """How an entry fared on one log. ``us`` per sample of it and of the reference, where they were measured."""

    status: str
    reason: str = ""
    us: float | None = None
    reference_us: float | None = None
    solution: NavSolution | None = None


@dataclass(frozen=True)
class Logs:
    """The logs of a block: in memory, and as folders that are written when somebody first needs them."""

    logs: Sequence[SensorLog]
    folder: Path
    filters: str
    keep_hz: float | None
    """Answers of Python entries are thinned to this rate; None keeps all rows."""

    def serialised(self, kind: str, count: int) -> Path:
        """Folder with the first ``count`` logs, ``parquet`` for Python or ``csv`` for programs; nobody may write there."""
        root = self.folder / kind
        for k, log in enumerate(self.logs[:count]):
            place = root / run_name(k)
            if place.is_dir():
                continue
            plain = replace_names(log, k)
            if kind == "csv":
                write_log(plain, place)
            else:
                plain.save(place)
            for path in place.iterdir():
                path.chmod(0o444)
        return root


def replace_names(log: SensorLog, number: int) -> SensorLog:
    """A log that says neither what flew nor which run of how many it is."""
    return SensorLog(log.imu, log.initial, aiding=log.aiding, name="", run=number)


def answers(entry: Entry, logs: Logs, count: int, home: Path, built: Path | None) -> list[Answer]:
    """What an entry makes of the first ``count`` logs. ``home``: an empty folder for it; ``built``: its folder with all built."""
    home.mkdir(parents=True)
    work = home / "entry"
    if (source := built or (entry.folder if entry.files() else None)) is not None:
        shutil.copytree(source, work, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    else:
        work.mkdir()
    (home / "answers").mkdir()
    if entry.estimator() is not None:
        found = _of_child(entry, logs, count, home)
    elif entry.table.answers is not None and "{run}" in "\0".join(entry.table.answers.command):
        found = _of_program_per_log(entry, logs, count, home)
    else:
        found = _of_program(entry, logs, count, home)
    return [
        replace(answer, reason=answer.reason.replace(f"{home}/", "").replace(f"{logs.folder}/", "")) for answer in found
    ]


def build(entry: Entry, home: Path) -> Path | None:
    """A copy of an entry's folder in which its ``build`` was done; None where it has none. Raises InputError where it fails."""
    table = entry.table.answers
    if table is None or not table.build:
        return None
    work = home / entry.name
    shutil.copytree(entry.folder, work, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    ended, _ = _run(table.build, work, home, entry.table.timeout_s + COLD_S, None)
    if ended:
        raise InputError(f"{entry.place}: 'answers.build': {' '.join(table.build)}: {ended}")
    return work


def _of_child(entry: Entry, logs: Logs, count: int, home: Path) -> list[Answer]:
    """The answers of a Python entry. A child that dies or hangs costs the log that it was at; another one goes on."""
    table, made = entry.table, entry.estimator()
    assert made is not None
    (home / "logs").symlink_to(logs.serialised("parquet", count))
    told: dict[str, Any] = {
        "estimator": made[0],
        "params": made[1],
        "plugin": None if table.plugin is None else str(home / "entry" / table.plugin.file),
        "timeout_s": table.timeout_s,
        "reference": REFERENCE[logs.filters],
        "keep_hz": logs.keep_hz,
    }
    names = [run_name(k) for k in range(count)]
    waiting = names
    while waiting:
        write_json(home / "job.json", told | {"runs": waiting})
        ended = _child(home, waiting, table.timeout_s)
        waiting = [name for name in waiting if not (home / "answers" / f"{name}.json").is_file()]
        if waiting:
            write_json(home / "answers" / f"{waiting[0]}.json", {"status": "failed", "reason": ended or "says nothing"})
            waiting = waiting[1:]
    return [_of_file(home / "answers" / name) for name in names]


def _child(home: Path, waiting: Sequence[str], timeout_s: float) -> str:
    """Start a child on a job and wait as long as it goes on; why it ended early. Its standard input ends when we do."""
    command = [sys.executable, "-P", "-m", "testbed.league.child", str(home)]
    with (home / "said").open("wb") as said:
        process = subprocess.Popen(command, cwd=home / "entry", env=environment(home), stdin=subprocess.PIPE, stdout=said, stderr=said, start_new_session=True)  # fmt: skip
        try:
            done, since = 0, time.monotonic()
            while process.poll() is None:
                answered = sum((home / "answers" / f"{name}.json").is_file() for name in waiting)
                if answered > done:
                    done, since = answered, time.monotonic()
                if time.monotonic() - since > timeout_s + COLD_S + GRACE_S:
                    return f"no answer within {timeout_s:g} s, and it did not end at the limit"
                time.sleep(POLL_S)
        finally:
            _end(process)
    return _last_words(home / "said", process.returncode)


def _of_file(stem: Path) -> Answer:
    """One answer of a child."""
    try:
        told = json.loads(stem.with_suffix(".json").read_text(encoding="utf-8"))
        answer = Answer(told["status"], told["reason"], told.get("us"), told.get("reference_us"))
        return replace(answer, solution=from_arrays(stem.with_suffix(".npz"))) if answer.status == "ok" else answer
    except Exception as error:  # an answer that was damaged on purpose or by a crash is none
        return Answer("failed", f"its answer cannot be read: {reason_of(error)}")


def _of_program(entry: Entry, logs: Logs, count: int, home: Path) -> list[Answer]:
    """The answers of a program that is started once for all logs."""
    table = entry.table.answers
    assert table is not None
    folder, out = logs.serialised("csv", count), home / "answers"
    command = [word.replace("{log}", str(folder)).replace("{out}", str(out)) for word in table.command]
    if len(list(folder.iterdir())) > count:  # another row has more seeds
        (home / "logs").mkdir()
        for k in range(count):
            (home / "logs" / run_name(k)).symlink_to(folder / run_name(k))
        command = [word.replace("{log}", str(home / "logs")).replace("{out}", str(out)) for word in table.command]
    ended, seconds = _run(command, home / "entry", home, entry.table.timeout_s * count + COLD_S, None)
    us = 1e6 * seconds / sum(len(log.imu.t) for log in logs.logs[:count])
    reference = reference_us(REFERENCE[logs.filters], logs.logs[0])
    return [_of_program_file(out / run_name(k), log, ended, us, reference) for k, log in enumerate(logs.logs[:count])]


def _of_program_per_log(entry: Entry, logs: Logs, count: int, home: Path) -> list[Answer]:
    """The answers of a program that is started for each log, and prints its answer where it has no file for it."""
    table = entry.table.answers
    assert table is not None
    folder, found = logs.serialised("csv", count), []
    reference = reference_us(REFERENCE[logs.filters], logs.logs[0])
    for k, log in enumerate(logs.logs[:count]):
        stem = home / "answers" / run_name(k)
        file = stem.with_suffix(".csv")
        command = [
            word.replace("{run}", str(folder / run_name(k))).replace("{answer}", str(file)) for word in table.command
        ]
        prints = not any("{answer}" in word for word in table.command)
        ended, seconds = _run(command, home / "entry", home, entry.table.timeout_s, file if prints else None)
        found.append(_of_program_file(stem, log, ended, 1e6 * seconds / len(log.imu.t), reference))
    return found


def _of_program_file(stem: Path, log: SensorLog, ended: str, us: float, reference: float) -> Answer:
    """One answer of a program, read from its file."""
    path = next((p for suffix in SUFFIXES if (p := stem.with_suffix(suffix)).is_file()), None)
    if ended:
        return Answer("timeout" if ended.startswith("no answer within") else "failed", ended)
    if path is None:
        return Answer("failed", f"wrote no {stem.name}.csv")
    try:
        solution = read_solution(path)
        check_extent(solution, log, path)
    except InputError as error:
        return Answer("failed", str(error).splitlines()[0])
    return Answer("ok", "", us, reference, solution)


def _run(command: Sequence[str], work: Path, home: Path, limit_s: float, printed: Path | None) -> tuple[str, float]:
    """Run a program; why it failed (empty where it did not), and its seconds. ``printed``: file for what it prints."""
    words = [sys.executable if command[0] == "python" else command[0], *command[1:]]
    start = time.monotonic()
    with (home / "said").open("wb") as said, (printed or home / "printed").open("wb") as out:
        try:
            process = subprocess.Popen(words, cwd=work, env=environment(home), stdin=subprocess.DEVNULL, stdout=out, stderr=said, start_new_session=True)  # fmt: skip
        except OSError as error:
            return f"{command[0]}: cannot be started ({error.strerror})", 0.0
        try:
            process.wait(limit_s)
        except subprocess.TimeoutExpired:
            return f"no answer within {limit_s:g} s", limit_s
        finally:
            _end(process)
    return _last_words(home / "said", process.returncode), time.monotonic() - start


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and all that it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _last_words(said: Path, code: int) -> str:
    """Why a process failed: the last line that it said; empty where it did not fail."""
    if code == 0:
        return ""
    lines = said.read_bytes().decode(errors="replace").strip().splitlines()
    how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
    return f"{how}: {lines[-1][:300]}" if lines else how


def environment(home: Path) -> dict[str, str]:
    """The environment of a process: what it needs to start, and folders of its own for all that programs keep."""
    kept = {name: os.environ[name] for name in KEPT if name in os.environ}
    kept |= dict.fromkeys(THREAD_VARIABLES, "1")
    if VARIABLE in os.environ:  # compiled kernels, which say nothing of flights
        kept[VARIABLE] = os.environ[VARIABLE]
    return kept | {
        "HOME": str(home),
        "TESTBED_CACHE": str(home / "cache"),
        "TMPDIR": str(home),
        "MPLCONFIGDIR": str(home),
    }
