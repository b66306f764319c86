"""A tuning study as a whole: its folder, resuming after a kill, stop rules, tables, parameter files, refusals."""

from __future__ import annotations

import html
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from small_tuning import scenario
from test_tuning_objective import deaf_filter

from testbed.base.errors import InputError
from testbed.base.files import write_json
from testbed.base.schema import dump_toml
from testbed.data import registry
from testbed.scenario import Scenario, load_scenario
from testbed.tuning import tables, tune
from testbed.tuning.command import tune as tune_command
from testbed.tuning.config import Task, tune_config
from testbed.tuning.history import History, per_iteration
from testbed.tuning.objective import make_objective, record
from testbed.tuning.report import write_report
from testbed.tuning.speed import write_speed

KILLED = Path(__file__).parents[1] / "run_tuning.py"
RESULTS = ("searches.csv", "history.csv", "scores.csv", "heldout.csv")


def contents(folder, names=RESULTS):
    best = {path.name: path.read_bytes() for path in sorted((folder / "best").glob("*.toml"))}
    return best | {name: (folder / name).read_bytes() for name in names}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return tune.tune(scenario(), tmp_path_factory.mktemp("tuning") / "study", jobs=1)


def test_folder_holds_every_search(study):
    names = ["pso-0004-seed1", "sipo-0004-seed1", "de-0004-seed1", "innovations-pso-0004-seed1"]
    searches = pd.read_csv(study / "searches.csv")
    assert list(searches["search"]) == names
    assert (searches["shared"] == 0).all()
    assert (searches["evaluations"] == 20).all()
    history = pd.read_csv(study / "history.csv")
    own = history[history["search"] == "pso-0004-seed1"]
    assert list(own["iteration"]) == [1, 2, 3, 4]
    assert (
        own["best"].is_monotonic_decreasing
        and (own["best"] <= own["mean"]).all()
        and (own["mean"] <= own["worst"]).all()
    )
    scores = pd.read_csv(study / "scores.csv")
    assert set(scores["case"]) == {"ADIS16405", "ADIS16488"}
    assert set(scores[scores["set"] == "test"]["run"]) == {1, 2}


def test_gnss_alone_is_as_its_data_sheet(study):
    """12 s at 5 Hz, three runs and two cases of the same fixes: a 5 m sigma within 30 % (about 180 samples: 4 sigma are 21 %)."""
    scores = pd.read_csv(study / "scores.csv")
    alone = scores[(scores["row"] == "GNSS alone") & (scores["metric"] == "rmse_north_m")]
    assert np.sqrt((alone["value"] ** 2).mean()) == pytest.approx(5.0, rel=0.3)


@pytest.mark.parametrize("after", [33, 57])
def test_kill_and_resume_give_the_same_result(study, tmp_path, after):
    """A process that ends at evaluation 33 or 57 without a chance to tidy up; then --resume."""
    out = tmp_path / "study"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(KILLED.parent), str(KILLED.parent.parent)])}
    died = subprocess.run([sys.executable, KILLED, out, str(after)], env=environment, capture_output=True, text=True)
    assert died.returncode == 9, died.stderr
    assert not (out / "searches.csv").exists()
    calls = []
    tune.tune(scenario(), out, jobs=2, resume=True, progress=calls.append)
    assert contents(out) == contents(study)
    assert calls[-1].done == 80


def test_interrupt_stores_and_says_how_to_go_on(study, tmp_path):
    def interrupt(progress):
        if progress.done >= 10:
            raise KeyboardInterrupt

    with pytest.raises(tune.Stopped, match="--resume"):
        tune.tune(scenario(), tmp_path / "s", jobs=1, progress=interrupt)
    with pytest.raises(InputError, match="--resume"):
        tune.tune(scenario(), tmp_path / "s", jobs=1)
    with pytest.raises(tune.Stopped, match="time is up"):
        tune.tune(scenario(), tmp_path / "s", jobs=1, resume=True, time_limit_s=0.0)
    tune.tune(scenario(), tmp_path / "s", jobs=1, resume=True)
    assert contents(tmp_path / "s") == contents(study)


