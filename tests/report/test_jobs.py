"""The reports' jobs: what is kept and what is made again, from what commit, and that what git holds is what the jobs left."""

from __future__ import annotations

import json
import re
import sys
from argparse import Namespace
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).resolve().parents[2]
REPORTS = ROOT / "reports"


@pytest.fixture(scope="module")
def scripts():
    """`make`, which brings the folders of scripts onto the path; what it brings is forgotten again."""
    before, modules = list(sys.path), set(sys.modules)
    sys.path.insert(0, str(REPORTS))
    import make

    yield make
    sys.path[:] = before
    for name in set(sys.modules) - modules:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(str(REPORTS)):
            del sys.modules[name]


@pytest.fixture
def paper(scripts, tmp_path):
    """A paper of one job that counts its calls into its table."""
    calls = []

    def work(place):
        calls.append(place)
        (place.target / "t.csv").write_text(f"calls\n{len(calls)}\n")

    def told(inputs):
        job = scripts.study("count", work, 1.0, ("t.csv",), inputs=inputs)
        return scripts.Paper("p", "P", (job,)), calls

    return told


def options(**changed):
    return Namespace(**{"names": [], "resume": True, "long": False, "trial": True, "list": False} | changed)


def made_again(scripts, tmp_path, paper, **changed):
    scripts.make(paper, paper.jobs[0], tmp_path, "abc", options(**changed))


def test_a_job_is_kept_until_its_table_or_its_inputs_change(scripts, tmp_path, paper):
    first, calls = paper(1)
    for _ in range(3):
        made_again(scripts, tmp_path, first)
    assert len(calls) == 1
    made_again(scripts, tmp_path, first, resume=False)
    assert len(calls) == 2, "without --resume it is made again"
    (tmp_path / "p" / "t.csv").write_text("calls\n7\n")
    made_again(scripts, tmp_path, first)
    assert len(calls) == 3, "a table that was touched is no table of the job"
    made_again(scripts, tmp_path, paper(2)[0])
    assert len(calls) == 4, "other inputs"
    note = json.loads((tmp_path / "p" / "made.json").read_text())["count"]
    assert note["commit"] == "abc" and set(note) == {"commit", "inputs", "minutes", "files"}


def test_a_table_hangs_on_the_catalogue_and_on_the_weights(scripts, monkeypatch, tmp_path):
    """Neither stands in a scenario, so that a change of either would go unseen."""
    import ahrs_studies

    from estimators.learning import ahrs_weights
    from testbed.sensors import catalog

    known = [scripts.catalogue(""), ahrs_studies.learned("")]
    other = tmp_path / "other.safetensors"
    other.write_bytes(b"other")
    monkeypatch.setitem(ahrs_weights.BY_NAME, "", other)
    monkeypatch.setattr(catalog, "entry", lambda kind, model: {"model": model})
    assert scripts.catalogue("") != known[0]
    assert ahrs_studies.learned("") != known[1]


def test_a_job_that_leaves_no_table_is_not_noted(scripts, tmp_path):
    lazy = scripts.Paper("p", "P", (scripts.study("lazy", lambda place: None, 1.0, ("t.csv",)),))
    with pytest.raises(SystemExit, match=r"p/lazy: left no t\.csv"):
        made_again(scripts, tmp_path, lazy)
    assert not (tmp_path / "p" / "made.json").exists()


def test_a_job_without_its_data_leaves_table_and_note_as_they_are(scripts, tmp_path, capsys):
    def absent(place):
        raise scripts.Kept("no recording")

    made_again(scripts, tmp_path, scripts.Paper("p", "P", (scripts.study("absent", absent, 1.0, ("t.csv",)),)))
    assert "p/absent: stays as it is: no recording" in capsys.readouterr().out
    assert not (tmp_path / "p" / "made.json").exists()


def test_jobs_have_budgets(scripts):
    """No job above 100 minutes; all that `make reports` runs at most 90; names are folders, and no two jobs leave the same file."""
    with pytest.raises(ValueError, match="at most 100"):
        scripts.study("endless", print, 101.0, ("t.csv",))
    papers = scripts.all_papers()
    assert sum(job.minutes for paper in papers for job in paper.jobs if not job.long) <= 90.0
    for paper in papers:
        files = [name for job in paper.jobs for name in job.files()]
        assert len(files) == len(set(files)), paper.name
        assert all(re.fullmatch(r"[a-z0-9-]+", job.name) for job in paper.jobs), paper.name


@pytest.mark.parametrize(
    ("path", "written"),
    [
        ("reports/imm-rstekf-2023/verdicts.csv", True),
        ("reports/imm-rstekf-2023/figures/modes.png", True),
        ("reports/index.md", True),
        ("reports/imm-rstekf-2023/findings.md", False),
        ("reports/findings.md", False),
        ("reports/make.py", False),
        ("reports/studies/jobs.py", False),
        ("reports/benchmarks/paths.json", False),
        ("scenarios/imm-rstekf-2023.toml", False),
    ],
)
def test_what_counts_as_not_committed(scripts, path, written):
    assert scripts.is_output(path, scripts.all_papers()) is written


