"""The pages of a league: Markdown, one HTML file that needs no network, and a figure of all tracks."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import testbed
from testbed.base.figure_style import COLOURS, STYLE, logarithmic
from testbed.league.played import Played, Table
from testbed.league.ranking import HONEST, LOST, OVER, SILENT, UNDER, Standing
from testbed.league.speeds import LEAST_US, QUICK_SEEDS, SEEDS, speed_of
from testbed.league.suite import REFERENCE, SUITE, Track
from testbed.report.html import document
from testbed.scoring.quantities import metric_label, unit

MARKS = {OVER: "▲", UNDER: "▽", SILENT: "○", LOST: "✕", "": ""}
FIGURE = "league.png"
Times = Mapping[str, Mapping[str, float]]


def pages(played: Played, made: Sequence[Table], times: Times) -> dict[str, bytes]:
    """Name -> content of what people read."""
    text = markdown(played, made, times)
    picture = figure(played, made)
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / FIGURE).write_bytes(picture)
        html = document(f"League {SUITE}", "league", headline(played), text, Path(place))
    return {
        "league.md": f"# League {SUITE}\n\n{headline(played)}\n\n{text}".encode(),
        "league.html": html.encode(),
        FIGURE: picture,
    }


def headline(played: Played) -> str:
    """What was run, in a sentence."""
    seeds = "Development" if played.development else "Test"
    count = QUICK_SEEDS if played.quick else SEEDS
    each = f"{count['fast']} of a fast row and {count['slow']} of a slow one"
    if any(entry.table.speed == "very slow" for entry in played.entries):
        each += f" ({count['very slow']} of a very slow one)"
    return (
        f"{len(played.entries)} rows on {len(played.tracks)} tracks, testbed {testbed.__version__}. {seeds} seeds, {each}"
        + ("; so few tell that a row runs and roughly where it stands, and separate little." if played.quick else ".")
    )


def markdown(played: Played, made: Sequence[Table], times: Times) -> str:
    """The tables as text; the times stand in the last one, and all above is the same bytes again."""
    parts = [_legend(), f"![Errors of all rows on all tracks]({FIGURE})"]
    shown: list[list[str]] = []
    for table in made:
        if table.division == "open" and table.order in shown and not _has_open(played, table):
            parts.append(
                f"## {table.filters.title()} filters, open division\n\nThe rows of the closed division, and no other yet."
            )
            continue
        shown.append(table.order)
        parts.append(f"## {table.filters.title()} filters, {table.division} division\n\n{_overview(played, table)}")
        parts += [_of_track(track, table) for track in played.of_class(table.filters)]
    parts += [_rows(played), _times(played, times)]
    return "\n\n".join(parts) + "\n"


def _has_open(played: Played, table: Table) -> bool:
    return any(entry.table.division == "open" for entry in played.rows("open", table.filters))


def _legend() -> str:
    return f"""Errors are geometric means over the seeds with 95 % intervals; a lost run counts with the error at which a run is lost. A row
