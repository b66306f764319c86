"""The three nouns of the bench: `Trajectory` (truth), `SensorLog` (what a filter may know), `NavSolution` (its answer).

Frozen dataclasses of numpy arrays in SI units and radians, checked when made; `to_frame` gives a DataFrame with units in
the column names (degrees for angles), `save` and `load` use Parquet. Frames: n north-east-down, b forward-right-down,
quaternions body-to-nav and scalar first. Time is in seconds from the start of the flight.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from testbed import specs
from testbed.columns import columns, exact_columns, pva_columns, read_pva, read_table, stack, write_table
from testbed.errors import InputError
from testbed.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

POSITION_STATES = ("position_north_m", "position_east_m", "position_down_m")
VELOCITY_STATES = ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps")
ATTITUDE_STATES = ("attitude_north_rad", "attitude_east_rad", "attitude_down_rad")
ACCEL_BIAS_STATES = ("accel_bias_x_mps2", "accel_bias_y_mps2", "accel_bias_z_mps2")
GYRO_BIAS_STATES = ("gyro_bias_x_radps", "gyro_bias_y_radps", "gyro_bias_z_radps")
NAVIGATION_STATES = POSITION_STATES + VELOCITY_STATES + ATTITUDE_STATES
STATE_NAMES = NAVIGATION_STATES + ACCEL_BIAS_STATES + GYRO_BIAS_STATES
"""The error states that the bench knows the truth of: position (m), velocity and attitude (rotation vector) in n,
accelerometer and gyro bias in b; the order of `InitialState.std`. A filter may name others as it likes, with the unit last."""


@dataclass(frozen=True)
class Phase:
    """A stretch of a flight: one manoeuvre of the script."""

    name: str
    start: float
    end: float


@dataclass(frozen=True)
class Trajectory:
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

    def __post_init__(self) -> None:
        _check(
            self, "Trajectory", {"lat": (), "lon": (), "h": (), "v_n": (3,), "q_nb": (4,), "f_b": (3,), "w_ib_b": (3,)}
        )
        for key, values in self.extra.items():
            if np.shape(values) != self.t.shape:
                raise InputError(f"Trajectory: extra column '{key}' has shape {np.shape(values)}, not {self.t.shape}")

    @property
    def dt(self) -> float:
        """Sample interval, s."""
        return float((self.t[-1] - self.t[0]) / (len(self.t) - 1))

    def to_frame(self) -> pd.DataFrame:
        """Columns ``time_s, lat_deg, lon_deg, alt_m, v_north_mps.., roll_deg.., gyro_x_radps.., accel_x_mps2..``."""
        import pandas as pd

        table = pva_columns(self.t, self.lat, self.lon, self.h, self.v_n, self.q_nb)
        table |= columns("gyro_{}_radps", "xyz", self.w_ib_b) | columns("accel_{}_mps2", "xyz", self.f_b)
        return pd.DataFrame(table | dict(self.extra))

    def save(self, path: str | Path) -> None:
        """Write Parquet. Quaternions and radians are stored beside the degrees so that loading is exact."""
        frame = self.to_frame().assign(**exact_columns(self.lat, self.lon, self.q_nb))
        meta = {"name": self.name, "phases": [[p.name, p.start, p.end] for p in self.phases], "extra": list(self.extra)}
        write_table(frame, path, "Trajectory", meta)

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read what `save` wrote. Raises InputError when the file is no Trajectory."""
        table, meta = read_table(path, "Trajectory")
        return cls(
            **read_pva(table),
            f_b=stack(table, "accel_{}_mps2", "xyz"),
            w_ib_b=stack(table, "gyro_{}_radps", "xyz"),
            extra={key: table[key] for key in meta["extra"]},
            phases=tuple(Phase(*p) for p in meta["phases"]),
            name=meta["name"],
        )


@dataclass(frozen=True)
class ImuSamples:
    """``t`` (N,), ``gyro`` (N,3) rad/s, ``accel`` (N,3) m/s²: means over the interval that ends at ``t``.

    The first interval starts at ``initial.t`` of the log.
    """

    t: Array
    gyro: Array
    accel: Array
    spec: ImuSpec = field(default_factory=ImuSpec)

    def __post_init__(self) -> None:
        _check(self, "SensorLog.imu", {"gyro": (3,), "accel": (3,)})