def test_complete_searches_can_be_concluded(study, tmp_path):
    """A study that is given up after its first search has that search's tables; resumed, it is the undisturbed one."""

    def interrupt(progress):
        if progress.done > 20:
            raise KeyboardInterrupt

    with pytest.raises(InputError, match="no study"):
        tune.conclude(scenario(), tmp_path / "s")
    with pytest.raises(tune.Stopped):
        tune.tune(scenario(), tmp_path / "s", jobs=1, progress=interrupt)
    tune.conclude(scenario(), tmp_path / "s")
    assert list(pd.read_csv(tmp_path / "s/searches.csv")["search"]) == ["pso-0004-seed1"]
    assert "pso-0004-seed1" in write_report(tmp_path / "s", figures=False).read_text()
    tune.tune(scenario(), tmp_path / "s", jobs=1, resume=True)
    assert contents(tmp_path / "s") == contents(study)


def test_another_study_is_refused(study, tmp_path):
    """And what is there stays as it was."""
    before = (study / "manifest.json").read_bytes()
    with pytest.raises(InputError, match="another scenario, space or objective"):
        tune.tune(scenario(population=6), study, jobs=1, resume=True)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="no testbed tuning"):
        tune.tune(scenario(), tmp_path, jobs=1)
    with pytest.raises(InputError, match="did you mean 'pso-0004-seed1'"):
        tune.tune(scenario(), study, jobs=1, only="pso-004-seed1")
    assert (study / "manifest.json").read_bytes() == before


def test_a_changed_filter_is_noticed(study, tmp_path):
    """A stored value that the estimator no longer gives stops the resume."""
    space = tune.scenario_space(scenario(), tune_config(scenario()))
    identity = tune.identity(scenario(), tune_config(scenario()))
    history = History(tmp_path / "s" / "evaluations" / "pso-0004-seed1.parquet", space.names, study=identity)
    true = History(study / "evaluations" / "pso-0004-seed1.parquet", space.names)
    history.add(true.x, true.f * 1.001, 1.0)
    history.save()
    listed = {"evaluations/pso-0004-seed1.parquet": None}
    write_json(tmp_path / "s" / "manifest.json", {"kind": tune.KIND, "identity": identity, "files": listed})
    with pytest.raises(InputError, match="have changed since"):
        tune.tune(scenario(), tmp_path / "s", jobs=1, resume=True)


def test_constant_objective_is_refused(tmp_path, monkeypatch):
    """A filter that ignores its parameters: 10 equal evaluations, no best, exit code 2."""
    monkeypatch.setitem(registry._plugins, "deaf", deaf_filter())
    made = scenario(algorithms=["pso"], innovation_search="none", iterations=[2])
    made = made.model_copy(update={"estimators": [made.estimators[0].model_copy(update={"name": "deaf"})]})
    with pytest.raises(InputError, match="for each of 10 candidates"):
        tune.tune(made, tmp_path / "s", jobs=1)
    assert not (tmp_path / "s" / "best").exists()


def test_parameter_file_gives_the_stored_objective(study, tmp_path):
    """A scenario that names the file runs the tuned filter: its scores add up to what ``scores.csv`` says."""
    data = scenario().to_data()
    for entry in data["estimators"]:
        if entry["name"] == "indirect-kf":
            entry["params_file"] = f"{study}/best/pso-0004-seed1.toml"
    (tmp_path / "tuned.toml").write_text(dump_toml(data))
    read = load_scenario(tmp_path / "tuned.toml")
    scale = pd.read_csv(study / "searches.csv").set_index("search").loc["pso-0004-seed1", "gyro_noise_scale"]
    assert read.estimators[0].params["gyro_noise_scale"] == pytest.approx(10.0**scale, rel=1e-8)


def test_stop_rules():
    config = tune_config(scenario(target=1.0, population=2, stall=2, algorithms=["pso"]))
    rule = tune.StopRule(config)
    assert not rule.stops(np.array([5.0, 4.0]))
    assert not rule.stops(np.array([4.0, 6.0]))
    assert rule.stops(np.array([4.0, 6.0])), "two iterations without improvement"
    rule = tune.StopRule(config)
    assert not rule.stops(np.array([0.5])), "only whole iterations end a search"
    assert rule.stops(np.array([3.0]))


def test_stalled_search_is_short(tmp_path):
    out = tune.tune(
        scenario(algorithms=["sipo"], iterations=[40], stall=3, innovation_search="none", test_runs=[]),
        tmp_path / "s",
        jobs=1,
    )
    searches = pd.read_csv(out / "searches.csv")
    assert searches["evaluations"].iloc[0] < 200
    assert "test" not in set(pd.read_csv(out / "scores.csv")["set"])