of fewer seeds is set off against the reference on those that both have: the reference's figure times the ratio there. Places follow the errors, and a row shares the place of the one above it (=) unless it is significantly worse than one of
that place: paired t tests of the logarithms, 5 % after Holm for all pairs of a track. **Bold** wins: the best place among rows
that are honest. {MARKS[OVER]} over-confident and {MARKS[UNDER]} over-cautious: NEES over its degrees of freedom lies above {HONEST[1]} or
below {HONEST[0]} with 99 % confidence; {MARKS[SILENT]} tells no sigmas; {MARKS[LOST]} finished no run. None of these can win."""


def _overview(played: Played, table: Table) -> str:
    """Place and error of every row on every track, and the share of runs that it lost."""
    tracks = played.of_class(table.filters)
    units = [f"{track.name}, {unit(track.table.metric)}" for track in tracks]
    head = ["row", "division", "mean place", "over least", *units, "lost"]
    divisions = {entry.name: entry.table.division for entry in played.entries}
    body = []
    for name in table.order:
        places = [table.place(name, track.name) for track in tracks]
        lost, runs = sum(p.lost for p in places), sum(p.runs for p in places)
        cells = [
            f"{_place(place, table.tracks[track.name])} ({_number(place.error, 2)})"
            for place, track in zip(places, tracks, strict=True)
        ]
        mean, ratio = table.overall(name)
        body.append([name, divisions[name], f"{mean:.1f}", _number(ratio), *cells, _share(lost, runs)])
    return _grid(head, body, text=2)


def _of_track(track: Track, table: Table) -> str:
    """One track: error with interval, NEES, lost runs."""
    told = track.table
    name = f"{metric_label(told.metric)}, {unit(told.metric)}"
    body = []
    for s in table.tracks[track.name]:
        interval = "–" if s.low is None or s.high is None else f"{_number(s.low)} to {_number(s.high)}"
        nees = [_number(s.nees[group], 2) if group in s.nees else "–" for group in ("position", "velocity", "attitude")]
        mark = f"{MARKS[s.mark]} {s.mark}".strip()
        body.append(
            [
                s.entry,
                _place(s, table.tracks[track.name]),
                _number(s.error),
                interval,
                *nees,
                mark,
                _share(s.lost, s.runs),
                str(s.runs),
                s.reason.replace("|", "/"),
            ]
        )
    head = [
        "row",
        "place",
        name,
        "95 % interval",
        "NEES pos.",
        "vel.",
        "att.",
        "mark",
        "lost",
        "runs",
        "why the first was lost",
    ]
    window = "the whole run" if told.window == "all" else told.window
    return (
        f"### {track.scenario.scenario.title} (`{track.name}`, {told.length_s:g} s)\n\n{told.why} Scored over {window}.\n\n"
        + _grid(head, body, text=1)
    )


def _place(standing: Standing, among: Sequence[Standing]) -> str:
    """A place with its tie and its mark; bold where it wins."""
    tied = any(s.rank == standing.rank for s in among if s is not standing)
    text = f"{standing.rank}{'=' if tied else ''}"
    return f"**{text}**" if standing.wins else f"{text} {MARKS[standing.mark]}".strip()


def _number(value: float, digits: int = 3) -> str:
    """So many digits, and all those before the point."""
    return f"{value:.{digits}g}" if abs(value) < 10.0**digits else f"{value:.0f}"


def _share(lost: int, runs: int) -> str:
    return "0" if lost == 0 else f"{100.0 * lost / runs:.3g} %"


def _rows(played: Played) -> str:
    body = [
        [
            e.name,
            e.table.version,
            e.table.filters,
            e.table.division,
            e.how,
            e.table.licence,
            e.table.source,
            e.table.notes,
        ]
        for e in played.entries
    ]
    left = "".join(f"\n\nLeft out: {name}, which {reason}." for name, reason in played.left_out.items())
    head = ["row", "version", "class", "division", "run as", "licence", "source", "notes"]
    return "## Rows\n\n" + _grid(head, [[cell.replace("|", "/") for cell in row] for row in body], text=8) + left


def _times(played: Played, times: Times) -> str:
    """Time per sample in units of the reference's, measured in the same process right after the row."""
    body = []
    for entry in sorted(played.entries, key=lambda e: times.get(e.name, {}).get("relative", float("inf"))):
        found = times.get(entry.name)
        # by both, as on a busy machine the reference takes long as well
        least = 0.0 if found is None else min(LEAST_US[speed_of(found[key])] for key in ("us", "relative"))
        wrong = least > LEAST_US[entry.table.speed]
        cells = ["–", "–"] if found is None else [f"{found['relative']:.3g}", f"{found['us']:.3g}"]
        body.append([entry.name, *cells, f"{entry.table.speed}{', measured slower' if wrong else ''}"])
    names = " and ".join(f"`{name}` ({filters})" for filters, name in REFERENCE.items())
    return (
        f"## Time\n\nPer IMU sample, in units of {names} on the same log right after it; rows by files with the start of their program "
        "and its reading and writing. Other figures at each run.\n\n"
        + _grid(["row", "relative", "µs", "declared"], body, text=1)
    )


def _grid(head: Sequence[str], body: Sequence[Sequence[str]], text: int) -> str:
    """A table of Markdown; the first ``text`` columns to the left, the others to the right."""
    rule = [":---" if k < text else "---:" for k in range(len(head))]
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, rule, *body))


def figure(played: Played, made: Sequence[Table]) -> bytes:
    """Every track as a panel: errors of the open division's rows with intervals; hollow where a mark stands, a cross where a
    quarter of the runs is lost."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    tables = [table for table in made if table.division == "open"]
    panels = [(table, track) for table in tables for track in played.of_class(table.filters)]
    across = min(4, len(panels))
    down = -(-len(panels) // across)
    longest = max(len(table.order) for table in tables)
    with rc_context(STYLE):
        drawn = Figure(figsize=(3.1 * across, down * (1.0 + 0.16 * longest)), layout="constrained")
        FigureCanvasAgg(drawn)
        for k, (table, track) in enumerate(panels):
            _panel(drawn.add_subplot(down, across, k + 1), table, track)
        buffer = io.BytesIO()
        drawn.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return buffer.getvalue()


def _panel(axes: Any, table: Table, track: Track) -> None:
    """One track, best row on top."""
    standings = table.tracks[track.name]
    for y, s in enumerate(standings):
        colour = COLOURS[0][0] if s.mark == "" else COLOURS[1][0]
        low, high = (s.low, s.high) if s.low is not None and s.high is not None else (s.error, s.error)
        axes.plot([low, high], [y, y], color=colour, linewidth=1.0)
        marker = "x" if 4 * s.lost > s.runs else "o"
        face = colour if s.mark == "" or marker == "x" else "white"
        axes.plot([s.error], [y], marker=marker, markersize=4, color=colour, markerfacecolor=face, linestyle="none")
    axes.set_yticks(np.arange(len(standings)), [s.entry for s in standings], fontsize=6)
    axes.set_ylim(len(standings) - 0.5, -0.5)
    logarithmic(axes, "x")
    axes.set_title(track.name, fontsize=8)
    axes.set_xlabel(f"{metric_label(track.table.metric)}, {unit(track.table.metric)}", fontsize=7)
