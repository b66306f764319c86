"""Every mistake of a submitter in one message with exit code 2, and the suite as it was released."""

import hashlib
import os
import shutil
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from league.tracks import ENTRY, entry

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.league import cells, drive_data, suite
from testbed.league.check import Checked, remark
from testbed.league.entry import read_entries, read_entry, shipped_entries, unique
from testbed.league.run import Wanted, chosen_rows
from testbed.league.speeds import seeds_of
from testbed.league.suite import TRACKS, load_track, released_seed, shortened, track_files
from testbed.scoring.quantities import metric_names

HEAD = ENTRY.format(name="mine", division="closed")
SHIPPED = [entry.name for entry in shipped_entries()]
MISTAKES = {
    "no TOML": ("name = ", "not valid TOML"),
    "no way to run": (HEAD, "give exactly one of [plugin], [entry-point], [eskf] and [answers], not none"),
    "two ways": (HEAD + '[eskf]\n[entry-point]\nestimator = "ins"\n', "not [entry-point] and [eskf]"),
    "name": (HEAD.replace('"mine"', '"my filter"') + "[eskf]\n", "'name'"),
    "missing": (HEAD.replace('licence = "MIT"\n', "") + "[eskf]\n", "'licence' is missing"),
    "misspelt": (HEAD.replace("class =", "clas =") + "[eskf]\n", "'clas' is not a known key; did you mean 'class'?"),
    "division": (
        HEAD.replace('"closed"', '"half-open"') + "[eskf]\n",
        "'division': input should be 'closed' or 'open'",
    ),
    "class": (
        HEAD.replace('class = "position"', 'class = "both"') + "[eskf]\n",
        "'class': input should be 'position' or 'attitude'",
    ),
    "speed": (HEAD + 'speed = "quick"\n[eskf]\n', "'speed': input should be 'fast', 'slow' or 'very slow'"),
    "number": (HEAD + 'timeout_s = "60"\n[eskf]\n', "'timeout_s': input should be a valid number"),
    "file": (HEAD + '[plugin]\nfile = "absent.py"\n', "'plugin.file': no file absent.py"),
    "outside": (HEAD + '[plugin]\nfile = "../mine.py"\n', "lies outside of the entry's folder"),
    "estimator": (HEAD + '[entry-point]\nestimator = "indirekt-kf"\n', "did you mean 'indirect-kf'?"),
    "taken": (HEAD.replace('"mine"', '"indirect-kf"') + "[eskf]\n", "is the name of another row"),
    "needs": (HEAD + 'needs = ["no-such-program"]\n[eskf]\n', "this machine has no no-such-program"),
    "command": (HEAD + '[answers]\ncommand = ["./solve", "{log}"]\n', "command needs {log} and {out}"),
    "both": (HEAD + '[answers]\ncommand = ["octave", "{log}", "{run}"]\n', "command has both {run} and {log}"),
    "program": (HEAD + '[answers]\ncommand = ["./solve", "{log}", "{out}"]\n', "'answers.command': no file ./solve"),
    "key": (HEAD + '[plugin]\nfiel = "mine.py"\n', "'plugin.fiel' is not a known key; did you mean 'file'?"),
}


@pytest.mark.parametrize(("text", "told"), MISTAKES.values(), ids=list(MISTAKES))
def test_a_mistake_in_one_message(tmp_path, text, told):
    (tmp_path / "entry.toml").write_text(text)
    code, said = call("league", "--check", str(tmp_path))
    assert code == 2 and told in said
    assert said.startswith("testbed: ") and str(tmp_path / "entry.toml") in said
    assert len(said.strip().splitlines()) == 1


def test_mistakes_of_the_call(tmp_path):
    for words, told in (
        (["--check", str(tmp_path / "none")], "no such folder"),
        (["--check", str(tmp_path)], "it has no entry.toml"),
        (["--rows", "indirekt-kf"], "did you mean 'indirect-kf'?"),
        (["--tracks", "agile"], "did you mean 'agile-outages'?"),
        (["--tracks", "real-drive"], "--data FOLDER says where it lies"),
        (["--tracks", "real-drive", "--data", str(tmp_path)], "has no imu_1934.csv"),
        (["--rows", "ins", "--tracks", "no-gnss"], "no row is of the class of these tracks"),
    ):
        code, said = call("league", *words, "--out", str(tmp_path / "out"))
        assert code == 2 and told in said, said
        assert not (tmp_path / "out").exists()


