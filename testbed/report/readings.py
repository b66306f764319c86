"""The page of a scenario's readings: per claim a table *reading -> effect with interval -> verdict*, a forest plot, the class.

Reads the folder that `testbed.montecarlo.readings` wrote: ``manifest.json``, ``verdicts.csv`` and ``verdicts-timings.csv``; writes
``report.md``, ``report.html``, ``report.json`` and ``figures/forest-*.png``. Effects in per cent, positive where lower.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from testbed.base.csv_text import read_csv
from testbed.base.errors import InputError
from testbed.base.figure_style import COLOURS, new_figure
from testbed.base.files import as_json
from testbed.base.schema import validate
from testbed.montecarlo.folders import Folder, read_manifest
from testbed.montecarlo.readings import COLUMNS, KIND, slug
from testbed.report import html
from testbed.report.figures import Drawing, save
from testbed.report.labels import percent, verdict_kind, window_label
from testbed.report.tables import Cell, Column, Table, claim_cells
from testbed.report.text import markdown_table
from testbed.scoring.claims import ReadingConfig
from testbed.scoring.quantities import metric_label
from testbed.scoring.readings import FAILS, HOLDS, INCONSISTENT, Standing, standing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FARTHEST = 200.0
"""Per cent to either side that a forest plot shows: beyond "none at all" and "three times as much" the figures say nothing."""
KIND_COLOURS = {"good": COLOURS[2][0], "part": COLOURS[4][0], "bad": COLOURS[1][0], "open": COLOURS[7][0]}


def write_page(folder: Path) -> Path:
    """Write the page and what goes with it; returns its path. Raises InputError where the folder holds no finished readings."""
    manifest = read_manifest(folder, KIND)
    if manifest is None or not manifest.get("finished"):
        raise InputError(f"{folder}: no finished readings; testbed run SCENARIO --readings --resume completes them")
    try:
        table = _verdicts(folder)
        readings = [validate(ReadingConfig, entry, f"{folder}/manifest.json") for entry in manifest["readings"]]
        parts = [(claim, _rows_of(table, claim, k)) for k, claim in enumerate(manifest["claims"], 1)]
        standings = [_standing(claim, rows, readings) for claim, rows in parts]
    except (KeyError, ValueError) as error:
        raise InputError(f"{folder}: damaged readings: {error}") from error
    text = [
        "## Claims\n",
        markdown_table(_overview(parts, standings)),
        "\n## Readings\n",
        _reading_list(readings, manifest),
    ]
    title, kind = f"{manifest['title']}, readings", "Navigation testbed, readings of a source"
    with Folder.open(folder, KIND) as own:
        for k, ((claim, rows), where) in enumerate(zip(parts, standings, strict=True), 1):
            picture = f"figures/forest-{k:02d}.png"
            own.claim([picture])
            (folder / "figures").mkdir(exist_ok=True)
            save(Drawing(partial(forest, rows, claim), _claim_text(claim)), folder / picture, svg=False)
            own.finish(picture)
            text += [f"\n## {_name(claim, k)}: {_claim_text(claim)}\n", f"**{where.word}**. {where.sentence}\n"]
            text += [markdown_table(_table(rows)), f"\n![{_claim_text(claim)}]({picture})\n"]
        body, sentence = "\n".join(text) + "\n", _sentence(parts, standings)
        page = {
            "report.md": f"# {title}\n\n{sentence}\n\n{body}".encode(),
            "report.json": as_json(_entry(manifest, title, sentence, parts, standings)),
            "report.html": html.document(title, kind, sentence, body, folder).encode(),
        }
        own.write_all(page)
        own.save()
    return folder / "report.html"


def forest(rows: pd.DataFrame, claim: dict[str, Any]) -> Figure:
    """Effect and 95 % interval per reading (circle: ratio of means; diamond: median of ratios) beside what the source states."""
    height = 0.75 + 0.3 * len(rows)
    figure = new_figure(height)
    axis = figure.add_axes((0.30, 0.45 / height, 0.46, 1.0 - 0.55 / height))
    stated, margin = claim["paper_improvement_pct"], claim["margin_pct"]
    low, high = _limits(rows, stated or 0.0, margin or 0.0)
    axis.axvline(0.0, color="black", lw=0.8)
    if margin is not None:
        axis.axvspan(-margin, margin, color="#dddddd", lw=0, label="counts as equal")
    elif stated is not None:
        axis.axvline(stated, color="black", lw=0.8, ls="--", label="stated by the source")
    for place, row in enumerate(rows.to_dict("records")):
        colour = KIND_COLOURS[verdict_kind(row["verdict"])]
        ends = np.clip([row["ci_low"], row["ci_high"]], low, high)
        axis.plot(ends, [place, place], color=colour, lw=1.6, solid_capstyle="butt")
        for value, mark, fill in ((row["effect_pct"], "o", colour), (row["median_pct"], "D", "white")):
            inside = low <= value <= high
            shape = mark if inside else "<" if value < low else ">"
            axis.plot(np.clip(value, low, high), place, shape, color=colour, mfc=fill, ms=5, clip_on=False)
        axis.text(
            1.03, place, row["verdict"], color=colour, va="center", fontsize=8, transform=axis.get_yaxis_transform()
        )
    axis.set(xlim=(low, high), ylim=(len(rows) - 0.5, -0.5), xlabel="Lower by, %")
    axis.set_yticks(range(len(rows)), list(rows["reading"]))
    axis.tick_params(axis="y", length=0)
    axis.spines["left"].set_visible(False)
    for label, shape, fill in (("ratio of means", "o", "black"), ("median of ratios", "D", "white")):
        axis.plot([], [], shape, color="black", mfc=fill, ms=4, label=label)
    axis.xaxis.set_label_coords(-0.12, -0.24 / (height - 0.55))
    figure.legend(loc="lower right", ncols=3, fontsize=7, frameon=False, handletextpad=0.4, columnspacing=1.2)
    return figure


def _limits(rows: pd.DataFrame, *marks: float) -> tuple[float, float]:
    """What the axis shows: all intervals and medians with some room, but nothing beyond `FARTHEST`."""
    values = rows[["ci_low", "ci_high", "effect_pct", "median_pct"]].to_numpy(dtype=float).ravel()
    values = np.concatenate([values[np.isfinite(values)], [0.0], marks, [-mark for mark in marks[1:]]])
    low, high = max(-FARTHEST, values.min()), min(FARTHEST, values.max())
    room = 0.06 * max(high - low, 1.0)
    return low - room, high + room


def _verdicts(folder: Path) -> pd.DataFrame:
    paths = [folder / "verdicts.csv", folder / "verdicts-timings.csv"]
    frames = [read_csv(path, dtype={"runaways": str, "claim": str}) for path in paths if path.is_file()]
    if not frames:
        raise ValueError("verdicts.csv is missing")
    table = pd.concat(frames, ignore_index=True)
    if lacking := [name for name in COLUMNS if name not in table]:
        raise ValueError(f"verdicts.csv lacks {', '.join(lacking)}")
    return table


def _rows_of(table: pd.DataFrame, claim: dict[str, Any], number: int) -> pd.DataFrame:
    return table[table["claim"] == _name(claim, number)]


def _standing(claim: dict[str, Any], rows: pd.DataFrame, readings: list[ReadingConfig]) -> Standing:
    verdicts = dict(zip(rows["reading"], rows["verdict"], strict=True))
    return standing(readings, verdicts, claim["contradiction"])


def _overview(parts: list[tuple[dict[str, Any], pd.DataFrame]], standings: list[Standing]) -> Table:
    columns = [
        Column("Claim", numeric=False),
        Column("Whose", numeric=False),
        Column("Effects", "%"),
        Column("Class", numeric=False),
    ]
    rows = []
    for k, ((claim, effects), where) in enumerate(zip(parts, standings, strict=True), 1):
        ends = percent(effects["effect_pct"].min()), percent(effects["effect_pct"].max())
        cells = [Cell(_claim_text(claim)), Cell("source" if claim["origin"] == "paper" else "own")]
        cells += [Cell(" to ".join(dict.fromkeys(ends))), Cell(where.word, kind=verdict_kind(where.word))]
        rows.append((_name(claim, k), cells))
    return Table("classes", "Claims", columns, rows, corner="No.")


def _table(rows: pd.DataFrame) -> Table:
    """Reading, effect with interval, verdict."""
    renamed = rows.rename(columns={"effect_pct": "measured_pct", "stated_pct": "paper_pct", "runs": "n"})
    columns = [
        Column("Stated", "%"),
        Column("Effect", "%"),
        Column("95 % interval", "%", numeric=False),
        Column("Median", "%"),
        Column("Runs"),
        Column("p (Holm)"),
        Column("Verdict", numeric=False),
    ]
    cells = [(row["reading"], claim_cells(row | {"text": ""})[1:]) for row in renamed.to_dict("records")]
    told = [f"{row['reading']}: {lost}." for row in rows.to_dict("records") if (lost := _uneven(row))]
    return Table("readings", "Readings", columns, cells, " ".join(told), corner="Reading")


def _uneven(row: dict[Any, Any]) -> str:
    """Lost runs and runaways behind an effect."""
    parts = []
    if isinstance(row["runaways"], str):
        runs, without = row["runaways"].replace(" ", ", "), percent(row["trimmed_pct"])
        parts.append(f"runs far above all others: {runs} (effect without them {without} %)")
    lost = [int(row[f"lost_{side}"]) for side in ("better", "than")]
    parts += [f"runs lost: {lost[0]} of the first method, {lost[1]} of the second"] if any(lost) else []
    return "; ".join(parts)


def _reading_list(readings: list[ReadingConfig], manifest: dict[str, Any]) -> str:
    auto = manifest["auto"]
    how = (
        f"{manifest['runs']} runs each"
        if auto is None
        else f"from {auto['first']} runs on, until the interval of every claim is narrower than {auto['width_pct']:g} points, "
        f"{auto['cap']} at most"
    )
    lines = [f"Every reading with the seed {manifest['seed']}, {how}.\n"]
    for reading in readings:
        link = f"readings/{slug(reading.name)}/report.html"
        lines.append(f"- **{reading.name}** ([its own report]({link})): {reading.leaves_open}")
    return "\n".join(lines) + "\n"


def _sentence(parts: list[tuple[dict[str, Any], pd.DataFrame]], standings: list[Standing]) -> str:
    """How many claims of the source, and of our own, are of which class."""
    said = []
    for origin, whose in (("paper", "the source"), ("own", "our own")):
        words = [where.word for (claim, _), where in zip(parts, standings, strict=True) if claim["origin"] == origin]
        counts = ", ".join(_counted(word, words.count(word)) for word in dict.fromkeys(words))
        said += [f"Of {len(words)} claim{'s' * (len(words) != 1)} of {whose}: {counts}."] if words else []
    return " ".join(said)


def _counted(word: str, count: int) -> str:
    plural = {HOLDS: "hold", FAILS: "fail", INCONSISTENT: "where the source is inconsistent"}
    several = plural.get(word, word.replace("depends", "depend"))
    return f"{count} {several if count > 1 or word == INCONSISTENT else word}"


def _entry(
    manifest: dict[str, Any],
    title: str,
    sentence: str,
    parts: list[tuple[dict[str, Any], pd.DataFrame]],
    standings: list[Standing],
) -> dict[str, Any]:
    """What an index shows of the page."""
    words = [(claim["origin"], where.word) for (claim, _), where in zip(parts, standings, strict=True)]
    return {
        "scenario": manifest["scenario"],
        "variant": " ".join(filter(None, (manifest["variant"], "readings"))),
        "title": title,
        "source": manifest["source"],
        "sentence": sentence,
        "runs": int(max(rows["runs"].max() for _, rows in parts)),
        "verdicts": [word for origin, word in words if origin == "paper"],
        "own_verdicts": [word for origin, word in words if origin == "own"],
    }


def _name(claim: dict[str, Any], number: int) -> str:
    return str(claim["id"] or number)


def _claim_text(claim: dict[str, Any]) -> str:
    return (
        str(claim["text"])
        or f"{claim['better']} against {claim['than']}: {metric_label(claim['metric'])}, {window_label(claim['window'])}"
    )
