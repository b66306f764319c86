"""The league's oracle: rows whose errors are known land where they must, and what a row is given is its log alone."""

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from league.tracks import KNOWN, entry, known, program, table, use

from testbed.base.checksums import file_digest
from testbed.data.records import NAVIGATION_STATES, NavSolution
from testbed.league import cells, child, launch
from testbed.league.entry import read_entry
from testbed.league.run import Wanted, league
from testbed.league.suite import load_track

SEEDS = 6
DOCS = Path(__file__).resolve().parents[2] / "docs"


CRASH = '[answers]\ncommand = ["python", "-c", "import sys; sys.exit(\'no luck\')", "{run}"]\n'
ABSENT = 'needs = ["no-such-program", "python:no_such_module"]\n[eskf]\n'
DIES = """
import os
class Dies(Known):
    name = "dies"
    def run(self, log):
        return os._exit(3) if log.run == 2 else super().run(log)
"""


def documented() -> str:
    """The plug-in that the documentation prints."""
    page = (DOCS / "howto" / "estimator.md").read_text()
    return page.split("<!-- file: mine.py -->\n```python\n")[1].split("```")[0]


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Rows of known error, the documentation's filter, and rows that fail, on six seeds."""
    place = tmp_path_factory.mktemp("league")
    folders = [
        program(place / "in", "offset", 3.0),
        known(place / "in", "first", sigma_m=1.0, told_m=1.0),
        known(place / "in", "copy", sigma_m=1.0, told_m=1.0),
        known(place / "in", "boaster", sigma_m=0.5, told_m=0.1),
        known(place / "in", "second", sigma_m=2.0, told_m=2.0, fails_at=1),
        entry(
            place / "in",
            "gnss-hold",
            '[plugin]\nfile = "mine.py"\nestimator = "gnss-hold"\n',
            mine_py=documented() + KNOWN,
        ),
        entry(place / "in", "crash", CRASH),
        entry(place / "in", "dies", '[plugin]\nfile = "dies.py"\nestimator = "dies"\n', dies_py=KNOWN + DIES),
        entry(place / "in", "absent", ABSENT),
    ]
    with pytest.MonkeyPatch.context() as patch:
        use(patch, place, SEEDS)
        league(Wanted(folders, development=True), place / "out")
    return place / "out"


def test_a_known_error_lands_where_it_must(played):
    """3 m north is 3 m in every run; the interpolation of a car that goes straight errs by micrometres, the Earth's radius by 1e-5."""
    found = table(played)["offset"]
    assert found["error"] == pytest.approx(3.0, rel=1e-4)
    # White noise of 1 m on three axes: sqrt(3) m; 600 rows, 3 axes, 6 runs leave 1 / sqrt(2 * 10800) = 0.7 %, so 3 % is 4 sigma.
    assert table(played)["first"]["error"] == pytest.approx(math.sqrt(3.0), rel=0.03)


def test_two_copies_of_a_method_tie(played):
    found = table(played)
    assert found["first"]["error"] == found["copy"]["error"]
    assert found["first"]["rank"] == found["copy"]["rank"] and "copy" in found["first"]["tied"]
    assert found["first"]["wins"] and found["copy"]["wins"]


def test_the_most_accurate_row_does_not_win_without_honesty(played):
    """It tells a fifth of its sigma: NEES is 25 times its degrees of freedom."""
    found = table(played)
    assert found["boaster"]["rank"] == 3 and found["boaster"]["mark"] == "over-confident"
    assert found["boaster"]["nees"]["position"] == pytest.approx(25.0, rel=0.05)
    assert not found["boaster"]["wins"] and found["first"]["rank"] == 4
    assert found["first"]["mark"] == "" and found["first"]["nees"]["position"] == pytest.approx(1.0, rel=0.05)
    assert found["offset"]["mark"] == "no sigmas" and not found["offset"]["wins"]
    page = (played / "league.md").read_text()
    assert "**4=**" in page and "▲ over-confident" in page


def test_a_lost_run_counts_as_lost(played):
    """One of six runs fails: the geometric mean of five errors of 2 sqrt(3) m and the 1000 m of a lost run."""
    found = table(played)["second"]
    assert found["lost"] == 1 and "as asked (known.py:" in found["reason"]
    assert found["error"] == pytest.approx((2.0 * math.sqrt(3.0)) ** (5 / 6) * 1000.0 ** (1 / 6), rel=0.03)


