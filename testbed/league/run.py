"""The league run: rows and tracks chosen, cells computed where none of just this identity is stored, tables and pages written."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

from testbed import pipeline
from testbed.base.checksums import read_json
from testbed.base.child_processes import end_with_parent, share
from testbed.base.errors import InputError, TestbedError, nearest, tell_user
from testbed.league import drive_data, tables
from testbed.league.cells import Cell, cells_of, work
from testbed.league.entry import Entry, read_entry, shipped_entries, unique
from testbed.league.launch import build
from testbed.league.played import Played
from testbed.league.speeds import seeds_of
from testbed.league.suite import RECORDED, Track, chosen_tracks, load_track
from testbed.montecarlo.folders import Folder

KIND = "testbed league"


class Interrupted(TestbedError):
    """The user stopped the league; what is done is stored."""


@dataclass(frozen=True)
class Wanted:
    """What a call of the league asks for. ``rows`` and ``tracks``: only these; None: all there are."""

    folders: Sequence[Path] = ()
    """Of entries beside the shipped rows."""
    rows: Sequence[str] | None = None
    tracks: list[str] | None = None
    quick: bool = False
    """A few development seeds."""
    development: bool = False
    """Development seeds in place of those of the test."""
    data: Path | None = None
    """Folder of the recorded drive."""
    jobs: int = 1


def league(wanted: Wanted, out: Path) -> list[Path]:
    """Run the league into a folder; the files of its tables. Raises InputError before anything is computed, Interrupted on Ctrl-C."""
    entries, left_out = chosen_rows(wanted)
    with tempfile.TemporaryDirectory(prefix="testbed-league-") as scratch:
        tracks = _tracks(wanted, Path(scratch))
        cells = [
            cell
            for track in tracks
            for entry in entries
            if entry.table.filters == track.table.filters
            for cell in cells_of(track, entry, seeds_of(entry.table.speed, wanted.quick))
        ]
        if not cells:
            raise InputError("the league has nothing to do: no row is of the class of these tracks")
        for track in tracks:
            pipeline.fly(track.scenario)  # once, so that all workers find the flight
        with Folder.open(out, KIND) as folder:
            _complete(folder, cells, wanted.jobs, Path(scratch))
            played = Played(wanted.quick, wanted.quick or wanted.development, tuple(tracks), tuple(entries), left_out)
            written = tables.write(folder, played, _stored(folder, cells))
            folder.save()
    return written


def chosen_rows(wanted: Wanted) -> tuple[list[Entry], dict[str, str]]:
    """The rows that run here, and of those that do not, why. Raises InputError for a name that there is not."""
    entries = unique([*shipped_entries(), *(read_entry(folder) for folder in wanted.folders)])
    if wanted.rows is not None:
        known = [entry.name for entry in entries]
        for name in wanted.rows:
            if name not in known:
                raise InputError(f"--rows: no row '{name}'; {nearest(name, known)}")
        entries = [entry for entry in entries if entry.name in wanted.rows]
    left_out = {entry.name: f"needs {missing}" for entry in entries if (missing := entry.missing())}
    left_out |= {
        entry.name: "is too slow for --quick" for entry in entries if not seeds_of(entry.table.speed, wanted.quick)
    }
    for name, reason in left_out.items():
        tell_user(f"note: {name} is left out: it {reason}")
    return [entry for entry in entries if entry.name not in left_out], left_out


def _tracks(wanted: Wanted, scratch: Path) -> list[Track]:
    names = chosen_tracks(wanted.tracks, wanted.data is not None)
    recording = None if wanted.data is None else drive_data.prepared(wanted.data, scratch / "drive")
    seeds = wanted.quick or wanted.development
    return [load_track(name, seeds, recording if name in RECORDED else None) for name in names]


def _complete(folder: Folder, cells: Sequence[Cell], jobs: int, scratch: Path) -> None:
    """Compute the cells that are missing."""
    due = [cell for cell in cells if cell.stored(folder.out) is None]
    if len(due) < len(cells):
        tell_user(f"league: {len(cells) - len(due)} of {len(cells)} cells are there already")
    if not due:
        return
    folder.claim([name for cell in due for name in (cell.name, cell.timings)])
    built = {}
    for entry in {cell.entry.name: cell.entry for cell in due}.values():
        if (made := build(entry, scratch / "built")) is not None:
            built[entry.name] = made
    blocks: dict[tuple[str, int], list[Cell]] = {}
    for cell in due:
        blocks.setdefault((cell.track.name, cell.first), []).append(cell)
    longest = sorted(
        blocks.values(), key=lambda block: -block[0].track.table.length_s * sum(c.last - c.first for c in block)
    )
    tasks: list[Callable[[], object]] = [partial(_work, block, folder.out, built) for block in longest]
    try:
        share(tasks, jobs)
    except KeyboardInterrupt:
        raise Interrupted(f"{folder.out}: stopped; the same command goes on with what is missing") from None


def _work(cells: Sequence[Cell], out: Path, built: dict[str, Path]) -> None:
    if parent_process() is not None:
        end_with_parent()
    todo = [cell for cell in cells if cell.stored(out) is None]  # a task that failed in a copy is done again
    if todo:
        work(todo, out, built)
        first, last = todo[0].first, max(cell.last for cell in todo)
        tell_user(f"league: {todo[0].track.name}, runs {first} to {last - 1}: {len(todo)} rows done")


def _stored(folder: Folder, cells: Sequence[Cell]) -> list[tuple[Cell, dict[str, Any], dict[str, Any]]]:
    """Every cell with its content and its seconds."""
    found = []
    for cell in cells:
        held = cell.stored(folder.out)
        if held is None:
            raise TestbedError(f"{folder.out / cell.name}: was not computed; run the same command again")
        found.append((cell, held, read_json(folder.out / cell.timings)))
        for name in (cell.name, cell.timings):
            if folder.files.get(name) is None:
                folder.finish(name)
    return found


def default_jobs() -> int:
    """One per core."""
    return os.cpu_count() or 1
