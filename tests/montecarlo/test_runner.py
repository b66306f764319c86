"""The runner: same tables whatever computes them; a bad estimator costs its own row; settings that cannot be are refused."""

from __future__ import annotations

import functools
import json
import os
import sys

import monte_carlo as mc
import numpy as np
import pandas as pd
import pytest

from testbed import pipeline
from testbed.base.errors import InputError, TestbedError
from testbed.data.registry import load_plugin
from testbed.montecarlo import executors, runner
from testbed.montecarlo.store import StoreError

TABLES = ("summary.csv", "claims.csv", "improvements.csv", "consistency.csv", "metrics.parquet", "envelopes.parquet")


@pytest.fixture(autouse=True)
def real_pipeline():
    """The plug-in of these tests replaces two functions of the pipeline; put them back."""
    before = pipeline.fly, pipeline.sense
    yield
    pipeline.fly, pipeline.sense = before


@pytest.fixture
def short_cold_start(monkeypatch):
    """Three seconds for a worker to load what an estimator needs, so that a hang need not be waited for longer."""
    monkeypatch.setattr(runner, "Setup", functools.partial(runner.Setup, cold_s=3.0))
    monkeypatch.setattr("testbed.montecarlo.executors.GRACE_S", 0.5)


def run(scenario, out, **options):
    return runner.run(scenario, out, plugins=[mc.PLUGIN], **({"jobs": 1} | options))


def contents(folder):
    return {name: (folder / name).read_bytes() for name in TABLES}


def test_tables_do_not_depend_on_the_number_of_workers(tmp_path):
    scenario = mc.scenario([mc.GOOD, mc.BAD], claims=[mc.CLAIM], windows=[{"kind": "outages"}])
    run(scenario, tmp_path / "one")
    run(scenario, tmp_path / "two", jobs=2)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_result_folder_is_what_the_design_says(tmp_path):
    result = run(mc.scenario([mc.GOOD, mc.BAD], claims=[mc.CLAIM], windows=[{"kind": "outages"}]), tmp_path / "out")
    design = {
        "summary": "estimator window metric n mean std median p05 p95 ci_low ci_high",
        "claims": "id text paper_pct measured_pct ci_low ci_high verdict",
        "timings": "estimator samples median_us min_us",
        "consistency": "estimator quantity dof n_runs mean lower upper share_inside",
    }
    for name, columns in design.items():
        read = pd.read_csv(result.out / f"{name}.csv")
        assert " ".join(read.columns).startswith(columns)
    assert list(result.metrics.columns) == ["run", "estimator", "window", "metric", "value"]
    assert set(result.metrics["window"]) == {"all", "outage_1", "outages"}
    assert len(list((result.out / "runs").glob("??????.parquet"))) == 12
    assert {"truth.parquet", "errors-good.parquet", "innovations-bad.parquet", "info.json"} <= set(
        os.listdir(result.out / "details")
    )
    assert json.loads((result.out / "manifest.json").read_text())["finished"]
    assert not (result.out / ".scratch").exists()


def test_statistics_of_a_plugin_with_known_noise(tmp_path):
    """Offsets |N(0, 1)| and |N(0, 2)|: mean sigma sqrt(2/pi), half as large, so 50 % better."""
    result = run(mc.scenario([mc.GOOD, mc.BAD], runs=400, claims=[mc.CLAIM]), tmp_path / "out")
    rows = result.summary.query("estimator == 'good' and window == 'all'").set_index("metric")
    standard_error = np.sqrt((1 - 2 / np.pi) / 400)
    assert abs(rows.loc["rmse_north_m", "mean"] - np.sqrt(2 / np.pi)) < 4 * standard_error
    assert rows.loc["rmse_east_m", "mean"] == pytest.approx(0.0, abs=1e-6)
    claim = result.claims.iloc[0]
    assert claim["ci_low"] < 50.0 < claim["ci_high"] and claim["verdict"] == "reproduced" and claim["p_value"] < 1e-6
    nis = result.consistency.set_index(["estimator", "quantity"]).loc[("good", "nis")]
    assert nis["share_inside"] >= 0.95 - 4 * np.sqrt(0.95 * 0.05 / 30)
    assert nis["lower"] < nis["mean"] < nis["upper"]


