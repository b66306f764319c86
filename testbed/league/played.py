"""A league that was played, and the table of a division and class: what is computed in `tables` and shown in `page`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from testbed.league import ranking
from testbed.league.entry import Entry
from testbed.league.ranking import Standing
from testbed.league.suite import Track


@dataclass(frozen=True)
class Played:
    """A league that was played: which seeds, tracks and rows."""

    quick: bool
    development: bool
    tracks: tuple[Track, ...]
    entries: tuple[Entry, ...]
    left_out: Mapping[str, str]

    def of_class(self, filters: str) -> list[Track]:
        """The tracks of a class."""
        return [track for track in self.tracks if track.table.filters == filters]

    def rows(self, division: str, filters: str) -> list[Entry]:
        """The rows of a table: those of the closed division stand in the open one, too."""
        mine = [entry for entry in self.entries if entry.table.filters == filters]
        return [entry for entry in mine if division == "open" or entry.table.division == "closed"]


@dataclass(frozen=True)
class Table:
    """A division's table of a class: the standings of each track, and the rows in order of their mean place, and of their errors."""

    division: str
    filters: str
    tracks: dict[str, list[Standing]]
    order: list[str]

    def place(self, entry: str, track: str) -> Standing:
        """A row's standing on a track."""
        return next(s for s in self.tracks[track] if s.entry == entry)

    def overall(self, entry: str) -> tuple[float, float]:
        """Mean place of a row, and its mean error over the least."""
        return ranking.overall(self.tracks, entry)
