"""The page ``reports/benchmarks.md`` and its figures, from the files that `benchmarks` wrote. Nothing is measured here.

Ratios compare least times of one process (what the machine does when nothing disturbs it); goals are judged by medians.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from benchmark_cells import NOT_MEASURED, Data, Timing, number, ratio, table
from benchmark_goals import goals
from benchmark_rows import PAPER_TIMES, ROWS, TUNING_HOURS, TUNING_TABLE, Row

SCALES = {
    "length": ("length of the flight, s", "seconds", "Flight at 50 Hz: cost of each stage against its length"),
    "runs": ("runs", "seconds", "Monte Carlo of a flight of 10 s with one filter: cost against the number of runs"),
    "estimators": ("estimators", "seconds", "Ten runs of that flight: cost against the number of estimators"),
    "states": ("states", "microseconds", "One step of a filter: cost against the number of states"),
}


def render(folder: Path, page: Path) -> Path:
    """Write the page and the figures in ``folder``."""
    files = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))}
    data = {name: content["measured"] for name, content in files.items()}
    parts = [
        "# Speed",
        INTRODUCTION,
        "## Goals",
        *goals(data),
        "## Hot paths",
        *_paths(data.get("paths")),
        "## The papers' own computation times",
        *_papers(data.get("paths")),
        "## Whole jobs",
        *_jobs(data),
        "## Scale",
        *_scale(data, folder, page.parent),
        "## Memory",
        *_memory(data),
        "## Graphics processors",
        GRAPHICS,
        "## Every benchmark",
        *_everything(data.get("paths")),
        "## Where and when",
        *_provenance(files),
    ]
    page.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return page


INTRODUCTION = """Made by `make bench` (`python reports/studies/benchmarks.py`; with `--long` also the jobs of many minutes). What was
measured lies in `reports/benchmarks/*.json`; `--render` makes the page from it again. A ratio "x arithmetic" says how many
times as long the path takes as the arithmetic that it cannot do without, run bare in compiled loops of
`tests/benchmarks/arithmetic.py`; a ratio "x peer" how many times as long the peer takes as the path. Both were timed in the
same process as the path; a path may stay below 1 x arithmetic where it knows zeros and symmetry that a dense product does
not."""

GRAPHICS = """The training of the AHRS network runs on the device that its setting `device` names (`cpu` by default). The
machine of these measurements has no graphics processor, so no gain by one is claimed. Nothing else uses one: every other hot
path is a sequential recursion over samples with small matrices, on which a graphics processor waits."""


def _paths(paths: Data | None) -> list[str]:
    if paths is None:
        return [NOT_MEASURED.format("paths")]
    rows = [cells for row in ROWS if (cells := _path_row(paths, row))]
    head = ("path", "unit", "µs per unit", "least", "arithmetic it cannot do without", "x arithmetic", "x peer")
    return [table(head, rows, 2)]


def _path_row(paths: Data, row: Row) -> tuple[str, ...] | None:
    timing = Timing.of(paths, row.name, row.unit)
    if timing is None:
        return None
    times = ""
    if row.floor and (floor := Timing.of(paths, row.floor, row.unit)):
        in_turn = paths[row.name]["extra"].get("over_bare")  # the two timed in turn
        times = number(in_turn or timing.least / (row.times * floor.least))
    peers = (
        f"{label} {number(slower)}"
        for label, name in row.peers.items()
        if (slower := ratio(Timing.of(paths, name, row.unit), timing)) is not None
    )
    unit = {
        "samples": "sample",
        "steps": "step",
        "epochs": "epoch",
        "flight_s": "s of flight",
        "calls": "call",
        "evaluations": "evaluation",
    }[row.unit]
    median, least = number(1e6 * timing.median), number(1e6 * timing.least)
    return row.label, unit, median, least, row.what, times, "; ".join(peers)


def _papers(paths: Data | None) -> list[str]:
    if paths is None:
        return [NOT_MEASURED.format("paths")]
    rows = []
    for label, name, seconds in PAPER_TIMES:
        timing = Timing.of(paths, name, "calls")
        if timing is not None:
            rows.append((label, f"{seconds:g}", number(timing.median), number(seconds / timing.median)))
    words = """IMM-RSTEKF (2023), 150 s at 100 Hz with fixes at 5 Hz: 15,000 samples; the paper's figures are of MATLAB 2019b on
