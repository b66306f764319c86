"""The command line as a user meets it: one message per mistake, the right exit code, nothing half-written."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

FLIGHT = """
[scenario]
name = "broken"
[flight]
aircraft = "aerosonde"
initial = { speed_mps = 30.0 }
manoeuvres = [{ type = "straight", duration_s = 5.0 }]
[sensors.imu]
model = "ADIS16448"
[sensors.gnss]
model = "Garmin16x"
outages = [[2.0, 3.0]]
[[estimators]]
name = "ins"
[monte_carlo]
runs = 1
"""
RECORDING = """
[scenario]
name = "broken"
[recording]
format = "navego"
dir = "."
[[estimators]]
name = "ins"
"""


def command_line(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "testbed.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


def check_refused(done: subprocess.CompletedProcess[str], folder: Path, code: int, *words: str) -> None:
    """One message of at most three lines with all of ``words``, the code, no traceback, no result folder."""
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    assert len(done.stderr.strip().splitlines()) <= 3
    for word in words:
        assert word in done.stderr
    assert not list(folder.glob("out*"))
    assert not list(folder.glob(".out*"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("speed_mps", "speed_kmh", ["flight.initial.speed_kmh", "speed_mps"]),
        ("runs = 1", 'runs = "many"', ["monte_carlo.runs", "'many'"]),
        ("[sensors.imu]", "[sensors.imu]\nrate_hz = -100.0", ["sensors.imu.rate_hz", "-100"]),
        ('"aerosonde"', '"aerosond"', ["aerosond", "aerosonde"]),
        ('name = "ins"', 'name = "inss"', ["estimators.0", "'inss'", "'ins'"]),
        ("[[2.0, 3.0]]", "[[8.0, 9.0]]", ["outage", "8", "5"]),
        ("speed_mps = 30.0", "speed_mps = nan", ["flight.initial.speed_mps", "finite"]),
        ('[{ type = "straight", duration_s = 5.0 }]', "[]", ["flight.manoeuvres", "at least 1"]),
        ('"Garmin16x"', '"Garmin16"', ["Garmin16x"]),
    ],
)
def test_broken_scenarios_are_refused(tmp_path, old, new, words):
    assert old in FLIGHT
    (tmp_path / "broken.toml").write_text(FLIGHT.replace(old, new))
    done = command_line("run", "broken.toml", "--out", "out", cwd=tmp_path)
    check_refused(done, tmp_path, 2, "broken.toml", *words)


def test_missing_file_is_refused(tmp_path):
    check_refused(
        command_line("run", "absent.toml", "--out", "out", cwd=tmp_path), tmp_path, 2, "absent.toml", "no such"
    )
    (tmp_path / "broken.toml").write_text(RECORDING)
    done = command_line("run", "broken.toml", "--out", "out", cwd=tmp_path)
    check_refused(done, tmp_path, 2, "imu")


def test_corrupt_recording_is_refused(tmp_path):
    (tmp_path / "imu.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(range(256)) * 3)
    (tmp_path / "broken.toml").write_text(RECORDING)
    done = command_line("run", "broken.toml", "--out", "out", cwd=tmp_path)
    check_refused(done, tmp_path, 2, "imu.mat")


def test_recording_with_decreasing_time_is_refused(tmp_path):
    from scipy.io import savemat

    t = 0.01 * np.arange(100.0)
    t[60] = 0.2
    struct = {"t": t, "fb": np.tile([0, 0, -9.8], (100, 1)), "wb": np.zeros((100, 3)), "freq": 100.0}
    savemat(tmp_path / "imu.mat", {"imu": struct})
    (tmp_path / "broken.toml").write_text(RECORDING)
    done = command_line("run", "broken.toml", "--out", "out", cwd=tmp_path)
    check_refused(done, tmp_path, 2, "imu.mat", "time must increase", "sample 60")


def test_a_flight_that_fails_in_the_air_names_manoeuvre_and_time(tmp_path):
    """A small UAV told to descend into the ground: an impossible manoeuvre is bad input, found out in the air or before."""
    script = '[{ type = "descent", climb_rate_mps = 5.0, duration_s = 100.0 }]'
    text = FLIGHT.replace('[{ type = "straight", duration_s = 5.0 }]', script)
    text = text.replace("speed_mps = 30.0", "speed_mps = 30.0, alt_m = 50.0")
    (tmp_path / "broken.toml").write_text(text)
    done = command_line("run", "broken.toml", "--out", "out", cwd=tmp_path)
    check_refused(done, tmp_path, 2, "broken.toml", "descent", " s")


def test_help_and_lists_need_no_heavy_import(tmp_path):
    """``testbed --help`` must not import numba, pandas, torch, scipy, jsbsim or matplotlib."""
    code = (
        "import sys; sys.argv = ['testbed', '--help']\n"
        "from testbed.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print([m for m in ('numba', 'pandas', 'torch', 'scipy', 'jsbsim', 'matplotlib', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip().endswith("[]")
    for what, word in (
        ("scenarios", "quickstart"),
        ("aircraft", "aerosonde"),
        ("sensors", "ADIS16448"),
        ("estimators", "ins"),
    ):
        assert word in command_line("list", what, cwd=tmp_path).stdout


def test_no_help_line_loses_what_stands_in_brackets():
    """The help is printed with markup, in which [columns] would be a style, and vanish."""
    import typer.main

    from testbed.cli import app

    for name, command in typer.main.get_command(app.app).commands.items():
        for parameter in command.params:
            assert "[" not in (getattr(parameter, "help", None) or ""), (name, parameter.name)


def test_the_time_left_counts_from_the_first_run(monkeypatch, capsys):
    """Compilation before the first run is no part of the rate: 100 s, then a run a second."""
    from testbed.cli.console import progress_line

    now = iter([0.0, 0.0, *(t for k in range(1, 11) for t in [100.0 + k] * 3)])
    monkeypatch.setattr("time.monotonic", lambda: next(now))
    monkeypatch.setattr("sys.stderr.isatty", lambda: False, raising=False)
    with progress_line("runs") as tell:
        tell(0, 10)
        for done in (1, 2):
            tell(done, 10)
    told = capsys.readouterr().err.splitlines()
    assert told[-1].startswith("runs: 2 of 10") and "left" not in told[0]
    assert 1.0 <= float(told[-1].split(", ")[-1].removesuffix(" s left")) <= 10.0


def test_runs_that_are_done_at_once_say_nothing_of_the_time_left(monkeypatch, capsys):
    """Eight runs side by side in 7 s, then the next eight in 5 s: of twenty the last four take 2.5 s more, not none."""
    from testbed.cli.console import progress_line

    clock = 0.0
    monkeypatch.setattr("time.monotonic", lambda: clock)
    monkeypatch.setattr("sys.stderr.isatty", lambda: False, raising=False)
    with progress_line("runs") as tell:
        tell(0, 20)
        for k in range(1, 17):
            clock = (7.0 if k <= 8 else 12.0) + 0.001 * k
            tell(k, 20)
    told = capsys.readouterr().err.splitlines()
    assert told[4].startswith("runs: 8 of 20, 7 s") and not any("left" in line for line in told[:5])
    assert told[-1] in ("runs: 16 of 20, 12 s, 1 s left", "runs: 16 of 20, 12 s, 2 s left")
