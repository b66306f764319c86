"""Answers of programs of one's own as rows: the same tables as of an estimator that thinks alike, and every fault by its name.

The filter of the templates is written three times, in C, in Octave and here in NumPy; who writes a CSV file with ten decimals of
a degree is apart by at most half a last digit, 6e-6 m.
"""

import shutil
import subprocess
import tomllib
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from command_line import SHORT, call

from testbed import load_scenario, pipeline
from testbed.base.schema import dump_toml
from testbed.cli.templates import new_file
from testbed.data import registry
from testbed.data.records import SensorLog
from testbed.montecarlo.external import External, sensed_by

RUNS = 2
HOLD = """
import numpy as np
from testbed import NavSolution
from testbed.data.records import POSITION_STATES, VELOCITY_STATES

class Twin:
    name = "twin"
    def run(self, log):
        t, fixes, start = log.imu.t, log.gnss, log.initial
        rows = np.column_stack([fixes.t, fixes.lat, fixes.lon, fixes.h, fixes.v_n])
        rows = np.vstack([[start.t, start.lat, start.lon, start.h, *start.v_n], rows])
        last = rows[np.searchsorted(rows[:, 0], t, side="right") - 1]
        age, v = t - last[:, 0], last[:, 4:]
        lat = last[:, 1] + v[:, 0] * age / 6.37e6
        lon = last[:, 2] + v[:, 1] * age / (6.37e6 * np.cos(last[:, 1]))
        q = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
        return NavSolution(t, lat, lon, last[:, 3] - v[:, 2] * age, v, q, states=POSITION_STATES + VELOCITY_STATES)
"""


@pytest.fixture(autouse=True)
def _no_plugins(monkeypatch):
    monkeypatch.setattr(registry, "_plugins", {})


@pytest.fixture(scope="module")
def sensed(tmp_path_factory):
    """The logs of two short runs."""
    logs = tmp_path_factory.mktemp("sensed") / "logs"
    assert call("sense", "quickstart", *SHORT, "--runs", str(RUNS), "--out", str(logs))[0] == 0
    return logs


@pytest.fixture
def logs(sensed, tmp_path):
    """A copy of them that a test may fill with answers."""
    return shutil.copytree(sensed, tmp_path / "logs")


def answer(logs, name, run, change=lambda frame: frame):
    """The start held for all of the run."""
    t = pd.read_csv(logs / f"{run:06d}" / "imu.csv")["time_s"]
    start = pd.read_csv(logs / f"{run:06d}" / "initial.csv").iloc[0]
    columns = [
        "lat_deg",
        "lon_deg",
        "alt_m",
        "v_north_mps",
        "v_east_mps",
        "v_down_mps",
        "roll_deg",
        "pitch_deg",
        "yaw_deg",
    ]
    frame = pd.DataFrame({"time_s": t} | {key: np.full(len(t), start[key]) for key in columns})
    path = logs / "answers" / name / f"{run:06d}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    change(frame).to_csv(path, index=False)
    return path


def run(logs, out, *more, estimators="ins"):
    settings = [*SHORT, "--runs", str(RUNS), "--jobs", "1", "--no-report"]
    rows = ["--estimators", estimators] if estimators else []
    return call("run", "quickstart", *settings, *rows, "--external", str(logs), "--out", str(out), *more)


def test_logs_say_which_run_they_are_and_are_those_of_the_monte_carlo(sensed, tmp_path):
    settings = {"flight.duration_s": 10, "sensors.gnss.outages": [], "windows": []}
    scenario = load_scenario("quickstart", overrides=settings)
    log, _ = pipeline.sense(scenario, pipeline.fly(scenario), run=1)
    assert log.run == 1 and replace(log, name="other").run == 1
    log.save(tmp_path / "log")
    assert SensorLog.load(tmp_path / "log").run == 1
    table = pd.read_csv(sensed / "000001" / "imu.csv")
    assert np.array_equal(table["gyro_x_radps"], log.imu.gyro[:, 0])
    assert '"run": 1' in (sensed / "000001" / "log.json").read_text()
    assert not list(sensed.rglob("*reference*")) + list(sensed.rglob("*trajectory*"))  # the truth stays with the bench


