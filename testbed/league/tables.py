"""What the league says: ``league.json`` (the same bytes again), and ``league.md``, ``league.html``, ``league.png`` with the times.

A division's table ranks its rows among themselves: closed those that use the given sensors and specifications, open all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import testbed
from testbed.base.checksums import sealed_json
from testbed.league import page, ranking
from testbed.league.cells import Cell
from testbed.league.entry import Entry
from testbed.league.played import Played, Table
from testbed.league.speeds import QUICK_SEEDS, SEEDS
from testbed.league.suite import REFERENCE, SUITE, Track
from testbed.montecarlo.folders import Folder

DIVISIONS = ("closed", "open")
CLASSES = ("position", "attitude")
OVERALL = ("entry", "mean_rank", "error_over_least")
Stored = Sequence[tuple[Cell, dict[str, Any], dict[str, Any]]]


def write(folder: Folder, played: Played, stored: Stored) -> list[Path]:
    """Write the tables into a folder; their files."""
    runs = runs_of(stored)
    made = [
        table
        for filters in CLASSES
        for division in DIVISIONS
        if (table := _table(played, division, filters, runs)) is not None
    ]
    times = times_of(stored)
    contents = {
        "league.json": sealed_json(as_data(played, made)),
        "timings.json": sealed_json({"us_per_sample": times}),
        **page.pages(played, made, times),
    }
    folder.write_all(contents)
    return [folder.out / name for name in contents]


def runs_of(stored: Stored) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """(track, entry) -> its runs in order."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for cell, held, _ in sorted(stored, key=lambda each: each[0].first):
        found.setdefault((cell.track.name, cell.entry.name), []).extend(held["runs"])
    return found


def times_of(stored: Stored) -> dict[str, dict[str, float]]:
    """Of each row the median over its runs of the time per sample in units of the reference's, and in µs."""
    ratios: dict[str, list[float]] = {}
    plain: dict[str, list[float]] = {}
    for cell, _, times in stored:
        for own, reference in zip(times["us"], times["reference_us"], strict=True):
            if own is not None and reference:
                ratios.setdefault(cell.entry.name, []).append(own / reference)
                plain.setdefault(cell.entry.name, []).append(own)
    return {name: {"relative": float(np.median(ratios[name])), "us": float(np.median(plain[name]))} for name in ratios}


def _table(played: Played, division: str, filters: str, runs: Mapping[tuple[str, str], Any]) -> Table | None:
    tracks, rows = played.of_class(filters), played.rows(division, filters)
    if not tracks or not rows:
        return None
    standings = {t.name: ranking.table(t, {e.name: runs[t.name, e.name] for e in rows}) for t in tracks}
    names = sorted((e.name for e in rows), key=lambda name: (*ranking.overall(standings, name), name))
    return Table(division, filters, standings, names)


def as_data(played: Played, made: Sequence[Table]) -> dict[str, Any]:
    """``league.json``: a pure function of suite, seeds, entries and code."""
    return {
        "suite": SUITE,
        "testbed": testbed.__version__,
        "seeds": "development" if played.development else "test",
        "runs": QUICK_SEEDS if played.quick else SEEDS,
        "reference": REFERENCE,
        "tracks": [_track(track) for track in played.tracks],
        "entries": [_entry(entry) for entry in played.entries],
        "left_out": dict(played.left_out),
        "tables": [
            {
                "division": table.division,
                "class": table.filters,
                "rows": [dict(zip(OVERALL, (name, *table.overall(name)), strict=True)) for name in table.order],
                "tracks": {track: [asdict(s) for s in standings] for track, standings in table.tracks.items()},
            }
            for table in made
        ],
    }


def _track(track: Track) -> dict[str, Any]:
    told = track.table
    return {
        "name": track.name,
        "title": track.scenario.scenario.title,
        "class": told.filters,
        "metric": told.metric,
        "window": told.window,
        "length_s": told.length_s,
        "seed": track.scenario.monte_carlo.seed,
        "lost_counts_as": ranking.limit_of(track),
        "why": told.why,
    }


def _entry(entry: Entry) -> dict[str, Any]:
    told = entry.table.model_dump(mode="json", by_alias=True, exclude={"plugin", "named", "eskf", "answers"})
    return told | {"how": entry.how, "digest": entry.digest}
