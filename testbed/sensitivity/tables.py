"""What a study finds, as tables: ``sensitivity.csv`` (an index per figure), ``outcomes.csv`` (the metric itself), ``sensitivity.md``.

Indices without unit; ``mu``, ``mu_star`` and ``sigma`` in the metric's unit per whole range of the figure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.csv_text import csv_text
from testbed.base.files import write_with
from testbed.data.records import Array
from testbed.montecarlo.folders import Folder
from testbed.report.labels import window_label
from testbed.scenario import Scenario
from testbed.scoring.quantities import axis_title
from testbed.sensitivity.design import MORRIS, SOBOL, Design
from testbed.sensitivity.evaluate import Cell
from testbed.sensitivity.factors import Factor
from testbed.sensitivity.indices import indices, names, noise_share
from testbed.sensitivity.question import Question
from testbed.sensitivity.store import Evaluations

if TYPE_CHECKING:
    import pandas as pd

Found = tuple[Design, Evaluations]
"""A plan and its values."""
SHOWN = {MORRIS: "mu_star", SOBOL: "ST"}
"""The index by which a method ranks."""
WORDS = {
    "mu_star": "mean effect µ*, {}",
    "sigma": "its scatter σ, {}",
    "S1": "alone (S1)",
    "ST": "with all its interplays (ST)",
}


def write_tables(
    folder: Folder,
    scenario: Scenario,
    question: Question,
    cells: Sequence[Cell],
    found: Sequence[Found],
    notes: Sequence[str],
) -> None:
    """Write tables, figures and text of a study whose points are all evaluated."""
    from testbed.sensitivity.plots import draw

    seed = scenario.monte_carlo.seed
    table, outcomes = _tables(question.factors, cells, found, seed)
    folder.write_all(
        {
            "sensitivity.csv": csv_text(table, float_format="%.6g").encode(),
            "outcomes.csv": csv_text(outcomes, float_format="%.6g").encode(),
        }
    )
    pictures = {}
    for (metric, window), rows in table.groupby(["metric", "window"], sort=False):
        name = pictures[metric, window] = f"sensitivity-{metric}-{window}.png"
        folder.claim([name])
        figure = draw(rows, question.methods, axis_title(str(metric)))
        write_with(folder.out / name, partial(figure.savefig, format="png", dpi=150))
        folder.finish(name)
    text = _text(scenario, question, table, outcomes, pictures, [*notes, *_notes(table, outcomes, found)])
    folder.write_all({"sensitivity.md": text.encode()})


def _tables(
    factors: Sequence[Factor], cells: Sequence[Cell], found: Sequence[Found], seed: int
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """A row per cell and figure with the indices and their intervals; a row per cell and method of the metric itself."""
    import pandas as pd

    rows, outcomes = [], []
    for k, cell in enumerate(cells):
        entries = [{**cell._asdict(), "key": f.key, "low": f.low, "high": f.high, "log": f.log} for f in factors]
        for design, store in found:
            y = store.values[:, k].reshape(design.groups, design.size, -1)
            values, reach = indices(design, y, seed)
            for name in names(design.method):
                for entry, value, half in zip(entries, values[name], reach[name], strict=True):
                    entry |= {name: value, f"{name}_low": value - half, f"{name}_high": value + half}
            outcomes.append({**cell._asdict(), "method": design.method, **_outcome(y)})
        rows += entries
    return pd.DataFrame(rows), pd.DataFrame(outcomes)


def _outcome(y: Array) -> dict[str, Any]:
    """The metric over the points: ``y`` (groups, size, seeds)."""
    whole = np.isfinite(y).all(axis=(1, 2))
    means = y[whole].mean(axis=2)
    some = means.size > 0
    return {
        "points": y.shape[0] * y.shape[1],
        "groups": len(y),
        "groups_lost": int((~whole).sum()),
        "mean": means.mean() if some else np.nan,
        "std": means.std() if some else np.nan,
        "least": means.min() if some else np.nan,
        "most": means.max() if some else np.nan,
        "seeds": y.shape[2],
        "noise_share": noise_share(y),
    }


def _notes(table: pd.DataFrame, outcomes: pd.DataFrame, found: Sequence[Found]) -> list[str]:
    """What a reader must know before believing an index."""
    notes = []
    reasons = {design.method: store.first_lost() for design, store in found}
    for row in outcomes.to_dict("records"):
        cell = f"{row['estimator']}, {row['metric']}, {window_label(row['window'])}, {row['method']}"
        if row["groups_lost"]:
            reason = f" (the first: {reasons[row['method']]})" if reasons[row["method"]] else ""
            notes.append(
                f"{cell}: {row['groups_lost']} of {row['groups']} groups of points hold a run that was lost and are left out"
                f"{reason}; the indices are those of the rest, and a narrower range loses fewer"
            )
        if row["std"] == 0.0:
            notes.append(f"{cell}: the same value at every point: none of the figures has any effect")
        if row["noise_share"] > 0.05:
            notes.append(
                f"{cell}: {100 * row['noise_share']:.0f} % of the variance between points is their interplay with these {row['seeds']} noise"
                " seeds; more --runs lessen it"
            )
    for key, rows in table.groupby("key", sort=False):
        columns = [name for name in ("mu_star", "ST") if name in rows]
        if (rows[columns] == 0.0).all(axis=None):
            notes.append(
                f"{key}: no effect at all on any metric; is the error switched off, or given by another figure?"
            )
    return notes


def _text(
    scenario: Scenario,
    question: Question,
    table: pd.DataFrame,
    outcomes: pd.DataFrame,
    pictures: Mapping[tuple[Any, Any], str],
    notes: Sequence[str],
) -> str:
    """The study in words and tables."""
    plans = " and ".join(
        f"{rows['points'].iloc[0]} points in {rows['groups'].iloc[0]} {'trajectories of Morris' if m == MORRIS else 'base samples of Sobol'}"
        for m, rows in outcomes.groupby("method", sort=False)
    )
    parts = [
        f"# Sensitivity: {scenario.scenario.title or scenario.name}\n",
        f"{len(question.factors)} figures moved over their ranges at once: {plans}, {question.runs} noise seeds each, the same at every"
        " point. In parentheses 95 % intervals over plans and seeds. S1 is the share of the metric's variance that a figure makes"
        " alone, ST with all its interplays; µ* is the mean size of the metric's change per whole range of the figure, σ its"
        " scatter (interplay or curvature).\n",
    ]
    parts += [f"- {note}" for note in notes] + [""] * bool(notes)
    for (metric, window), rows in table.groupby(["metric", "window"], sort=False):
        for estimator, own in rows.groupby("estimator", sort=False):
            parts.append(f"## {estimator}: {axis_title(str(metric))}, {window_label(str(window))}\n")
            parts += [_sentence(own), "", _markdown(own, str(metric)), ""]
        parts.append(f"![{axis_title(str(metric))}]({pictures[metric, window]})\n")
    return "\n".join(parts)


def ranked(rows: pd.DataFrame) -> tuple[str, pd.DataFrame]:
    """The index that ranks (total order where there is one) and a cell's rows by it, the most decisive figure first."""
    by = SHOWN[SOBOL] if SHOWN[SOBOL] in rows else SHOWN[MORRIS]
    return by, rows.sort_values(by, ascending=False, kind="stable")


