"""The wheel: built, installed into a folder of its own, and run from there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder of an installation from the wheel, without what it depends on."""
    pytest.importorskip("hatchling")
    place = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", place, ROOT], check=True)
    (wheel,) = place.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", place / "site", wheel], check=True)
    return place / "site"


def test_it_holds_what_the_sources_hold(installed):
    for package in ("testbed", "estimators"):
        here = {path.relative_to(ROOT) for path in (ROOT / package).rglob("*.py")}
        there = {path.relative_to(installed) for path in (installed / package).rglob("*.py")}
        assert here == there
    for data in ("aircraft", "scenarios"):
        here = {path.relative_to(ROOT) for path in (ROOT / data).rglob("*") if path.is_file()}
        there = {
            p.relative_to(installed / "testbed" / "_data") for p in (installed / "testbed" / "_data" / data).rglob("*")
        }
        assert here and here <= there


@pytest.mark.parametrize(
    ("arguments", "shown"),
    [
        ("list scenarios", "imm-rstekf-2023"),
        ("list aircraft", "aerosonde"),
        ("list estimators eskf", "gyro-misalignment"),
        ("new policy mine", "mine.py"),
        ("run quickstart --set sensors.imu.rate=1", "'rate_hz'"),
    ],
)
def test_it_runs_from_there(installed, tmp_path, arguments, shown):
    """In a folder that has none of the sources; the last reads a scenario whole and refuses a key of it."""
    environment = os.environ | {"PYTHONPATH": str(installed)}
    code = "import sys, testbed; from testbed.cli import main; print(testbed.__file__); sys.argv[0] = 'testbed'; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments.split()], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == (2 if "--set" in arguments else 0), done.stderr
    assert done.stdout.startswith(str(installed))
    assert shown in done.stdout + done.stderr
