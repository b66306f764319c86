"""Interrupted batches: whatever is killed, and whenever, the resumed tables are those of an undisturbed run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import monte_carlo as mc
import numpy as np
import psutil
import pytest

from testbed import pipeline
from testbed.base.checksums import read_json, sealed_json
from testbed.base.errors import InputError
from testbed.montecarlo import runner

RUNS = 40
TABLES = ("summary.csv", "claims.csv", "improvements.csv", "consistency.csv", "metrics.parquet", "envelopes.parquet")


@pytest.fixture(autouse=True)
def real_pipeline():
    """The plug-in of these tests replaces two functions of the pipeline; put them back."""
    before = pipeline.fly, pipeline.sense
    yield
    pipeline.fly, pipeline.sense = before


def contents(folder):
    return {name: (folder / name).read_bytes() for name in TABLES}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The tables of a batch that nothing happened to."""
    before = pipeline.fly, pipeline.sense
    out = tmp_path_factory.mktemp("undisturbed")
    runner.run(mc.slow_scenario(RUNS), out, jobs=1, plugins=[mc.PLUGIN])
    pipeline.fly, pipeline.sense = before
    return contents(out)


def start(out, *more, jobs=2):
    here = Path(__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(here), str(here.parent)])}
    command = [sys.executable, str(here / "run_monte_carlo.py"), str(out), str(RUNS), str(jobs), *more]
    # a shell lets what it runs in the background ignore Ctrl-C, and children inherit that
    heeded = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    options = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    return subprocess.Popen(command, env=environment, preexec_fn=heeded, **options)


def stored(out):
    return len(list((out / "runs").glob("??????.parquet"))) if (out / "runs").is_dir() else 0


