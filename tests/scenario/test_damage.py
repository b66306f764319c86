"""Damaged scenarios, tables and result folders: one message with the file's name and exit code 2, or it simply works.

2,000 examples in this process and 60 command lines in child processes under a watchdog; TESTBED_DAMAGE=50000 draws as
many, one in thirty of them as a command line.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import damage
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from result_folder import make_result

from testbed.base.errors import LONGEST_LINE, MOST_LINES, InputError
from testbed.flight.aircraft import load_aircraft
from testbed.flight.script import check_script
from testbed.formats import export_log, load_recording
from testbed.montecarlo.runner import plan
from testbed.pipeline import flight_of_run, fly, sense
from testbed.report import text
from testbed.report.results import load_result
from testbed.scenario import load_scenario

EXAMPLES = int(os.environ.get("TESTBED_DAMAGE", "2060"))
SHARES = {"scenarios": 0.75, "tables": 0.15, "results": 0.07, "lines": 0.03}
"""Of the examples: text is cheap to try, a command line takes a third of a second."""
HANG_S = 20.0


def patience() -> float:
    """`HANG_S` on a machine that does nothing else; where others compute as well, everything takes as many times as long."""
    return HANG_S * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def drawn(share: str, **kinds):
    """A property over so many examples, the same in every run."""
    quiet = settings(
        max_examples=max(1, round(SHARES[share] * EXAMPLES)),
        derandomize=True,
        deadline=None,
        database=None,
        phases=(Phase.generate,),  # what was damaged is told: nothing to shrink
        suppress_health_check=list(HealthCheck),
    )
    return lambda function: quiet(given(**kinds)(function))


@contextmanager
def watchdog():
    """TimeoutError after `patience`."""
    limit = patience()

    def bark(*_):
        raise TimeoutError(f"hangs for more than {limit:.0f} s")

    before = signal.signal(signal.SIGALRM, bark)
    signal.setitimer(signal.ITIMER_REAL, limit)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def check_told(message: str, name: str) -> None:
    """One message that a screen holds, with the name of what is wrong."""
    lines = message.splitlines()
    assert name in message, message
    assert "Traceback" not in message
    assert len(lines) <= MOST_LINES + 1 and max(map(len, lines)) <= LONGEST_LINE


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A folder with a recording's tables, a result folder, and the scenarios that belong to them."""
    place = tmp_path_factory.mktemp("sound")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TESTBED_CACHE", str(place / ".cache"))
        flight = place / "flight.toml"
        flight.write_bytes(damage.tomli_w.dumps(damage.FLIGHT).encode())
        (place / "recording.toml").write_bytes(damage.tomli_w.dumps(damage.RECORDING).encode())
        scenario = load_scenario(flight)
        truth = fly(scenario)
        log, _ = sense(scenario, truth)
        export_log(log, place / "table", "csv", reference=truth)
        make_result(place / "result", {"kf": 1.0, "imm-rstekf": 0.8}, runs=3)
        yield place


def test_the_undamaged_inputs_are_sound(sound):
    """Or everything below would be refused for the same reason."""
    for name in ("flight", "recording"):
        assert load_scenario(sound / f"{name}.toml")
    recording = load_scenario(sound / "recording.toml").recording
    assert load_recording(recording, sound).reference is not None
    assert load_result(sound / "result").windows


@pytest.fixture(scope="module")
def bench(sound, tmp_path_factory):
    """A place to damage things in."""
    place = tmp_path_factory.mktemp("bench")
    shutil.copytree(sound, place, dirs_exist_ok=True)
    return place


def test_a_damaged_scenario_is_refused_by_name_or_reads_back_the_same(bench):
    @drawn("scenarios", content=damage.scenarios())
    def holds(content):
        file = bench / "damaged.toml"
        file.write_bytes(content)
        try:
            with watchdog():
                scenario = load_scenario(file)
                plan(scenario)
                if scenario.flight is not None:
                    config, _ = flight_of_run(scenario, 0)
        except InputError as error:
            check_told(str(error), "damaged.toml")
            return
        again = bench / "again.toml"
        again.write_text(scenario.to_toml(), encoding="utf-8")
        assert repr(load_scenario(again).to_data()) == repr(scenario.to_data())  # repr: NaN is like itself
        if scenario.flight is not None:
            with watchdog():
                try:
                    check_script(config, load_aircraft(config.aircraft)[0])
                except InputError as error:
                    check_told(str(error), "")

    holds()