def test_filters_in_c_and_octave_score_as_their_twin_in_numpy(logs, tmp_path):
    tools = {"c-filter": "cc", "octave-filter": "octave-cli"}
    kinds = [kind for kind, tool in tools.items() if shutil.which(tool)]
    if not kinds:
        pytest.skip("neither cc nor octave-cli is installed")
    for kind in kinds:
        source = new_file(kind, kind, tmp_path)
        command = ["octave-cli", "-q", str(source)]
        if kind == "c-filter":
            command = [str(source.with_suffix(""))]
            subprocess.run(["cc", "-Wall", "-O2", "-o", *command, source, "-lm"], check=True)
        for k in range(RUNS):
            path = logs / "answers" / kind / f"{k:06d}.csv"
            path.parent.mkdir(parents=True, exist_ok=True)
            said = subprocess.run([*command, logs / f"{k:06d}"], check=True, capture_output=True)
            path.write_bytes(said.stdout)
    (tmp_path / "twin.py").write_text(HOLD)
    options = ("--plugin", str(tmp_path / "twin.py"), "--timeout", "60")
    code, said = run(logs, tmp_path / "out", *options, estimators="twin")
    assert code == 0, said
    table = pd.read_parquet(tmp_path / "out" / "metrics.parquet").set_index(["run", "window", "metric", "estimator"])
    scores = table["value"].unstack()
    assert (
        len(scores) > 50 and scores.notna().all().all()
    )  # the same rows, and none of the attitude, which nobody answers
    assert not any("yaw" in metric for metric in scores.index.get_level_values("metric"))
    for kind in kinds:
        assert (scores[kind] - scores["twin"]).abs().max() < 2e-5
    assert set(pd.read_csv(tmp_path / "out" / "timings.csv")["estimator"]) == {"twin"}


def test_sigmas_and_attitude_are_read_and_a_scenario_may_name_the_answers(logs, tmp_path):
    states = ["position_{}_m", "velocity_{}_mps", "attitude_{}_rad"]
    names = [f"std_{state.format(axis)}" for state in states for axis in ("north", "east", "down")]

    for k in range(RUNS):
        answer(logs, "still", k, lambda frame: frame.assign(**dict.fromkeys(names, 2.0)))
    data = tomllib.loads((logs / "scenario.toml").read_text())
    data["estimators"] += [{"name": "external", "label": "still", "params": {"dir": "logs", "answers": "still"}}]
    claim = {"text": "standing still is better", "better": "still", "than": "indirect-kf"}
    data["claims"] = [claim | {"metric": "rmse_position_3d_m"}]
    (tmp_path / "own.toml").write_text(dump_toml(data))
    command = ["run", str(tmp_path / "own.toml"), "--runs", "2", "--jobs", "1", "--no-report"]
    code, said = call(*command, "--estimators", "indirect-kf,still", "--out", str(tmp_path / "out"))
    assert code == 0, said
    claims = pd.read_csv(tmp_path / "out" / "claims.csv")
    assert claims["verdict"].tolist() == ["reversed"]
    band = pd.read_parquet(tmp_path / "out" / "envelopes.parquet").query(
        "estimator == 'still' and quantity == 'east_m'"
    )
    assert np.allclose(band["sigma"], 2.0)
    solution = External(str(logs), "still").run(
        pipeline.sense(scenario := load_scenario(tmp_path / "own.toml"), pipeline.fly(scenario))[0]
    )
    assert len(solution.states) == 9 and solution.std.shape == (len(solution.t), 9)


