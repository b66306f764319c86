"""Flipped bits, kills and full disks at random: nothing wrong is read, nothing half stays, and a resumed job gives the same bytes.

A sample here; ``TESTBED_FLIPS=1000 TESTBED_KILLS=20 TESTBED_DISKS=20`` for as many as the acceptance asks.
"""

from __future__ import annotations

import ctypes
import os
import resource
import shutil
import signal
import time
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import monte_carlo as mc
import numpy as np
import pytest
from result_folder import make_result
from synthetic import sensor_log, weaving_flight

from testbed import pipeline
from testbed.base.errors import InputError, TestbedError
from testbed.data.records import NavSolution, SensorLog, Trajectory
from testbed.flight import cache as flights
from testbed.montecarlo import runner
from testbed.montecarlo.store import decode, open_result
from testbed.montecarlo.sweep import sweep
from testbed.report import render
from testbed.report.results import load_result
from testbed.tuning.history import History, read_evaluations

FLIPS = int(os.environ.get("TESTBED_FLIPS", "40"))
KILLS = int(os.environ.get("TESTBED_KILLS", "1"))
DISKS = int(os.environ.get("TESTBED_DISKS", "1"))
RUNS = 6
LONG = pytest.mark.skipif("TESTBED_KILLS" not in os.environ, reason="half a minute each: TESTBED_KILLS=20")


@pytest.fixture(autouse=True)
def real_pipeline():
    """The plug-in of these tests replaces two functions of the pipeline; put them back."""
    before = pipeline.fly, pipeline.sense
    yield
    pipeline.fly, pipeline.sense = before


def scenario(seed=1):
    return mc.scenario([mc.GOOD, mc.BAD], RUNS, seed=seed, claims=[mc.CLAIM])


def batch(out, resume=False):
    runner.run(scenario(), out, jobs=1, resume=resume, plugins=[mc.PLUGIN])


def batch_and_report(out, resume=False):
    batch(out, resume)
    render(out, svg=False)


def report_only(out, resume=False):
    render(out, svg=False)


def grid(out, resume=False):
    sweep(lambda o: scenario(o["seed"]), {"seed": [1, 2]}, out, resume=resume, jobs=1, plugins=[mc.PLUGIN])


def study(out, resume=False):
    import small_tuning

    from testbed.tuning import tune

    tune.tune(small_tuning.scenario(), out, jobs=1, resume=resume)


TIMED = ("timings.csv", "runs.parquet", "manifest.json", "report.html", "report.md", "report.json", "tables.tex")


def pure(folder):
    """Every file that is a function of scenario and seed: not the seconds, nor what shows or hashes them."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in TIMED)
    kept = [path for path in files if path.parent.name not in ("runs", "evaluations", "figures")]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in kept}


def differing(one, other):
    """Names of the files that are not in both with the same content."""
    return sorted(name for name in {*one, *other} if one.get(name) != other.get(name))


def whole(folder):
    """Every file, hidden ones too: for a job that only reads."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# flipped bits


def shown(*parts):
    """Numbers and texts as bytes that can be compared."""
    return [part.tobytes() if isinstance(part, np.ndarray) else repr(part) for part in parts]


def read_result(folder):
    result = load_result(folder)
    tables = (result.summary, result.claims, result.consistency, result.improvements, result.runs, result.envelopes)
    more = [
        result.per_run(["rmse_north_m"], "all"),
        result.truth,
        *result.errors.values(),
        *(table for aidings in result.innovations.values() for table in aidings.values()),
    ]
    return [table.to_csv() for table in (*tables, *more)] + shown(result.info, result.scenario, result.manifest)


def read_run(path, store):
    stored = decode(path, store.batch, int(path.stem))
    return shown(stored.run, stored.outcomes, stored.values, stored.keys.to_pydict(), *stored.series.values())


def fields(record):
    return shown(*(value for value in vars(record).values()))


