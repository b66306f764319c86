"""Whole jobs, each measured in a process of its own: wall time and peak of the resident memory, stage by stage.

``python reports/studies/benchmark_jobs.py NAME ARGUMENTS`` is one such process: it does the job and prints a line of JSON. The
calls are made by `benchmarks`. Seconds, MiB.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
STATES = (3, 6, 9, 12, 15, 18, 21, 24, 30, 36, 45, 60)
TINY = """[scenario]
name = "tiny"
[flight]
aircraft = "aerosonde"
rate_hz = 50.0
initial = { lat_deg = 47.0, lon_deg = 11.0, alt_m = 1000.0, speed_mps = 30.0, heading_deg = 60.0 }
[[flight.manoeuvres]]
type = "turn"
bank_deg = 30.0
duration_s = 10.0
[sensors.imu]
model = "ADIS16448"
[sensors.gnss]
model = "Garmin16x"
[[estimators]]
name = "indirect-kf"
[monte_carlo]
runs = 1
seed = 1
"""


def peak_mib() -> float:
    """Largest resident memory of this process so far, MiB."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024.0
    except (OSError, StopIteration):
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 1024.0)


def child(name: str, *arguments: object) -> dict[str, Any]:
    """Do a job of this module in a process of its own; what it printed."""
    command = [sys.executable, str(Path(__file__).resolve()), name, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def command_seconds(command: Sequence[str], rounds: int) -> dict[str, Any]:
    """Median and least wall time of a command, after one round that warms the disk's cache."""
    times = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        times.append(time.perf_counter() - start)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return {"median_s": statistics.median(times[1:]), "min_s": min(times[1:]), "rounds": rounds}


def testbed_command() -> str:
    """The installed command of this interpreter's environment."""
    return str(Path(sys.executable).parent / "testbed")


def measure_jobs() -> dict[str, Any]:
    """Start-up, the quickstart warm and on a fresh machine, and where a warm quickstart spends its seconds."""
    testbed, python = testbed_command(), sys.executable
    found: dict[str, Any] = {
        "help": command_seconds([testbed, "--help"], 9),
        "python": command_seconds([python, "-c", "pass"], 9),
        "import": command_seconds([python, "-c", "import testbed"], 9),
        "list": command_seconds([testbed, "list", "scenarios"], 5),
    }
    with tempfile.TemporaryDirectory() as scratch:
        run = [testbed, "run", "quickstart", "--out", f"{scratch}/warm"]
        found["quickstart"] = command_seconds(run, 5)
        found["report"] = command_seconds([testbed, "report", f"{scratch}/warm"], 3)
        fresh = {"TESTBED_CACHE": f"{scratch}/cache", "NUMBA_CACHE_DIR": f"{scratch}/numba"}
        start = time.perf_counter()
        cold = [testbed, "run", "quickstart", "--out", f"{scratch}/cold"]
        done = subprocess.run(cold, capture_output=True, text=True, cwd=ROOT, env=os.environ | fresh, check=True)
        found["first_run"] = {"seconds": time.perf_counter() - start, "told": "compiling" in done.stderr}
    found["stages"] = child("stages")
    return found


def measure_memory() -> dict[str, Any]:
    """Flights of 9 h at 50 Hz and 3 h at 200 Hz: fly, sense, estimate, score in one process."""
    return {f"{hours} h at {rate} Hz": child("flight", hours * 3600, rate) for hours, rate in ((9, 50), (3, 200))}


def measure_scale() -> dict[str, Any]:
    """Cost against length of flight, number of runs, number of estimators and number of states."""
    return {
        "length": {str(60 * m): child("flight", 60 * m, 50) for m in (1, 3, 10, 30, 100, 300, 600)},
        "runs": {str(n): child("runs", n) for n in (1, 3, 10, 30, 100, 300, 1000)},
        "estimators": {str(n): child("estimators", n) for n in (1, 2, 4, 8, 16)},
        "states": child("states"),
    }


def measure_many_runs() -> dict[str, Any]:
    """The tiny scenario, ten thousand times."""
    return {str(n): child("runs", n) for n in (100, 1000, 10_000)}


def measure_monte_carlo(runs: int = 1000) -> dict[str, Any]:
    """``imm-rstekf-2023`` with its seven filters, report included, from the command line on two cores."""
    chosen = "KF,EKF,UKF,STEKF,RSTEKF,IMM-EKF,IMM-RSTEKF"
    with tempfile.TemporaryDirectory() as scratch:
        base = [testbed_command(), "run", "imm-rstekf-2023", "--estimators", chosen, "--jobs", "2"]
        subprocess.run([*base, "--runs", "2", "--out", f"{scratch}/warm"], capture_output=True, cwd=ROOT, check=True)
        start = time.perf_counter()
        command = [*base, "--runs", str(runs), "--out", f"{scratch}/out"]
        subprocess.run(command, capture_output=True, cwd=ROOT, check=True)
        return {"runs": runs, "estimators": len(chosen.split(",")), "seconds": time.perf_counter() - start}


def measure_tests() -> dict[str, Any]:
    """The test suite on two cores."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "pytest", "-n", "2"], capture_output=True, text=True, cwd=ROOT)
    return {
        "seconds": time.perf_counter() - start,
        "passed": done.returncode == 0,
        "last": done.stdout.splitlines()[-1],
    }


class Stages:
    """Seconds and peak memory of the stages of a job."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.peak: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start
        self.peak[name] = peak_mib()

    def table(self) -> dict[str, Any]:
        """As JSON."""
        return {"seconds": self.seconds, "peak_mib": self.peak}


def flight(duration_s: str, rate_hz: str) -> dict[str, Any]:
    """Fly without the cache, sense, filter, score: one long flight of turns and straights."""
    from testbed.base.schema import validate
    from testbed.data.registry import make_estimator
    from testbed.flight import FlightConfig, fly_flight
    from testbed.scenario.windows import Window
    from testbed.scoring import metrics
    from testbed.sensors import sense_flight
    from testbed.sensors.config import InitialConfig
    from testbed.sensors.registry import SensorsConfig

    def job(duration: float, stage: Stages) -> int:
        legs = [{"type": "turn", "bank_deg": bank, "duration_s": 30.0} for bank in (30.0, -30.0)] * 1000
        start = {"lat_deg": 47.0, "lon_deg": 11.0, "alt_m": 1000.0, "speed_mps": 30.0, "heading_deg": 60.0}
        keys = {"aircraft": "aerosonde", "rate_hz": float(rate_hz), "duration_s": duration, "initial": start}
        config = validate(FlightConfig, keys | {"manoeuvres": legs}, "flight")
        table = {"imu": {"model": "ADIS16448"}, "gnss": {"model": "Garmin16x"}}
        sensors = validate(SensorsConfig, table, "sensors")
        estimator = make_estimator("indirect-kf")
        with stage("fly"):
            truth = fly_flight(config, use_cache=False)
        with stage("sense"):
            log, errors = sense_flight(sensors, InitialConfig(), truth, 0, 0)
        with stage("estimate"):
            solution = estimator.run(log)
        with stage("score"):
            metrics.score(truth, solution, [Window("all", ((-1.0, duration),))], errors=errors, gnss=log.gnss)
        return len(truth.t)

    job(20.0, Stages())
    stage = Stages()
    started = peak_mib()
    samples = job(float(duration_s), stage)
    return stage.table() | {"samples": samples, "start_mib": started}


def runs(count: str) -> dict[str, Any]:
    """So many runs of the tiny scenario in this process, stored and aggregated."""

    def job(scenario: Any, folder: str, number: int) -> float:
        from testbed.montecarlo.runner import run

        start = time.perf_counter()
        run(scenario, folder, runs=number, jobs=1)
        return time.perf_counter() - start

    with tempfile.TemporaryDirectory() as scratch:
        scenario = _tiny(Path(scratch), 1)
        job(scenario, f"{scratch}/warm", 2)
        seconds = job(scenario, f"{scratch}/out", int(count))
    return {"seconds": seconds, "peak_mib": peak_mib()}


def estimators(count: str) -> dict[str, Any]:
    """Ten runs of the tiny scenario with so many rows."""
    from testbed.montecarlo.runner import run

    with tempfile.TemporaryDirectory() as scratch:
        scenario = _tiny(Path(scratch), int(count))
        run(scenario, f"{scratch}/warm", runs=1, jobs=1)
        start = time.perf_counter()
        run(scenario, f"{scratch}/out", runs=10, jobs=1)
        return {"seconds": time.perf_counter() - start, "peak_mib": peak_mib()}


def _tiny(folder: Path, rows: int) -> Any:
    from testbed.scenario import load_scenario

    text = TINY
    for k in range(1, rows):
        text += f'[[estimators]]\nname = "indirect-kf"\nlabel = "copy {k}"\n'
    path = folder / "tiny.toml"
    path.write_text(text, encoding="utf-8")
    return load_scenario(str(path))


def states() -> dict[str, Any]:
    """Microseconds per step of what a filter of n states does: propagate P, an update with three fixes, sigma points."""
    import numpy as np

    sys.path.insert(0, str(ROOT))
    from tests.benchmarks.arithmetic import triple_products
    from tests.benchmarks.state_loops import unscented_transforms, updates

    found: dict[str, dict[str, float]] = {"propagate": {}, "update": {}, "sigma_points": {}}
    for n in STATES:
        phi = np.eye(n) + 1e-9
        jobs: dict[str, Callable[[int], Any]] = {
            "propagate": lambda count, phi=phi, n=n: triple_products(phi, np.eye(n), count),  # type: ignore[misc]
            "update": lambda count, n=n: updates(n, 3, count),  # type: ignore[misc]
            "sigma_points": lambda count, n=n: unscented_transforms(n, count),  # type: ignore[misc]
        }
        for name, job in jobs.items():
            found[name][str(n)] = _microseconds(job)
    return found


def _microseconds(job: Callable[[int], Any]) -> float:
    """Least time of a step among five series of some 20 ms."""

    def seconds(count: int) -> float:
        start = time.perf_counter()
        job(count)
        return time.perf_counter() - start

    seconds(1)
    count = max(10, int(0.02 / (seconds(100) / 100)))
    return 1e6 * min(seconds(count) for _ in range(5)) / count


def stages() -> dict[str, Any]:
    """A warm quickstart, stage by stage, in one process."""
    stage, start = Stages(), time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        with stage("imports"):
            import testbed.montecarlo.runner
            import testbed.report.figures
            import testbed.report.html
            from testbed.scenario import load_scenario
        with stage("read the scenario"):
            scenario = load_scenario("quickstart")
        with stage("flight from the cache, kernels, one log"):
            testbed.montecarlo.runner.prepare(testbed.montecarlo.runner.plan(scenario))
        with stage("first run: kernels of the filters"):
            testbed.montecarlo.runner.run(scenario, f"{scratch}/one", runs=1, jobs=1)
        with stage("20 runs in two processes, tables"):
            testbed.montecarlo.runner.run(scenario, f"{scratch}/out", jobs=2)
        with stage("report"):
            testbed.report.render(f"{scratch}/out", svg=False)
    return stage.table() | {"total_s": time.perf_counter() - start}


JOBS: dict[str, Callable[..., dict[str, Any]]] = {
    "flight": flight,
    "runs": runs,
    "estimators": estimators,
    "states": states,
    "stages": stages,
}

if __name__ == "__main__":
    print(json.dumps(JOBS[sys.argv[1]](*sys.argv[2:])))
