"""The result folder: one atomic file per run, a manifest that says what it is a result of, and how to resume.

``runs/NNNNNN.parquet`` holds the scores of a run (estimator, window, metric, value) and its error series (estimator,
metric, series at 1 Hz or slower) in SI units and degrees; its header the status of each estimator. A file is written
under a temporary name and renamed, so a kill at any moment leaves whole files only.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.errors import InputError, TestbedError
from testbed.units import Outcome, UnitResult

if TYPE_CHECKING:
    import pyarrow as pa

KIND = "testbed result"
MANIFEST = "manifest.json"
_OWN_FILES = (
    *(
        "scenario.toml",
        "metrics.parquet",
        "runs.parquet",
        "summary.csv",
        "timings.csv",
        "claims.csv",
        "consistency.csv",
    ),
    *(
        "claims-timings.csv",
        "improvements.csv",
        "envelopes.parquet",
        "report.html",
        "report.md",
        "report.json",
        "tables.tex",
        MANIFEST,
    ),
)
_OWN_FOLDERS = ("runs", "details", "figures", ".scratch")


class StoreError(TestbedError):
    """The result folder could not be written (disk full, permissions)."""


def encode(result: UnitResult) -> bytes:
    """A unit as the bytes of its Parquet file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

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
    header = {"run": result.run, "outcomes": [asdict(o) for o in result.outcomes]}
    buffer = io.BytesIO()
    pq.write_table(table.replace_schema_metadata({"testbed": json.dumps(header).encode()}), buffer)
    return buffer.getvalue()


@dataclass(frozen=True)
class StoredRun:
    """The file of a run: ``keys`` (Arrow table: estimator, window, metric) beside ``values``, and the series."""

    run: int
    outcomes: list[Outcome]
    keys: pa.Table
    values: np.ndarray
    series: dict[tuple[str, str], np.ndarray]


def decode(source: Path | bytes) -> StoredRun:
    """Inverse of `encode` (``files`` are not kept)."""
    import pyarrow.parquet as pq

    table = (
        pq.ParquetFile(io.BytesIO(source) if isinstance(source, bytes) else source)
        .read(use_threads=False)
        .combine_chunks()
    )
    header = json.loads(table.schema.metadata[b"testbed"])
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


