"""The process in which a Python entry answers: ``python -m testbed.league.child JOB``, with the folder JOB and nothing else.

JOB holds ``job.json`` (estimator, parameters, plug-in, numbers of the logs), ``logs/000000`` and so on as `SensorLog.save`
writes them, and takes ``answers/000000.npz`` with ``000000.json``: how it ended, and the seconds. No seed, no scenario, no
cache of flights.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.child_processes import end_with_standard_input
from testbed.base.errors import InputError
from testbed.base.files import write_json, write_with
from testbed.base.guarded import reason_of, timed
from testbed.base.time_limit import TimeLimitError, single_threaded
from testbed.data.records import ATTITUDE_STATES, NAVIGATION_STATES, NavSolution, SensorLog
from testbed.data.registry import load_plugin, make_estimator

COLD_S = 60.0
"""Added to the time limit of a process's first log, in which kernels are compiled and networks loaded."""
ARRAYS = ("t", "lat", "lon", "h", "v_n", "q_nb")


def main(job: Path) -> None:
    """Answer every log of a job."""
    told: dict[str, Any] = json.loads((job / "job.json").read_text(encoding="utf-8"))
    with single_threaded():
        reference = None
        for place, run in enumerate(told["runs"]):
            log = SensorLog.load(job / "logs" / run)
            outcome = _answer(told, log, job / "answers" / f"{run}.npz", COLD_S if place == 0 else 0.0)
            if reference is None:
                reference = reference_us(told["reference"], log)
            write_json(job / "answers" / f"{run}.json", outcome | {"reference_us": reference})


def reference_us(name: str, log: SensorLog) -> float:
    """Microseconds per sample of an estimator on a log, the better of two times."""
    return 1e6 / len(log.imu.t) * min(timed(make_estimator(name).run, log, None)[1] for _ in range(2))


def _answer(told: dict[str, Any], log: SensorLog, path: Path, extra_s: float) -> dict[str, Any]:
    """Run the estimator on one log and keep its answer; status, reason and seconds."""
    try:
        estimator = make_estimator(_estimator(told), **told["params"])
        solution, seconds = timed(estimator.run, log, told["timeout_s"] + extra_s)
        if not isinstance(solution, NavSolution):
            raise InputError(f"run(log) returned {type(solution).__name__}, not a NavSolution")
        write_with(path, lambda buffer: np.savez(buffer, **as_arrays(solution, told["keep_hz"])))
    except TimeLimitError:
        return {"status": "timeout", "reason": f"no answer within {told['timeout_s']:g} s", "us": None}
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return {"status": "failed", "reason": reason_of(error), "us": None}
    return {"status": "ok", "reason": "", "us": 1e6 * seconds / len(log.imu.t)}


def _estimator(told: dict[str, Any]) -> str:
    """Name of the estimator, after the plug-in that may hold it is loaded."""
    if told["plugin"] is None:
        return str(told["estimator"])
    if "loaded" not in told:
        told["loaded"] = load_plugin(told["plugin"])
    names: list[str] = told["loaded"]
    if told["estimator"]:
        return str(told["estimator"])
    if len(names) != 1:
        raise InputError(
            f"'plugin.estimator' must name one of {', '.join(names) or 'the estimators'}: the file has {len(names)}"
        )
    return names[0]


def as_arrays(solution: NavSolution, keep_hz: float | None) -> dict[str, Any]:
    """What of an answer is scored, as plain arrays: motion and sigmas at no more than ``keep_hz``, and covariances of it."""
    rows = slice(None)
    if keep_hz is not None and len(solution.t) > 2:
        step = float(np.median(np.diff(solution.t)))
        rows = slice(None, None, max(1, int(1.0 / (keep_hz * step) + 1e-6)))
    out: dict[str, Any] = {name: np.asarray(getattr(solution, name))[rows] for name in ARRAYS}
    named = list(solution.states)
    kept = [k for k, name in enumerate(named) if name in NAVIGATION_STATES]
    out["states"] = np.array([named[k] for k in kept], dtype=np.str_)
    if solution.std is not None and kept:
        out["std"] = np.asarray(solution.std)[rows][:, kept]
    if solution.covariance is not None and solution.covariance_t is not None and kept:
        out["covariance_t"] = np.asarray(solution.covariance_t)
        out["covariance"] = np.asarray(solution.covariance)[:, kept][:, :, kept]
    return out


def from_arrays(path: Path) -> NavSolution:
    """The solution that `as_arrays` made. Raises InputError or ValueError for anything else."""
    with np.load(path, allow_pickle=False) as held:
        found = {name: held[name] for name in held.files}
    states = tuple(str(name) for name in found.pop("states"))
    return NavSolution(**found, states=states)


def attitude_only(solution: NavSolution) -> NavSolution:
    """An answer of which only the attitude counts: without the states of position and velocity."""
    kept = [k for k, name in enumerate(solution.states) if name in ATTITUDE_STATES]
    changes: dict[str, Any] = {"states": tuple(solution.states[k] for k in kept) or ATTITUDE_STATES}
    changes["std"] = None if solution.std is None else solution.std[:, kept]
    if solution.covariance is not None:
        changes["covariance"] = solution.covariance[:, kept][:, :, kept]
        changes["covariance_t"] = solution.covariance_t
    plain = {name: getattr(solution, name) for name in ARRAYS}
    return NavSolution(**plain, **changes)


if __name__ == "__main__":
    end_with_standard_input()
    main(Path(sys.argv[1]))