def wait_for(condition, seconds=300.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def resume(out):
    return runner.run(mc.slow_scenario(RUNS), out, jobs=1, resume=True, plugins=[mc.PLUGIN])


def test_kill_9_of_the_main_process_at_any_moment(tmp_path, undisturbed):
    """Twice here; `TESTBED_KILLS=10` for as many as the acceptance asks."""
    rng = np.random.default_rng()
    for k in range(int(os.environ.get("TESTBED_KILLS", "2"))):
        out, after = tmp_path / str(k), int(rng.integers(1, RUNS - 5))
        process = start(out)
        wait_for(lambda out=out, after=after: stored(out) >= after)
        workers = psutil.Process(process.pid).children(recursive=True)
        process.kill()
        process.communicate()
        wait_for(
            lambda workers=workers: not any(w.is_running() and w.status() != psutil.STATUS_ZOMBIE for w in workers)
        )
        assert after <= stored(out) < RUNS
        resume(out)
        assert contents(out) == undisturbed


def test_ctrl_c_says_how_to_resume_and_loses_nothing(tmp_path, undisturbed):
    process = start(tmp_path / "out")
    wait_for(lambda: stored(tmp_path / "out") >= 5)
    os.killpg(process.pid, signal.SIGINT)
    message = process.communicate(timeout=300)[1]
    assert "--resume" in message and f"of {RUNS} runs stored" in message and "Traceback" not in message
    resume(tmp_path / "out")
    assert contents(tmp_path / "out") == undisturbed


def test_ctrl_c_inside_of_a_compiled_loop_is_no_failure_of_the_estimator(tmp_path):
    with pytest.raises(runner.Interrupted, match="2 of 12 runs stored"):
        runner.run(mc.scenario([{"name": "interrupted"}]), tmp_path / "out", jobs=1, plugins=[mc.PLUGIN])
    assert stored(tmp_path / "out") == 2


def test_a_killed_worker_loses_nothing(tmp_path, undisturbed):
    process = start(tmp_path / "out")
    wait_for(lambda: stored(tmp_path / "out") >= 5)
    workers = [c for c in psutil.Process(process.pid).children() if "resource_tracker" not in " ".join(c.cmdline())]
    assert len(workers) == 2
    workers[0].kill()
    process.communicate(timeout=300)
    assert process.returncode == 0
    assert contents(tmp_path / "out") == undisturbed


def test_a_worker_that_dies_once_loses_nothing(tmp_path):
    row = {"name": "kills", "params": {"marker": str(tmp_path / "killed")}}
    result = runner.run(mc.scenario([mc.GOOD, row]), tmp_path / "out", jobs=2, plugins=[mc.PLUGIN])
    assert (tmp_path / "killed").exists() and (result.runs["status"] == "ok").all() and len(result.runs) == 24


def test_dask_with_one_of_two_workers_killed_half_way(tmp_path, undisturbed):
    distributed = pytest.importorskip("distributed")
    settings = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**settings) as cluster:
        process = start(tmp_path / "out", cluster.scheduler_address)
        wait_for(lambda: stored(tmp_path / "out") >= RUNS // 2)
        victim = next(iter(cluster.workers.values())).process.process.pid
        os.kill(victim, signal.SIGKILL)
        message = process.communicate(timeout=300)[1]
    assert process.returncode == 0, message
    assert contents(tmp_path / "out") == undisturbed


def test_no_scheduler_is_an_input_error(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="extra 'cluster'"):
        runner.run(mc.scenario([mc.GOOD]), tmp_path / "out", scheduler="tcp://127.0.0.1:1", plugins=[mc.PLUGIN])


def test_a_scheduler_that_does_not_answer_leaves_nothing_behind(tmp_path):
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        runner.run(mc.scenario([mc.GOOD]), tmp_path / "out", scheduler="tcp://127.0.0.1:1", plugins=[mc.PLUGIN])
    assert not (tmp_path / "out").exists()


def test_damaged_and_left_over_files_are_done_again(tmp_path, undisturbed):
    first = runner.run(mc.slow_scenario(RUNS), tmp_path / "out", jobs=1, plugins=[mc.PLUGIN])
    runs = first.out / "runs"
    (runs / "000007.parquet").write_bytes((runs / "000007.parquet").read_bytes()[:500])
    (runs / "000009.parquet").unlink()
    (runs / ".000011.parquet.99.tmp").write_bytes(b"half")
    resume(first.out)
    assert contents(first.out) == undisturbed and len(os.listdir(runs)) == RUNS


def test_more_runs_extend_a_result(tmp_path):
    scenario = mc.scenario([mc.GOOD, mc.BAD], runs=20)
    runner.run(scenario, tmp_path / "at once", jobs=1, plugins=[mc.PLUGIN])
    runner.run(scenario, tmp_path / "out", runs=8, jobs=1, plugins=[mc.PLUGIN])
    told = []
    runner.run(scenario, tmp_path / "out", jobs=1, resume=True, progress=lambda *n: told.append(n), plugins=[mc.PLUGIN])
    assert told[0] == (8, 20) and told[-1] == (20, 20)
    assert contents(tmp_path / "out") == contents(tmp_path / "at once")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"seed": 2}, r"\(\[monte_carlo\] differs\)"),
        ({"sensors": {"imu": {"model": "ADIS16448"}}}, r"\(\[sensors\] differs\)"),
        ({"estimators": [mc.GOOD]}, r"\(\[estimators\] differs\)"),
        ({"seed": 2, "initial": {"yaw_deg": 9.0}}, r"\(\[initial\], \[monte_carlo\] differ\)"),
    ],
)
def test_a_changed_scenario_is_not_resumed(tmp_path, change, told):
    rows = change.get("estimators", [mc.GOOD, mc.BAD])
    runner.run(mc.scenario([mc.GOOD, mc.BAD], runs=2), tmp_path / "out", jobs=1, plugins=[mc.PLUGIN])
    before = (tmp_path / "out" / "summary.csv").read_bytes()
    changed = mc.scenario(rows, runs=4, **{k: v for k, v in change.items() if k != "estimators"})
    with pytest.raises(InputError, match=f"another batch {told}"):
        runner.run(changed, tmp_path / "out", jobs=1, resume=True, plugins=[mc.PLUGIN])
    assert (tmp_path / "out" / "summary.csv").read_bytes() == before


def test_a_changed_plugin_is_not_resumed(tmp_path):
    copy = tmp_path / "plugin.py"
    copy.write_text(mc.PLUGIN.read_text())
    runner.run(mc.scenario([mc.GOOD], runs=2), tmp_path / "out", jobs=1, plugins=[copy])
    copy.write_text(copy.read_text() + "\n# changed\n")
    with pytest.raises(InputError, match="plugins"):
        runner.run(mc.scenario([mc.GOOD], runs=4), tmp_path / "out", jobs=1, resume=True, plugins=[copy])


def test_what_may_be_overwritten(tmp_path):
    scenario = mc.scenario([mc.GOOD], runs=2)
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("precious")
    with pytest.raises(InputError, match="holds no testbed result"):
        runner.run(scenario, other, jobs=1, plugins=[mc.PLUGIN])
    out = runner.run(scenario, tmp_path / "out", runs=5, jobs=1, plugins=[mc.PLUGIN]).out
    (out / "findings.md").write_text("what we learned")
    assert len(runner.run(scenario, out, jobs=1, plugins=[mc.PLUGIN]).runs) == 2
    assert len(os.listdir(out / "runs")) == 2 and (out / "findings.md").exists()
    manifest = out / "manifest.json"
    manifest.write_bytes(sealed_json(read_json(manifest) | {"finished": False}))
    with pytest.raises(InputError, match=r"unfinished result.*--resume"):
        runner.run(scenario, out, jobs=1, plugins=[mc.PLUGIN])
