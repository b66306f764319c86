"""What is stored and read back: a flipped bit, a run of another batch, a file of the user, a second writer, a stepped clock."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from multiprocessing import get_context

import monte_carlo as mc
import numpy as np
import pytest
from result_folder import make_result

from testbed import pipeline
from testbed.base.errors import InputError, TestbedError
from testbed.cli import commands
from testbed.montecarlo import executors, runner
from testbed.montecarlo.compare import compare_results
from testbed.report import render, render_index

TABLES = ("summary.csv", "claims.csv", "improvements.csv", "consistency.csv", "metrics.parquet", "envelopes.parquet")


@pytest.fixture(autouse=True)
def real_pipeline():
    """The plug-in of these tests replaces two functions of the pipeline; put them back."""
    before = pipeline.fly, pipeline.sense
    yield
    pipeline.fly, pipeline.sense = before


def batch(out, seed=1, runs=4, **options):
    scenario = mc.scenario([mc.GOOD, mc.BAD], seed=seed, claims=[mc.CLAIM])
    return runner.run(scenario, out, runs, plugins=[mc.PLUGIN], **({"jobs": 1} | options))


def contents(folder):
    return {name: (folder / name).read_bytes() for name in TABLES}


def flip(path, rng):
    """One random bit of a file."""
    data = bytearray(path.read_bytes())
    place = int(rng.integers(8 * len(data)))
    data[place // 8] ^= 1 << place % 8
    path.write_bytes(data)


def test_runs_of_another_seed_or_number_are_never_read(tmp_path, capfd):
    """Run files that do not belong: of seed 99 under the same name, and run 2 copied over run 1."""
    batch(tmp_path / "whole"), batch(tmp_path / "other", seed=99)
    batch(tmp_path / "out", runs=3)
    shutil.copy(tmp_path / "other/runs/000000.parquet", tmp_path / "out/runs/000000.parquet")
    shutil.copy(tmp_path / "out/runs/000002.parquet", tmp_path / "out/runs/000001.parquet")
    batch(tmp_path / "out", resume=True)
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    told = capfd.readouterr().err
    assert "000000.parquet: is run 0 of another batch" in told and "000001.parquet: is run 2, not run 1" in told


def test_what_cannot_be_deleted_stops_a_new_batch(tmp_path, monkeypatch):
    """A read-only ``runs`` once gave the tables of seed 1 under the name of seed 99."""
    batch(tmp_path / "seed-1"), batch(tmp_path / "seed-99", seed=99)
    unlink = os.unlink

    def refuses(path, *more, **options):
        if str(path).endswith("000001.parquet"):
            raise PermissionError(13, "Permission denied", str(path))
        return unlink(path, *more, **options)

    with monkeypatch.context() as patched:
        patched.setattr(os, "unlink", refuses)
        with pytest.raises(TestbedError, match=r"000001\.parquet: cannot be deleted"):
            batch(tmp_path / "seed-1", seed=99)
    batch(tmp_path / "seed-1", seed=99, resume=True)
    assert contents(tmp_path / "seed-1") == contents(tmp_path / "seed-99")


def test_a_flipped_bit_in_a_run_changes_no_table(tmp_path, capfd):
    rng = np.random.default_rng(5)
    out = batch(tmp_path / "out").out
    before = contents(out)
    for _ in range(3):
        flip(out / "runs" / f"{rng.integers(4):06d}.parquet", rng)
        batch(out, resume=True)
        assert contents(out) == before and "damaged" in capfd.readouterr().err


def test_files_of_the_user_stay(tmp_path):
    out = batch(tmp_path / "out").out
    render(out, svg=False)
    mine = [
        out / name for name in ("figures/mine.png", "details/notes.txt", "runs/README.txt", ".scratch/x", "todo.md")
    ]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    batch(out, seed=2)
    render(out, svg=False)
    batch(out, seed=2, resume=True, runs=5)
    assert [path.read_text() for path in mine] == ["mine"] * len(mine)


def test_a_file_in_the_way_is_refused_and_kept(tmp_path):
    """A look-alike manifest makes no result; a table, a page or a run of the user's is not overwritten."""
    alike = tmp_path / "alike"
    alike.mkdir()
    (alike / "manifest.json").write_text('{"kind": "testbed result", "finished": true}')
    (alike / "report.md").write_text("mine")
    with pytest.raises(InputError, match=r"alike: is not empty"):
        batch(alike)
    for name in ("report.html", "figures/monte_carlo.png"):
        folder = make_result(tmp_path / name.replace("/", "-"), runs=3)
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("mine")
        with pytest.raises(InputError, match="was not written by the bench"):
            render(folder, svg=False)
        assert (folder / name).read_text() == "mine"
    out = batch(tmp_path / "out").out
    (out / "runs" / "000003.parquet").write_text("mine")
    with pytest.raises(InputError, match=r"000003\.parquet: has the name of a stored run but is none"):
        batch(out, resume=True)
    assert (alike / "report.md").read_text() == (out / "runs" / "000003.parquet").read_text() == "mine"