@dataclass(frozen=True)
class GnssFixes:
    """``t`` (M,), ``lat``, ``lon`` (rad), ``h`` (m), ``v_n`` (M,3): of the antenna. No rows while there is an outage.

    ``outages`` are the (start, end) times without fixes, as far as the receiver reports them. ``std`` (M,6), where it
    is given, is the 1-sigma of each fix (m north, east, down; m/s) as the receiver states it.
    """

    t: Array
    lat: Array
    lon: Array
    h: Array
    v_n: Array
    spec: GnssSpec = field(default_factory=GnssSpec)
    outages: tuple[tuple[float, float], ...] = ()
    std: Array | None = None

    def __post_init__(self) -> None:
        _check(self, "SensorLog.gnss", {"lat": (), "lon": (), "h": (), "v_n": (3,)}, minimum=0)

    def measurement_std(self) -> Array:
        """(M,6) 1-sigma per fix: the receiver's own, else the specification's. Order m N, E, D, then m/s N, E, D."""
        if self.std is not None:
            return self.std
        s = self.spec
        horizontal = float(np.hypot(s.horizontal_sigma, s.horizontal_markov_sigma))
        vertical = float(np.hypot(s.vertical_sigma, s.vertical_markov_sigma))
        row = [horizontal, horizontal, vertical, s.velocity_sigma, s.velocity_sigma, s.velocity_sigma]
        return np.tile(row, (len(self.t), 1))


@dataclass(frozen=True)
class MagSamples:
    """``t`` (M,), ``field`` (M,3) in µT along b."""

    t: Array
    field: Array
    spec: MagSpec

    def __post_init__(self) -> None:
        _check(self, "SensorLog.mag", {"field": (3,)}, minimum=0)


@dataclass(frozen=True)
class BaroSamples:
    """``t`` (M,), ``pressure`` (M,) in Pa."""

    t: Array
    pressure: Array
    spec: BaroSpec

    def __post_init__(self) -> None:
        _check(self, "SensorLog.baro", {"pressure": ()}, minimum=0)


@dataclass(frozen=True)
class InitialState:
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


