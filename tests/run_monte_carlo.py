"""A batch in a process of its own, to be killed by the tests of resuming: OUT RUNS JOBS [--resume] [SCHEDULER]."""

from __future__ import annotations

import sys

import monte_carlo as mc

from testbed.base.errors import TestbedError
from testbed.montecarlo import runner

if __name__ == "__main__":
    out, runs, jobs, *rest = sys.argv[1:]
    addresses = [word for word in rest if "://" in word]
    try:
        runner.run(
            mc.slow_scenario(int(runs)),
            out,
            jobs=int(jobs),
            resume="--resume" in rest,
            scheduler=addresses[0] if addresses else None,
            plugins=[mc.PLUGIN],
        )
    except TestbedError as error:
        sys.exit(str(error))