def test_an_index_and_a_sweep_do_not_overwrite(tmp_path):
    from testbed.montecarlo.sweep import sweep

    folder = make_result(tmp_path / "one", runs=3)
    (tmp_path / "index.html").write_text("mine")
    with pytest.raises(InputError, match=r"index\.html: is in the way"):
        render_index([folder, folder], tmp_path)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "sweep.csv").write_text("mine")
    with pytest.raises(InputError, match="is not empty and holds no testbed sweep"):
        sweep(lambda _: mc.scenario([mc.GOOD]), {"a": [1]}, tmp_path / "thesis", plugins=[mc.PLUGIN])
    assert (tmp_path / "index.html").read_text() == (tmp_path / "thesis/sweep.csv").read_text() == "mine"


def _hold(out, held):
    from testbed.montecarlo.store import Store

    with Store.create(out, {"scenario": "x"}, "", resume=False):
        held.set()
        time.sleep(60.0)


def test_two_batches_do_not_share_a_folder_and_a_dead_one_is_no_obstacle(tmp_path):
    context = get_context("fork")
    held = context.Event()
    writer = context.Process(target=_hold, args=(tmp_path / "out", held))
    writer.start()
    assert held.wait(30.0)
    with pytest.raises(InputError, match=rf"another run \(process {writer.pid}\) is writing to it"):
        batch(tmp_path / "out")
    os.kill(writer.pid, signal.SIGKILL)
    writer.join()
    assert (tmp_path / "out" / ".lock").exists()
    batch(tmp_path / "out")
    assert not (tmp_path / "out" / ".lock").exists()


def test_a_stepped_clock_kills_no_worker(tmp_path, monkeypatch):
    """The wall clock jumps by a day with every look: no estimator has taken a day."""
    now = iter(range(10**9))
    monkeypatch.setattr(time, "time", lambda: 1e9 + 86400.0 * next(now))
    monkeypatch.setattr(executors, "POLL_S", 0.02)
    row = {"name": "noisy", "label": "slow", "params": {"delay_s": 0.3}}
    scenario = mc.scenario([row], runs=4)
    result = runner.run(scenario, tmp_path / "out", jobs=2, timeout=30.0, plugins=[mc.PLUGIN])
    assert (result.runs["status"] == "ok").all()
    assert result.out.joinpath("manifest.json").stat().st_size > 0.0 and 0.0 < _seconds(result.out) < 600.0