@dataclass(frozen=True)
class SensorLog:
    """Exactly what a filter may know: recordings, the sensors' specifications, and the initial state. No truth."""

    imu: ImuSamples
    initial: InitialState
    gnss: GnssFixes | None = None
    mag: MagSamples | None = None
    baro: BaroSamples | None = None
    name: str = ""

    def to_frame(self) -> pd.DataFrame:
        """The IMU table: ``time_s, gyro_x_radps.., accel_x_mps2..``. Aiding sensors: see `frames`."""
        return self.frames()["imu"]

    def frames(self) -> dict[str, pd.DataFrame]:
        """One DataFrame per sensor that the log has: ``imu``, ``gnss``, ``mag``, ``baro``."""
        import pandas as pd

        imu = self.imu
        gyro, accel = columns("gyro_{}_radps", "xyz", imu.gyro), columns("accel_{}_mps2", "xyz", imu.accel)
        out = {"imu": pd.DataFrame({"time_s": imu.t} | gyro | accel)}
        if (gnss := self.gnss) is not None:
            lla = {"time_s": gnss.t, "lat_deg": np.degrees(gnss.lat), "lon_deg": np.degrees(gnss.lon), "alt_m": gnss.h}
            velocity = columns("v_{}_mps", ("north", "east", "down"), gnss.v_n)
            out["gnss"] = pd.DataFrame(
                lla | velocity | ({} if gnss.std is None else columns("std_{}", range(6), gnss.std))
            )
        if self.mag is not None:
            out["mag"] = pd.DataFrame({"time_s": self.mag.t} | columns("mag_{}_ut", "xyz", self.mag.field))
        if self.baro is not None:
            out["baro"] = pd.DataFrame({"time_s": self.baro.t, "pressure_pa": self.baro.pressure})
        return out

    def save(self, path: str | Path) -> None:
        """Write a folder: ``imu.parquet`` and one file per aiding sensor."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        initial = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(self.initial).items()}
        for key, frame in self.frames().items():
            meta: dict[str, Any] = {"spec": specs.to_dict(getattr(self, key).spec)}
            if key == "imu":
                meta |= {"initial": initial, "name": self.name}
            elif key == "gnss" and self.gnss is not None:
                frame = frame.assign(lat_rad=self.gnss.lat, lon_rad=self.gnss.lon)
                meta["outages"] = list(self.gnss.outages)
            write_table(frame, folder / f"{key}.parquet", f"SensorLog.{key}", meta)

    @classmethod
    def load(cls, path: str | Path) -> SensorLog:
        """Read the folder that `save` wrote. Raises InputError when it is none."""
        folder = Path(path)
        table, meta = read_table(folder / "imu.parquet", "SensorLog.imu")
        initial: dict[str, Any] = {k: np.array(v) if isinstance(v, list) else v for k, v in meta["initial"].items()}
        gyro, accel = stack(table, "gyro_{}_radps", "xyz"), stack(table, "accel_{}_mps2", "xyz")
        imu = ImuSamples(table["time_s"], gyro, accel, specs.from_dict(ImuSpec, meta["spec"]))
        gnss, mag, baro = None, None, None
        if (folder / "gnss.parquet").exists():
            table, other = read_table(folder / "gnss.parquet", "SensorLog.gnss")
            gnss = GnssFixes(
                t=table["time_s"],
                lat=table["lat_rad"],
                lon=table["lon_rad"],
                h=table["alt_m"],
                v_n=stack(table, "v_{}_mps", ("north", "east", "down")),
                spec=specs.from_dict(GnssSpec, other["spec"]),
                outages=tuple((a, b) for a, b in other["outages"]),
                std=stack(table, "std_{}", range(6)) if "std_0" in table else None,
            )
        if (folder / "mag.parquet").exists():
            table, other = read_table(folder / "mag.parquet", "SensorLog.mag")
            values = stack(table, "mag_{}_ut", "xyz")
            mag = MagSamples(table["time_s"], values, specs.from_dict(MagSpec, other["spec"]))
        if (folder / "baro.parquet").exists():
            table, other = read_table(folder / "baro.parquet", "SensorLog.baro")
            spec = specs.from_dict(BaroSpec, other["spec"])
            baro = BaroSamples(table["time_s"], table["pressure_pa"], spec)
        return cls(imu, InitialState(**initial), gnss, mag, baro, meta["name"])


@dataclass(frozen=True)
class SensorErrors:
    """What `sense` drew beside a log, for scoring only: the true bias (N,3) at each IMU time, and drawn constants."""

    t: Array
    accel_bias: Array
    gyro_bias: Array
    constants: Mapping[str, Any] = field(default_factory=dict)


UNIT_TOLERANCE = 1e-3
"""Of a quaternion's norm: far above rounding, also that of single precision, and far below what an angle would notice."""
GNSS_CHANNELS = ("north, m", "east, m", "down, m", "north, m/s", "east, m/s", "down, m/s")
"""Names of the six channels of a loosely coupled filter's innovation."""


@dataclass(frozen=True)
class Innovations:
    """A filter's innovations at one aiding: ``t`` (M,), ``value`` (M,m), ``covariance`` (M,m,m), in SI units of the measurement.

    ``names`` of the m channels, for plots; six unnamed channels are position and velocity of a GNSS fix. ``rejected`` (M,)
    marks updates that the filter's policy refused: they are shown, and do not count in NIS.
    """

    t: Array
    value: Array
    covariance: Array
    names: tuple[str, ...] = ()
    rejected: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        _check(self, "NavSolution.innovations", {"value": (None,), "covariance": (None, None)}, minimum=0, finite=False)
        m = self.value.shape[1]
        if self.covariance.shape[1:] != (m, m):
            raise InputError(
                f"NavSolution.innovations: 'covariance' has shape {self.covariance.shape}, expected {(len(self.t), m, m)}"
            )
        if self.rejected is not None:
            rejected = np.asarray(self.rejected)
            if rejected.shape != self.t.shape or rejected.dtype != np.bool_:
                raise InputError(
                    f"NavSolution.innovations: 'rejected' is {rejected.dtype} of shape {rejected.shape}, expected true or "
                    f"false for each of {len(self.t)} updates"
                )
            object.__setattr__(self, "rejected", rejected)

    @property
    def channels(self) -> tuple[str, ...]:
        """Name of every channel: those given, a GNSS fix's for six unnamed ones, else numbers."""
        m = self.value.shape[1]
        if len(self.names) >= m:
            return self.names
        return GNSS_CHANNELS if m == len(GNSS_CHANNELS) else tuple(f"channel {k + 1}" for k in range(m))

    def taken(self) -> Innovations:
        """Those that the filter used: without the rejected ones."""
        if self.rejected is None:
            return self
        keep = ~self.rejected
        return Innovations(self.t[keep], self.value[keep], self.covariance[keep], self.names)


