"""Sweeps: one Monte Carlo for each point of a grid of scenario settings, in one table, figure and page.

Each point is a result folder of its own, so a sweep resumes as its points do. ``sweep.csv`` holds the rows of every
``summary.csv`` behind the settings of the point (units as the settings' keys and the metric names say).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed import pipeline
from testbed.base.csv_text import csv_text, read_csv
from testbed.base.errors import InputError, nearest
from testbed.base.schema import parse_toml
from testbed.montecarlo.folders import Folder, check_own, read_manifest
from testbed.montecarlo.runner import plan, prepare, run
from testbed.montecarlo.store import KIND as RESULT
from testbed.report.sweeps import FILES
from testbed.report.sweeps import write as write_files
from testbed.scenario import Scenario, hides
from testbed.scoring.quantities import MAIN, is_consistency, metric_names

if TYPE_CHECKING:
    import pandas as pd

KIND = "testbed sweep"
PLOT_METRIC = f"rmse_{MAIN[0]}"


def parse_sweep(text: str) -> tuple[str, list[Any]]:
    """``KEY=V1,V2,...`` of ``--sweep``, values in TOML; a bare word counts as a string."""
    key, separator, values = text.partition("=")
    if not separator or not key.strip() or not values.strip():
        raise InputError(f"--sweep {text}: expected KEY=V1,V2,..., for example sensors.imu.rate_hz=50,100,200")
    try:
        parsed = parse_toml(f"value = [{values}]", "--sweep")["value"]
    except InputError:
        parsed = [value.strip() for value in values.split(",")]
    return key.strip(), parsed


def parse_grid(texts: Sequence[str]) -> dict[str, list[Any]]:
    """Key -> values of several ``--sweep``. Raises InputError for a key that two of them give, or a value that stands twice."""
    grid: dict[str, list[Any]] = {}
    for key, values in map(parse_sweep, texts):
        for other in grid:
            if hides(key, other):
                why = "is given twice" if key == other else f"leaves nothing of '{other}'"
                raise InputError(f"--sweep {key} {why}; give each key once, with all of its values: {other}=V1,V2,V3")
        grid[key] = values
    check_values(grid)
    return grid


def check_values(grid: Mapping[str, Sequence[Any]]) -> None:
    """Raise InputError where two points of a grid would be one and the same."""
    for key, values in grid.items():
        cells = [_cell(value) for value in values]
        for k, cell in enumerate(cells):
            if any(cell == other or str(cell) == str(other) for other in cells[:k]):
                raise InputError(f"--sweep {key}: the value {cell} stands twice; name each value once")


def sweep(
    load: Callable[[Mapping[str, Any]], Scenario],
    grid: Mapping[str, Sequence[Any]],
    out: str | Path,
    resume: bool = False,
    metric: str = PLOT_METRIC,
    announce: Callable[[str], None] | None = None,
    window: str = "all",
    log: str | None = None,
    **options: Any,
) -> pd.DataFrame:
    """Run every combination of ``grid`` (dotted scenario key -> values); write ``sweep.csv``, figure, LaTeX table and page.

    ``metric`` and ``window`` are those that are drawn, ``log`` as in `testbed.report.sweeps.figure`.

    ``load`` makes the scenario of a point from its overrides, for example ``lambda o: load_scenario(name, overrides=o)``.
    ``announce`` is told each point; ``options`` go to `testbed.montecarlo.runner.run`. All points are flown
    and sensed once, and so checked, before any is run.
    """
    out, keys = Path(out), list(grid)
    if not keys or not all(grid.values()):
        raise InputError("a sweep needs at least one key with at least one value")
    check_values(grid)
    points = [dict(zip(keys, values, strict=True)) for values in itertools.product(*grid.values())]
    scenarios = [load(point) for point in points]
    planned = {key: value for key, value in options.items() if key in signature(plan).parameters}
    folders = [out / f"point_{number:03d}" for number in range(1, len(points) + 1)]
    for folder, kind in ((out, KIND), *((folder, RESULT) for folder in folders)):
        check_own(folder, kind)
    _check_drawn(metric, log)
    for scenario in scenarios:
        trajectory = prepare(plan(scenario, **planned))
        if scenario is scenarios[0] and window != "all":
            windows = [
                w.name for w in pipeline.windows_of(scenario, trajectory, pipeline.sense(scenario, trajectory)[0])
            ]
            if window not in windows:
                raise InputError(f"--window {window}: the scenario has no such window; {nearest(window, windows)}")
    shown = {"keys": keys, "metric": metric, "window": window, "log": log, "title": _title(scenarios[0])}
    with Folder.open(out, KIND) as own:
        own.claim(["sweep.csv", *FILES])
        table = _run_points(points, scenarios, folders, resume, announce, options)
        own.write("sweep.csv", csv_text(table, float_format="%.10g", lineterminator="\n").encode())
        _write_shown(own, read_csv(out / "sweep.csv"), shown)  # of its digits, so that they can be made again
    return table


def write_page(folder: Path) -> Path:
    """Make figure, LaTeX table and page of a sweep again from its ``sweep.csv``; returns the page.

    Raises InputError where the folder holds no finished sweep, or one of version 0.1, which does not say what its keys are.
    """
    table, shown = read_sweep(folder)
    with Folder.open(folder, KIND) as own:
        own.claim(FILES)
        _write_shown(own, table, shown)
    return folder / "report.html"


def read_sweep(folder: Path) -> tuple[pd.DataFrame, dict[str, Any]]:
    """The table of a finished sweep, and what its figure shows: keys, metric, window, log, title. Raises InputError."""
    manifest = read_manifest(folder, KIND)
    path = folder / "sweep.csv"
    if manifest is None or not path.is_file():
        raise InputError(f"{folder}: no finished sweep; testbed run SCENARIO --sweep KEY=V1,V2 --resume completes one")
    shown = manifest.get("shown")
    if not isinstance(shown, dict) or set(shown) != {"keys", "metric", "window", "log", "title"}:
        raise InputError(f"{folder}: this sweep does not say what it shows; run it again with --resume")
    return read_csv(Folder(folder, manifest).check("sweep.csv")), shown


def _write_shown(own: Folder, table: pd.DataFrame, shown: Mapping[str, Any]) -> None:
    write_files(own.out, table, **shown)
    for name in FILES:
        own.finish(name)
    own.save(shown=dict(shown))


def _check_drawn(metric: str, log: str | None) -> None:
    if metric not in (known := metric_names()) and not is_consistency(metric):
        raise InputError(f"--metric {metric}: unknown; {nearest(metric, known)} (testbed list metrics shows all)")
    if log not in (None, "x", "y", "xy", "none"):
        raise InputError(f"--log {log}: x, y, xy or none")


def _title(scenario: Scenario) -> str:
    return scenario.scenario.title or scenario.name


def _run_points(
    points: Sequence[Mapping[str, Any]],
    scenarios: Sequence[Scenario],
    folders: Sequence[Path],
    resume: bool,
    announce: Callable[[str], None] | None,
    options: Mapping[str, Any],
) -> pd.DataFrame:
    """Each point's summary behind its settings, in one table."""
    import pandas as pd

    frames = []
    for number, (point, scenario, folder) in enumerate(zip(points, scenarios, folders, strict=True), 1):
        label = f"point {number} of {len(points)}: " + ", ".join(
            f"{k.split('.')[-1]} {_cell(v)}" for k, v in point.items()
        )
        known = resume and read_manifest(folder, RESULT) is not None
        if announce is not None:
            announce(label)
        summary = run(scenario, folder, resume=known, **options).summary
        settings = {key: [_cell(value)] * len(summary) for key, value in point.items()}
        frames.append(pd.concat([pd.DataFrame(settings), summary], axis=1))
    return pd.concat(frames, ignore_index=True)


def _cell(value: Any) -> Any:
    """A setting as a table shows it."""
    return value if isinstance(value, int | float | str | bool) else str(value).replace(" ", "")
