"""Memory of long flights, measured as the peak of a child process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PEAK = """
import resource, sys
from flights import flight, turn
from testbed.flight import fly_flight
rate = float(sys.argv[2])
short = fly_flight(flight("aerosonde", 30.0, turn(20.0, 300.0), rate_hz=rate), 0, False)
rows = len(short.t)
del short
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
truth = fly_flight(flight("aerosonde", 30.0, turn(20.0, float(sys.argv[1])), rate_hz=rate), 0, False)
print(len(truth.t), len(truth.t) - rows, before * 1024, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""
HELD = 30 * 8
"""Bytes of a row of the truth: 17 columns of motion, 13 of air data and controls."""
linux = pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux")


def flown(seconds: float, rate_hz: float) -> list[int]:
    """Rows, how many more than of a flight of 300 s before it, and the peak in bytes before and after the flight."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, "-c", PEAK, str(seconds), str(rate_hz)]
    child = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return [int(part) for part in child.stdout.split()]


@linux
def test_a_flight_takes_little_more_than_its_rows():
    """The rows themselves, the air data at 25 Hz (10 bytes a row) and a column or two that are being made; the splines' blocks
    are those of the flight before."""
    _, more, before, after = flown(1500.0, 250.0)
    assert after - before < 1.25 * HELD * more


@linux
@pytest.mark.skipif("TESTBED_FULL_COUNTS" not in os.environ, reason="two minutes: TESTBED_FULL_COUNTS=1")
def test_nine_hours_at_the_step_of_the_flight_take_a_gibibyte():
    """Splined at JSBSim's 400 Hz, with rows at 100 Hz: 3.24 million, 742 MiB of them, and what Python and JSBSim take."""
    rows, _, _, after = flown(9 * 3600.0, 100.0)
    assert rows == 9 * 360_000 + 1 and after < 2**30