def test_rows_that_fail_are_lost_with_their_reason(played):
    found = table(played)
    assert found["crash"]["lost"] == SEEDS and found["crash"]["reason"] == "ended with exit code 1: no luck"
    assert found["dies"]["lost"] == 1 and found["dies"]["reason"] == "ended with exit code 3"
    assert found["crash"]["error"] == pytest.approx(1000.0) and not found["crash"]["wins"]
    assert "absent" not in found
    data = json.loads((played / "league.json").read_text())
    assert data["left_out"] == {"absent": "needs no-such-program, python:no_such_module"}


def test_the_filter_of_the_documentation_is_a_row(played):
    """Its fixes are exact and 0.2 s apart: on a car that goes straight at 20 m/s it errs by rounding."""
    found = table(played)["gnss-hold"]
    assert found["lost"] == 0 and found["error"] < 0.01 and found["rank"] == 1
    times = json.loads((played / "timings.json").read_text())["us_per_sample"]
    assert times["gnss-hold"]["relative"] > 0.0 and "crash" not in times


def test_same_bytes_whatever_the_order_and_the_workers(tmp_path, monkeypatch):
    use(monkeypatch, tmp_path, 3)
    folders = [program(tmp_path / "in", name, offset) for name, offset in (("a", 3.0), ("b", 4.0), ("c", 3.0))]
    monkeypatch.setattr("testbed.league.cells.BLOCK", 2)
    league(Wanted(folders), tmp_path / "one")
    league(Wanted(folders[::-1], jobs=2), tmp_path / "two")
    cells_of = [
        {p.name: p.read_bytes() for p in (tmp_path / out / "cells" / "roll").iterdir()} for out in ("one", "two")
    ]
    assert cells_of[0] == cells_of[1] and len(cells_of[0]) == 6
    texts = [(tmp_path / out / "league.md").read_text().split("## Rows")[0] for out in ("one", "two")]
    assert texts[0] == texts[1] and "lost" in texts[0]


def test_what_is_stored_is_taken_and_what_changed_is_computed_again(tmp_path, monkeypatch):
    use(monkeypatch, tmp_path, 2)
    folders = [program(tmp_path / "in", "a", 3.0), program(tmp_path / "in", "b", 4.0)]
    out, done = tmp_path / "out", []
    league(Wanted(folders), out)
    before = (out / "league.json").read_bytes()

    def noted(due, *rest):
        done.append([cell.entry.name for cell in due])
        cells.work(due, *rest)

    monkeypatch.setattr("testbed.league.run.work", noted)
    league(Wanted(folders), out)
    assert done == [] and (out / "league.json").read_bytes() == before
    told = folders[1] / "entry.toml"
    told.write_text(told.read_text().replace("4.0", "5.0"))
    league(Wanted(folders), out)
    assert done == [["b"]] and table(out)["b"]["error"] == pytest.approx(5.0, rel=1e-4)
    listed = json.loads((out / "manifest.json").read_text())["files"]
    assert listed and all(listed[name] == file_digest(out / name) for name in listed)
    cell = out / "cells" / "roll" / "a-0.json"
    cell.write_text(cell.read_text().replace("2.99", "1.99").replace("3.0", "1.0"))
    league(Wanted(folders), out)
    assert done == [["b"], ["a"]] and table(out)["a"]["error"] == pytest.approx(3.0, rel=1e-4)


SPY = """
import os, sys
from pathlib import Path
class Spy(Known):
    name = "spy"
    def run(self, log):
        told = [f"{k}={v}" for k, v in os.environ.items()] + sys.argv + [str(Path.cwd()), log.name, str(log.run), *sorted(vars(log))]
        Path(os.environ["HOME"], "told").write_text("\\n".join(told))
        return super().run(log)
"""


