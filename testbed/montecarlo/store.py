"""The result folder: one atomic file per run, a manifest that says what it is a result of, and how to resume.

``runs/NNNNNN.parquet`` holds the scores of a run (estimator, window, metric, value) and its error series (estimator,
metric, series at 1 Hz or slower) in SI units and degrees; its header the status of each estimator, the run's number, and
the hash of the batch (scenario, seed, plug-ins, version) that it belongs to. A file is written under a temporary name and
renamed, so a kill at any moment leaves whole files only; what does not carry its batch and the hash of its content is
never read.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from testbed.base.checksums import DamagedError, digest, is_sealed, sealed_parquet, unsealed
from testbed.base.errors import InputError
from testbed.base.files import StoreError, from_json, left_over, remove, write_atomic, writing
from testbed.base.schema import parse_toml
from testbed.montecarlo.folders import MANIFEST, Folder, check_own, read_manifest, tables_that_differ
from testbed.montecarlo.work_unit import Outcome, UnitResult
from testbed.scenario import PRESENTED

if TYPE_CHECKING:
    import pyarrow as pa

KIND = "testbed result"
FORMAT = 2
"""Of the stored runs; version 0.1 wrote the first, without hashes."""
SCRATCH = (".scratch/values", ".scratch/series", ".scratch/metrics.parquet")
"""What only lasts while the tables are made: two `ColumnStore` and the table of metrics."""
_RUN = re.compile(r"[0-9]{6,}\.parquet")
__all__ = (
    "ColumnStore",
    "Store",
    "StoreError",
    "StoredRun",
    "batch_of",
    "decode",
    "encode",
    "open_result",
    "optional_part",
    "read_part",
)


def batch_of(identity: Mapping[str, Any]) -> str:
    """Hash of what all runs of a batch share."""
    return digest(json.dumps(dict(identity), sort_keys=True).encode())[:32]


def encode(result: UnitResult, batch: str = "") -> bytes:
    """A unit of the batch with this hash as the bytes of its Parquet file."""
    import pyarrow as pa

    rows, series = result.rows, result.series
    empty = [None] * len(series)
    table = pa.table(
        {
            "estimator": pa.array([r[0] for r in rows] + [key[0] for key in series]).cast(pa.string()),
            "window": pa.array([r[1] for r in rows] + empty, pa.string()),
            "metric": pa.array([r[2] for r in rows] + [key[1] for key in series], pa.string()),
            "value": pa.array([r[3] for r in rows] + empty, pa.float64()),
            "series": pa.array([None] * len(rows) + list(series.values()), pa.list_(pa.float32())),
        }
    )
    header = {"batch": batch, "run": result.run, "outcomes": [asdict(o) for o in result.outcomes]}
    return sealed_parquet(table.replace_schema_metadata({"testbed": json.dumps(header).encode()}))


@dataclass(frozen=True)
class StoredRun:
    """The file of a run: ``keys`` (Arrow table: estimator, window, metric) beside ``values``, and the series."""

    run: int
    outcomes: list[Outcome]
    keys: pa.Table
    values: np.ndarray
    series: dict[tuple[str, str], np.ndarray]


def decode(source: Path | bytes, batch: str = "", run: int | None = None) -> StoredRun:
    """Inverse of `encode` (``files`` are not kept).

    Raises DamagedError when the content is not what was written, or is of another batch or another ``run``.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    where = "stored run" if isinstance(source, bytes) else str(source)
    content = unsealed(source, where)
    table = pq.ParquetFile(pa.BufferReader(content)).read(use_threads=False).combine_chunks()
    header = from_json(table.schema.metadata[b"testbed"])
    if header["batch"] != batch or run not in (None, header["run"]):
        raise DamagedError(
            f"{where}: is run {header['run']} of another batch"
            if header["batch"] != batch
            else f"{where}: is run {header['run']}, not run {run}"
        )
    scored = len(table) - table["window"].null_count
    keys = table.select(["estimator", "window", "metric"]).replace_schema_metadata(None)
    names = keys.slice(scored).to_pydict()
    arrays = table["series"].combine_chunks()
    series = {
        key: arrays[scored + k].values.to_numpy(zero_copy_only=False)
        for k, key in enumerate(zip(names["estimator"], names["metric"], strict=True))
    }
    values = table["value"].to_numpy()[:scored]
    return StoredRun(header["run"], [Outcome(**o) for o in header["outcomes"]], keys.slice(0, scored), values, series)