@pytest.mark.usefixtures("short_cold_start")
def test_a_bad_estimator_costs_its_own_row(tmp_path):
    rows = [mc.GOOD, {"name": "raises"}, {"name": "nan"}, {"name": "hangs"}]
    result = run(mc.scenario(rows, runs=20), tmp_path / "out", jobs=2, timeout=1.0)
    status = result.runs.set_index(["estimator", "run"])["status"]
    assert (status["good"] == "ok").all() and len(status["good"]) == 20
    assert status["raises"][lambda s: s != "ok"].to_dict() == dict.fromkeys(
        (3, 13), "failed: ValueError: as told (monte_carlo.py:109)"
    )
    assert status["nan"][lambda s: s != "ok"].to_dict() == dict.fromkeys((1, 6, 11, 16), "diverged")
    assert status["hangs"][lambda s: s != "ok"].to_dict() == {1: "timeout"}
    counts = result.summary[(result.summary["window"] == "all") & (result.summary["metric"] == "rmse_north_m")]
    assert counts.set_index("estimator")["n"].to_dict() == {"good": 20, "raises": 18, "nan": 16, "hangs": 19}
    diverged = result.summary[result.summary["metric"] == "diverged"].set_index("estimator")["mean"]
    assert diverged["nan"] == pytest.approx(0.2) and diverged["good"] == 0.0
    reasons = result.runs.set_index(["estimator", "run"])["reason"]
    assert reasons["nan", 1] == "not finite from 30.1 s"


@pytest.mark.usefixtures("short_cold_start")
def test_native_code_that_hangs_or_crashes_is_given_up(tmp_path):
    rows = [mc.GOOD, {"name": "hangs", "params": {"deaf": True}}, {"name": "kills"}]
    result = run(mc.scenario(rows, runs=4), tmp_path / "out", jobs=2, timeout=1.0)
    status = result.runs.set_index(["estimator", "run"])["status"]
    assert (status["good"] == "ok").all() and len(status) == 12
    assert status["hangs"][lambda s: s != "ok"].to_dict() == {1: "timeout"}
    assert status["kills"][lambda s: s != "ok"].to_dict() == {
        2: "failed: it ended its worker process (crash or memory)"
    }


def test_a_lone_run_of_a_plugin_does_not_end_the_bench(tmp_path, capsys):
    """One run would be computed in this process, but for the plug-in: whose crash then costs its row, and is told once."""
    from testbed.cli.console import print_failures
    from testbed.report.results import load_result
    from testbed.report.tables import failures

    rows = [mc.GOOD, {"name": "kills", "params": {"at": 0}}]
    result = run(mc.scenario(rows, runs=1), tmp_path / "out", jobs=2)
    assert result.runs["status"].tolist() == ["ok", "failed: it ended its worker process (crash or memory)"]
    print_failures(result.runs)
    assert "run 0 failed: it ended its worker process (crash or memory)" in capsys.readouterr().err
    table = failures(load_result(result.out))
    assert table.rows[0][1][0].text == "failed: it ended its worker process (crash or memory)"


