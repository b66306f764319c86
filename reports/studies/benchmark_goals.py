"""What the bench shall reach, beside what was measured. Medians are judged; ratios are of least times."""

from __future__ import annotations

from benchmark_cells import NOT_MEASURED, Data, Timing, number, ratio, table

QUICKSTART_S = 5.0
SIDE_BY_SIDE = {"indirect-kf": 0.17, "direct-ukf": 0.3, "imm-rstekf": 0.3}
"""Filters in vector lanes: share of its single run that one of eight may cost."""


def goals(data: Data) -> list[str]:
    """The table of goals, and what a quickstart takes so long for."""
    rows = [
        (text, limit, measured, "-" if met is None else "yes" if met else "**no**")
        for text, limit, measured, met in [*_path_goals(data.get("paths", {})), *_job_goals(data)]
    ]
    return [table(("goal", "limit", "measured", "met"), rows, 1), _why_quickstart(data.get("jobs"))]


def _why_quickstart(jobs: Data | None) -> str:
    """Where the seconds of a quickstart go that misses its goal."""
    if jobs is None or jobs["quickstart"]["median_s"] <= QUICKSTART_S:
        return ""
    stages = sorted(jobs["stages"]["seconds"].items(), key=lambda item: -item[1])[:3]
    return (
        "The quickstart's seconds, most first (all of them under whole jobs): "
        + "; ".join(f"{name} {number(seconds)} s" for name, seconds in stages)
        + ". Workers, and the helper that draws half of the figures, are copies of a process whose imports and kernels are loaded."
    )


Goal = tuple[str, str, str, bool | None]


def _goal(text: str, limit: float, measured: float | None, unit: str, section: str, at_least: bool = False) -> Goal:
    bound = f"{'at least' if at_least else 'at most'} {limit:,g} {unit}".strip()
    if measured is None:
        return text, bound, NOT_MEASURED.format(section), None
    met = measured >= limit if at_least else measured <= limit
    return text, bound, f"{number(measured)} {unit}".strip(), met


def _path_goals(paths: Data) -> list[Goal]:
    def micro(name: str, unit: str = "samples") -> float | None:
        timing = Timing.of(paths, name, unit)
        return None if timing is None else 1e6 * timing.median

    kf, peer = "test_bench_indirect_kf", Timing.of(paths, "test_bench_python_ins")
    sense = Timing.of(paths, "test_imu[ADIS16405]", "flight_s")
    found = [
        _goal("`indirect-kf`, all in, per sample", 3.0, micro(kf), "µs", "paths"),
        _goal(
            "`indirect-kf` against python-ins, same process",
            200,
            ratio(peer, Timing.of(paths, kf)),
            "x",
            "paths",
            True,
        ),
        _goal("`direct-ukf` per sample", 25.0, micro("test_bench_direct_filter[direct-ukf]"), "µs", "paths"),
        _goal("`imm-rstekf` per sample", 15.0, micro("test_bench_direct_filter[imm-rstekf]"), "µs", "paths"),
        *(
            _goal(
                f"`{name}`, eight runs side by side, against its own single run",
                limit,
                ratio(
                    Timing.of(paths, f"test_bench_side_by_side_runs[{name}]"),
                    Timing.of(paths, f"test_bench_direct_filter[{name}]"),
                ),
                "x",
                "paths",
            )
            for name, limit in SIDE_BY_SIDE.items()
        ),
        _goal(
            "scoring, against its arithmetic",
            3.0,
            ratio(
                Timing.of(paths, "test_score_15000_samples"),
                Timing.of(paths, "test_subtract_and_square_15000_samples"),
            ),
            "x",
            "paths",
        ),
        _goal(
            "GNSS simulation per epoch, 24 satellites", 30.0, micro("test_bench_satellites", "epochs"), "µs", "paths"
        ),
        _goal(
            "GNSS receiver per epoch, 24 satellites", 15.0, micro("test_bench_receiver[24]", "epochs"), "µs", "paths"
        ),
        _goal("`tight-kf` per sample, larger noise", 3.0, micro("test_bench_tight[inflate]"), "µs", "paths"),
        _goal(
            "sensing a 200 Hz IMU (ADIS16405), times real time",
            5000,
            None if sense is None else 1.0 / sense.median,
            "x",
            "paths",
            True,
        ),
    ]
    for name in ("aerosonde", "transport", "agile"):
        over_bare = paths.get(f"test_fly[{name}]", {}).get("extra", {}).get("over_bare")
        found.append(_goal(f"flying the `{name}`, over the bare JSBSim loop", 1.3, over_bare, "x", "paths"))
    return found


def _job_goals(data: Data) -> list[Goal]:
    jobs, monte, tests = data.get("jobs"), data.get("monte-carlo"), data.get("tests")
    return [
        _goal(
            "`testbed run quickstart`, warm, in all", QUICKSTART_S, jobs and jobs["quickstart"]["median_s"], "s", "jobs"
        ),
        _goal("the first one of an installation", 25.0, jobs and jobs["first_run"]["seconds"], "s", "jobs"),
        _goal("`testbed --help`", 0.3, jobs and jobs["help"]["median_s"], "s", "jobs"),
        _goal(
            f"Monte Carlo of `imm-rstekf-2023`, {monte['runs'] if monte else 1000} runs, seven filters, report, two cores",
            120.0,
            monte and monte["seconds"],
            "s",
            "monte-carlo",
        ),
        *(
            _goal(f"memory of a flight of {name}, all in", 1024.0, max(found["peak_mib"].values()), "MiB", "memory")
            for name, found in (data.get("memory") or {}).items()
        ),
        _goal("`make test`", 600.0, tests and tests["seconds"], "s", "tests"),
    ]