class Store(Folder):
    """A result folder that is being filled."""

    again = "run the same command with --resume"

    @classmethod
    def create(cls, out: str | Path, identity: Mapping[str, Any], scenario_toml: str, resume: bool) -> Self:
        """Make or reopen a folder, to be closed. ``identity`` is what a resumed batch must agree on.

        Without ``resume`` a finished result is replaced; an unfinished one, or a folder of other things, is refused.
        """
        previous = check_own(Path(out), KIND)
        if resume and previous is not None:
            _check_identity(Path(out), previous, identity, scenario_toml)
        elif previous is not None:
            _check_replaceable(Path(out), previous)
        store = cls.open(out, KIND)
        try:
            if not resume or previous is None:
                store._begin(identity, scenario_toml)
            elif not (store.out / "scenario.toml").is_file():  # killed, or the disk full, just after the manifest
                store.write_all({"scenario.toml": scenario_toml.encode()})
        except BaseException:
            store.close()
            raise
        return store

    def _begin(self, identity: Mapping[str, Any], scenario_toml: str) -> None:
        """Start a batch, in place of an earlier one: its manifest goes first, so that no kill leaves old runs under a new name."""
        old = [name for name in self.files if name != MANIFEST]
        earlier = self._run_files()
        self.manifest = {"kind": KIND, "identity": dict(identity), "finished": False, "files": dict.fromkeys(old)}
        self.save()
        remove(earlier, self.again)
        self.delete(old)
        self.manifest["files"] = {}
        self.write_all({"scenario.toml": scenario_toml.encode()})

    @property
    def batch(self) -> str:
        """The hash that the runs of this batch carry."""
        return batch_of(self.manifest["identity"])

    def run_path(self, run: int) -> Path:
        """The file of a run."""
        return self.out / "runs" / f"{run:06d}.parquet"

    def write_run(self, run: int, content: bytes, files: Mapping[str, bytes]) -> None:
        """Store a unit; files for ``details`` go first, so that a stored run is a complete one."""
        if files:
            self.write_all({f"details/{name}": data for name, data in files.items()})
        write_atomic(self.run_path(run), content, self.again)

    def finished_runs(self, tell: Callable[[str], None] | None = None) -> list[int]:
        """Runs that are stored whole, in order; what a kill left is removed.

        A run that is damaged or of another batch is none: ``tell`` is told, and it will be computed again. Raises InputError
        when a file of somebody else has the name of a run.
        """
        done = []
        for path in self._run_files():
            number = int(path.stem)
            try:
                decode(path, self.batch, number)
                if number == 0:
                    for name in [name for name in self.files if name.startswith("details/")]:
                        self.check(name)
            except DamagedError as error:
                if tell is not None:
                    tell(f"{error}; run {number} is computed again")
                continue
            done.append(number)
        return done

    def _run_files(self) -> list[Path]:
        """The files of runs, in order; left-over temporary ones are removed. Raises InputError for a file that is none."""
        folder = self.out / "runs"
        if not folder.is_dir():
            return []
        own = []
        for path in sorted(folder.iterdir()):
            if _RUN.fullmatch(left_over(path) or ""):
                remove([path], self.again)
            elif _RUN.fullmatch(path.name):
                if not _is_run(path):
                    raise InputError(f"{path}: has the name of a stored run but is none; move it away")
                own.append(path)
        return own


def _is_run(path: Path) -> bool:
    """Whether a file was once a stored run, whatever has befallen it since: Parquet's first bytes, a seal, or nothing at all."""
    if path.is_symlink() or not path.is_file():
        return False
    content = path.read_bytes()
    return not content or content.startswith(b"PAR1") or is_sealed(content)


def _check_identity(out: Path, previous: Mapping[str, Any], identity: Mapping[str, Any], scenario_toml: str) -> None:
    """Raise InputError where a folder holds another batch; of another scenario the tables that differ are named."""
    known = previous.get("identity")
    known = known if isinstance(known, dict) else {}
    for key, value in identity.items():
        if known.get(key) != value:
            what = f"{key} was {known.get(key)}, is {value}"
            if key == "scenario":
                other = _other_tables(out / "scenario.toml", scenario_toml)
                what = f"{', '.join(other)} {'differs' if len(other) == 1 else 'differ'}"
            raise InputError(
                f"{out}: holds results of another batch ({what}); "
                "resume with the scenario, seed, estimators and plug-ins it was started with, or give another --out"
            )