def log_of(folder):
    log = SensorLog.load(folder)
    return shown(*(value for part in (log.imu, log.gnss, log.initial) for value in vars(part).values()))


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """(file, reader) of everything that is read back; a reader gives what it read in a form that can be compared."""
    before = pipeline.fly, pipeline.sense
    place = tmp_path_factory.mktemp("stored")
    batch(place / "result")
    pipeline.fly, pipeline.sense = before
    store = open_result(place / "result")
    out = [(path, lambda p=path: read_run(p, store)) for path in sorted((place / "result/runs").iterdir())]
    for path in sorted((place / "result").rglob("*")):
        if path.is_file() and path.parent.name != "runs":
            out.append((path, lambda: read_result(place / "result")))
    truth = weaving_flight(duration=20.0)
    truth.save(place / "truth.parquet")
    out.append((place / "truth.parquet", lambda: fields(Trajectory.load(place / "truth.parquet"))))
    flights.store(truth, place / "cached.parquet")
    out.append((place / "cached.parquet", lambda: fields(flights.load(place / "cached.parquet"))))
    keys = ("t", "lat", "lon", "h", "v_n", "q_nb")
    NavSolution(**{key: getattr(truth, key) for key in keys}).save(place / "solution.parquet")
    out.append((place / "solution.parquet", lambda: fields(NavSolution.load(place / "solution.parquet"))))
    sensor_log(truth).save(place / "log")
    out += [(path, lambda: log_of(place / "log")) for path in sorted((place / "log").iterdir())]
    history = History(place / "search.parquet", ["a", "b"], study="s")
    history.add(np.arange(40.0).reshape(20, 2), np.arange(20.0), 1.0)
    history.save()
    out.append((history.path, lambda: shown(*read_evaluations(history.path, ["a", "b"], "s"))))
    return out


def test_a_flipped_bit_is_refused_or_changes_nothing(stored):
    """Files drawn evenly, bits evenly within a file. A cached flight that is refused is flown again."""
    rng = np.random.default_rng(2)
    true = cache(lambda k: stored[k][1]())
    refused = 0
    for _ in range(FLIPS):
        k = int(rng.integers(len(stored)))
        path, read = stored[k]
        wanted, content = true(k), path.read_bytes()
        place = int(rng.integers(8 * len(content)))
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        try:
            assert read() == wanted, f"bit {place} of {path} changed what was read"
        except InputError as error:
            refused += path.name in str(error)
        except TypeError:
            assert path.name == "cached.parquet"  # None: no flight
            refused += 1
        finally:
            path.write_bytes(content)
    print(f"{FLIPS} flips in {len(stored)} files: {refused} refused, the others changed nothing")
    assert refused > FLIPS // 2


# kills


def in_a_copy(job, out, after=None):
    """Do ``job(out)`` in a copy of this process, killed after so many seconds; the seconds that it took."""
    process = get_context("fork").Process(target=job, args=(out,))
    start = time.monotonic()
    process.start()
    process.join(after)
    if process.is_alive():
        os.kill(process.pid, signal.SIGKILL)
    process.join()
    return time.monotonic() - start


@pytest.mark.parametrize(
    ("job", "look"),
    [(batch, pure), pytest.param(report_only, whole, marks=LONG), (grid, pure), pytest.param(study, pure, marks=LONG)],
)
def test_killed_at_any_moment_and_resumed_the_bytes_are_the_same(job, look, tmp_path):
    rng, place = np.random.default_rng(), tmp_path / "undisturbed"
    if job is report_only:
        batch(place)
    job(place)
    true = look(place)
    fresh = tmp_path / "fresh"
    if job is report_only:
        batch(fresh)
    seconds = in_a_copy(job, shutil.copytree(fresh, tmp_path / "timed") if fresh.exists() else tmp_path / "timed")
    cut = 0
    for k in range(KILLS):
        out = tmp_path / str(k)
        if job is report_only:
            shutil.copytree(place, out)
            job(out)
            true = look(out)
            for name in ("report.html", "tables.tex"):
                (out / name).unlink()
        after = float(rng.uniform(0.0, seconds))
        cut += in_a_copy(job, out, after) >= after
        job(out, resume=True)
        assert look(out) == true
        shutil.rmtree(out)
    print(f"{job.__name__}: {cut} of {KILLS} killed within {seconds:.1f} s, all the same bytes")