def test_a_longer_search_starts_from_a_shorter_one(tmp_path):
    """PSO's schedule knows no end: the 6 iterations begin with the 4 that are stored. SIPO's T/t moves after the first draw."""
    settings = {"algorithms": ["pso", "sipo"], "innovation_search": "none", "test_runs": []}
    tune.tune(scenario(**settings), tmp_path / "s", jobs=1)
    tune.tune(scenario(**settings, iterations=[4, 6]), tmp_path / "s", jobs=1, resume=True)
    tune.tune(scenario(**settings, iterations=[6]), tmp_path / "alone", jobs=1)
    assert (tmp_path / "s/best/pso-0006-seed1.toml").read_bytes() == (
        tmp_path / "alone/best/pso-0006-seed1.toml"
    ).read_bytes()
    for name, shared in (("pso", 20), ("sipo", 5)):
        short, long = (pd.read_parquet(tmp_path / f"s/evaluations/{name}-000{n}-seed1.parquet") for n in (4, 6))
        same = (short["seconds"].to_numpy() == long["seconds"].to_numpy()[:20]).sum()
        assert same == shared, "stored, not measured again"
    assert list(pd.read_csv(tmp_path / "s/searches.csv")["shared"]) == [0, 0, 20, 5]


def test_searches_abreast_are_as_alone(tmp_path):
    """SIPO and IIPO of two lengths share passes; each result is that of the search by itself."""
    settings = {"algorithms": ["sipo", "iipo"], "iterations": [3, 4], "innovation_search": "none", "test_runs": []}
    tune.tune(scenario(**settings), tmp_path / "together", jobs=1)
    for name in ("sipo-0003-seed1", "iipo-0004-seed1"):
        tune.tune(scenario(**settings), tmp_path / name, jobs=1, only=name)
        one, other = ((tmp_path / folder / "best" / f"{name}.toml").read_bytes() for folder in ("together", name))
        assert one == other


def test_seeds_abreast_are_as_alone(tmp_path):
    """Populations of 5 leave lanes of 8 empty, so three seeds go together; the 6 iterations of each still begin with its 4."""
    settings = {"algorithms": ["pso"], "seeds": [1, 2, 3], "iterations": [4, 6], "innovation_search": "none"}
    out = tune.tune(scenario(**settings, test_runs=[]), tmp_path / "together", jobs=1)
    alone = tune.tune(scenario(**settings | {"seeds": [2]}, test_runs=[]), tmp_path / "alone", jobs=1)
    searches, one = (pd.read_csv(folder / "searches.csv").set_index("search") for folder in (out, alone))
    assert list(searches["shared"]) == [0, 0, 0, 20, 20, 20]
    pd.testing.assert_frame_equal(searches.loc[one.index], one)
    assert searches.loc[searches["iterations"] == 4, "best"].nunique() == 3


def test_fresh_noise_is_another_run_for_each_evaluation(tmp_path):
    """A value is that of the candidate on a recording of its own run, to the bit; no run is met twice; frozen noise differs."""
    settings = {"algorithms": ["pso"], "iterations": [2], "innovation_search": "none", "test_runs": []}
    made = scenario(**settings, noise="fresh", seeds=[1, 2])
    out = tune.tune(made, tmp_path / "s", jobs=2)
    stored = pd.read_parquet(out / "evaluations/pso-0002-seed2.parquet")
    runs = Task("pso", 2, 2).fresh_runs(0, 10)
    assert not set(runs) & set(Task("pso", 2, 1).fresh_runs(0, 10))
    config = tune_config(scenario(**settings))
    x = stored.drop(columns=["objective", "seconds"]).to_numpy()
    for k in (0, 7):
        with make_objective(made, config, record(made, config, [runs[k]])) as frozen:
            assert frozen(x[k])[0] == stored["objective"][k]
    assert tune.identity(made, tune_config(made)) != tune.identity(scenario(**settings), config)


def test_fresh_noise_is_refused_where_it_cannot_be_had(tmp_path):
    data = scenario(noise="fresh").to_data()
    data["monte_carlo"] = {"vary": ["noise", "manoeuvres"], "disperse": {"initial.speed_mps": {"factor": [0.9, 1.1]}}}
    varied = Scenario.model_validate(data)
    with pytest.raises(InputError, match="no flight that varies"):
        tune.tune(varied, tmp_path / "a", jobs=1)
    with pytest.raises(
        InputError, match=r"noise = 'fresh': 'indirect-kf' with this window and these metrics has no fast path"
    ):
        tune.tune(scenario(noise="fresh", metrics=["rmse_position_2d_m"]), tmp_path / "b", jobs=1)
    with pytest.raises(InputError, match="runs from 1000000 on are those of noise = 'fresh'"):
        tune_config(scenario(noise="fresh", test_runs=[2_000_000]))


