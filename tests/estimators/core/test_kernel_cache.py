"""Compiled code never goes stale: the folder that numba uses follows the sources."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from testbed import kernel_cache

ROOT = Path(__file__).resolve().parents[3]
CALLER = """
import os, sys
sys.path.insert(0, sys.argv[1])
{first}
from estimators.core.strapdown import coning_sculling
from testbed.data.registry import load_plugin
load_plugin(sys.argv[2])
from testbed_plugin_mine import twice_cross
x, y, zero = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)
print(12.0 * coning_sculling(y, zero, x, zero)[0][2], twice_cross(x, y), os.environ["NUMBA_CACHE_DIR"])
"""
PLUGIN = """
from numba import njit
from testbed.physics.rotations import cross


@njit(cache=True)
def twice_cross(a, b):
    return 2.0 * cross(a, b)[2]


class Mine:
    name = "mine"

    def run(self, log):
        raise NotImplementedError
"""


def clean_environment(**more):
    """As from a shell: without the folder that this process uses."""
    return {k: v for k, v in os.environ.items() if not k.endswith("NUMBA_CACHE_DIR")} | more


@pytest.fixture
def copy(tmp_path):
    """Both packages in a folder of their own, and how to call kernels there in a new process."""
    for package in kernel_cache.PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__", "_data"))
    (tmp_path / "mine.py").write_text(PLUGIN)

    def call(first="", **environment):
        """What an installed kernel and a plug-in's make of x cross y, and where they are kept."""
        done = subprocess.run(
            [sys.executable, "-c", CALLER.format(first=first), str(tmp_path), str(tmp_path / "mine.py")],
            env=clean_environment(**environment),
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
        )
        installed, plugin, folder = done.stdout.split()
        return float(installed), float(plugin), Path(folder)

    return tmp_path, call


def compiled(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.nb[ic]")}


def test_an_edited_callee_changes_its_callers(copy):
    """A kernel of `estimators.core.strapdown` and one of a plug-in call `testbed.physics.rotations.cross`; neither's own file changes."""
    folder, call = copy
    *values, before = call()
    assert values == [1.0, 2.0]
    kept = compiled(before)
    assert any("strapdown" in path.name for path in kept) and any("mine" in path.name for path in kept)
    assert call()[2] == before and compiled(before) == kept  # nothing is compiled twice
    source = folder / "testbed" / "physics" / "rotations.py"
    text = source.read_text()
    source.write_text(text.replace("a[0] * b[1] - a[1] * b[0])", "3.0 * (a[0] * b[1] - a[1] * b[0]))"))
    *values, after = call(first="import numba")
    assert values == [3.0, 6.0] and after != before
    source.write_text(text)
    assert call()[2] == before and compiled(before) == kept


def test_the_users_own_folder_is_respected(copy, tmp_path):
    _, call = copy
    own = tmp_path / "own"
    assert call(NUMBA_CACHE_DIR=str(own))[2] == own
    assert any("strapdown" in path.name for path in compiled(own))


def test_children_know_the_folder_of_their_parent_from_a_users(copy):
    """A worker of a process whose sources were edited since chooses by the sources that it reads itself."""
    folder, call = copy
    elsewhere = str(folder / "kernels-of-the-parent")
    assert call(NUMBA_CACHE_DIR=elsewhere, TESTBED_NUMBA_CACHE_DIR=elsewhere)[2].parent.name == "kernels"


def test_workers_use_the_same_folder():
    """Spawned ones choose it again, forked ones have it."""
    code = "import testbed, os; print(os.environ['NUMBA_CACHE_DIR'])"
    spawned = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert spawned.stdout.strip() == os.environ["NUMBA_CACHE_DIR"]
    import numba

    assert os.environ["NUMBA_CACHE_DIR"] == numba.config.CACHE_DIR


def test_old_folders_go_but_those_in_use_stay(tmp_path):
    now = 1e9
    ages = {"a": 5e5, "b": 4e5, "c": 3e5, "d": 2e5, "e": 1e5}
    for name, age in ages.items():
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (now - age, now - age))
    (tmp_path / "sources.json").write_text("{}")
    kernel_cache.prune(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c", "d", "e", "sources.json"]
    for name in "cdefg":
        (tmp_path / name).mkdir(exist_ok=True)
        os.utime(tmp_path / name)
    kernel_cache.prune(tmp_path)
    assert len(list(tmp_path.iterdir())) == 6


def test_what_counts_as_a_source():
    """Every file with compiled functions; not the command line or the report, whose edits must not cost minutes."""
    sources = {name: path.read_bytes() for name, path in kernel_cache._files().items()}
    chosen = kernel_cache.kernel_sources(sources)
    assert {name for name, text in sources.items() if b"@njit" in text or b"def measure_" in text} <= chosen
    assert not chosen & {"testbed.cli", "testbed.report.page", "estimators.methods.eskf", "testbed.tuning.tune"}
    before = kernel_cache.hash_of(sources)
    for name, same in (
        ("testbed.cli", True),
        ("testbed.physics.earth", False),
        ("estimators.aiding.baro", False),
        ("numba", False),
    ):
        assert (kernel_cache.hash_of(sources | {name: sources[name] + b"\n# changed"}) == before) is same


WITH_LANES = """
from numba import njit
from testbed.kernels.lanes import splat
from testbed.physics.rotations import wrap

@njit
def wrapped(x):
    wrap(splat(x))
    return wrap(x)

wrapped(1.0)
"""
WITHOUT = """
import numpy as np
from testbed.flight.autopilot_kernels import step
step(np.ones(200), np.ones(100))
"""


def test_a_row_of_the_league_recompiles_nothing_but_itself():
    """It is a plug-in: numba keeps what is compiled of it by its own file."""
    modules = kernel_cache._files()
    assert "estimators.league" in modules and "estimators.policies.gate" in modules
    assert (ROOT / "estimators" / "league" / "gain-gru" / "gain_gru.py").is_file()
    assert not [module for module in modules if module.startswith("estimators.league.")]


def test_code_compiled_for_lanes_is_loaded_where_nobody_asked_for_them(tmp_path):
    """`wrap` in the cache knows lanes; `step` is compiled anew and loads it in the middle. numba ended with KeyError."""
    for code in (WITH_LANES, WITHOUT):
        environment = clean_environment(NUMBA_CACHE_DIR=str(tmp_path / "kernels"))
        done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert any("wrap" in path.name for path in compiled(tmp_path))


def test_news_name_the_latest_kernel(tmp_path, monkeypatch):
    """By the files that numba itself writes: a function of this name is compiled into an empty folder."""
    environment = clean_environment(NUMBA_CACHE_DIR=str(tmp_path))
    subprocess.run([sys.executable, "-c", WITH_LANES], env=environment, cwd=ROOT, check=True)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    written = [path.stat().st_mtime for path in tmp_path.glob("*/*.nbi")]
    assert kernel_cache.news_of(min(written) - 1.0)() == f"{len(written)} kernels compiled, last wrap"
    assert kernel_cache.news_of(max(written) + 1.0)() == ""


def test_no_kernel_is_compiled_by_numba_directly():
    sources = {
        name: path.read_text() for name, path in kernel_cache._files().items() if name.startswith(kernel_cache.PACKAGES)
    }
    found = [
        name for name, text in sources.items() if re.search(r"^from numba import .*\b(njit|cfunc|jit)\b", text, re.M)
    ]
    assert sorted(found) == ["testbed.kernels", "testbed.kernels.lane_functions"]