class Store:
    """A result folder that is being filled."""

    def __init__(self, out: Path, manifest: dict[str, Any]) -> None:
        self.out, self.manifest = out, manifest

    @classmethod
    def create(cls, out: str | Path, identity: Mapping[str, Any], scenario_toml: str, resume: bool) -> Store:
        """Make or reopen a folder. ``identity`` is what a resumed batch must agree on.

        Without ``resume`` a finished result is replaced; an unfinished one, or a folder of other things, is refused.
        """
        out = Path(out)
        if out.exists() and not out.is_dir():
            raise InputError(f"{out}: is a file, not a folder for results")
        previous = read_manifest(out)
        if resume and previous is not None:
            for key, value in identity.items():
                if previous.get("identity", {}).get(key) != value:
                    raise InputError(
                        f"{out}: holds results of another batch ({key} was {previous.get('identity', {}).get(key)}, is {value}); "
                        "resume with the scenario, seed, estimators and plug-ins it was started with, or give another --out"
                    )
            return cls(out, previous)
        if previous is None and out.exists() and any(p.name != "findings.md" for p in out.iterdir()):
            raise InputError(f"{out}: is not empty and holds no result of the testbed; give another --out")
        if previous is not None and not previous.get("finished") and any((out / "runs").glob("*.parquet")):
            raise InputError(
                f"{out}: holds an unfinished result; complete it with --resume, delete the folder, or give another --out"
            )
        with writing(out):
            if previous is not None:
                _clear(out)
            store = cls(out, {"kind": KIND, "identity": dict(identity), "finished": False})
            (out / "runs").mkdir(parents=True, exist_ok=True)
            store.write("scenario.toml", scenario_toml.encode())
            store.save_manifest()
        return store

    def update_manifest(self, **values: Any) -> None:
        """Set entries of the manifest and write it."""
        self.manifest |= values
        self.save_manifest()

    def save_manifest(self) -> None:
        """Write ``manifest.json``."""
        self.write(MANIFEST, (json.dumps(self.manifest, indent=1, ensure_ascii=False) + "\n").encode())

    def write(self, name: str, content: bytes) -> None:
        """Write a file of the folder atomically. Raises StoreError when the disk does not take it."""
        write_atomic(self.out / name, content, self.out)

    def run_path(self, run: int) -> Path:
        """The file of a run."""
        return self.out / "runs" / f"{run:06d}.parquet"

    def write_run(self, run: int, content: bytes, files: Mapping[str, bytes]) -> None:
        """Store a unit; files for ``details`` go first, so that a stored run is a complete one."""
        for name, data in files.items():
            self.write(f"details/{name}", data)
        self.write(f"runs/{run:06d}.parquet", content)

    def finished_runs(self) -> list[int]:
        """Runs whose file is whole, in order. Left-over temporary and damaged files are removed."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        done = []
        for path in sorted((self.out / "runs").iterdir()):
            if path.suffix == ".parquet" and path.stem.isdigit():
                try:
                    pq.read_metadata(path)
                    done.append(int(path.stem))
                    continue
                except (pa.ArrowInvalid, OSError):
                    pass
            path.unlink()
        return done


def read_manifest(out: Path) -> dict[str, Any] | None:
    """The manifest of a result folder, or None where there is none."""
    try:
        manifest = json.loads((out / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return manifest if isinstance(manifest, dict) and manifest.get("kind") == KIND else None


def open_result(out: str | Path) -> Store:
    """A finished or unfinished result for reading. Raises InputError when the folder is none."""
    manifest = read_manifest(Path(out))
    if manifest is None:
        raise InputError(f"{out}: no result of the testbed (no {MANIFEST})")
    return Store(Path(out), manifest)


def files_digest(paths: Iterable[str | Path]) -> str:
    """Hash of the contents of files: a changed plug-in is another batch."""
    digest = hashlib.sha256()
    for path in paths:
        try:
            digest.update(Path(path).read_bytes())
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    return digest.hexdigest()[:16]


def write_json(path: Path, data: object) -> None:
    """`write_atomic` of JSON."""
    write_atomic(path, (json.dumps(data, indent=1, ensure_ascii=False) + "\n").encode())


@contextmanager
def writing(out: Path) -> Iterator[None]:
    """Turn the operating system's refusals into a message that says how to go on."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            reason = "the disk is full; free some space, then run the same command with --resume"
        else:
            reason = f"cannot write: {error.strerror or error}; once that is mended, run the same command with --resume"
        raise StoreError(f"{out}: {reason}") from error


def write_atomic(path: Path, content: bytes, folder: Path | None = None) -> None:
    """Write a whole file or none. Raises StoreError, which names ``folder`` or the file's own, when the disk does not take it."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with writing(folder or path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(content)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def _clear(out: Path) -> None:
    """Remove what an earlier batch wrote, and nothing else; the manifest last."""
    for name in _OWN_FOLDERS:
        shutil.rmtree(out / name, ignore_errors=True)
    for name in _OWN_FILES:
        (out / name).unlink(missing_ok=True)


class ColumnStore:
    """Rows of floats on disk, appended one by one and read back column-wise, so that memory does not grow with rows.

    A row may be longer than those before it; what it lacks is NaN.
    """

    def __init__(self, path: Path, dtype: Any = np.float64) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.dtype = np.dtype(dtype)
        self._file = path.open("w+b")
        self._path = path
        self._spans: list[tuple[int, int]] = []
        self._end = 0

    def append(self, row: np.ndarray) -> None:
        """Add a row."""
        data = np.ascontiguousarray(row, dtype=self.dtype)
        with writing(self._path.parent.parent):
            self._file.write(data.data)
        self._spans.append((self._end, len(data)))
        self._end += data.nbytes

    def columns(self, start: int, stop: int) -> np.ndarray:
        """(rows, stop - start) values of a block of columns."""
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
        self._file.close()
        self._path.unlink(missing_ok=True)