def cut(frame):
    return frame.iloc[: len(frame) // 2]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (cut, "covers 0.01 to 5 s of a flight from 0.01 to 10 s (500 rows for 1000 samples of the IMU)"),
        (lambda f: f.assign(time_s=2.0 * f["time_s"]), "goes on for 10 s after its log"),
        (
            lambda f: f.assign(lat_deg=f["lat_deg"].where(f["time_s"] < 7.0)),
            "'lat_deg': sample 699 is not a finite number",
        ),
        (lambda f: f.assign(time_s=f["time_s"].round(1)), "time must increase"),
        (lambda f: f.drop(columns="lon_deg"), "no column for lon"),
        (lambda f: f.drop(columns="v_east_mps"), "not all three velocities"),
        (lambda f: f.drop(columns="yaw_deg"), "needs roll_deg, pitch_deg, yaw_deg or q_nb_0"),
        (lambda f: f.rename(columns={"alt_m": "alt_furlong"}), "'furlong' is no unit of length"),
        (lambda f: f.assign(std_position_north_m=1.0), "but not std_position_east"),
    ],
)
def test_an_answer_that_is_none_costs_its_run_and_is_told_by_its_file(change, reason, logs, tmp_path):
    answer(logs, "hold", 0)
    path = answer(logs, "hold", 1, change)
    code, said = run(logs, tmp_path / "out")
    assert code == 0
    told = next(line for line in said.splitlines() if line.startswith("hold: not ok in 1 of 2 runs; run 1"))
    assert str(path) in told and reason in told


def test_a_missing_answer_is_a_failed_run(logs, tmp_path):
    answer(logs, "hold", 1)
    code, said = run(logs, tmp_path / "out")
    assert code == 0 and "hold: no answer to run 0 of 2" in said
    assert (
        f"hold: not ok in 1 of 2 runs; run 0 failed: InputError: {logs}/answers/hold/000000.csv: no answer to run 0"
        in said
    )


def test_what_is_no_answer_to_these_runs_is_refused_before_anything_is_written(logs, tmp_path):
    out = tmp_path / "out"

    def refused(*more, estimators="ins"):
        code, said = run(logs, out, *more, estimators=estimators)
        assert code == 2 and not out.exists(), said
        assert len(said.splitlines()) == 1
        return said

    assert "no folder of answers; a filter called NAME" in refused()
    path = answer(logs, "hold", 0)
    answer(logs, "hold", 1)
    assert "[sensors] differ" in refused("--set", "sensors.gnss.rate_hz=2")
    assert "[monte_carlo] differ" in refused("--seed", "7")
    assert "holds the logs of 2 runs, but 3 are asked for" in refused("--runs", "3")
    assert "give --runs a number" in refused("--runs", "auto")
    assert "the scenario has a row 'hold' already" in refused("--external", str(logs))
    (path.parent / "notes.txt").write_text("mine")
    assert "notes.txt: answers no run" in refused()
    (path.parent / "notes.txt").unlink()
    beyond = answer(logs, "hold", 0).rename(path.parent / "000005.csv")
    answer(logs, "hold", 0)
    assert "answers run 5, of which" in refused()
    beyond.rename(path.parent / "000000.parquet")
    assert "a second answer to run 0" in refused()
    for file in path.parent.iterdir():
        file.unlink()
    assert "hold: no answer to runs 0, 1" in refused()
    path.parent.rmdir()
    assert (
        "holds no logs of 'testbed sense SCENARIO --runs N'"
        in call("run", "quickstart", "--external", str(tmp_path), "--out", str(out))[1]
    )


def test_changed_answers_are_another_batch(logs, tmp_path):
    for k in range(RUNS):
        answer(logs, "hold", k)
    assert run(logs, tmp_path / "out")[0] == 0
    assert run(logs, tmp_path / "out", "--resume")[0] == 0
    answer(logs, "hold", 1, lambda frame: frame.assign(alt_m=frame["alt_m"] + 1.0))
    code, said = run(logs, tmp_path / "out", "--resume")
    assert code == 2 and "answers was" in said


def test_what_the_logs_do_not_depend_on_may_change():
    base = load_scenario("quickstart")
    for key, value, same in (
        ("monte_carlo.runs", 3, True),
        ("estimators.indirect-kf.params.gyro_bias_scale", 2.0, True),
        ("monte_carlo.seed", 3, False),
        ("initial.yaw_deg", 7.0, False),
        ("flight.initial.alt_m", 900.0, False),
    ):
        changed = load_scenario("quickstart", overrides={key: value})
        assert (sensed_by(changed) == sensed_by(base)) == same, key
