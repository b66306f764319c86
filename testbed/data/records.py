"""The three nouns of the bench: `Trajectory` (truth), `SensorLog` (what a filter may know), `NavSolution` (its answer).

Frozen dataclasses of numpy arrays in SI units and radians, checked when made; `to_frame` gives a DataFrame with units in
the column names (degrees for angles), `save` and `load` use Parquet. Frames: n north-east-down, b forward-right-down,
quaternions body-to-nav and scalar first. Time is in seconds from the start of the flight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import EllipsisType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data import specs
from testbed.data.columns import columns, exact_columns, pva_columns, read_pva, read_table, stack, write_table
from testbed.data.shapes import check_arrays
from testbed.data.shown import Shown, in_words
from testbed.data.solution import (
    ACCEL_BIAS_STATES as ACCEL_BIAS_STATES,
)
from testbed.data.solution import (
    ATTITUDE_STATES as ATTITUDE_STATES,
)
from testbed.data.solution import (
    GNSS_CHANNELS as GNSS_CHANNELS,
)
from testbed.data.solution import (
    GYRO_BIAS_STATES as GYRO_BIAS_STATES,
)
from testbed.data.solution import (
    NAVIGATION_STATES as NAVIGATION_STATES,
)
from testbed.data.solution import (
    POSITION_STATES as POSITION_STATES,
)
from testbed.data.solution import (
    STATE_NAMES as STATE_NAMES,
)
from testbed.data.solution import (
    VELOCITY_STATES as VELOCITY_STATES,
)
from testbed.data.solution import (
    Innovations as Innovations,
)
from testbed.data.solution import (
    NavSolution as NavSolution,
)
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


NO_HEADING_STD = np.pi / np.sqrt(3.0)
"""1 sigma of a heading that nothing tells: uniform around the circle."""
UNKNOWN_HEADING_STD = np.radians(60.0)
"""A linearised filter takes the sine of an error for the error: beyond 60° it sees less than 0.83 of it and the cosine, with
which it weighs, is less than a half. A wider heading is not one start but several."""
KNOWN = ("position", "velocity", "attitude")
"""What a reference may know of a motion."""


@dataclass(frozen=True)
class Phase:
    """A stretch of a flight: one manoeuvre of the script."""

    name: str
    start: float
    end: float


@dataclass(frozen=True, repr=False)
class Trajectory(Shown):
    """Truth on the IMU grid.

    ``t`` (N,), ``lat``, ``lon`` (rad), ``h`` (m), ``v_n`` (N,3), ``q_nb`` (N,4). ``f_b`` and ``w_ib_b`` (N,3) are the
    means over (t[k-1], t[k]] of specific force (m/s²) and angular rate (rad/s); row 0, which no interval precedes,
    repeats row 1. ``extra`` holds further columns (air data, controls), each (N,).
    """

    t: Array
    lat: Array
    lon: Array
    h: Array
    v_n: Array
    q_nb: Array
    f_b: Array
    w_ib_b: Array
    extra: Mapping[str, Array] = field(default_factory=dict)
    phases: tuple[Phase, ...] = ()
    name: str = ""
    own_times: bool = False
    """Whether the truth is known at its rows only, so that nothing is scored between them: a slow reference, withheld fixes."""
    known: tuple[str, ...] = KNOWN
    """What of the motion is known: columns of another group mean nothing and are not scored."""
    arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From the point that a filter navigates to the point of the rows, m, in b: the antenna of withheld fixes."""

    def __post_init__(self) -> None:
        check_arrays(
            self, "Trajectory", {"lat": (), "lon": (), "h": (), "v_n": (3,), "q_nb": (4,), "f_b": (3,), "w_ib_b": (3,)}
        )
        for key, values in self.extra.items():
            if np.shape(values) != self.t.shape:
                raise InputError(f"Trajectory: extra column '{key}' has shape {np.shape(values)}, not {self.t.shape}")

    @property
    def dt(self) -> float:
        """Sample interval, s."""
        return float((self.t[-1] - self.t[0]) / (len(self.t) - 1))

    def plot(self) -> Figure:
        """A figure (matplotlib): ground track, height, speed and attitude."""
        from testbed.data import plots

        return plots.motion(self.t, (self.lat, self.lon, self.h), self.v_n, self.q_nb)

    def to_frame(self) -> pd.DataFrame:
        """Columns ``time_s, lat_deg, lon_deg, alt_m, v_north_mps.., roll_deg.., gyro_x_radps.., accel_x_mps2..``."""
        import pandas as pd

        table = pva_columns(self.t, self.lat, self.lon, self.h, self.v_n, self.q_nb)
        table |= columns("gyro_{}_radps", "xyz", self.w_ib_b) | columns("accel_{}_mps2", "xyz", self.f_b)
        return pd.DataFrame(table | dict(self.extra))

    def save(self, path: str | Path, **header: str) -> None:
        """Write Parquet. Quaternions and radians are stored beside the degrees so that loading is exact.

        ``header``: further entries of the file's header, such as what a cache knows the flight by.
        """
        frame = self.to_frame().assign(**exact_columns(self.lat, self.lon, self.q_nb))
        meta: dict[str, Any] = {
            "name": self.name,
            "phases": [[p.name, p.start, p.end] for p in self.phases],
            "extra": list(self.extra),
        }
        if self.own_times or self.known != KNOWN or any(self.arm_b):
            meta["reference"] = {"own_times": self.own_times, "known": list(self.known), "arm_b": list(self.arm_b)}
        write_table(frame, path, "Trajectory", meta | header)

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read what `save` wrote. Raises InputError when the file is no Trajectory."""
        table, meta = read_table(path, "Trajectory")
        stored = meta.get("reference", {})
        reference: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in stored.items()}
        return cls(
            **read_pva(table),
            f_b=stack(table, "accel_{}_mps2", "xyz"),
            w_ib_b=stack(table, "gyro_{}_radps", "xyz"),
            extra={key: table[key] for key in meta["extra"]},
            phases=tuple(Phase(*p) for p in meta["phases"]),
            name=meta["name"],
            **reference,
        )


@dataclass(frozen=True, repr=False)
class ImuSamples(Shown):
    """``t`` (N,), ``gyro`` (N,3) rad/s, ``accel`` (N,3) m/s²: means over the interval that ends at ``t``.

    The first interval starts at ``initial.t`` of the log.
    """

    t: Array
    gyro: Array
    accel: Array
    spec: ImuSpec = field(default_factory=ImuSpec)

    def __post_init__(self) -> None:
        check_arrays(self, "SensorLog.imu", {"gyro": (3,), "accel": (3,)})


@dataclass(frozen=True, repr=False)
class Samples(Shown):
    """Base of what an aiding sensor records: ``t`` (M,), s, and fields whose shapes behind M stand in ``shapes``.

    A subclass adds the fields and ``spec``, the sensor's specification, which a filter may know.
    """

    t: Array
    kind: ClassVar[str] = ""
    shapes: ClassVar[Mapping[str, tuple[int | None, ...]]] = {}

    def __post_init__(self) -> None:
        check_arrays(self, f"SensorLog.{self.kind}", dict(self.shapes), minimum=0)


@dataclass(frozen=True, repr=False)
class GnssFixes(Samples):
    """``t`` (M,), ``lat``, ``lon`` (rad), ``h`` (m), ``v_n`` (M,3): of the antenna. No rows while there is an outage.

    ``outages`` are the (start, end) times without fixes, as far as the receiver reports them. ``std`` (M,6), where it
    is given, is the 1-sigma of each fix (m north, east, down; m/s) as the receiver states it, and ``correlation`` (M,6),
    which comes with it, how its errors hang together: north with east, north with down, east with down, of position and
    then of velocity.
    """

    lat: Array
    lon: Array
    h: Array
    v_n: Array
    spec: GnssSpec = field(default_factory=GnssSpec)
    outages: tuple[tuple[float, float], ...] = ()
    std: Array | None = None
    correlation: Array | None = None
    kind: ClassVar[str] = "gnss"
    shapes: ClassVar[Mapping[str, tuple[int | None, ...]]] = {"lat": (), "lon": (), "h": (), "v_n": (3,)}

    def taken(self, rows: Any, **changes: Any) -> GnssFixes:
        """Some of the rows, by a mask, a slice or their numbers; ``changes`` as of `dataclasses.replace`."""
        arrays = ("t", "lat", "lon", "h", "v_n", "std", "correlation")
        kept: dict[str, Any] = {key: value[rows] for key in arrays if (value := getattr(self, key)) is not None}
        return replace(self, **(kept | changes))

    def measurement_std(self) -> Array:
        """(M,6) 1-sigma per fix: the receiver's own, else the specification's. Order m N, E, D, then m/s N, E, D."""
        if self.std is not None:
            return self.std
        s = self.spec
        horizontal = float(np.hypot(s.horizontal_sigma, s.horizontal_markov_sigma))
        vertical = float(np.hypot(s.vertical_sigma, s.vertical_markov_sigma))
        row = [horizontal, horizontal, vertical, s.velocity_sigma, s.velocity_sigma, s.velocity_sigma]
        return np.tile(row, (len(self.t), 1))


@dataclass(frozen=True, repr=False)
class MagSamples(Samples):
    """``t`` (M,), ``field`` (M,3) in µT along b."""

    field: Array
    spec: MagSpec
    kind: ClassVar[str] = "mag"
    shapes: ClassVar[Mapping[str, tuple[int | None, ...]]] = {"field": (3,)}


@dataclass(frozen=True, repr=False)
class BaroSamples(Samples):
    """``t`` (M,), ``pressure`` (M,) in Pa."""

    pressure: Array
    spec: BaroSpec
    kind: ClassVar[str] = "baro"
    shapes: ClassVar[Mapping[str, tuple[int | None, ...]]] = {"pressure": ()}


@dataclass(frozen=True, repr=False)
class InitialState(Shown):
    """Where a filter starts: mean at time ``t`` and ``std`` (15,) in the order of `STATE_NAMES`."""

    t: float
    lat: float
    lon: float
    h: float
    v_n: Array
    q_nb: Array
    accel_bias: Array
    gyro_bias: Array
    std: Array

    @property
    def heading_unknown(self) -> bool:
        """Whether the heading is one that no linearised filter can be started with, see `UNKNOWN_HEADING_STD`."""
        return bool(self.std[8] > UNKNOWN_HEADING_STD)


@dataclass(frozen=True, init=False, repr=False)
class SensorLog(Shown):
    """Exactly what a filter may know: recordings, the sensors' specifications, and the initial state. No truth.

    ``aiding`` maps a kind of sensor (``gnss``, ``gnss_raw``, ``mag``, ``baro``, ``odometer``, one's own) to its `Samples`. A kind is also
    an attribute, and a keyword here: ``log.gnss``, None where the log has none. ``run`` is the Monte Carlo run that it is of.
    """

    imu: ImuSamples
    initial: InitialState
    aiding: Mapping[str, Samples]
    name: str
    run: int

    def __init__(
        self,
        imu: ImuSamples,
        initial: InitialState,
        gnss: GnssFixes | EllipsisType | None = ...,
        mag: MagSamples | EllipsisType | None = ...,
        baro: BaroSamples | EllipsisType | None = ...,
        name: str = "",
        aiding: Mapping[str, Samples] | None = None,
        run: int = 0,
        **others: Samples | None,
    ) -> None:
        given = {"gnss": gnss, "mag": mag, "baro": baro, **others}
        changed = dict(aiding or {}) | {kind: samples for kind, samples in given.items() if samples is not ...}
        for key, value in (("imu", imu), ("initial", initial), ("name", name), ("run", run)):
            object.__setattr__(self, key, value)
        object.__setattr__(self, "aiding", {kind: samples for kind, samples in changed.items() if samples is not None})

    if TYPE_CHECKING:
        gnss: ClassVar[GnssFixes | None]
        mag: ClassVar[MagSamples | None]
        baro: ClassVar[BaroSamples | None]

    def __getattr__(self, kind: str) -> Any:
        """Samples of a kind; None for one that the bench knows and this log lacks."""
        if kind.startswith("_") or kind == "aiding":
            raise AttributeError(kind)
        if kind in self.aiding:
            return self.aiding[kind]
        if kind in ("gnss", "mag", "baro") or kind in _sensors():
            return None
        raise AttributeError(f"a SensorLog has no '{kind}'; this one has {', '.join(['imu', *self.aiding])}")

    def _told(self) -> tuple[str, list[tuple[str, str]]]:
        kinds = {"imu": self.imu} | dict(self.aiding)
        rows = [(kind, in_words(samples).partition(": ")[2] + _model_of(samples)) for kind, samples in kinds.items()]
        return f"SensorLog {self.name}".strip(), [*rows, ("initial", f"at {self.initial.t:.6g} s")]

    def plot(self) -> Figure:
        """A figure (matplotlib): angular rate, specific force, and place of the GNSS fixes over time."""
        from testbed.data import plots

        gnss, imu = self.gnss, self.imu
        fixes = None if gnss is None else (gnss.t, (gnss.lat, gnss.lon, gnss.h))
        return plots.log(imu.t, imu.gyro, imu.accel, fixes)

    def to_frame(self) -> pd.DataFrame:
        """The IMU table: ``time_s, gyro_x_radps.., accel_x_mps2..``. Aiding sensors: see `frames`."""
        return self.frames()["imu"]

    def frames(self) -> dict[str, pd.DataFrame]:
        """One DataFrame per sensor that the log has: ``imu``, ``gnss``, ``mag`` ..., with the unit in each column's name."""
        import pandas as pd

        imu = self.imu
        gyro, accel = columns("gyro_{}_radps", "xyz", imu.gyro), columns("accel_{}_mps2", "xyz", imu.accel)
        out = {"imu": pd.DataFrame({"time_s": imu.t} | gyro | accel)}
        for kind, samples in self.aiding.items():
            table = _sensors()[kind].table(samples) if kind in _sensors() else _plain_table(samples)
            out[kind] = pd.DataFrame(table)
        if self.gnss is not None and self.gnss.std is not None:
            out["gnss"] = out["gnss"].assign(**columns("std_{}", range(6), self.gnss.std))
        return out

    def save(self, path: str | Path) -> None:
        """Write a folder: ``imu.parquet`` and one file per aiding sensor. Raises InputError for a sensor that is not known."""
        import pandas as pd

        if unknown := sorted(set(self.aiding) - set(_sensors())):
            raise InputError(
                f"{path}: no sensor of the bench is called '{unknown[0]}', so that it could not be read again"
            )
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        initial = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(self.initial).items()}
        head = {"spec": specs.to_dict(self.imu.spec), "initial": initial, "name": self.name, "run": self.run}
        write_table(self.to_frame(), folder / "imu.parquet", "SensorLog.imu", head)
        for kind, samples in self.aiding.items():
            sensor = _sensors()[kind]
            table, more = (sensor.table(samples), {}) if sensor.write is None else sensor.write(samples)
            meta = {"spec": specs.to_dict(samples.spec)} | more  # type: ignore[attr-defined]
            write_table(pd.DataFrame(table), folder / f"{kind}.parquet", f"SensorLog.{kind}", meta)

    @classmethod
    def load(cls, path: str | Path) -> SensorLog:
        """Read the folder that `save` wrote. Raises InputError when it is none."""
        folder = Path(path)
        table, meta = read_table(folder / "imu.parquet", "SensorLog.imu")
        initial: dict[str, Any] = {k: np.array(v) if isinstance(v, list) else v for k, v in meta["initial"].items()}
        gyro, accel = stack(table, "gyro_{}_radps", "xyz"), stack(table, "accel_{}_mps2", "xyz")
        imu = ImuSamples(table["time_s"], gyro, accel, specs.from_dict(ImuSpec, meta["spec"]))
        aiding = {}
        for kind, sensor in _sensors().items():
            if (folder / f"{kind}.parquet").exists():
                table, other = read_table(folder / f"{kind}.parquet", f"SensorLog.{kind}")
                spec = specs.from_dict(sensor.spec, other["spec"])
                known = sensor.read is None
                aiding[kind] = sensor.from_table(table, spec) if known else sensor.read(table, other, spec)
        return cls(imu, InitialState(**initial), name=meta["name"], aiding=aiding, run=meta.get("run", 0))


def _sensors() -> dict[str, Any]:
    """The registered sensors, whose modules build on this one."""
    from testbed.sensors.registry import SAMPLES

    return SAMPLES


def _model_of(samples: Any) -> str:
    name = getattr(getattr(samples, "spec", None), "name", "")
    return f", {name}" if name else ""


def _plain_table(samples: Any) -> dict[str, Array]:
    """Of samples that no registered sensor describes: time and the fields named in ``shapes``, a vector's by number."""
    out = {"time_s": samples.t}
    for name in samples.shapes:
        values = np.asarray(getattr(samples, name))
        out |= {name: values} if values.ndim == 1 else columns(name + "_{}", range(values.shape[1]), values)
    return out


@dataclass(frozen=True, repr=False)
class SensorErrors(Shown):
    """What `sense` drew beside a log, for scoring only: the true bias (N,3) at each IMU time, and drawn constants."""

    t: Array
    accel_bias: Array
    gyro_bias: Array
    constants: Mapping[str, Any] = field(default_factory=dict)