@dataclass(frozen=True)
class NavSolution:
    """An estimator's answer, usually at the IMU times.

    ``t`` (N,), ``lat``, ``lon``, ``h``, ``v_n``, ``q_nb`` as in `Trajectory`; ``accel_bias``, ``gyro_bias`` (N,3) in b;
    ``estimates`` maps the names of further states to (N,) values.
    ``states`` names the n error states that the estimator has: of `STATE_NAMES` those that it estimates, and any of its own
    (``accel_scale_x``). What is named is scored, what is not named is not; without names, or with none of position, velocity
    and attitude among them, all of the navigation is. ``std`` (N,n) is 1 sigma in their order; ``covariance_t`` (K,) and
    ``covariance`` (K,n,n) are snapshots for consistency tests (about 1 Hz).
    ``innovations`` maps an aiding to its `Innovations`; one alone counts as ``gnss``. ``extras`` maps names to (time (J,),
    values (J,) or (J,c)) pairs: mode probabilities, fading factors, network outputs. Non-finite values are allowed: the
    scorer counts them as divergence. Raises InputError for a wrong shape, times that do not increase, or a quaternion that
    is not of unit length.
    """

    t: Array
    lat: Array
    lon: Array
    h: Array
    v_n: Array
    q_nb: Array
    accel_bias: Array | None = None
    gyro_bias: Array | None = None
    std: Array | None = None
    covariance_t: Array | None = None
    covariance: Array | None = None
    innovations: Mapping[str, Innovations] = field(default_factory=dict)
    extras: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    extra_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of the columns of an extra, for legends."""
    states: tuple[str, ...] = ()
    estimates: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", _named_states(self))
        if isinstance(self.innovations, Innovations):
            object.__setattr__(self, "innovations", {"gnss": self.innovations})
        elif self.innovations is None:
            object.__setattr__(self, "innovations", {})
        shapes: dict[str, tuple[int | None, ...]] = {"lat": (), "lon": (), "h": (), "v_n": (3,), "q_nb": (4,)}
        optional = {"accel_bias": (3,), "gyro_bias": (3,), "std": (len(self.states),)}
        shapes |= {key: shape for key, shape in optional.items() if getattr(self, key) is not None}
        _check(self, "NavSolution", shapes, finite=False)
        _check_snapshots(self)
        for name, values in self.estimates.items():
            if np.shape(values) != self.t.shape:
                raise InputError(f"NavSolution: estimate '{name}' has shape {np.shape(values)}, not {self.t.shape}")
        norm = np.sqrt(np.einsum("ij,ij->i", self.q_nb, self.q_nb))
        if (off := np.abs(norm - 1.0) > UNIT_TOLERANCE).any():  # False where the norm is not finite: divergence
            k = int(np.argmax(off))
            raise InputError(
                f"NavSolution: 'q_nb' must be unit quaternions, but has norm {norm[k]:.6g} at sample {k} (t = {self.t[k]:.6g} s)"
            )

    def to_frame(self) -> pd.DataFrame:
        """Columns as in `Trajectory`, then biases, estimates, and ``std_`` + state name, as far as the estimator gives them."""
        import pandas as pd

        table = pva_columns(self.t, self.lat, self.lon, self.h, self.v_n, self.q_nb)
        if self.accel_bias is not None:
            table |= columns("accel_bias_{}_mps2", "xyz", self.accel_bias)
        if self.gyro_bias is not None:
            table |= columns("gyro_bias_{}_radps", "xyz", self.gyro_bias)
        table |= {f"estimate_{name}": np.asarray(values) for name, values in self.estimates.items()}
        if self.std is not None:
            table |= columns("std_{}", self.states, self.std)
        return pd.DataFrame(table)

    def save(self, path: str | Path) -> None:
        """Write Parquet: the table of `to_frame` (innovations, snapshots and extras are not kept)."""
        frame = self.to_frame().assign(**exact_columns(self.lat, self.lon, self.q_nb))
        write_table(frame, path, "NavSolution", {"states": list(self.states), "estimates": list(self.estimates)})

    @classmethod
    def load(cls, path: str | Path) -> NavSolution:
        """Read what `save` wrote, now or in version 0.1, where the states were always the 15 of `STATE_NAMES`."""
        table, meta = read_table(path, "NavSolution")
        known = "std_" + STATE_NAMES[0] in table
        states = tuple(meta.get("states", STATE_NAMES if known else ()))
        return cls(
            **read_pva(table),
            accel_bias=stack(table, "accel_bias_{}_mps2", "xyz") if "accel_bias_x_mps2" in table else None,
            gyro_bias=stack(table, "gyro_bias_{}_radps", "xyz") if "gyro_bias_x_radps" in table else None,
            std=stack(table, "std_{}", states) if states and "std_" + states[0] in table else None,
            states=states,
            estimates={name: table[f"estimate_{name}"] for name in meta.get("estimates", ())},
        )


def _named_states(solution: NavSolution) -> tuple[str, ...]:
    """The states' names, checked; a solution of version 0.1 gives none and has the 15 of `STATE_NAMES`."""
    states = tuple(solution.states)
    if twice := sorted({name for name in states if states.count(name) > 1}):
        raise InputError(f"NavSolution: 'states' names {', '.join(twice)} twice")
    if states or (solution.std is None and solution.covariance is None):
        return states
    widths = {np.shape(values)[-1] for values in (solution.std, solution.covariance) if values is not None}
    width = widths.pop()
    if width != len(STATE_NAMES):
        raise InputError(
            f"NavSolution: 'std' or 'covariance' is of {width} states; name them: states=('position_north_m', ...), of "
            "testbed.records.STATE_NAMES those that are estimated, and your own"
        )
    warnings.warn(
        "a NavSolution with 'std' or 'covariance' of 15 states names them from version 0.3 on: "
        "NavSolution(..., states=testbed.records.STATE_NAMES), or only those that the filter estimates",
        FutureWarning,
        stacklevel=4,
    )
    return STATE_NAMES


