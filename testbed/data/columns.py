"""How records stand on disk: columns with their unit in the name, in Parquet files that say what they hold.

Angles are in degrees for the reader; the columns that `exact_columns` adds give latitude, longitude and attitude back bit
for bit. SI units otherwise.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.checksums import check_seal, sealed_parquet
from testbed.base.errors import InputError
from testbed.base.files import from_json, write_atomic

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]


def columns(pattern: str, names: Any, values: Array) -> dict[str, Array]:
    """The columns of ``values`` (N,n) under the pattern's names."""
    return {pattern.format(name): values[:, i] for i, name in enumerate(names)}


def stack(table: Mapping[str, Array], pattern: str, names: Any) -> Array:
    """`columns` backwards: (N,n) of a table."""
    return np.column_stack([table[pattern.format(name)] for name in names])


def exact_columns(lat: Array, lon: Array, q_nb: Array) -> dict[str, Array]:
    """What degrees would round: radians and the quaternion."""
    return columns("q_nb_{}", range(4), q_nb) | {"lat_rad": lat, "lon_rad": lon}


def pva_columns(t: Array, lat: Array, lon: Array, h: Array, v_n: Array, q_nb: Array) -> dict[str, Array]:
    """Time, position, velocity and attitude as a table shows them."""
    from testbed.physics.rotations import quats_to_eulers

    euler = np.degrees(quats_to_eulers(q_nb))
    place = {"time_s": t, "lat_deg": np.degrees(lat), "lon_deg": np.degrees(lon), "alt_m": h}
    velocity = columns("v_{}_mps", ("north", "east", "down"), v_n)
    return place | velocity | columns("{}_deg", ("roll", "pitch", "yaw"), euler)


def read_pva(table: Mapping[str, Array]) -> dict[str, Any]:
    """t, lat, lon, h, v_n and q_nb of a table with `pva_columns` and `exact_columns`."""

    def angle(name: str) -> Array:
        exact = f"{name}_rad"
        return table[exact] if exact in table else np.radians(table[f"{name}_deg"])

    return {
        "t": table["time_s"],
        "lat": angle("lat"),
        "lon": angle("lon"),
        "h": table["alt_m"],
        "v_n": stack(table, "v_{}_mps", ("north", "east", "down")),
        "q_nb": stack(table, "q_nb_{}", range(4)),
    }


def write_table(frame: pd.DataFrame, path: str | Path, kind: str, meta: dict[str, Any]) -> None:
    """Write a Parquet file whose header holds ``kind`` and ``meta``, and which carries the hash of its content."""
    import pyarrow as pa

    table = pa.Table.from_pandas(frame, preserve_index=False)
    header = {"testbed": json.dumps({"kind": kind} | meta).encode()}
    write_atomic(Path(path), sealed_parquet(table.replace_schema_metadata(header)))


def read_table(path: str | Path, kind: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """Columns and header of a file of this kind, undamaged. Raises InputError for anything else."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not Path(path).exists():
        raise InputError(f"{path}: no such file")
    check_seal(path)
    try:
        with pq.ParquetFile(path) as file:
            table = file.read()
        meta = from_json((table.schema.metadata or {}).get(b"testbed", b"{}"))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable Parquet file ({error})") from None
    if not isinstance(meta, dict) or meta.get("kind") != kind:
        meta = meta if isinstance(meta, dict) else {}
        raise InputError(f"{path}: holds {meta.get('kind') or 'no record of the testbed'}, expected {kind}")
    return {name: _values(table[name]) for name in table.column_names}, meta


def read_header(path: str | Path) -> dict[str, Any]:
    """The header of a file that `read_table` has read."""
    import pyarrow.parquet as pq

    header: dict[str, Any] = from_json((pq.read_schema(path).metadata or {})[b"testbed"])
    return header


def _values(column: Any) -> Array:
    """A column as an array of its own; the usual one without pandas, which pyarrow's own conversion imports."""
    import pyarrow as pa

    plain = column.num_chunks == 1 and not column.null_count and pa.types.is_floating(column.type)
    return np.array(np.from_dlpack(column.chunk(0)) if plain else column)
