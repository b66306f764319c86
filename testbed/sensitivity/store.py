"""The points of a plan that are evaluated, on disk: a Parquet file per method, which a resumed or longer study takes up."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from testbed.base.checksums import DamagedError, sealed_parquet, unsealed
from testbed.base.errors import InputError
from testbed.base.files import from_json, write_atomic
from testbed.data.records import Array

AGAIN = "run the same command with --resume"
EVERY_S = 10.0
"""What a kill costs at most: a few seconds of work are not worth a write of all that is done."""


class Evaluations:
    """Values (points, cells, runs) at the points (n,d) of a plan; a row that is not evaluated yet is not ``done``.

    ``keys`` (d) and ``cells`` name the columns; ``study`` is the hash of what the values depend on. Raises InputError for a file
    that is damaged or of another study.
    """

    def __init__(self, path: Path, keys: Sequence[str], cells: Sequence[str], runs: int, study: str) -> None:
        self.path, self.keys, self.cells, self.study = path, list(keys), list(cells), study
        self.columns = [f"{cell}|{run}" for cell in self.cells for run in range(runs)]
        self._runs = runs
        self._saved_at = time.monotonic()
        self._changed = False

    def take(self, points: Array) -> None:
        """Begin with these points, and what the file knows of them."""
        self.points = points
        self.values = np.full((len(points), len(self.cells), self._runs), np.nan)
        self.done = np.zeros(len(points), dtype=bool)
        self.lost = np.full(len(points), "", dtype=object)
        if self.path.exists():
            rows, lost, x, values = self._read()
            known = rows < len(points)
            rows, lost, x, values = rows[known], lost[known], x[known], values[known]
            if not np.array_equal(points[rows], x):
                raise InputError(f"{self.path}: holds another plan of points; delete it to start anew")
            self.values[rows] = values.reshape(len(rows), len(self.cells), self._runs)
            self.lost[rows], self.done[rows] = lost, True

    def missing(self) -> list[int]:
        """Rows that are not evaluated."""
        return [int(row) for row in np.flatnonzero(~self.done)]

    def first_lost(self) -> str:
        """Why the first run that was lost was."""
        return next((str(reason) for reason in self.lost if reason), "")

    def add(self, rows: Iterable[int], found: Iterable[tuple[Array, str]]) -> None:
        """Take the values (cells, runs) of some rows, and why the first lost run of each was."""
        for row, (values, lost) in zip(rows, found, strict=True):
            self.values[row], self.lost[row], self.done[row] = values, lost, True
        self._changed = True
        if time.monotonic() - self._saved_at > EVERY_S:
            self.save()

    def save(self) -> None:
        """Write the file, if there is anything new."""
        import pyarrow as pa

        self._saved_at = time.monotonic()
        if not self._changed:
            return
        rows = np.flatnonzero(self.done)
        columns = {
            "point": rows,
            "lost": list(self.lost[rows]),
            **dict(zip(self.keys, self.points[rows].T, strict=True)),
        }
        columns |= zip(self.columns, self.values[rows].reshape(len(rows), -1).T, strict=True)
        header = {"testbed": json.dumps({"study": self.study, "plan": self.path.stem}).encode()}
        write_atomic(self.path, sealed_parquet(pa.table(columns).replace_schema_metadata(header)), AGAIN)
        self._changed = False

    def _read(self) -> tuple[Array, Array, Array, Array]:
        """``rows`` (k,), reasons (k,), ``points`` (k,d) and values (k, cells * runs) of the file."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            table = pq.read_table(pa.BufferReader(unsealed(self.path)))
        except DamagedError as error:
            raise InputError(f"{error}; delete it to evaluate its points anew") from None
        header = from_json(table.schema.metadata[b"testbed"])
        if header != {"study": self.study, "plan": self.path.stem}:
            raise InputError(f"{self.path}: holds the points of another study; delete it to start anew")
        parts = (np.column_stack([table[name].to_numpy() for name in names]) for names in (self.keys, self.columns))
        lost = np.array(table["lost"].to_pylist(), dtype=object)
        return table["point"].to_numpy().astype(int), lost, *parts
