"""The one place for speed: measure every hot path and whole jobs, and write ``reports/benchmarks.md`` (``make bench``).

Each section is measured on its own and kept as ``reports/benchmarks/SECTION.json`` with machine, versions and date; the
page and its figures are made from these files alone. ``--only scale,memory`` measures only those sections, ``--long`` adds
the ones that take many minutes, ``--render`` measures nothing. Nothing else should run on the machine meanwhile.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import benchmark_jobs as jobs

REPORTS = Path(__file__).resolve().parents[1]
DATA = REPORTS / "benchmarks"
PACKAGES = (
    *("numpy", "scipy", "numba", "llvmlite", "pandas", "pyarrow", "matplotlib", "jsbsim", "torch"),
    *("python-ins", "ahrs", "filterpy", "vqf", "inslib", "sidereon", "scikit-learn"),
)


def measure_paths() -> dict[str, Any]:
    """Run the benchmarks of ``tests/benchmarks`` in one process; name -> group, least and median seconds, extras."""
    from testbed.base.time_limit import thread_environment

    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "benchmarks.json"
        options = ["--benchmark-only", "--benchmark-columns=min,median,rounds", "--benchmark-sort=name"]
        command = [sys.executable, "-m", "pytest", "tests/benchmarks", *options, f"--benchmark-json={file}"]
        # one thread: the bare matrix products are compared with loops that have one
        with thread_environment():
            subprocess.run(command, cwd=REPORTS.parent, check=True)
        found = json.loads(file.read_text(encoding="utf-8"))["benchmarks"]
    return {
        entry["name"]: {
            "group": entry["group"] or "",
            "min_s": entry["stats"]["min"],
            "median_s": entry["stats"]["median"],
            "rounds": entry["stats"]["rounds"],
            "extra": entry["extra_info"],
        }
        for entry in sorted(found, key=lambda entry: entry["name"])
    }


SECTIONS: dict[str, Callable[[], dict[str, Any]]] = {
    "paths": measure_paths,
    "jobs": jobs.measure_jobs,
    "memory": jobs.measure_memory,
    "scale": jobs.measure_scale,
    "monte-carlo": jobs.measure_monte_carlo,
    "many-runs": jobs.measure_many_runs,
    "tests": jobs.measure_tests,
}
LONG = ("monte-carlo", "many-runs", "tests")


def provenance() -> dict[str, Any]:
    """Machine, versions and date of a measurement."""
    from testbed.montecarlo.runner import git_revision

    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "git": git_revision(),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": os.cpu_count(),
        "packages": versions,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = {line.split(":")[0].strip(): line.split(":")[1].strip() for line in lines if ":" in line}
        return f"{model['model name']} (family {model['cpu family']}, model {model['model']})"
    except (OSError, KeyError):
        return platform.processor()


def measure(section: str) -> None:
    """Measure a section and keep what was found."""
    print(f"measuring: {section}", flush=True)
    content = {"provenance": provenance(), "measured": SECTIONS[section]()}
    DATA.mkdir(exist_ok=True)
    (DATA / f"{section}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Measure what is asked for, then render the page from everything that is there."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", help=f"sections, separated by commas: {', '.join(SECTIONS)}")
    parser.add_argument("--long", action="store_true", help=f"also {', '.join(LONG)}")
    parser.add_argument("--render", action="store_true", help="measure nothing")
    arguments = parser.parse_args()
    chosen = [name for name in SECTIONS if arguments.long or name not in LONG]
    if arguments.only:
        chosen = [name.strip() for name in arguments.only.split(",")]
        if unknown := [name for name in chosen if name not in SECTIONS]:
            parser.error(f"--only: no section '{unknown[0]}'; there are {', '.join(SECTIONS)}")
    for section in [] if arguments.render else chosen:
        measure(section)
    import benchmark_page

    print(f"page: {benchmark_page.render(DATA, REPORTS / 'benchmarks.md')}")


if __name__ == "__main__":
    main()