def _sentence(rows: pd.DataFrame) -> str:
    """The figure that decides, where the intervals tell it apart from the second."""
    by, rows = ranked(rows)
    if not np.isfinite(rows[by].iloc[0]) or rows[by].iloc[0] == 0.0:
        return "No figure has an effect that could be told."
    first = rows["key"].iloc[0]
    if len(rows) == 1 or rows[f"{by}_low"].iloc[0] > rows[f"{by}_high"].iloc[1]:
        return f"`{first}` decides most."
    close = rows[rows[f"{by}_high"] >= rows[f"{by}_low"].iloc[0]]["key"]
    return f"Not told apart at the top: {', '.join(f'`{key}`' for key in close)}."


def columns_of(rows: pd.DataFrame, metric: str) -> dict[str, str]:
    """Indices that a table shows, and the heads of their columns."""
    unit = axis_title(metric).rpartition(", ")[2] if ", " in axis_title(metric) else "no unit"
    return {name: words.format(unit) for name, words in WORDS.items() if name in rows}


def _markdown(rows: pd.DataFrame, metric: str) -> str:
    shown = columns_of(rows, metric)
    lines = [
        "| figure | range | " + " | ".join(shown.values()) + " |",
        "| :--- | :--- |" + " ---: |" * len(shown),
    ]
    for row in ranked(rows)[1].to_dict("records"):
        cells = [_with_interval(row, name) for name in shown]
        axis = ", log" if row["log"] else ""
        lines.append(f"| `{row['key']}` | {row['low']:g} to {row['high']:g}{axis} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _with_interval(row: Mapping[str, Any], name: str) -> str:
    value, low, high = (row[n] for n in (name, f"{name}_low", f"{name}_high"))
    form: Callable[[float], str] = (lambda v: f"{v:.2f}") if name in ("S1", "ST") else (lambda v: f"{v:.3g}")
    return "–" if not np.isfinite(value) else f"{form(value)} ({form(low)} to {form(high)})"