def _seconds(out):
    import json

    return json.loads((out / "manifest.json").read_text())["seconds"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"timeout": float("inf")}, "at most 1e"),
        ({"timeout": float("nan")}, "at most 1e"),
        ({"runs": 10**9}, "at most 1000000"),
        ({"runs": runner.Auto(5.0, 10**9)}, "at most 1000000"),
    ],
)
def test_endless_requests_are_refused(tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        batch(tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


DAMAGE = {
    "manifest.json": [b"", b"{", b"[]", b'"x"', b"\xff\xfe", b"[" * 100_000, b'{"kind": 3}'],
    "scenario.toml": [b"a = ", b"\xff", b"monte_carlo = 3", b"scenario = 1\nestimators = 2"],
    "details/info.json": [b"", b"[1]", b'{"estimators": [1]}', b'{"phases": 3}', b'{"outages": [[1, "x"]]}'],
    "summary.csv": [b"", b"\xff\xfe\x00", b"estimator,mean\na,b\n"],
    "findings.md": [b"\xff\xfe"],
    "runs.parquet": [b"", b"PAR1PAR1"],
}


@pytest.mark.parametrize(("name", "content"), [(name, c) for name, cases in DAMAGE.items() for c in cases])
def test_damaged_results_are_refused_by_name(tmp_path_factory, name, content):
    """By ``report`` always; by ``compare`` where it reads the file. The rest of the folder stays as it was."""
    whole = tmp_path_factory.getbasetemp() / "damage"
    if not whole.exists():
        make_result(whole, runs=3)
    folder = tmp_path_factory.mktemp("damaged") / "r"
    shutil.copytree(whole, folder)
    (folder / name).write_bytes(content)
    before = sorted(folder.rglob("*"))
    with pytest.raises(InputError, match=r"r(/|: no result)"):
        render(folder, svg=False)
    if (
        name != "findings.md"
        and not name.startswith(("details", "summary"))
        and content != b"scenario = 1\nestimators = 2"
    ):
        with pytest.raises(InputError, match=r"r(/|: no result)"):
            compare_results(whole, folder)
    assert sorted(folder.rglob("*")) == before


def test_out_may_be_the_current_folder_or_a_link(tmp_path, monkeypatch):
    for name in ("here", "target"):
        (tmp_path / name).mkdir()
    (tmp_path / "link").symlink_to("target")
    (tmp_path / "nowhere").symlink_to("missing")
    monkeypatch.chdir(tmp_path / "here")
    for out in (commands.Path("."), tmp_path / "link"):
        with commands.fresh_folder(out) as scratch:
            (scratch / "a.txt").write_text("whole")
        assert (out / "a.txt").read_text() == "whole" and os.listdir(out) == ["a.txt"]
    assert (tmp_path / "link").is_symlink() and os.listdir(".") == ["a.txt"]
    with pytest.raises(InputError, match="is a link that leads nowhere"), commands.fresh_folder(tmp_path / "nowhere"):
        pass
    assert sorted(os.listdir(tmp_path)) == ["here", "link", "nowhere", "target"]


@pytest.mark.parametrize("shell", ["{} >&-", "PYTHONIOENCODING=ascii {}", "{} 2>&- | head -c 1"])
def test_any_stdout_will_do(tmp_path, shell):
    """Closed, ASCII only, or gone: no traceback."""
    command = f"{sys.executable} -m testbed.cli list manoeuvres"
    done = subprocess.run(["sh", "-c", shell.format(command)], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode in (0, 1) and "Traceback" not in done.stderr and "Exception" not in done.stderr


def test_names_that_are_no_text_can_be_printed(tmp_path):
    name = os.fsdecode(b"caf\xe9")
    (tmp_path / name).mkdir()
    (tmp_path / name / "mine").touch()
    command = [sys.executable, "-m", "testbed.cli", "fly", "quickstart", "--out", name]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and "Traceback" not in done.stderr and "caf" in done.stderr


def _half(out):
    with commands.fresh_folder(out) as scratch:
        (scratch / "half").write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_leaves_no_half_folder(tmp_path):
    """What `fly`, `sense` and `import` write appears at once or not at all."""
    with pytest.raises(TestbedError, match=r"new: the disk is full"):
        _half(tmp_path / "new")
    assert os.listdir(tmp_path) == []