def _check_snapshots(solution: NavSolution) -> None:
    if solution.covariance is None and solution.covariance_t is None:
        return
    n = len(solution.states)
    found = np.shape(np.asarray(solution.covariance)), np.shape(np.asarray(solution.covariance_t))
    if len(found[0]) != 3 or found[0] != (*found[1], n, n):
        raise InputError(
            f"NavSolution: 'covariance' has shape {found[0]} and 'covariance_t' {found[1]}, expected (K, {n}, {n}) and (K,)"
        )


def _check(
    record: Any, what: str, shapes: dict[str, tuple[int | None, ...]], minimum: int = 2, finite: bool = True
) -> None:
    """Shapes, finite values and increasing time; None in a shape means any length. Arrays become float64."""
    t = np.ascontiguousarray(record.t, dtype=np.float64)
    object.__setattr__(record, "t", t)
    if t.ndim != 1 or len(t) < minimum:
        raise InputError(f"{what}: needs at least {minimum} samples, has shape {t.shape}")
    if not np.isfinite(t).all():
        raise InputError(f"{what}: time is not finite at sample {int(np.argmin(np.isfinite(t)))}")
    if len(t) > 1 and not (steps := np.diff(t) > 0).all():
        k = int(np.argmin(steps)) + 1
        raise InputError(f"{what}: time must increase, but sample {k} is at {t[k]:.6g} s after {t[k - 1]:.6g} s")
    for name, shape in shapes.items():
        values = np.ascontiguousarray(getattr(record, name), dtype=np.float64)
        object.__setattr__(record, name, values)
        wanted = (len(t), *shape)
        fits = values.ndim == len(wanted) and all(w in (None, v) for w, v in zip(wanted, values.shape, strict=True))
        if not fits:
            length = " as 't' has it" if values.shape[1:] == wanted[1:] else ""
            raise InputError(f"{what}: '{name}' has shape {values.shape}, expected {wanted}{length}")
        if finite and not np.isfinite(values).all():
            k = int(np.argmin(np.isfinite(values).reshape(len(t), -1).all(axis=1)))
            raise InputError(f"{what}: '{name}' is not finite at sample {k} (t = {t[k]:.6g} s)")
