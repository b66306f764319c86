"""Readings: what becomes of a claim under each, from synthetic filters whose order is known in every reading."""

from __future__ import annotations

import json
import re
import shutil

import monte_carlo as mc
import pandas as pd
import pytest
from PIL import Image

from testbed import cli, pipeline
from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.cli import commands
from testbed.data import registry
from testbed.montecarlo import runner
from testbed.montecarlo.readings import COLUMNS, run_readings, slug
from testbed.report.index import write_index
from testbed.report.labels import percent
from testbed.report.readings import write_page
from testbed.scenario import load_scenario
from testbed.scoring.claims import ReadingConfig
from testbed.scoring.readings import standing

CONDITIONS = {"quiet": {"noise": "low", "place": "here"}, "loud": {"noise": "high", "place": "here"}}
RUNS = 16


@pytest.fixture(autouse=True)
def real_pipeline():
    """The plug-in of these tests replaces two functions of the pipeline; put them back."""
    before = pipeline.fly, pipeline.sense
    yield
    pipeline.fly, pipeline.sense = before


@pytest.fixture
def file(tmp_path):
    return scenario_file(tmp_path)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A folder with finished readings, and its page."""
    before = pipeline.fly, pipeline.sense
    folder = tmp_path_factory.mktemp("readings")
    made(scenario_file(folder), folder / "out")
    write_page(folder / "out")
    pipeline.fly, pipeline.sense = before
    return folder / "out"


def scenario_file(tmp_path):
    """A scenario in which "good" beats "bad" by 80 % as it stands, and loses where "bad" has a tenth of its noise."""
    registry.load_plugin(mc.PLUGIN)
    loud = mc.BAD | {"params": mc.BAD["params"] | {"sigma_m": 5.0}}
    bad = mc.BAD | {"params": mc.BAD["params"] | {"sigma_m": 0.1}}
    readings = [
        {"name": "quiet", "leaves_open": "How loud it was: quiet.", "conditions": CONDITIONS["quiet"]},
        {"name": "loud", "leaves_open": "How loud it was: loud.", "conditions": CONDITIONS["loud"]}
        | {"overlay": {"estimators": [mc.GOOD, bad]}},
    ]
    own = mc.CLAIM | {"id": "2", "origin": "own", "paper_improvement_pct": 10.0, "text": "Good is better"}
    said = own | {"id": "3", "contradiction": "Page 1: better. Page 2: worse."}
    claims = [mc.CLAIM, own, said, mc.CLAIM | {"id": "4", "metric": "us_per_sample"}]
    path = tmp_path / "s.toml"
    made = mc.scenario([mc.GOOD, loud], runs=5, claims=claims, readings=readings)
    path.write_text(made.to_toml())
    return path


def made(file, out, runs=RUNS, **options):
    def load(reading):
        return load_scenario(file, reading=reading)

    return run_readings(load, out, runs=runs, jobs=1, plugins=[mc.PLUGIN], **options)


def reading(name, **conditions):
    return ReadingConfig(name=name, leaves_open="Something.", conditions=conditions)


@pytest.mark.parametrize(
    ("verdicts", "word"),
    [
        (("reproduced", "reproduced", "reproduced"), "holds"),
        (("reproduced", "not tested", "reproduced"), "holds"),
        (("not reproduced", "direction reproduced", "reversed"), "fails"),
        (("reproduced", "reproduced", "reversed"), "depends on noise"),
        (("reproduced", "undecided", "reversed"), "depends on noise or place"),
        (("reproduced", "reversed", "reproduced"), "depends on noise and place"),
        (("not tested", "undecided", "depends on runaways"), "depends on runaways"),
        (("not tested", "not tested", "not tested"), "not tested"),
    ],
)
def test_class_of_a_claim(verdicts, word):
    readings = [
        reading("a", noise="low", place="here"),
        reading("b", noise="low", place="there"),
        reading("c", noise="high", place="there"),
    ]
    found = dict(zip("abc", verdicts, strict=True))
    assert standing(readings, found).word == word
    quoted = standing(readings, found, "Text: 12 %. Table: 27 %.")
    assert quoted.word == "source inconsistent" and quoted.sentence.startswith("Text: 12 %. Table: 27 %.")


def test_a_condition_that_decides_is_told_with_its_values():
    """Whatever tells the readings apart: the one condition, or both where only the pair does."""
    a, b, c = (
        reading(n, noise=x, place=p) for n, x, p in (("a", "5 m", "0"), ("b", "5 m", "1 %"), ("c", "3 m", "1 %"))
    )
    one = standing([a, b, c], {"a": "reproduced", "b": "reproduced", "c": "reversed"})
    assert one.word == "depends on noise"
    assert one.sentence.endswith("; noise: “5 m” where it holds, “3 m” where it fails.")
    both = standing([a, b, c], {"a": "reproduced", "b": "reversed", "c": "reproduced"})
    assert "noise and place: “5 m and 0”, “3 m and 1 %” where it holds, “5 m and 1 %” where it fails" in both.sentence


def test_claims_are_judged_under_every_reading(done):
    table = pd.read_csv(done / "verdicts.csv")
    assert list(table.columns) == COLUMNS
    assert table["claim"].tolist() == [1, 1, 2, 2, 3, 3] and set(table["runs"]) == {RUNS}
    assert table["reading"].tolist() == ["quiet", "loud"] * 3
    assert table["verdict"].tolist() == ["reproduced", "reversed"] * 3
    assert table["class"].unique().tolist() == ["depends on noise", "source inconsistent"]
    assert set(pd.read_csv(done / "verdicts-timings.csv")["claim"]) == {4}
    # |N(0, 1)| against |N(0, 5)| is 80 % less, in the other reading against |N(0, 0.1)| ten times as much
    assert (table["ci_low"] < table["reading"].map({"quiet": 80.0, "loud": -900.0})).all()
    assert (table["ci_high"] > table["reading"].map({"quiet": 80.0, "loud": -900.0})).all()


def test_readings_are_paired_and_leave_a_plain_run_as_it_is(file, tmp_path):
    made(file, tmp_path / "out", runs=6)
    frames = [pd.read_parquet(tmp_path / "out" / "readings" / name / "metrics.parquet") for name in ("quiet", "loud")]
    good = [frame[frame["estimator"] == "good"].reset_index(drop=True) for frame in frames]
    pd.testing.assert_frame_equal(*good)
    plain = runner.run(load_scenario(file), tmp_path / "plain", runs=6, jobs=1, plugins=[mc.PLUGIN])
    pd.testing.assert_frame_equal(plain.metrics, frames[0])
    assert not list(plain.out.glob("verdicts*"))
    without = load_scenario(file).model_copy(update={"readings": []})
    assert without.digest() == load_scenario(file).digest() != load_scenario(file, reading="loud").digest()


def test_interrupted_readings_resume_to_the_same_bytes(file, done, tmp_path, monkeypatch):
    calls = []
    write_run = runner.Store.write_run

    def stops(store, *arguments):
        calls.append(1)
        if len(calls) == RUNS + 5:
            raise KeyboardInterrupt
        write_run(store, *arguments)

    monkeypatch.setattr(runner.Store, "write_run", stops)
    with pytest.raises(runner.Interrupted, match="--resume"):
        made(file, tmp_path / "out")
    with pytest.raises(InputError, match="--readings --resume"):
        write_page(tmp_path / "out")
    made(file, tmp_path / "out", resume=True)
    assert len(calls) == 2 * RUNS + 1
    assert (tmp_path / "out" / "verdicts.csv").read_bytes() == (done / "verdicts.csv").read_bytes()


def test_each_reading_runs_until_its_intervals_are_narrow(file, tmp_path):
    # the ratio of two |N| scatters by sqrt(2) 0.75 of itself per run: at 0.2 by 21 points over sqrt(runs), at 10 by 1000
    table = made(file, tmp_path / "out", runs=runner.Auto(width_pct=80.0, cap=20, first=10))
    counts = table[~table["claim"].eq("4")].groupby("reading")["runs"].max()
    assert counts.to_dict() == {"quiet": 10, "loud": 20}


def test_the_page_shows_table_plot_and_class(done, tmp_path):
    out, page = done, done / "report.html"
    text = (out / "report.md").read_text()
    for row in pd.read_csv(out / "verdicts.csv").to_dict("records"):
        lines = [line for line in text.splitlines() if line.startswith(f"| {row['reading']} |")]
        cells = [
            percent(row["effect_pct"]),
            f"{percent(row['ci_low'])} to {percent(row['ci_high'])}",
            f"**{row['verdict']}**",
        ]
        assert any(all(f" {cell} |" in line for cell in cells) for line in lines)
    assert (
        "**depends on noise**. It holds under “quiet”; fails under “loud”; noise: “low” where it holds, “high”" in text
    )
    assert "Page 1: better. Page 2: worse." in text and "How loud it was: quiet." in text
    assert "Of 2 claims of our own: 1 depends on noise, 1 where the source is inconsistent." in page.read_text()
    for picture in sorted((out / "figures").glob("forest-*.png")):
        assert Image.open(picture).width > 600
    assert len(re.findall(r'src="data:image/png', page.read_text())) == 4
    entry = json.loads((out / "report.json").read_text())
    assert entry["verdicts"][0] == "depends on noise" and len(entry["own_verdicts"]) == 2
    assert " in part" in write_index([out], tmp_path / "site").read_text()
    again = (out / "report.html").read_bytes()
    commands.report([out], None)
    assert (out / "report.html").read_bytes() == again


def test_damaged_readings_are_named(done, tmp_path):
    folder = tmp_path / "damaged"
    shutil.copytree(done, folder)
    pd.read_csv(folder / "verdicts.csv").drop(columns="verdict").to_csv(folder / "verdicts.csv")
    (folder / "verdicts-timings.csv").unlink()
    with pytest.raises(InputError, match=r"damaged: damaged readings: verdicts.csv lacks verdict"):
        write_page(folder)
    (folder / "verdicts.csv").unlink()
    with pytest.raises(InputError, match=r"verdicts.csv is missing"):
        write_page(folder)


def test_readings_touch_nothing_foreign_and_say_what_is_missing(file, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="holds no testbed readings"):
        made(file, out)
    assert [p.name for p in out.iterdir()] == ["mine.txt"]
    plain = tmp_path / "plain.toml"
    plain.write_text(mc.scenario([mc.GOOD, mc.BAD], claims=[mc.CLAIM]).to_toml())
    with pytest.raises(InputError, match=r"plain.toml: --readings: the scenario has no \[\[readings\]\]"):
        made(plain, tmp_path / "other")
    with pytest.raises(InputError, match=r"no \[\[readings\]\] named 'quit'.*quiet"):
        load_scenario(file, reading="quit")
    with pytest.raises(InputError, match=r"leaves \[claims\] as it is"):
        validate(ReadingConfig, {"name": "x", "leaves_open": "y", "overlay": {"claims": []}}, "s.toml")
    assert not (tmp_path / "other").exists()


def test_the_command_tells_each_class_and_refuses_a_sweep(file, tmp_path, monkeypatch, capsys):
    def command_line(*more):
        words = [
            "run",
            file,
            "--readings",
            "--jobs",
            "1",
            "--no-report",
            "--plugin",
            mc.PLUGIN,
            "--out",
            tmp_path / "cli",
        ]
        monkeypatch.setattr("sys.argv", ["testbed", *map(str, [*words, *more])])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return end.value.code, capsys.readouterr()

    code, told = command_line("--sweep", "monte_carlo.seed=1,2")
    assert code == 2 and "--readings and --sweep: one of them" in told.err and not (tmp_path / "cli").exists()
    code, told = command_line("--runs", "2")
    assert not code and [line.split(":")[0] for line in told.out.splitlines()] == ["1", "2", "3", "4", "tables"]
    assert "reading 2 of 2: loud" in told.err and (tmp_path / "cli" / "verdicts.csv").is_file()


def test_shipped_readings_load_and_have_folders_of_their_own():
    for name in ("imm-rstekf-2023", "quickstart"):
        readings = load_scenario(name).readings
        assert len({slug(r.name) for r in readings}) == len(readings) >= 3
        digests = [load_scenario(name, reading=r.name).digest() for r in readings]
        assert len(set(digests)) == len(readings) and digests[0] == load_scenario(name).digest()