# full disks


def small_disk(folder, size_kb):
    """Mount a file system of this size at ``folder``, in a name space of this process alone; False where that is not allowed."""
    libc = ctypes.CDLL(None, use_errno=True)
    uid, gid = os.getuid(), os.getgid()
    if libc.unshare(0x10000000 | 0x20000):  # CLONE_NEWUSER | CLONE_NEWNS
        return False
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"0 {uid} 1")
    Path("/proc/self/gid_map").write_text(f"0 {gid} 1")
    return libc.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", 0, f"size={size_kb}k".encode()) == 0


def grow_disk(folder):
    """Make room again."""
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", 32, b"size=100m") == 0  # MS_REMOUNT


def _on_a_small_disk(folder, size_kb, wanted, answer):
    """In a copy of this process: fill the disk, look at what is there, make room, resume; ``answer`` gets the outcome."""
    try:
        mounted = small_disk(folder, size_kb)
        if not mounted:  # then no file may be larger than this
            resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * size_kb // RUNS, resource.RLIM_INFINITY))
        told, job = "went through", batch_and_report if DISKS > 1 else batch
        try:
            job(folder / "out")
        except TestbedError as error:
            told = str(error)
        left = [path.name for path in folder.rglob("*") if path.name.endswith(".tmp") or path.name == ".scratch"]
        for path in (folder / "out").glob("runs/*.parquet"):
            decode(path, open_result(folder / "out").batch)
        if mounted:
            grow_disk(folder)
        else:
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        job(folder / "out", resume=(folder / "out/manifest.json").exists())
        answer.send((mounted, told, left, differing(pure(folder / "out"), wanted)))
    except BaseException as error:
        answer.send((None, repr(error), [], ["all"]))
        raise


def test_a_full_disk_leaves_nothing_half_and_can_be_resumed(tmp_path):
    place, rng = tmp_path / "undisturbed", np.random.default_rng(3)
    (batch_and_report if DISKS > 1 else batch)(place)
    wanted = pure(place)
    total = sum(path.stat().st_size for path in place.rglob("*") if path.is_file()) // 1024
    context, stopped = get_context("fork"), 0
    for k in range(DISKS):
        folder = tmp_path / str(k)
        folder.mkdir()
        here, there = context.Pipe()
        size = int(rng.uniform(4 + k * total / DISKS, 4 + (k + 1) * total / DISKS))
        process = context.Process(target=_on_a_small_disk, args=(folder, size, wanted, there))
        process.start()
        assert here.poll(300.0)
        mounted, told, left, other = here.recv()
        process.join()
        assert not other and not left, (size, told)
        if told != "went through":
            stopped += 1
            assert ("the disk is full" if mounted else "File too large") in told and "\n" not in told
    print(f"{stopped} of {DISKS} sizes from 4 to {total} kB stopped the job, all the same bytes after a resume")
    assert stopped > DISKS // 3 or DISKS == 1


def _report_on_a_full_disk(folder, answer):
    """No file above 40 kB: in a copy of this process, which the limit ends with."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, resource.RLIM_INFINITY))
    try:
        render(folder, svg=False)
        answer.send("went through")
    except TestbedError as error:
        answer.send(str(error))


def test_a_report_that_does_not_fit_is_told_in_one_line_and_not_cut(tmp_path):
    folder = make_result(tmp_path / "r", runs=3)
    context = get_context("fork")
    here, there = context.Pipe()
    process = context.Process(target=_report_on_a_full_disk, args=(folder, there))
    process.start()
    assert here.poll(120.0)
    told = here.recv()
    process.join()
    assert "File too large" in told and "\n" not in told and str(folder) in told
    assert not (folder / "report.html").exists() and not list(folder.rglob("*.tmp"))
