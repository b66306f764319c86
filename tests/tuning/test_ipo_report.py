"""What the page of IPO 2022 is made from: one row per search, claims by reading, and the source's table against itself."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from small_tuning import scenario

from testbed.tuning import tune
from testbed.tuning.study import Study

STUDIES = Path(__file__).resolve().parents[2] / "reports" / "studies"


@pytest.fixture(scope="module")
def report():
    sys.path.insert(0, str(STUDIES))
    try:
        yield {name: importlib.import_module(name) for name in ("jobs", "ipo_searches", "ipo_ranks", "paper_ipo_2022")}
    finally:
        sys.path.remove(str(STUDIES))


def place(report, folder):
    return report["jobs"].Place("ipo-2022", folder / "work", folder, folder / "pages")


def write_searches(folder, name, values, iterations=100):
    """Tables as the jobs of a box leave them: algorithm to the best value of each seed; both units err alike."""
    for job, algorithms in {**{a: [a] for a in ("ipo", "mipo", "pso", "ga")}, "sipo-iipo": ["sipo", "iipo"]}.items():
        rows = [
            {"algorithm": a, "iterations": iterations, "seed": k, "best": v, "train": v, "test": 2.0 * v}
            | {"ADIS16405:rmse_roll_deg": v, "ADIS16488:rmse_roll_deg": v}
            for a in algorithms
            for k, v in enumerate(values[a], 1)
        ]
        pd.DataFrame(rows).to_csv(folder / f"searches-{name}-{job}.csv", index=False)


def test_a_row_per_search(report, tmp_path):
    """It tells what the study's own tables tell, and how many of its coordinates lie on a wall."""
    made = scenario(algorithms=["pso", "ga"], seeds=[2, 1], iterations=[10], innovation_search="none")
    study = Study(tune.tune(made, tmp_path / "s", jobs=1))
    rows = report["ipo_searches"].rows_of(study).set_index(["algorithm", "seed"])
    assert list(rows.index) == [("ga", 1), ("ga", 2), ("pso", 1), ("pso", 2)]
    evaluations = pd.read_parquet(tmp_path / "s/evaluations/pso-0010-seed2.parquet")
    row = rows.loc["pso", 2]
    assert row["best"] == row["best_10"] == pytest.approx(evaluations["objective"].min(), rel=1e-9)
    best = evaluations.loc[evaluations["objective"].idxmin()].drop(["objective", "seconds"])
    assert row["walls"] == (best.abs() == 3.0).sum()
    held = study.heldout.set_index("row").loc["pso-0010-seed2"]
    assert (row["train"], row["test"], row["ci_low"]) == (held["train"], held["test"], held["ci_low"])
    assert not [name for name in rows.columns if "second" in name]


def test_claims_hang_on_the_box(report, tmp_path):
    """IPO at 1 and all others at 2 in one box, the other way round in the other: lower by half as printed for none, so by reading."""
    rng, ranks = np.random.default_rng(0), report["ipo_ranks"]

    def values(ipo, others):
        return {a: (ipo if a == "ipo" else others) * (1.0 + 0.01 * rng.standard_normal(10)) for a in ranks.SIX}

    with pytest.raises(SystemExit, match="no reading has the searches of all six"):
        ranks.make(place(report, tmp_path))
    write_searches(tmp_path, "box-100", values(1.0, 4.0))
    write_searches(tmp_path, "log-100", values(4.0, 2.0))
    sheet = [{"row": "data-sheet", "set": which, "case": c, "sum": 1.5} for which in ("train", "test") for c in "ab"]
    pd.DataFrame(sheet).to_csv(tmp_path / "data-sheet.csv", index=False)
    ranks.make(place(report, tmp_path))
    table = pd.read_csv(tmp_path / ranks.FITNESS)
    assert set(table["reading"]) == {"0 to 1, 100 iterations", "log, 100 iterations"}
    found = table.set_index(["claim", "reading"])
    first = found.loc["1-pso", "0 to 1, 100 iterations"]
    assert first["verdict"] == "reproduced" and first["effect_pct"] == pytest.approx(75.0, abs=1.0)
    assert first["stated_pct"] == pytest.approx(100.0 * (1.0 - 8.784 / 17.18), rel=1e-5)
    assert found.loc["1-pso", "log, 100 iterations"]["verdict"] == "reversed"
    assert set(table.loc[table["claim"] == "1-pso", "class"]) == {"depends on box"}
    assert found.loc["1-sipo", "0 to 1, 100 iterations"]["verdict"] == "direction reproduced", "81 % are stated"
    places = pd.read_csv(tmp_path / ranks.PLACES).set_index(["reading", "part", "algorithm"])
    assert places.loc[("0 to 1, 100 iterations", "fitness, mean", "ipo"), "place_high"] == 1.0
    assert places.loc[("log, 100 iterations", "fitness, mean", "ipo"), "place_low"] == 6.0
    beside = pd.read_csv(tmp_path / ranks.BESIDE).set_index(["quantity", "statistic", "source"])
    assert beside.loc[("ADIS16405:rmse_roll_deg", "mean", "paper"), "ipo"] == 5.48
    assert beside.loc[("fitness", "mean", "log, 100 iterations"), "pso"] == pytest.approx(2.0, rel=0.02)
    assert set(beside.index.levels[0]) == {"fitness", "ADIS16405:rmse_roll_deg", "ADIS16488:rmse_roll_deg", "rank"}
    assert beside.loc[("rank", "mean", "paper"), "mipo"] == pytest.approx(492 / 128), "the specification's figure"
    assert beside.loc[("rank", "mean", "0 to 1, 100 iterations"), "ipo"] < 2.0, (
        "first in all but variances, which are chance"
    )
    firsts = pd.read_csv(tmp_path / ranks.FIRSTS).set_index(["claim", "reading"])
    assert set(firsts["class"]) == {"depends on box"} and set(firsts.index.levels[0]) == {
        "1-min",
        "1-variance",
        "1-final",
    }
    assert firsts.loc[("1-final", "log, 100 iterations"), "verdict"] == "reversed"
    own = pd.read_csv(tmp_path / ranks.SHEET).set_index("reading")
    assert own.loc["0 to 1, the errors searched", "verdict"] == "reproduced", "1 against 3"
    assert own.loc["log, unseen errors", "verdict"] == "reversed", "8 against 3"


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [(1.0, 1.0, "reproduced"), (1.0, 1.5, "undecided"), (1.0, 3.0, "undecided"), (1.5, 2.0, "reversed")],
)
def test_first_place_is_what_its_interval_says(report, low, high, verdict):
    """A place is the first where the interval holds no other, and another where it does not hold the first."""
    ranks = report["ipo_ranks"]
    reading = ranks.READINGS[0]
    lines = [
        {"part": part, "reading": reading.name, "algorithm": a, "place_low": low, "place_high": high, "searches": 10}
        for part in ranks.FIRST
        for a in ranks.SIX
    ]
    assert set(ranks.first_verdicts(pd.DataFrame(lines), [reading])["verdict"]) == {verdict}


