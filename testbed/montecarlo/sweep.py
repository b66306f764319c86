"""Sweeps: one Monte Carlo for each point of a grid of scenario settings, in one table and one plot.

Each point is a result folder of its own, so a sweep resumes as its points do. ``sweep.csv`` holds the rows of every
``summary.csv`` behind the settings of the point (units as the settings' keys and the metric names say).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.csv_text import csv_text
from testbed.base.errors import InputError
from testbed.base.files import write_with
from testbed.base.schema import parse_toml
from testbed.montecarlo.folders import Folder, check_own, read_manifest
from testbed.montecarlo.runner import plan, prepare, run
from testbed.montecarlo.store import KIND as RESULT
from testbed.report.labels import window_label
from testbed.scenario import Scenario
from testbed.scoring.quantities import MAIN, metric_label, unit

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


def first_point(grid: Sequence[str]) -> dict[str, Any]:
    """The settings of the first point of the grid that some ``--sweep`` span."""
    return {key: values[0] for key, values in map(parse_sweep, grid)}


def sweep(
    load: Callable[[Mapping[str, Any]], Scenario],
    grid: Mapping[str, Sequence[Any]],
    out: str | Path,
    resume: bool = False,
    metric: str = PLOT_METRIC,
    announce: Callable[[str], None] | None = None,
    **options: Any,
) -> pd.DataFrame:
    """Run every combination of ``grid`` (dotted scenario key -> values) and write ``sweep.csv`` and ``sweep.png``.

    ``load`` makes the scenario of a point from its overrides, for example ``lambda o: load_scenario(name, overrides=o)``.
    ``announce`` is told each point; ``options`` go to `testbed.montecarlo.runner.run`. All points are flown
    and sensed once, and so checked, before any is run.
    """
    out, keys = Path(out), list(grid)
    if not keys or not all(grid.values()):
        raise InputError("a sweep needs at least one key with at least one value")
    points = [dict(zip(keys, values, strict=True)) for values in itertools.product(*grid.values())]
    scenarios = [load(point) for point in points]
    planned = {key: value for key, value in options.items() if key in signature(plan).parameters}
    folders = [out / f"point_{number:03d}" for number in range(1, len(points) + 1)]
    for folder, kind in ((out, KIND), *((folder, RESULT) for folder in folders)):
        check_own(folder, kind)
    for scenario in scenarios:
        prepare(plan(scenario, **planned))
    with Folder.open(out, KIND) as own:
        own.claim(["sweep.csv", "sweep.png"])
        table = _run_points(points, scenarios, folders, resume, announce, options)
        own.write("sweep.csv", csv_text(table, float_format="%.10g", lineterminator="\n").encode())
        plot(table, keys, out / "sweep.png", metric)
        own.finish("sweep.png")
        own.save()
    return table


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


def plot(table: pd.DataFrame, keys: Sequence[str], path: Path, metric: str = PLOT_METRIC, window: str = "all") -> None:
    """Mean and 95 % interval of a metric over the first key, a line per estimator, a panel per value of the other keys."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    first, others = keys[0], list(keys[1:])
    rows = table[(table["metric"] == metric) & (table["window"] == window)]
    panels: list[tuple[Any, Any]] = list(rows.groupby(others, sort=False)) if others else [((), rows)]
    figure = Figure(figsize=(1.0 + 4.2 * max(1, len(panels)), 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, max(1, len(panels)), sharey=True, squeeze=False)[0]
    for axis, (values, part) in zip(axes, panels, strict=False):
        for estimator, line in part.groupby("estimator", sort=False):
            numeric = [isinstance(v, int | float) for v in line[first]]
            x = line[first].to_numpy(dtype=float) if all(numeric) else line[first].astype(str).to_numpy()
            spread = [line["mean"] - line["ci_low"], line["ci_high"] - line["mean"]]
            axis.errorbar(
                x,
                line["mean"],
                yerr=[s.clip(lower=0).fillna(0) for s in spread],
                marker="o",
                capsize=3,
                label=estimator,
            )
        axis.set_xlabel(first)
        axis.set_title(", ".join(f"{k} = {v}" for k, v in zip(others, values, strict=False)), fontsize=9)
        axis.grid(alpha=0.3)
    what = ", ".join(filter(None, (metric_label(metric), unit(metric), window_label(window))))
    axes[0].set_ylabel(f"{what}\n(mean and 95 % interval)", fontsize=9)
    if len(rows):
        axes[0].legend(fontsize=8)
    write_with(path, partial(figure.savefig, format="png", dpi=150))