def test_a_dirty_tree_is_refused(scripts, monkeypatch):
    monkeypatch.setattr(scripts, "status", lambda: ["reports/index.md", "scenarios/imm-rstekf-2023.toml"])
    with pytest.raises(
        SystemExit, match=r"not committed: scenarios/imm-rstekf-2023\.toml; reports are made from a clean commit"
    ):
        scripts.clean_commit(scripts.all_papers())


def test_classes_of_a_study_and_of_a_scenario_stand_in_one_table(scripts, tmp_path):
    """A claim of the scenario gets its sentence from its readings, with the condition's values; a study's own from its verdicts."""
    import pages

    from testbed.scenario import load_scenario

    name = "imm-rstekf-2023"
    readings = [r.name for r in load_scenario(name).readings]
    white = [r.name for r in load_scenario(name).readings if r.conditions["GNSS error"] == "5 m white"]
    shared = {"origin": "paper", "margin_pct": None, "stated_pct": 26.8}
    rows = [
        shared
        | {"claim": "1-position-gps-table", "reading": r, "class": "depends on GNSS error"}
        | {"effect_pct": 5.0 if r in white else 30.0, "verdict": "direction reproduced" if r in white else "reproduced"}
        for r in readings
    ]
    own = [
        shared
        | {
            "claim": "own-x",
            "reading": "all",
            "effect_pct": 1.0,
            "verdict": "reproduced",
            "class": "holds",
            "text": "X",
        }
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "verdicts.csv", index=False)
    contradicted = own[0] | {"claim": "own-y", "class": "source inconsistent"}
    own += [contradicted, contradicted | {"reading": "other", "verdict": "reversed"}]
    own += [contradicted | {"claim": "own-z", "verdict": "direction reproduced"}]
    pd.DataFrame(own).to_csv(tmp_path / "verdicts-more.csv", index=False)
    readings_job = scripts.readings("readings", 1.0)
    jobs = readings_job, scripts.study("more", print, 1.0, ("verdicts-more.csv",))
    table = pages.write_claims(scripts.Paper(name, "T", jobs), tmp_path).set_index("claim")
    told = table.loc["1-position-gps-table"]
    assert (told["lowest_pct"], told["highest_pct"], told["readings"]) == (5.0, 30.0, len(readings))
    assert (
        "GNSS error: “0.3 m white and 3 m of 20 s”, “0.3 m white and 2.5 m of 20 s”, “1.95 m white” where it holds, “5 m white” where it fails"
        in told["where"]
    )
    assert table.loc["own-x", "text"] == "X" and table.loc["own-x", "where"] == "reproduced: all"
    tested = {"own-x": "holds", "own-y": "depends on the reading", "own-z": "fails"}
    assert {claim: table.loc[claim, "as_tested"] for claim in tested} == tested


def reported(scripts):
    return [paper for paper in scripts.all_papers() if (REPORTS / paper.name / "made.json").is_file()]


def test_what_git_holds_is_what_the_jobs_left(scripts):
    """Tables by their checksums; claims and page by making them again from the tables, to the byte."""
    import pages

    for paper in reported(scripts):
        folder = REPORTS / paper.name
        for name, entry in scripts.made(folder).items():
            for file, known in entry["files"].items():
                assert scripts.checksum(folder / file) == known, f"{paper.name}/{name}: {file} is not what the job left"
        if paper is not scripts.SENSORS:
            before = {
                name: (folder / name).read_bytes() for name in ("report.md", "claims.csv") if (folder / name).is_file()
            }
            try:
                pages.write_claims(paper, folder)
                pages.write_report(paper, folder)
                for name, content in before.items():
                    assert (folder / name).read_bytes() == content, f"python reports/make.py {paper.name} --resume"
            finally:
                for name, content in before.items():
                    (folder / name).write_bytes(content)


def test_committed_tables_are_of_no_machine_and_no_day(scripts):
    """No date, version of a package, platform or commit in what is compared, and nothing that is generated besides."""
    marks = re.compile(r"\b20\d\d-\d\d-\d\d\b|numpy|Linux|x86_64|`[0-9a-f]{12}`|us_per_sample")
    for paper in reported(scripts):
        for path in (REPORTS / paper.name).iterdir():
            if path.suffix in (".csv", ".md") and "timings" not in path.name and path.name != "findings.md":
                found = marks.search(path.read_text())
                assert found is None, f"{path}: {found}"
        assert not list((REPORTS / paper.name).glob("*.html")) and not list((REPORTS / paper.name).glob("*.tex"))