def test_what_does_not_build_is_told_before_anything_runs(tmp_path):
    how = '[answers]\ncommand = ["./solve", "{log}", "{out}"]\nbuild = ["python", "-c", "import sys; sys.exit(\'no compiler\')"]\n'
    folder = entry(tmp_path, "unbuilt", how)
    code, said = call("league", "--check", str(folder))
    assert code == 2 and "'answers.build'" in said and "exit code 1: no compiler" in said


def test_a_file_of_several_entries(tmp_path):
    path = tmp_path / "rows.toml"
    path.write_text("[[entries]]\n" + HEAD + "eskf = {}\n[[entries]]\n" + HEAD.replace("mine", "other") + "eskf = {}\n")
    assert [e.name for e in read_entries(path)] == ["mine", "other"]
    path.write_text(path.read_text().replace("eskf = {}\n[[", "eskf = { a = 1 }\nesfk = 1\n[["))
    with pytest.raises(InputError, match="entry 1: 'esfk' is not a known key"):
        read_entries(path)
    with pytest.raises(InputError, match="is the name of another row"):
        unique([read_entry(entry(tmp_path / part, "mine", "[eskf]\n")) for part in ("a", "b")])


def test_the_digest_follows_the_files(tmp_path):
    folder = entry(tmp_path, "mine", '[plugin]\nfile = "mine.py"\n', mine_py="1")
    first = read_entry(folder).digest
    (folder / "weights.bin").write_bytes(b"\0\1")
    second = read_entry(folder).digest
    assert first != second
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "mine.pyc").write_bytes(b"\0")
    assert read_entry(folder).digest == second


