"""How records stand on disk: columns with their unit in the name, in Parquet files that say what they hold.

Angles are in degrees for the reader; the columns that `exact_columns` adds give latitude, longitude and attitude back bit
for bit. SI units otherwise.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]


def columns(pattern: str, names: Any, values: Array) -> dict[str, Array]:
    """The columns of ``values`` (N,n) under the pattern's names."""
    return {pattern.format(name): values[:, i] for i, name in enumerate(names)}


def stack(frame: pd.DataFrame, pattern: str, names: Any) -> Array:
    """`columns` backwards: (N,n) of a frame."""
    return np.column_stack([frame[pattern.format(name)].to_numpy() for name in names])


def exact_columns(lat: Array, lon: Array, q_nb: Array) -> dict[str, Array]:
    """What degrees would round: radians and the quaternion."""
    return columns("q_nb_{}", range(4), q_nb) | {"lat_rad": lat, "lon_rad": lon}


def pva_columns(t: Array, lat: Array, lon: Array, h: Array, v_n: Array, q_nb: Array) -> dict[str, Array]:
    """Time, position, velocity and attitude as a table shows them."""
    from testbed.rotations import quats_to_eulers

    euler = np.degrees(quats_to_eulers(q_nb))
    place = {"time_s": t, "lat_deg": np.degrees(lat), "lon_deg": np.degrees(lon), "alt_m": h}
    velocity = columns("v_{}_mps", ("north", "east", "down"), v_n)
    return place | velocity | columns("{}_deg", ("roll", "pitch", "yaw"), euler)


def read_pva(frame: pd.DataFrame) -> dict[str, Any]:
    """t, lat, lon, h, v_n and q_nb of a frame with `pva_columns` and `exact_columns`."""

    def angle(name: str) -> Array:
        exact = f"{name}_rad"
        return frame[exact].to_numpy() if exact in frame else np.radians(frame[f"{name}_deg"].to_numpy())

    return {
        "t": frame["time_s"].to_numpy(),
        "lat": angle("lat"),
        "lon": angle("lon"),
        "h": frame["alt_m"].to_numpy(),
        "v_n": stack(frame, "v_{}_mps", ("north", "east", "down")),
        "q_nb": stack(frame, "q_nb_{}", range(4)),
    }


def write_table(frame: pd.DataFrame, path: str | Path, kind: str, meta: dict[str, Any]) -> None:
    """Write a Parquet file whose header holds ``kind`` and ``meta``."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.Table.from_pandas(frame, preserve_index=False)
    header = {"testbed": json.dumps({"kind": kind} | meta).encode()}
    pq.write_table(table.replace_schema_metadata(header), path)


def read_table(path: str | Path, kind: str) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Frame and header of a file of this kind. Raises InputError for anything else."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise InputError(f"{path}: not a readable Parquet file ({error})") from None
    meta = json.loads((table.schema.metadata or {}).get(b"testbed", b"{}"))
    if meta.get("kind") != kind:
        raise InputError(f"{path}: holds {meta.get('kind') or 'no record of the testbed'}, expected {kind}")
    return table.to_pandas(), meta