def test_a_run_without_data_costs_its_rows(tmp_path, monkeypatch):
    scenario = mc.scenario([mc.GOOD], runs=3)
    from testbed.base.errors import FlightError
    from testbed.data import registry

    registry.load_plugin(mc.PLUGIN)
    sense = pipeline.sense

    def refuses(scenario, trajectory, seed=None, run=0):
        if run == 1:
            raise FlightError("stalled")
        return sense(scenario, trajectory, seed, run)

    monkeypatch.setattr(pipeline, "sense", refuses)
    result = runner.run(scenario, tmp_path / "out", jobs=1)
    assert result.runs["status"].tolist() == ["ok", "failed: no data: FlightError: stalled", "ok"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"runs": 0}, "at least one"),
        ({"jobs": 0}, "at least one"),
        ({"timeout": 0.0}, "above 0"),
        ({"estimators": ["godo"]}, "did you mean 'good'"),
        ({"runs": runner.Auto(5.0, 100)}, "has none"),
    ],
)
def test_settings_that_cannot_be_are_refused_and_nothing_is_written(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        run(mc.scenario([mc.GOOD]), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("key", "value", "hint"), [("metric", "rmse_nort_m", "rmse_north_m"), ("window", "al", "'all'")]
)
def test_claims_on_what_does_not_exist_are_refused(tmp_path, key, value, hint):
    with pytest.raises(InputError, match=hint):
        run(mc.scenario([mc.GOOD, mc.BAD], claims=[mc.CLAIM | {key: value}]), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_full_disk_says_so_and_can_be_resumed(tmp_path, monkeypatch):
    import errno
    from pathlib import Path

    scenario = mc.scenario([mc.GOOD])
    run(scenario, tmp_path / "whole")
    write = Path.write_bytes

    def full(path, data):
        if "000005" in path.name:
            write(path, data[:100])
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, data)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_bytes", full)
        with pytest.raises(StoreError, match=r"disk is full.*--resume"):
            run(scenario, tmp_path / "out")
    assert len(os.listdir(tmp_path / "out" / "runs")) == 5
    run(scenario, tmp_path / "out", resume=True)
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_sequential_stopping_ends_when_every_claim_is_narrow_enough(tmp_path):
    scenario = mc.scenario([mc.GOOD, mc.BAD], claims=[mc.CLAIM])
    result = run(scenario, tmp_path / "out", runs=runner.Auto(width_pct=30.0, cap=500, first=10))
    claim, n = result.claims.iloc[0], result.runs["run"].nunique()
    assert claim["ci_high"] - claim["ci_low"] < 30.0 and 10 < n < 500
    capped = run(scenario, tmp_path / "capped", runs=runner.Auto(width_pct=0.1, cap=15, first=10))
    assert capped.runs["run"].nunique() == 15


def test_estimators_share_their_sensors_and_do_not_disturb_each_other(tmp_path):
    both = run(mc.scenario([mc.BAD, mc.GOOD]), tmp_path / "both").summary
    alone = run(mc.scenario([mc.BAD, mc.GOOD]), tmp_path / "alone", estimators=["good"]).summary
    good = both[both["estimator"] == "good"].reset_index(drop=True)
    pd.testing.assert_frame_equal(good, alone)


@pytest.mark.parametrize("order", [["spoils", "reads"], ["reads", "spoils"]])
def test_what_a_plugin_writes_into_its_log_no_other_row_sees(order, tmp_path):
    """Units go through the rows forwards and backwards in turn, so either order would meet it."""
    result = run(mc.scenario([{"name": name} for name in order], runs=12), tmp_path / "out").summary
    rows = result.query("estimator == 'reads' and window == 'all'").set_index("metric")
    assert rows.loc["rmse_north_m", "mean"] < 1e-5


def test_a_window_beyond_the_flight_is_told(tmp_path):
    windows = [
        {"name": name, "start": start, "end": end}
        for name, start, end in (("inside", 10.0, 60.4), ("end", 50.0, 90.0), ("start", -30.0, 5.0))
    ]
    notes = run(mc.scenario([mc.GOOD], runs=2, windows=windows), tmp_path / "out").notes
    told = [note for note in notes if "reaches beyond" in note]
    assert told == [
        "window 'end' (50 to 90 s) reaches beyond the flight (0 to 60 s): 50 to 60 s of it are scored",
        "window 'start' (-30 to 5 s) reaches beyond the flight (0 to 60 s): 0 to 5 s of it are scored",
    ]


@pytest.mark.parametrize(
    ("windows", "name"),
    [
        ([{"name": "all", "start": 10.0, "end": 20.0}], "all"),
        ([{"name": "end", "start": 10.0, "end": 20.0}, {"name": "end", "start": 30.0, "end": 40.0}], "end"),
        ([{"kind": "outages"}, {"name": "outages", "start": 10.0, "end": 20.0}], "outages"),
        ([{"name": "outage_1", "start": 10.0, "end": 20.0}, {"kind": "outages"}], "outage_1"),
    ],
)
def test_two_windows_of_one_name_are_refused(windows, name, tmp_path):
    with pytest.raises(InputError, match=f"two windows are called '{name}'"):
        run(mc.scenario([mc.GOOD], windows=windows), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_dead_start_of_every_worker_is_an_error_not_a_loop(tmp_path, monkeypatch):
    from testbed.montecarlo import executors

    monkeypatch.setattr(executors, "_start_worker", os._exit)
    with pytest.raises(TestbedError, match="die when they start"):
        run(mc.scenario([mc.GOOD]), tmp_path / "out", jobs=2)


def test_time_to_compile_is_not_time_to_compute(tmp_path):
    """An estimator with a kernel that is compiled in its first run: seconds to compile, microseconds to compute."""
    (tmp_path / "fresh.py").write_text(
        "import time\nfrom numba import njit\nfrom estimators.methods.ins import Ins\n\n"
        "class Fresh:\n    name = 'fresh'\n    spent = []\n    def run(self, log):\n"
        "        start = time.perf_counter()\n"
        "        njit(lambda x: sum([x * k for k in range(10)]))(3.0)\n"
        "        Fresh.spent.append(time.perf_counter() - start)\n        return Ins().run(log)\n"
    )
    load_plugin(tmp_path / "fresh.py")
    result = runner.run(
        mc.scenario([{"name": "fresh"}], runs=1), tmp_path / "out", jobs=1, plugins=[mc.PLUGIN, tmp_path / "fresh.py"]
    )
    spent = sys.modules["testbed_plugin_fresh"].Fresh.spent[0]
    assert float(result.runs["seconds"].iloc[0]) < 0.5 * spent


def test_closing_a_pool_before_its_first_unit_ends_its_workers():
    """Ctrl-C may come while the tables' modules load, before anyone has asked for a unit."""
    setup = runner.plan(mc.scenario([mc.GOOD], runs=4), plugins=[mc.PLUGIN])
    runner.prepare(setup)
    pool = executors.Pool(setup, 2)
    units = pool.run(range(4))
    assert pool._executor is not None
    workers = list(pool._executor._processes.values())
    units.close()
    assert len(workers) == 2 and not any(worker.is_alive() for worker in workers) and pool._executor is None


def test_innovations_that_are_not_what_a_filter_takes_them_for_are_told():
    """Of two channels with a sigma of 2, one of size 2 and one of size 0.2: 1 and 0.01, of which the second is told."""
    from testbed.data.records import Innovations, NavSolution
    from testbed.montecarlo.first_run import _nis_per_channel, innovation_notes

    t, still = np.arange(10.0), np.tile([1.0, 0.0, 0.0, 0.0], (10, 1))
    value = np.tile([2.0, 0.2], (10, 1)) * np.where(np.arange(10) % 2, 1.0, -1.0)[:, None]
    value[9] = np.nan, 50.0
    rejected = np.arange(10) == 9
    nu = Innovations(t, value, np.tile(4.0 * np.eye(2), (10, 1, 1)), ("north, m", "east, m"), rejected)
    solution = NavSolution(t, *(np.zeros((3, 10))), np.zeros((10, 3)), still, innovations={"beacon": nu})
    found = _nis_per_channel(solution)
    assert found == {"beacon": {"north, m": 1.0, "east, m": 0.01}}
    (note,) = innovation_notes({"nis_per_channel": {"mine": found}})
    assert note.startswith("mine: NIS per channel of the aiding beacon") and note.endswith("east 0.01")
    assert innovation_notes({}) == []