def test_damaged_tables_are_refused_by_name_or_read(bench, sound):
    config = load_scenario(sound / "recording.toml").recording

    @drawn("tables", data=st.data())
    def holds(data):
        folder = damage.copy_of(sound / "table", bench / "table")
        done = damage.damage_folder(folder, damage.TABLE_DAMAGE, data.draw)
        try:
            with watchdog():
                load_recording(config, bench)
        except InputError as error:
            check_told(str(error), "table")
        except Exception as error:
            raise AssertionError(done) from error

    holds()


def test_damaged_results_are_refused_by_name_or_shown(bench, sound):
    @drawn("results", data=st.data())
    def holds(data):
        folder = damage.copy_of(sound / "result", bench / "result")
        done = damage.damage_folder(folder, damage.RESULT_DAMAGE, data.draw)
        try:
            with watchdog():
                result = load_result(folder)
                text.markdown(result, {})
                text.latex(result)
        except InputError as error:
            check_told(str(error), "result")
        except Exception as error:
            raise AssertionError(done) from error

    holds()


VERBS = {
    "run": ["run", "damaged.toml", "--jobs", "1", "--no-report", "--out", "out"],
    "fly": ["fly", "damaged.toml", "--out", "out"],
    "sense": ["sense", "damaged.toml", "--out", "out"],
    "import": ["import", "table", "table", "--out", "out"],
    "report": ["report", "result"],
    "compare": ["compare", "result", "other"],
}
OWN = {"report": ("result",)}
"""Folders that a verb may change."""


@pytest.fixture
def driver(sound):
    environment = os.environ | {"TESTBED_CACHE": str(sound / ".cache"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).parents[1] / "damage_driver.py")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment, **pipes) as process:

        def ask(argv: list[str], cwd: Path) -> dict:
            print(json.dumps({"argv": argv, "cwd": str(cwd), "limit_s": patience()}), file=process.stdin, flush=True)
            return json.loads(process.stdout.readline())

        yield ask
        process.stdin.close()


def state(folder: Path, leave_out: tuple[str, ...] = ()) -> dict[str, str]:
    """Path and hash of every file in the folder, but for the folders left out."""
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.relative_to(folder).parts[0] not in leave_out)
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_command_lines_on_damaged_input_end_with_a_message_and_touch_nothing_of_others(sound, tmp_path, driver):
    @drawn("lines", verb=st.sampled_from(sorted(VERBS)), content=damage.scenarios(), data=st.data())
    def holds(verb, content, data):
        place = damage.copy_of(sound, tmp_path / "place")
        shutil.rmtree(place / ".cache", ignore_errors=True)
        shutil.copytree(place / "result", place / "other")
        (place / "damaged.toml").write_bytes(content)
        (place / "sentinel").mkdir()
        for name in ("notes.txt", "runs.parquet", "report.html"):
            (place / "sentinel" / name).write_text("of another")
        if verb == "import":
            damage.damage_folder(place / "table", damage.TABLE_DAMAGE, data.draw)
        elif verb in ("report", "compare"):
            damage.damage_folder(place / "result", damage.RESULT_DAMAGE, data.draw)
        leave_out = ("out", *OWN.get(verb, ()))
        before = state(place, leave_out)
        began = time.monotonic()
        got = driver(VERBS[verb], place)
        if os.environ.get("TESTBED_SHOW"):
            print(verb, got["code"], round(time.monotonic() - began, 1), got["said"][:200], flush=True)
        assert not got["hung"], f"{verb} hangs"
        assert "Traceback" not in got["said"] and "inside of the bench" not in got["said"], got["said"]
        assert got["code"] in (0, 2) or (got["code"] == 1 and may_fail(verb, got["said"])), got
        assert state(place, leave_out) == before
        if got["code"] == 2:
            assert not (place / "out").exists()
            check_told(got["said"], "")

    holds()


def may_fail(verb: str, said: str) -> bool:
    """Exit code 1 is for work that failed: a comparison that found something worse, a run in which no filter arrived."""
    return verb == "compare" or "no estimator came to the end of a run" in said