def test_the_child_receives_the_log_alone(tmp_path, monkeypatch):
    """Every file that a child can reach in its folders is the log, its entry or its job; nothing names seed, scenario or cache."""
    use(monkeypatch, tmp_path, 2)
    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path / "my-cache"))
    monkeypatch.setenv("MY_SECRET_SEED", "77")
    folder = entry(
        tmp_path,
        "spy",
        '[plugin]\nfile = "spy.py"\nestimator = "spy"\n',
        spy_py=KNOWN + SPY,
    )
    track = load_track("roll")
    (sensed,) = cells.sense(track, [7])
    logs = launch.Logs([sensed.log], tmp_path / "work" / "logs", "position", None)
    home = tmp_path / "work" / "spy"
    (answer,) = launch.answers(read_entry(folder), logs, 1, home, None)
    assert answer.status == "ok", answer.reason
    files = sorted(
        path.relative_to(home).as_posix()
        for path in home.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    )
    assert files == [
        "answers/000000.json",
        "answers/000000.npz",
        "entry/entry.toml",
        "entry/spy.py",
        "job.json",
        "said",
        "told",
    ]
    given = sorted(path.name for path in (home / "logs" / "000000").iterdir())
    assert given == ["gnss.parquet", "imu.parquet"]
    told = (home / "told").read_text()
    words = (home / "job.json").read_text() + told
    for secret in ("77", str(track.scenario.monte_carlo.seed), "my-cache", "roll", "scenario"):
        assert secret not in words.replace(str(tmp_path), ""), secret
    assert "\n0\n" in told, "the log says which run it is of"


def test_an_answer_is_scored_as_it_was_given(tmp_path):
    """What goes through the child's file is what the estimator said, row for row."""
    rng = np.random.default_rng(1)
    n, states = 40, (*NAVIGATION_STATES, "accel_scale_x")
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    cov = rng.standard_normal((3, 10, 10))
    given = NavSolution(np.arange(n) * 0.01, *rng.standard_normal((3, n)), rng.standard_normal((n, 3)), q, std=rng.random((n, 10)), covariance_t=np.array([0.1, 0.2, 0.3]), covariance=cov, states=states)  # fmt: skip
    np.savez(tmp_path / "a.npz", **child.as_arrays(given, 10.0))
    back = child.from_arrays(tmp_path / "a.npz")
    assert back.states == NAVIGATION_STATES
    assert np.array_equal(back.t, given.t[::10]) and np.array_equal(back.lat, given.lat[::10])
    assert np.array_equal(back.std, given.std[::10, :9]) and np.array_equal(back.covariance, cov[:, :9, :9])


def test_the_environment_names_no_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TESTBED_CACHE", "/somewhere")
    found = launch.environment(tmp_path)
    assert found["TESTBED_CACHE"] == str(tmp_path / "cache") and found["HOME"] == str(tmp_path)
    assert set(found) <= {
        *launch.KEPT,
        *launch.THREAD_VARIABLES,
        launch.VARIABLE,
        "HOME",
        "TESTBED_CACHE",
        "TMPDIR",
        "MPLCONFIGDIR",
    }
    assert os.environ["TESTBED_CACHE"] == "/somewhere" and sys.executable


SLEEPS = """
import os, time
from pathlib import Path
class Sleeps(Known):
    name = "sleeps"
    def run(self, log):
        Path({place!r}).write_text(str(os.getpid()))
        time.sleep(50.0)
"""
KILLED = """
import sys
import pytest
from pathlib import Path
from league.tracks import use
from testbed.league.run import Wanted, league
place = Path(sys.argv[1])
with pytest.MonkeyPatch.context() as patch:
    use(patch, place, 1)
    league(Wanted([place / "in" / "sleeps"], development=True), place / "out")
"""


def test_no_row_goes_on_after_a_league_that_was_killed(tmp_path):
    """SIGKILL leaves the league no moment to end its children: they notice by their standard input."""
    told = tmp_path / "pid"
    plugin = KNOWN + SLEEPS.format(place=str(told))
    entry(tmp_path / "in", "sleeps", '[plugin]\nfile = "sleeps.py"\nestimator = "sleeps"\n', sleeps_py=plugin)
    tests = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])}
    killed = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], env=tests)
    try:
        assert _within(40.0, lambda: told.is_file() and told.read_text())
    finally:
        killed.kill()
        killed.wait()
    assert _within(10.0, lambda: not _runs(int(told.read_text())))


def _runs(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def _within(seconds, found):
    """Whether something comes true in time."""
    end = time.monotonic() + seconds
    while not found() and time.monotonic() < end:
        time.sleep(0.05)
    return found()