an i5-5200U at 2.2 GHz, so another machine and another language stand between the columns, not the method alone."""
    parts = [words, table(("filter", "paper, s", "here, s", "paper / here"), rows)]
    one = Timing.of(paths, "test_bench_side_by_side", "evaluations")
    if one is not None:
        hours = one.median * TUNING_TABLE / 3600.0
        ratio = number(TUNING_HOURS / hours)
        parts.append(
            f"Metaheuristic tuning (2022): {TUNING_TABLE:,} evaluations, each two filter runs over 437 s at 200 Hz, took "
            f"about {TUNING_HOURS:,} machine hours in the paper (MATLAB, four PCs of unknown kind). One evaluation takes "
            f"{number(1e3 * one.median)} ms here on one core: {number(hours)} core hours for the table, {ratio} times fewer. "
            "The other papers state no computation time."
        )
    return parts


def _jobs(data: Data) -> list[str]:
    jobs = data.get("jobs")
    if jobs is None:
        return [NOT_MEASURED.format("jobs")]
    names = {
        "python": "the interpreter itself",
        "import": "`import testbed` in a new interpreter",
        "help": "`testbed --help`",
        "list": "`testbed list scenarios`",
        "quickstart": "`testbed run quickstart`, warm (20 runs, five estimators, report)",
        "report": "`testbed report` of that result (with vector figures)",
    }
    rows = [(text, number(jobs[k]["median_s"]), number(jobs[k]["min_s"])) for k, text in names.items()]
    first = jobs["first_run"]
    told = "a line on the screen says so" if first["told"] else "**no line on the screen says so**"
    stages = jobs["stages"]
    parts = [
        table(("job", "median, s", "least, s"), rows),
        f"On a fresh machine (empty caches) the first `testbed run quickstart` takes {number(first['seconds'])} s, because it "
        f"compiles the kernels; {told}. Compiled code is kept on the disk.",
        "A warm quickstart, stage by stage in one process (the second line of estimators runs in two further processes):",
        table(
            ("stage", "s", "peak memory, MiB"),
            [(name, number(s), f"{stages['peak_mib'][name]:.0f}") for name, s in stages["seconds"].items()],
        ),
    ]
    if unit := _runner_overhead(data.get("paths")):
        parts.append(unit)
    return parts


def _runner_overhead(paths: Data | None) -> str:
    if paths is None:
        return ""
    whole, inner = (
        Timing.of(paths, f"test_unit_of_the_quickstart[{what}]", "calls") for what in ("unit", "estimators")
    )
    if whole is None or inner is None:
        return ""
    extra = whole.median - inner.median
    return (
        f"One unit of the quickstart (sensing, five estimators, scoring, encoding) takes {number(1e3 * whole.median)} ms, its "
        f"estimators alone {number(1e3 * inner.median)} ms: the runner adds {number(1e3 * extra)} ms per run."
    )


def slope(points: Sequence[tuple[float, float]]) -> float:
    """Exponent of the power law through the upper half of the points (n, cost): what large n will cost."""
    upper = sorted(points)[min(len(points) // 2, len(points) - 2) :]
    x, y = [math.log(n) for n, _ in upper], [math.log(cost) for _, cost in upper]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    above = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True))
    return above / sum((a - mean_x) ** 2 for a in x)


def _series(data: Data, axis: str) -> dict[str, list[tuple[float, float]]]:
    """Name -> points (n, cost) of one scale plot."""
    scale = data["scale"][axis]
    if axis == "length":
        names = next(iter(scale.values()))["seconds"]
        return {name: [(float(n), job["seconds"][name]) for n, job in scale.items()] for name in names}
    if axis == "states":
        return {name.replace("_", " "): [(float(n), t) for n, t in by.items()] for name, by in scale.items()}
    jobs = scale | (data.get("many-runs", {}) if axis == "runs" else {})
    return {"whole job": sorted((float(n), job["seconds"]) for n, job in jobs.items())}


def _scale(data: Data, folder: Path, start: Path) -> list[str]:
    if "scale" not in data:
        return [NOT_MEASURED.format("scale")]
    parts, rows = [], []
    for axis, (label, unit, title) in SCALES.items():
        series = _series(data, axis)
        file = folder / f"scale-{axis}.png"
        _draw(series, label, unit, title, file)
        for name, points in series.items():
            least, most = points[0], points[-1]
            costs = f"{number(least[1])} to {number(most[1])} {unit}"
            rows.append((axis, name, f"{least[0]:,g} to {most[0]:,g}", costs, f"{slope(points):.2f}"))
        parts.append(f"![{title}]({file.relative_to(start).as_posix()})")
    words = """The slope is that of log cost over log n through the upper half of the points: 1 is linear. The work of a step