def _other_tables(stored: Path, scenario_toml: str) -> list[str]:
    """The tables in which the scenario of a batch and a stored one differ, of those that determine a run."""
    try:
        tables = [parse_toml(text, str(stored)) for text in (scenario_toml, stored.read_text(encoding="utf-8"))]
    except (InputError, OSError, UnicodeDecodeError):
        return ["the scenario"]
    for table in tables:
        for key in PRESENTED:
            table.pop(key, None)
        table.get("monte_carlo", {}).pop("runs", None)
    return tables_that_differ(*tables) or ["a file that the scenario names, or the aircraft's model,"]


def _check_replaceable(out: Path, previous: Mapping[str, Any]) -> None:
    """Raise InputError where a new batch must not take the place of what there is."""
    if not previous.get("finished") and any((out / "runs").glob("*.parquet")):
        raise InputError(
            f"{out}: holds an unfinished result; complete it with --resume, delete the folder, or give another --out"
        )
    if previous.get("files") is None:
        raise InputError(
            f"{out}: holds a result of version 0.1, which kept no list of what it wrote; delete the folder, or give another --out"
        )


def open_result(out: str | Path) -> Store:
    """A finished or unfinished result for reading. Raises InputError when the folder is none, DamagedError for a damaged one."""
    manifest = read_manifest(out, KIND)
    if manifest is None:
        raise InputError(f"{out}: no result of the testbed (no {MANIFEST} of one)")
    return Store(Path(out), manifest)


def read_part(store: Store, name: str, read: Callable[[Path], Any]) -> Any:
    """What ``read(path)`` makes of a file of a result that is there and undamaged.

    Raises InputError that names the file when it is not.
    """
    path = store.check(name)
    if not path.is_file():
        raise InputError(f"{path}: {'is no file' if path.exists() else 'is missing'}")
    try:
        return read(path)
    except InputError:
        raise
    except Exception as error:  # whatever a reader of CSV, Parquet, TOML or JSON stumbles over
        reason = str(error).strip().split("\n")[0][:200]
        raise InputError(f"{path}: damaged ({type(error).__name__}: {reason})") from error


def optional_part(store: Store, name: str, read: Callable[[Path], Any]) -> Any:
    """`read_part`, None where the manifest lists no such file and there is none."""
    return read_part(store, name, read) if store.check(name).exists() else None


def files_digest(paths: Iterable[str | Path]) -> str:
    """Hash of the contents of files: a changed plug-in is another batch."""
    digest = hashlib.sha256()
    for path in paths:
        try:
            digest.update(Path(path).read_bytes())
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    return digest.hexdigest()[:16]


class ColumnStore:
    """Rows of floats on disk, appended one by one and read back column-wise, so that memory does not grow with rows.

    A row may be longer than those before it; what it lacks is NaN.
    """

    def __init__(self, path: Path, dtype: Any = np.float64) -> None:
        self.dtype = np.dtype(dtype)
        with writing(path.parent.parent, Store.again):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("w+b")
        self._path = path
        self._spans: list[tuple[int, int]] = []
        self._end = 0

    def append(self, row: np.ndarray) -> None:
        """Add a row."""
        data = np.ascontiguousarray(row, dtype=self.dtype)
        with writing(self._path.parent.parent, Store.again):
            self._file.write(data.data)
        self._spans.append((self._end, len(data)))
        self._end += data.nbytes

    def columns(self, start: int, stop: int) -> np.ndarray:
        """(rows, stop - start) values of a block of columns."""
        with writing(self._path.parent.parent, Store.again):
            self._file.flush()
        out = np.full((len(self._spans), stop - start), np.nan, dtype=self.dtype)
        size, descriptor = self.dtype.itemsize, self._file.fileno()
        for k, (offset, length) in enumerate(self._spans):
            n = min(stop, length) - start
            if n > 0:
                out[k, :n] = np.frombuffer(os.pread(descriptor, n * size, offset + start * size), dtype=self.dtype)
        return out

    def __len__(self) -> int:
        return len(self._spans)

    def close(self) -> None:
        """Delete the file."""
        with contextlib.suppress(OSError):  # a full disk, told when it mattered
            self._file.close()
        self._path.unlink(missing_ok=True)
