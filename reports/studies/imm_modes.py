"""IMM-RSTEKF 2023: which of the three motion models holds the probability, phase by phase, and over the first run.

``modes.csv``: mean over runs and fixes of a phase. Probabilities from 0 to 1, times in seconds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from jobs import Place
    from matplotlib.figure import Figure

READINGS = ("white GNSS error", "correlated, scale factor")
ROWS = ("IMM-EKF", "IMM-RSTEKF")
RUNS = 30
"""A mean over some hundred fixes of a phase and 30 runs: known to a hundredth."""
NOTE = f"Mean over {RUNS} runs and the fixes of each phase; the figure is of run 0."


def make(place: Place) -> None:
    """Table and figure."""
    import pandas as pd
    from jobs import write_csv

    parts, first = [], {}
    for reading in READINGS:
        table, curves = probabilities(place.paper, reading, 2 if place.trial else RUNS)
        parts.append(table)
        first[reading] = curves
    write_csv(place.target / "modes.csv", pd.concat(parts, ignore_index=True), digits=4)
    (place.target / "figures").mkdir(exist_ok=True)
    draw(first).savefig(place.target / "figures" / "modes.png", dpi=120, metadata={"Software": None})


def probabilities(paper: str, reading: str, runs: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """reading, estimator, phase, and a column for each mode; and of run 0 per estimator (times, (E,B), names)."""
    import pandas as pd

    from testbed import pipeline
    from testbed.data.registry import make_estimator
    from testbed.scenario import load_scenario

    scenario = load_scenario(paper, reading=reading)
    flight = pipeline.fly(scenario)
    rows, first = [], {}
    for run in range(runs):
        log, _ = pipeline.sense(scenario, flight, run=run)
        windows = [w for w in pipeline.windows_of(scenario, flight, log) if w.name.startswith("phase_")]
        for entry in [entry for entry in scenario.estimators if entry.row in ROWS]:
            solution = make_estimator(entry.name, **entry.params).run(log)
            t, values = solution.extras["mode_probability"]
            names = solution.extra_names["mode_probability"]
            first.setdefault(entry.row, (t, values, names))
            for window in windows:
                ((start, end),) = window.intervals
                inside = (t > start) & (t <= end)
                means = np.nanmean(values[inside], axis=0)
                modes = [name.split()[0] for name in names]
                rows.append(
                    {"reading": reading, "estimator": entry.row, "phase": window.name}
                    | dict(zip(modes, means, strict=True))
                )
    table = pd.DataFrame(rows)
    return table.groupby(["reading", "estimator", "phase"], sort=False).mean().reset_index(), first


def draw(first: dict[str, dict[str, Any]]) -> Figure:
    """Probabilities over time: readings down, filters across."""
    from testbed.base.figure_style import COLOURS, new_figure

    figure = new_figure(1.7 * len(first) + 0.6)
    axes = figure.subplots(len(first), len(ROWS), sharex=True, sharey=True, squeeze=False)
    for line, (reading, curves) in zip(axes, first.items(), strict=True):
        for ax, (label, (t, values, names)) in zip(line, curves.items(), strict=True):
            for k, name in enumerate(names):
                ax.plot(t, values[:, k], color=COLOURS[k][0], lw=0.8, label=name.split()[0])
            ax.set_title(f"{label}, {reading}", fontsize=8)
            ax.margins(x=0)
        line[0].set_ylabel("Probability")
    for ax in axes[-1]:
        ax.set_xlabel("Time, s")
    axes[0, 0].legend(fontsize=7, frameon=False)
    return figure