def test_table_2_against_itself(report, tmp_path):
    """IPO: 5.48 + 4.46 + 32.9 + 1.64 + 2.85 + 16.2 = 63.53 beside a mean fitness of 8.784."""
    report["ipo_ranks"].make_printed(place(report, tmp_path))
    table = pd.read_csv(tmp_path / "printed.csv").set_index("algorithm")
    assert table.loc["ipo", "attitude_rmse_sum_deg"] == pytest.approx(63.53)
    assert (table["times"] > 3.0).all() and (table["terms"] == 6).all()
    claims = pd.read_csv(tmp_path / "verdicts-printed.csv").set_index("claim")
    assert claims["class"].to_dict() == {"1-printed": "source inconsistent", "3-hours": "not tested"}
    assert "11.2 to 83.6 hours" in claims.loc["3-hours", "text"]


def test_a_length_is_compared_on_its_own_seeds(report, tmp_path):
    """Searches of 200 iterations have three seeds. Where only these three differ from the ten, the class names the seeds and no length."""
    rng, ranks = np.random.default_rng(1), report["ipo_ranks"]
    scatter = {a: 1.0 + 0.01 * rng.standard_normal(10) for a in ranks.SIX}
    ten = {a: 4.0 * scatter[a] for a in ranks.SIX}
    # lower by 75 % with the first three seeds, at both lengths, and by 40 % with all ten
    ten["ipo"] = np.array([1.0, 1.0, 1.0, *[3.0] * 7]) * scatter["ipo"]
    write_searches(tmp_path, "box-100", ten)
    folder = place(report, tmp_path)
    sheet = [{"row": "data-sheet", "set": which, "case": "a", "sum": 1.5} for which in ("train", "test")]
    pd.DataFrame(sheet).to_csv(tmp_path / "data-sheet.csv", index=False)
    ranks.make(folder)
    assert set(pd.read_csv(tmp_path / ranks.FITNESS)["reading"]) == {"0 to 1, 100 iterations"}, (
        "alone it says nothing new"
    )
    write_searches(tmp_path, "box-200", {a: values[:3] for a, values in ten.items()}, iterations=200)
    ranks.make(folder)
    table = pd.read_csv(tmp_path / ranks.FITNESS).set_index(["claim", "reading"])
    runs = table.loc["1-sipo", "runs"].to_dict()
    assert runs == {
        "0 to 1, 100 iterations": 10,
        "0 to 1, 100 iterations, seeds 1 to 3": 3,
        "0 to 1, 200 iterations": 3,
    }
    one, other = (table.loc[("1-ga", name), "effect_pct"] for name in list(runs)[1:])
    assert one == other == pytest.approx(75.0, abs=1.0)
    assert set(table.loc["1-ga", "class"]) == {"depends on seeds"}, "62 % are stated"


def test_every_reading_has_its_jobs(report):
    """What a reading names is a job of the page, and every search is one that can be resumed by itself."""
    paper = report["paper_ipo_2022"].PAPER
    tables = {name for job in paper.jobs for name in job.tables}
    for reading in report["ipo_ranks"].READINGS:
        for algorithm in report["ipo_ranks"].SIX:
            assert reading.table_of(algorithm) in tables
    assert {f"searches-{part}.csv" for _, _, part, *_ in report["ipo_ranks"].SHEETS} <= tables
    assert all(job.long for job in paper.jobs if job.name.startswith(("box", "log", "navego")))
