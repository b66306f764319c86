"""What a search has evaluated, on disk: enough to resume it, since an algorithm is a function of its seed and the values told.

A Parquet file per search: coordinates (no unit), objective, seconds. Written beside and renamed, so a kill leaves whole
files only. A resumed search asks again from the start and is told the stored values until they are used up.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from testbed.base.checksums import DamagedError, sealed_parquet, unsealed
from testbed.base.errors import InputError
from testbed.base.files import from_json, write_atomic
from testbed.data.records import Array

if TYPE_CHECKING:
    import pandas as pd


AGAIN = "run the same command with --resume"


class History:
    """Evaluations of one search in the order asked; ``names`` (d,) are the coordinates. Saved every ``interval_s``.

    ``relatives`` are files of searches that may have asked for the same at the same place, such as those of another length:
    an algorithm without a schedule over its whole length starts a long search as it does a short one. ``study``: hash of what
    the values depend on; what was stored for another is refused.
    """

    def __init__(
        self,
        path: Path,
        names: list[str],
        interval_s: float = 10.0,
        relatives: Sequence[Path] = (),
        study: str | None = None,
    ) -> None:
        self.path, self.names, self.interval_s, self.study = path, names, interval_s, study
        self.x, self.f, self.seconds = read_evaluations(path, names, study) if path.exists() else _empty(len(names))
        self._relatives = {other: read_evaluations(other, names, study) for other in relatives if other.exists()}
        self._replayed = 0
        self._fresh: list[tuple[Array, Array, float]] = []
        self._saved_at = time.monotonic()

    def __len__(self) -> int:
        return self._replayed + sum(len(f) for _, f, _ in self._fresh)

    def first(self) -> tuple[Path, Array, Array] | None:
        """A file with its first stored candidate (1,d) and value (1,): its own, else a relative's."""
        stored = {self.path: (self.x, self.f, self.seconds), **self._relatives}
        return next(((path, x[:1], f[:1]) for path, (x, f, _) in stored.items() if len(f)), None)

    def recall(self, x: Array) -> Array | None:
        """(n,) stored values of the candidates asked next, or None where the store ends.

        Raises InputError when the store holds other candidates: it comes from another search.
        """
        n = len(x)
        if self._fresh or self._replayed + n > len(self.f):
            if not self._fresh:
                self.x, self.f, self.seconds = (a[: self._replayed] for a in (self.x, self.f, self.seconds))
            return self._borrow(x)
        rows = slice(self._replayed, self._replayed + n)
        if not np.array_equal(self.x[rows], x):
            raise InputError(
                f"{self.path}: holds another search (candidate {self._replayed} differs); delete it to start anew"
            )
        self._replayed += n
        return self.f[rows]

    def _borrow(self, x: Array) -> Array | None:
        """(n,) values that a relative has for the same candidates at this place, or None."""
        rows = slice(len(self), len(self) + len(x))
        for other_x, other_f, seconds in self._relatives.values():
            if np.array_equal(other_x[rows], x):
                self.add(x, other_f[rows], float(seconds[rows].sum()))
                return other_f[rows]
        return None

    def add(self, x: Array, f: Array, seconds: float) -> None:
        """Take new evaluations, which took so long together."""
        self._fresh.append((x.copy(), f.copy(), seconds))
        if time.monotonic() - self._saved_at > self.interval_s:
            self.save()

    def all(self) -> tuple[Array, Array, Array]:
        """``x`` (k,d), ``f`` (k,), ``seconds`` (k,) of all that was asked so far."""
        fresh = self._fresh
        x = [self.x[: self._replayed], *(x for x, _, _ in fresh)]
        f = [self.f[: self._replayed], *(f for _, f, _ in fresh)]
        seconds = [self.seconds[: self._replayed], *(np.full(len(f), s / len(f)) for _, f, s in fresh)]
        return np.concatenate(x), np.concatenate(f), np.concatenate(seconds)

    def save(self) -> None:
        """Write the file, if there is anything new."""
        import pyarrow as pa

        self._saved_at = time.monotonic()
        if not self._fresh:
            return
        x, f, seconds = self.all()
        columns = dict(zip(self.names, x.T, strict=True)) | {"objective": f, "seconds": seconds}
        header = {"testbed": json.dumps({"study": self.study, "search": self.path.stem}).encode()}
        write_atomic(self.path, sealed_parquet(pa.table(columns).replace_schema_metadata(header)), AGAIN)


def read_evaluations(path: Path, names: list[str], study: str | None = None) -> tuple[Array, Array, Array]:
    """``x``, ``f``, ``seconds`` of a file.

    Raises InputError when it is damaged, of another search or another ``study`` (None: of any), or has other coordinates.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(pa.BufferReader(unsealed(path)))
    except DamagedError as error:
        raise InputError(f"{error}; delete it to start this search anew") from None
    header = from_json(table.schema.metadata[b"testbed"])
    if header["search"] != path.stem or study not in (None, header["study"]):
        raise InputError(f"{path}: holds the evaluations of another search or study; delete it to start this one anew")
    if table.column_names != [*names, "objective", "seconds"]:
        raise InputError(f"{path}: has the columns {', '.join(table.column_names)}; the space of the search is another")
    x = np.column_stack([table[name].to_numpy() for name in names])
    return x, table["objective"].to_numpy().copy(), table["seconds"].to_numpy().copy()


def per_iteration(f: Array, population: int) -> pd.DataFrame:
    """Columns iteration, evaluations, best (so far), mean and worst (of the iteration's candidates)."""
    import pandas as pd

    rows = []
    best = np.inf
    for k, start in enumerate(range(0, len(f), population), 1):
        part = f[start : start + population]
        best = min(best, float(part.min()))
        rows.append((k, start + len(part), best, float(part.mean()), float(part.max())))
    return pd.DataFrame(rows, columns=["iteration", "evaluations", "best", "mean", "worst"])


def _empty(size: int) -> tuple[Array, Array, Array]:
    return np.empty((0, size)), np.empty(0), np.empty(0)
