"""Wheel and source distribution in a fresh virtual environment, without torch and from an empty folder: the quickstart runs.

Some minutes of downloads and compilation, so only where ``TESTBED_SLOW`` is set.
"""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif("TESTBED_SLOW" not in os.environ, reason="takes minutes; TESTBED_SLOW=1 runs it")
WHEEL_MB = 10.0
QUIET = ["--quiet", "--disable-pip-version-check"]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder with both distributions; the sdist is made first and the wheel of it, as an index would."""
    pytest.importorskip("hatchling")
    out = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", out], cwd=ROOT, check=True)
    (sdist,) = out.glob("*.tar.gz")
    subprocess.run([sys.executable, "-m", "pip", "wheel", *QUIET, "--no-deps", "--wheel-dir", out, sdist], check=True)
    return out


def test_the_wheel_is_small(built):
    (wheel,) = built.glob("*.whl")
    assert wheel.stat().st_size < 1e6 * WHEEL_MB


@pytest.mark.parametrize("kind", ["*.whl", "*.tar.gz"])
def test_it_installs_and_runs_in_a_fresh_environment(built, tmp_path, kind):
    """The core alone: no torch comes along, and every Kalman filter of the quickstart answers."""
    (file,) = built.glob(kind)
    venv.create(tmp_path / "venv", with_pip=True)
    python, elsewhere = tmp_path / "venv" / "bin" / "python", tmp_path / "elsewhere"
    elsewhere.mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "NUMBA", "TESTBED"))}
    environment["TESTBED_CACHE"] = str(tmp_path / "cache")

    def call(*words: object) -> str:
        done = subprocess.run(
            [str(word) for word in words], cwd=elsewhere, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    call(python, "-m", "pip", "install", *QUIET, "-c", ROOT / "constraints.txt", file)
    assert "torch" not in call(python, "-m", "pip", "list").lower()
    testbed = python.with_name("testbed")
    assert "city-partial" in call(testbed, "list", "scenarios")
    table = call(testbed, "run", "quickstart", "--profile", "smoke", "--no-report", "--out", "result")
    for row in ("ins", "update-ins", "indirect-kf", "direct-ekf", "direct-ukf"):
        assert f"│ {row} " in table
    assert (elsewhere / "result" / "summary.csv").is_file()