def test_iterations_of_a_history():
    frame = per_iteration(np.array([3.0, 5.0, 4.0, 2.0, 1.0]), 2)
    assert list(frame["best"]) == [3.0, 2.0, 1.0]
    assert list(frame["mean"]) == [4.0, 3.0, 1.0]
    assert list(frame["worst"]) == [5.0, 4.0, 1.0]


def test_rank_sums_by_hand():
    """Ranks 1 2, 1 2 and a tie: 3.5 and 5.5; time is not ranked."""
    index = pd.MultiIndex.from_tuples(
        [("fitness", "min"), ("fitness", "max"), ("x", "min"), ("seconds", "min")], names=["quantity", "statistic"]
    )
    table = pd.DataFrame({"a": [1.0, 2.0, 3.0, 9.0], "b": [2.0, 4.0, 3.0, 1.0]}, index=index)
    ranks = tables.rank_sums(table)
    assert list(ranks["rank_sum"]) == [3.5, 5.5]
    assert list(ranks["place"]) == [1, 2]


def test_report(study, tmp_path):
    text = write_report(study, tmp_path).read_text()
    for expected in ("Rank sums", "convergence.png", "data-sheet", "innovations-pso-0004-seed1"):
        assert expected in text
    for name in (
        "convergence.png",
        "variables.png",
        "best-ADIS16405.png",
        "best-ADIS16488.png",
        "table2.csv",
        "table4.csv",
    ):
        assert (tmp_path / name).stat().st_size > 0
    page, entry = (tmp_path / "report.html").read_text(), json.loads((tmp_path / "report.json").read_text())
    assert page.count('src="data:image/png;base64,') == 4 and "<table>" in page and "http:" not in page
    assert entry["sentence"] in html.unescape(page)
    assert all(f"**{verdict}**" in text for verdict in entry["verdicts"])


def test_report_shows_what_was_measured_beside_it(study, tmp_path):
    """A table of speed left in the folder stands on the page; without one, and without functions, there is no such heading."""
    (tmp_path / "speed.csv").write_text("what,table_h\none by one,20\n")
    text = write_report(study, tmp_path, figures=False).read_text()
    assert "Benchmark functions" not in text and "one by one" in text


def test_speed_is_measured(tmp_path):
    """Two threads share the work: the busier has less than one thread had, and processor time is within the wall time."""
    table = pd.read_csv(write_speed(scenario(population=20), tmp_path, tries=2)).set_index(["what", "threads"])
    assert (table["busiest_thread_s"] <= table["wall_s"] * 1.05).all()
    assert (table["table_h"] * 3600.0 / 450_000).to_numpy() == pytest.approx(table["per_evaluation_s"], rel=1e-3)
    if ("a population", 2) in table.index:
        one, two = (table.loc[("a population", n), "busiest_thread_s"] for n in (1, 2))
        assert two < one


def test_report_needs_a_finished_study(tmp_path):
    with pytest.raises(InputError, match="no tuning study"):
        write_report(tmp_path)


def test_command(tmp_path, capsys):
    tune_command(
        scenario(cases=[{"name": "one"}]),
        tmp_path / "s",
        algorithms="pso",
        iterations="2",
        population=3,
        seeds="1,2",
        jobs=1,
    )
    captured = capsys.readouterr()
    assert "data-sheet" in captured.out and "pso-0002-seed2" in captured.out and "report.html" in captured.out
    assert "left" in captured.err and "best" in captured.err
    with pytest.raises(InputError, match="whole numbers"):
        tune_command(scenario(), tmp_path / "t", iterations="many")


@pytest.mark.parametrize("variant", [None, "as-stated", "ADIS16488", "navego", "navego-as-stated", "navego-both"])
def test_shipped_scenario_has_eighteen_variables(variant):
    made = load_scenario("ipo-2022", variant=variant)
    config = tune_config(made)
    space = tune.scenario_space(made, config)
    assert len(space.names) == 18
    assert (made.recording is not None) == (variant or "").startswith("navego")
    assert len(config.cases) == (1 if variant in ("navego", "navego-as-stated") else 2)
    low = 0.0 if "as-stated" in (variant or "") else -3.0
    assert (space.bounds.low == low).all()