def test_the_code_of_a_result_is_not_that_of_other_rows(tmp_path, monkeypatch):
    """A new row in a package of rows makes no other row anew; a filter that changes does."""
    rows = tmp_path / "peer_filters" / "rows"
    (rows / "mine").mkdir(parents=True)
    for folder in (rows, rows.parent):
        (folder / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    named = {"testbed.estimators": "peer_filters", "testbed.league": "peer_filters.rows"}
    monkeypatch.setattr(cells, "entry_points", lambda group: [EntryPoint("peers", named[group], group)])
    digest = cells.code_digest.__wrapped__
    before = digest()
    (rows / "mine" / "mine.py").write_text("x = 1\n")
    assert digest() == before
    (rows.parent / "filter.py").write_text("x = 1\n")
    assert digest() != before


def test_a_very_slow_row_is_left_out_of_a_quick_league(tmp_path, capsys):
    entry(tmp_path, "mine", 'speed = "very slow"\n[eskf]\n')
    rows, left_out = chosen_rows(Wanted([tmp_path / "mine"], ["mine", "ins"], quick=True))
    assert [row.name for row in rows] == ["ins"]
    assert left_out == {"mine": "is too slow for --quick"}
    assert "mine is left out: it is too slow for --quick" in capsys.readouterr().err
    assert seeds_of(chosen_rows(Wanted([tmp_path / "mine"], ["mine"]))[0][0].table.speed, quick=False) == 3


@pytest.mark.parametrize(
    ("declared", "us", "reference_us", "said"),
    [
        ("fast", 19.0, 1.0, None),
        ("fast", 21.0, 1.0, "'slow' (10 seeds in place of 100)"),
        ("fast", 21.0, 5.0, None),  # a busy machine, on which the reference takes long as well
        ("slow", 250.0, 1.0, "'very slow' (3 seeds in place of 10)"),
        ("slow", 11.0, 1.0, None),
        ("slow", 9.0, 1.0, "'fast' (100 seeds in place of 10)"),
        ("very slow", 90.0, 1.0, "'slow' (10 seeds in place of 3)"),
    ],
)
def test_a_speed_declared_wrong_is_told(declared, us, reference_us, said):
    told = remark(declared, [Checked("roll", "m", 1.0, us, reference_us, True)], "ins", False)
    assert ("say speed" in told) == (said is not None)
    assert said is None or said in told


def test_shipped_rows_are_sound():
    assert len(SHIPPED) >= 20 and len(set(SHIPPED)) == len(SHIPPED)
    classes = [e.table.filters for e in shipped_entries()]
    assert classes.count("position") >= 10 and classes.count("attitude") >= 5


RELEASED = {"2026.1": "50aa5cd0d585cbfd"}
"""Version of the suite -> hash of its track files: whoever changes a track raises `suite.SUITE`, or test seeds would be known."""


def test_a_changed_track_is_another_suite():
    total = hashlib.sha256(b"".join(path.read_bytes() for path in track_files().values())).hexdigest()[:16]
    assert RELEASED[suite.SUITE] == total


def test_tracks_are_eight_and_say_why():
    assert len(TRACKS) == 8 and set(TRACKS) == {path.stem for path in track_files()["no-gnss"].parent.glob("*.toml")}
    for name in TRACKS:
        track = load_track(name)
        assert track.name == name and track.table.metric in metric_names() and len(track.table.why) > 40
        windows = {"all", *(w.name or w.kind for w in track.scenario.windows)}
        assert track.table.window in windows
        raw = tomllib.loads(track_files()[name].read_text())
        assert raw["estimators"] == [{"name": suite.REFERENCE[track.table.filters]}]


def test_test_seeds_follow_from_the_version_and_are_nobodys_development_seed():
    seeds = [load_track(name).scenario.monte_carlo.seed for name in TRACKS]
    assert len(set(seeds)) == len(TRACKS) and suite.DEVELOPMENT_SEED not in seeds
    assert {load_track(name, development=True).scenario.monte_carlo.seed for name in TRACKS} == {1}
    # By another implementation: printf 'league 2026.1 raw-unit' | sha256sum
    assert released_seed("raw-unit", "2026.1") == 4206840022
    assert released_seed("raw-unit", "2026.2") != released_seed("raw-unit", "2026.1")


def test_a_first_look_is_short():
    """The drive needs no flight simulator: its beginning, without its walls, has the sensors of the whole."""
    track = shortened("city-partial")
    truth = pipeline.fly(track.scenario)
    assert truth.t[-1] == pytest.approx(60.0)
    log, _ = pipeline.sense(track.scenario, truth)
    assert set(log.aiding) == {"gnss", "gnss_raw", "odometer"} and log.gnss.outages == ()


@pytest.mark.skipif("TESTBED_SLOW" not in os.environ, reason="flies seven flights (TESTBED_SLOW=1)")
def test_tracks_are_as_long_as_they_say():
    for name in TRACKS:
        if name not in suite.RECORDED:
            track = load_track(name)
            assert np.round(pipeline.fly(track.scenario).t[-1]) == pytest.approx(track.table.length_s, abs=1.0)


DRIVE = Path(__file__).resolve().parents[3] / "shared" / "data" / "drive"


@pytest.mark.skipif(not DRIVE.is_dir(), reason="the recorded drive is not here")
def test_the_recorded_drive_is_as_long_as_it_says_and_draws_its_windows(tmp_path):
    folder = drive_data.prepared(DRIVE, tmp_path / "drive")
    track = load_track("real-drive", recording=folder)
    assert track.digest == load_track("real-drive", recording=shutil.copytree(folder, tmp_path / "elsewhere")).digest
    logs = [pipeline.sense(track.scenario, pipeline.fly(track.scenario, run), run=run)[0] for run in (0, 1)]
    t = logs[0].imu.t
    assert t[-1] - t[0] == pytest.approx(track.table.length_s, abs=1.0)
    for log in logs:
        assert [end - start for start, end in log.gnss.outages] == pytest.approx([15.0] * 8)
    assert logs[0].gnss.outages != logs[1].gnss.outages