grows with the states by nature: n³ for a dense product and for sigma points, n² for an update."""
    return [words, table(("against", "what", "n", "cost", "slope"), rows, 2), *parts]


def _draw(series: dict[str, list[tuple[float, float]]], label: str, unit: str, title: str, file: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for name, points in series.items():
        x, y = zip(*points, strict=True)
        axes.loglog(x, y, "o-", markersize=4, label=f"{name}: slope {slope(points):.2f}")
    axes.set_xlabel(label)
    axes.set_ylabel(unit)
    axes.set_title(title, fontsize="medium")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(file, dpi=120, metadata={"Software": None})


def _memory(data: Data) -> list[str]:
    parts = []
    if "memory" in data:
        rows = [
            (
                name,
                f"{job['samples']:,}",
                f"{job['start_mib']:.0f}",
                *(f"{job['peak_mib'][stage]:.0f}" for stage in ("fly", "sense", "estimate", "score")),
                number(2**20 * (job["peak_mib"]["score"] - job["start_mib"]) / job["samples"]),
                number(sum(job["seconds"].values())),
            )
            for name, job in data["memory"].items()
        ]
        head = ("flight", "samples", "at start", "fly", "sense", "estimate", "score", "bytes per sample", "s in all")
        parts += [
            "Peak resident memory (MiB) after each stage of a long flight, in a process of its own:",
            table(head, rows),
        ]
    else:
        parts.append(NOT_MEASURED.format("memory"))
    if "many-runs" in data or "scale" in data:
        jobs = data.get("scale", {}).get("runs", {}) | data.get("many-runs", {})
        rows = [(f"{int(n):,}", f"{job['peak_mib']:.0f}") for n, job in sorted(jobs.items(), key=lambda kv: int(kv[0]))]
        parts += ["Peak resident memory against the number of runs of a Monte Carlo:", table(("runs", "MiB"), rows, 0)]
    return parts


def _everything(paths: Data | None) -> list[str]:
    if paths is None:
        return [NOT_MEASURED.format("paths")]
    rows = []
    for name, entry in sorted(paths.items(), key=lambda kv: (kv[1]["group"], kv[0])):
        values = (f"{number(1e3 * entry[key])}" for key in ("min_s", "median_s"))
        rows.append((entry["group"], f"`{name}`", *values, str(entry["rounds"])))
    return [table(("group", "benchmark", "least, ms", "median, ms", "rounds"), rows, 2)]


def _provenance(files: Data) -> list[str]:
    rows, versions = [], ""
    for name, content in files.items():
        p = content["provenance"]
        machine = f"{p['processor']}, {p['cores']} cores, {p['platform']}"
        rows.append((name, p["date"], str(p["git"]), p["python"], machine))
        versions = ", ".join(f"{package} {v}" for package, v in p["packages"].items())
    return [table(("section", "date", "revision", "Python", "machine"), rows, 5), f"Packages: {versions}."]
