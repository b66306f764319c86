"""Shards of training data: one flight as a table on the IMU's times, inputs and labels, that is read window by window.

Columns are float32 in SI units (µT for a field). Inputs: ``gyro``, ``accel``, and what the sensors beside the IMU recorded, each
sample in the row of the IMU interval in which it was taken and NaN in the rows without one, so that rates may differ. Labels,
true at the row's time: ``q_nb``, ``position`` (north, east, down, m, from the start of the flight), ``v_n``, and the biases
``accel_bias`` and ``gyro_bias`` that the sensors had.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.checksums import check_seal, sealed_parquet
from testbed.base.errors import InputError, nearest
from testbed.base.files import from_json, write_atomic

if TYPE_CHECKING:
    from testbed.data.records import SensorErrors, SensorLog, Trajectory

ROWS_PER_GROUP = 3000
"""Rows of a Parquet row group: what a reader must hold to read one window."""
INPUTS = {"gyro": 3, "accel": 3, "mag": 3, "gnss": 6, "baro": 1, "airspeed": 1, "odometer": 1}
"""Groups of columns that a filter may know, and their widths. ``gnss``: north, east, down (m) from the start, then velocity."""
LABELS = {"q_nb": 4, "position": 3, "v_n": 3, "accel_bias": 3, "gyro_bias": 3}
"""Groups of columns that only training may know."""
WIDTHS = INPUTS | LABELS
SAMPLED = {"mag": "field", "baro": "pressure", "airspeed": "speed", "odometer": "speed"}
"""Field of the samples that is stored of each sensor beside the IMU."""


def write_shard(
    path: Path, log: SensorLog, trajectory: Trajectory, meta: dict[str, Any], errors: SensorErrors | None = None
) -> None:
    """Store a log with the truth at its IMU times; with ``errors`` also the true biases."""
    import pyarrow as pa

    from testbed.data import specs
    from testbed.scoring.error_series import truth_at

    t = log.imu.t
    lat, lon, h, v_n, q_nb = truth_at(trajectory, t)
    origin = (float(trajectory.lat[0]), float(trajectory.lon[0]), float(trajectory.h[0]))
    groups = {"gyro": log.imu.gyro, "accel": log.imu.accel} | _aiding(log, origin)
    groups |= {"q_nb": q_nb, "position": _metres(lat, lon, h, origin), "v_n": v_n}
    if errors is not None:
        groups |= {"accel_bias": errors.accel_bias, "gyro_bias": errors.gyro_bias}
    columns = {"time_s": t.astype(np.float64)}
    for name, values in groups.items():
        columns |= {f"{name}_{i}": values[:, i].astype(np.float32) for i in range(WIDTHS[name])}
    initial = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(log.initial).items()}
    known = {"initial": initial, "imu": specs.to_dict(log.imu.spec), "origin": origin}
    known |= {kind: specs.to_dict(log.aiding[kind].spec) for kind in groups if kind in log.aiding}  # type: ignore[attr-defined]
    table = pa.table(columns).replace_schema_metadata({"testbed": json.dumps(meta | {"log": known}).encode()})
    write_atomic(path, sealed_parquet(table, row_group_size=ROWS_PER_GROUP))


def _metres(lat: Any, lon: Any, h: Any, origin: tuple[float, float, float]) -> NDArray[np.float64]:
    """North, east, down of places (N,) from the origin, m."""
    from testbed.physics import earth

    return np.column_stack(earth.position_difference(lat, lon, h, *origin))


def _aiding(log: SensorLog, origin: tuple[float, float, float]) -> dict[str, NDArray[np.float64]]:
    """What other sensors recorded, on the rows of the IMU."""
    found = {}
    for kind, field in SAMPLED.items():
        if (samples := log.aiding.get(kind)) is not None:
            found[kind] = _on_rows(
                log.imu.t, samples.t, np.asarray(getattr(samples, field)).reshape(len(samples.t), -1)
            )
    if (gnss := log.gnss) is not None:
        values = np.column_stack([_metres(gnss.lat, gnss.lon, gnss.h, origin), gnss.v_n])
        found["gnss"] = _on_rows(log.imu.t, gnss.t, values)
    return found


def _on_rows(t: NDArray[np.float64], times: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Samples (M,w) in the rows (N,w) of the intervals that end at ``t``; of several in one interval the last; NaN elsewhere."""
    out = np.full((len(t), values.shape[1]), np.nan)
    rows = np.searchsorted(t, times - 1e-6)
    inside = rows < len(t)
    out[rows[inside]] = values[inside]
    return out


