"""A user's aircraft is tried in a child process before it flies: a bad model can abort the interpreter or never return.

The child loads the model, sets it up and takes a second of steps, as the flight will; what it dies of becomes one message.
"""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
from pathlib import Path

from testbed.base.errors import InputError
from testbed.base.resources import aircraft_root
from testbed.flight.cache import content_of
from testbed.flight.config import FlightConfig

LONGEST_S = 15.0
"""The trial of a sound model takes two seconds, most of it imports."""
REFUSED = 3
"""Exit code of a child whose message says what is wrong."""
STEPS = 200
_passed: set[str] = set()


def try_aircraft(config: FlightConfig, folder: Path) -> None:
    """Raise InputError where the aircraft in ``folder`` cannot be loaded and started; shipped ones are trusted.

    What has passed once in this process is not tried again.
    """
    if folder.parent == aircraft_root():
        return
    asked = json.dumps({"folder": str(folder.resolve()), "config": config.model_dump(mode="json", exclude_none=True)})
    key = hashlib.sha256(asked.encode() + content_of(folder)).hexdigest()
    if key in _passed:
        return
    command = [sys.executable, "-c", "from testbed.flight.trial import main; main()"]
    try:
        child = subprocess.run(
            command, input=asked, capture_output=True, text=True, errors="replace", timeout=LONGEST_S
        )
    except subprocess.TimeoutExpired:
        raise InputError(
            f"{folder}: JSBSim does not return from loading or starting it within {LONGEST_S:g} s"
        ) from None
    if child.returncode == REFUSED:
        raise InputError(child.stdout.strip())
    if child.returncode:
        raise InputError(f"{folder}: JSBSim breaks down when it loads or starts it ({_death(child)})")
    _passed.add(key)


def _death(child: subprocess.CompletedProcess[str]) -> str:
    """How a child ended: the signal, and what it said last."""
    code = child.returncode
    how = f"{signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    said = [line.strip() for line in (child.stderr + child.stdout).splitlines() if line.strip()]
    return f"{how}: {said[-1]}" if said else how


def main() -> None:
    """The child: reads what to try from stdin; says what is wrong on stdout and leaves with `REFUSED`."""
    from testbed.base.errors import TestbedError
    from testbed.flight.aircraft import load_aircraft
    from testbed.flight.driver import STEP_HZ
    from testbed.flight.simulator import Simulator

    asked = json.loads(sys.stdin.read())
    config = FlightConfig.model_validate(asked["config"])
    try:
        aircraft, folder = load_aircraft(asked["folder"])
        simulator = Simulator(config, aircraft, folder, 1.0 / STEP_HZ, seed=0)
        for _ in range(STEPS):
            simulator.run()
        simulator.set_wind(1.0)
        simulator.turbulence_on()
        for setter in (*simulator.surfaces, *simulator.throttles):
            setter(0.5)
        for _ in range(STEPS):
            simulator.run()
        for reader in (*simulator.state, *simulator.air, *simulator.motion, *simulator.place):
            reader()
    except TestbedError as error:
        print(error)
        sys.exit(REFUSED)
