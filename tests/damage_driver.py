"""Runs ``testbed`` command lines in copies of one warm process, each under a watchdog; JSON lines in, JSON lines out.

A request is ``{"argv": [...], "cwd": "...", "limit_s": 20}``, the answer ``{"code": 2, "said": "stderr", "hung": false}``.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Run one command line in a copy of this process."""
    with tempfile.TemporaryDirectory() as place:
        said = Path(place) / "stderr"
        child = os.fork()
        if child == 0:
            _be_testbed(request, said)
        code = _wait(child, float(request["limit_s"]))
        return {"code": code, "said": said.read_text(errors="replace") if said.exists() else "", "hung": code is None}


def _be_testbed(request: dict[str, Any], said: Path) -> None:
    """In the child: the command line, its output in files; never returns."""
    code: Any = 70  # an error that escaped `main`, as sysexits.h numbers it
    try:
        os.setsid()
        os.chdir(request["cwd"])
        for descriptor, file in ((0, os.devnull), (1, os.devnull), (2, str(said))):
            os.dup2(os.open(file, os.O_RDWR | os.O_CREAT), descriptor)
        sys.argv = ["testbed", *request["argv"]]
        from testbed import cli

        cli.main()
        code = 0
    except SystemExit as end:
        code = end.code
    except BaseException:
        import traceback

        traceback.print_exc()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 0 if code is None else 1)


def _wait(child: int, limit_s: float) -> int | None:
    """Exit code of the child; None after the limit, when it and what it started are killed."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def main() -> None:
    # what the copies share: without it each would import for two seconds
    import testbed.cli.commands
    import testbed.flight.driver
    import testbed.formats.importers
    import testbed.montecarlo.runner
    import testbed.report
    from testbed.data.registry import estimator_class

    testbed.report.preload()
    for name in ("ins", "indirect-kf"):
        estimator_class(name)
    for line in sys.stdin:
        print(json.dumps(answer(json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