def shard_meta(path: Path) -> dict[str, Any]:
    """What a shard says of itself, once it is undamaged. Raises InputError when it is none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    check_seal(path)
    try:
        header = pq.read_schema(path).metadata or {}
    except (OSError, pa.ArrowInvalid) as error:
        raise InputError(f"{path}: not a readable shard ({error})") from None
    try:
        return dict(from_json(header.get(b"testbed", b"{}")))
    except (ValueError, TypeError):
        raise InputError(f"{path}: its header is damaged; delete it and make the data set again") from None


class Shard:
    """One flight of a data set: `window` reads some of its rows and holds no more than these."""

    def __init__(self, path: str | Path) -> None:
        import pyarrow.parquet as pq

        self.path = Path(path)
        self.meta = shard_meta(self.path)
        self._file = pq.ParquetFile(self.path, memory_map=True)
        self.rows = int(self._file.metadata.num_rows)
        names = set(self._file.schema_arrow.names)
        self.groups: Mapping[str, int] = {name: width for name, width in WIDTHS.items() if f"{name}_0" in names}
        """Groups of columns that it has, and their widths."""

    def window(self, start: int, rows: int, groups: Sequence[str] | None = None) -> dict[str, NDArray[np.float32]]:
        """Rows ``start`` to ``start + rows``: an array (rows, width) float32 for each group, of all that there are unless named.

        Raises InputError for a group that the flight has not.
        """
        for name in groups or ():
            if name not in self.groups:
                raise InputError(f"{self.path}: has no column group '{name}'; {nearest(name, self.groups)}")
        wanted = {name: self.groups[name] for name in groups or self.groups}
        columns = [f"{name}_{i}" for name, width in wanted.items() for i in range(width)]
        first, last = start // ROWS_PER_GROUP, (start + rows - 1) // ROWS_PER_GROUP
        table = self._file.read_row_groups(list(range(first, last + 1)), columns=columns)
        table = table.slice(start - first * ROWS_PER_GROUP, rows)
        return {
            name: np.column_stack([table.column(f"{name}_{i}").to_numpy() for i in range(width)])
            for name, width in wanted.items()
        }

    def log(self) -> SensorLog:
        """The flight as a filter sees it: IMU, magnetometer and GNSS, samples in float32 precision at the times of their rows."""
        from testbed.data import specs
        from testbed.data.records import GnssFixes, ImuSamples, InitialState, MagSamples, SensorLog
        from testbed.data.specs import GnssSpec, ImuSpec, MagSpec
        from testbed.physics import earth

        known, data = self.meta["log"], self.window(0, self.rows)
        t = self._file.read(columns=["time_s"]).column("time_s").to_numpy()
        initial: dict[str, Any] = {k: np.array(v) if isinstance(v, list) else v for k, v in known["initial"].items()}
        imu = ImuSamples(
            t, data["gyro"].astype(float), data["accel"].astype(float), specs.from_dict(ImuSpec, known["imu"])
        )
        aiding: dict[str, Any] = {}
        for kind in ("mag", "gnss"):
            if kind in data:
                rows = np.isfinite(data[kind]).all(axis=1)
                times, values = t[rows], data[kind][rows].astype(float)
                if kind == "mag":
                    aiding[kind] = MagSamples(times, values, specs.from_dict(MagSpec, known[kind]))
                    continue
                lat, lon, h = known["origin"]
                north, east = earth.metres_per_radian(lat, h)
                place = (lat + values[:, 0] / north, lon + values[:, 1] / east, h - values[:, 2])
                aiding[kind] = GnssFixes(times, *place, values[:, 3:], specs.from_dict(GnssSpec, known[kind]))
        return SensorLog(imu, InitialState(**initial), name=self.path.stem, aiding=aiding)
