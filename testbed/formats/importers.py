"""From a ``[recording]`` table to a Recording: read by format, specify the sensors, align, cut to the wanted time.

Specifications come, in this order, from the scenario, from the files, and for a PX4 log from documented defaults.
SI units and radians; frames as in `testbed.data.records`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data import specs
from testbed.data.records import (
    Array,
    BaroSamples,
    GnssFixes,
    ImuSamples,
    InitialState,
    MagSamples,
    SensorLog,
    Trajectory,
)
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec
from testbed.formats.alignment import align, cut_before
from testbed.formats.config import RecordingConfig
from testbed.formats.recording import Recording, reference_on_grid
from testbed.sensors.registry import SENSORS

KINDS: dict[str, type] = {"imu": ImuSpec} | {kind: sensor.spec for kind, sensor in SENSORS.items()}


def load(config: RecordingConfig, folder: Path) -> Recording:
    """Read what ``config`` describes. Raises InputError that names the file and what is wrong with it."""
    root = folder / config.dir
    if config.format == "navego":
        return _load_navego(config, root, folder)
    return _load_table(config, root, folder)


def _load_navego(config: RecordingConfig, root: Path, folder: Path) -> Recording:
    from testbed.formats import navego

    recording = navego.load(root, config.files, config.sampling, config.initial.start)
    log = recording.log
    changed = {kind: _respecify(config, folder, kind, getattr(log, kind)) for kind in ("imu", "gnss", "mag", "baro")}
    given = config.initial.model_fields_set
    idle = without_effect(config, () if "start" in given and navego.states_initial(root, config.files) else ("start",))
    return _cut(config, Recording(replace(log, **changed), recording.reference, idle), str(root))


def _load_table(config: RecordingConfig, root: Path, folder: Path) -> Recording:
    from testbed.formats import table

    columns = table.read_mapping(folder / config.mapping) if config.mapping else {}
    tables = table.Tables(root, config.files, columns | config.columns)
    raw = Raw.from_tables(tables, config.sampling)
    return finish(config, folder, raw, str(root))


def without_effect(config: RecordingConfig, heeded: tuple[str, ...]) -> tuple[str, ...]:
    """A note on the keys of ``[recording.initial]`` that were given but not ``heeded``: the files state the initial state."""
    idle = sorted(set(config.initial.model_fields_set) - set(heeded))
    keys = ", ".join(f"recording.initial.{key}" for key in idle)
    return (f"{keys} has no effect: the files of the recording state the initial state",) if idle else ()


class Raw:
    """What a reader found, before alignment: sample tables with the files' specifications (None: not stated)."""

    def __init__(self, imu: ImuSamples | None = None, t_start: float = 0.0, name: str = "") -> None:
        self.imu, self.t_start, self.name = imu, t_start, name
        self.gnss: GnssFixes | None = None
        self.mag: MagSamples | None = None
        self.baro: BaroSamples | None = None
        self.others: dict[str, Any] = {}
        """Samples of further sensors by their kind."""
        self.motion: tuple[Array, ...] | None = None
        self.stated: set[str] = set()
        self.initial: InitialState | None = None

    @classmethod
    def from_tables(cls, tables: Any, sampling: str) -> Raw:
        """The samples of a folder of tables (`testbed.formats.table.Tables`)."""
        stored, parts = tables.stored(), tables.parts
        raw = cls(name=stored.get("name") or tables.folder.name)
        spec = {kind: _stored_spec(stored, kind, tables.folder) for kind in KINDS}
        raw.stated = {kind for kind, value in spec.items() if value is not None}
        raw.initial = _stored_initial(stored, tables.folder)
        t = parts["imu"]["time"]
        if len(t) < 3:
            raise InputError(f"{tables.folder}: imu has {len(t)} samples, at least 3 are needed")
        gyro, accel = (
            tables.block("imu", [f"gyro_{a}" for a in "xyz"]),
            tables.block("imu", [f"accel_{a}" for a in "xyz"]),
        )
        rate = spec["imu"] or ImuSpec("unknown", rate_hz=float(np.round(1.0 / np.median(np.diff(t)), 6)))
        if sampling == "instant":
            raw.t_start = float(t[0])
            t, gyro, accel = t[1:], 0.5 * (gyro[1:] + gyro[:-1]), 0.5 * (accel[1:] + accel[:-1])
        else:
            raw.t_start = float(t[0] - np.median(np.diff(t)))
        if raw.initial is not None:
            raw.t_start = raw.initial.t
        raw.imu = ImuSamples(t, gyro, accel, rate)
        raw._add_aiding(tables, spec, _stored_outages(stored, tables.folder))
        return raw

    def _add_aiding(self, tables: Any, spec: dict[str, Any], outages: tuple[tuple[float, float], ...]) -> None:
        parts = tables.parts
        if (g := parts.get("gnss")) is not None:
            from testbed.formats.table import OPTIONAL

            named = [key for key in OPTIONAL["gnss"] if key in g]
            if named and len(named) < 6:
                raise InputError(
                    f"{tables.folder}: gnss has {', '.join(named)}, but not all of {', '.join(OPTIONAL['gnss'])}"
                )
            std = tables.block("gnss", named) if named else None
            v_n = tables.block("gnss", ["v_north", "v_east", "v_down"])
            self.gnss = GnssFixes(
                g["time"], g["lat"], g["lon"], g["alt"], v_n, spec["gnss"] or GnssSpec("unknown"), outages, std
            )
            if std is not None:
                self.stated.add("gnss")
        if "mag" in parts:
            field = tables.block("mag", ["mag_x", "mag_y", "mag_z"])
            self.mag = MagSamples(parts["mag"]["time"], field, spec["mag"] or MagSpec("unknown"))
        if "baro" in parts:
            self.baro = BaroSamples(
                parts["baro"]["time"], parts["baro"]["pressure"], spec["baro"] or BaroSpec("unknown")
            )
        for kind in set(parts) & set(SENSORS) - {"gnss", "mag", "baro"}:
            unknown = SENSORS[kind].spec(name="unknown")
            self.others[kind] = SENSORS[kind].from_stems(parts[kind], spec[kind] or unknown)
        if (r := parts.get("reference")) is not None:
            if len(r["time"]) < 3:
                raise InputError(f"{tables.folder}: reference has {len(r['time'])} rows, at least 3 are needed")
            v_n = tables.block("reference", ["v_north", "v_east", "v_down"])
            self.motion = (r["time"], r["lat"], r["lon"], r["alt"], v_n, tables.quaternions())


def finish(config: RecordingConfig, folder: Path, raw: Raw, place: str) -> Recording:
    """Specifications, reference on the IMU grid, initial state, wanted time."""
    assert raw.imu is not None
    samples = {kind: _respecify(config, folder, kind, getattr(raw, kind)) for kind in ("imu", "gnss", "mag", "baro")}
    for kind in ("imu", "gnss"):
        if samples[kind] is not None and kind not in raw.stated and not getattr(config, kind):
            raise InputError(
                f"{place}: nothing states how good the {kind} is; give [recording.{kind}] a model of the catalogue or its figures"
            )
    imu, gnss, t_start, initial = samples["imu"], samples["gnss"], raw.t_start, raw.initial
    if config.start_s is not None and config.start_s > t_start:
        imu, t_start = cut_before(imu, t_start, config.start_s, place)
        gnss, initial = _after(gnss, t_start), None
    grid = np.concatenate([[t_start], imu.t])
    reference = reference_on_grid(grid, raw.motion, place) if raw.motion is not None else None
    idle = () if initial is None else without_effect(config, ())
    if initial is None:
        aligned = align(config.initial, imu, gnss, samples["mag"], reference, t_start, place)
        imu, gnss, initial = aligned.imu, aligned.gnss, aligned.initial
    aiding = {kind: _after(values, initial.t) for kind, values in {**samples, **raw.others}.items() if kind != "imu"}
    log = SensorLog(imu, initial, name=raw.name, aiding=aiding | {"gnss": gnss})
    return _cut(config, Recording(log, reference, idle), place)


def _respecify(config: RecordingConfig, folder: Path, kind: str, samples: Any) -> Any:
    """Samples with the specification that the scenario gives, where it gives one."""
    table = dict(getattr(config, kind))
    if not table or samples is None:
        return samples
    from testbed.sensors import catalog

    lever = tuple(float(v) for v in table.pop("lever_arm_m", (0.0, 0.0, 0.0)))
    model, file = table.pop("model", None), table.pop("file", None)
    spec = catalog.specification(kind, model or "ideal", table, folder / file if file else None)
    rate = float(np.round(1.0 / np.median(np.diff(samples.t)), 6)) if len(samples.t) > 1 else spec.rate_hz
    changes: dict[str, Any] = {"rate_hz": rate, "name": model or samples.spec.name}
    if kind in ("imu", "gnss"):
        changes["lever_arm_b"] = lever
    if kind == "mag":
        changes |= {"declination": samples.spec.declination, "field_n": samples.spec.field_n}
    out = replace(samples, spec=replace(spec, **changes))
    return (
        replace(out, std=None)
        if kind == "gnss" and ("model" in config.gnss or "horizontal_sigma_m" in config.gnss)
        else out
    )


def _after(samples: Any, t: float) -> Any:
    """Aiding samples from ``t`` on."""
    return None if samples is None else _select(samples, samples.t >= t - 1e-9)


def _select(samples: Any, keep: NDArray[np.bool_]) -> Any:
    changes = {key: value[keep] for key, value in vars(samples).items() if isinstance(value, np.ndarray)}
    return replace(samples, **changes)


def _cut(config: RecordingConfig, recording: Recording, place: str) -> Recording:
    """The recording up to ``end_s``, and its reference from the initial time on."""
    log, reference = recording.log, recording.reference
    end = np.inf if config.end_s is None else config.end_s + 1e-9
    if int((log.imu.t <= end).sum()) < 2:
        raise InputError(
            f"{place}: end_s = {config.end_s} leaves no data; the recording begins at {log.initial.t:.6g} s"
        )
    if np.isfinite(end):
        kinds = {k: s for k in KINDS if (s := getattr(log, k)) is not None}
        log = replace(log, **{k: _select(s, s.t <= end) for k, s in kinds.items()})
    if reference is not None:
        keep = (reference.t >= log.initial.t - 1e-9) & (reference.t <= end)
        if keep.sum() < 2:
            raise InputError(f"{place}: the reference does not overlap the part that is used")
        if not keep.all():
            reference = _cut_trajectory(reference, keep)
    return Recording(log, reference, recording.notes)


def _cut_trajectory(trajectory: Trajectory, keep: NDArray[np.bool_]) -> Trajectory:
    extra = {key: values[keep] for key, values in trajectory.extra.items()}
    return replace(_select(trajectory, keep), extra=extra)


def _stored_spec(stored: dict[str, Any], kind: str, folder: Path) -> Any:
    try:
        return specs.from_dict(KINDS[kind], stored[kind]) if kind in stored else None
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{folder / 'log.json'}: {kind}: {error}") from None


def _stored_initial(stored: dict[str, Any], folder: Path) -> InitialState | None:
    if "initial" not in stored:
        return None
    try:
        values: dict[str, Any] = {
            k: np.array(v) if isinstance(v, list) else float(v) for k, v in stored["initial"].items()
        }
        if np.ndim(values.get("t", 0.0)):
            raise ValueError("t must be a number of seconds")
        return InitialState(**values)
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{folder / 'log.json'}: initial: {error}") from None


def _stored_outages(stored: dict[str, Any], folder: Path) -> tuple[tuple[float, float], ...]:
    try:
        pairs = tuple((float(a), float(b)) for a, b in stored.get("outages", []))
    except (TypeError, ValueError):
        pairs = ((np.inf, -np.inf),)
    if not all(np.isfinite(pair).all() and pair[0] <= pair[1] for pair in pairs):
        raise InputError(f"{folder / 'log.json'}: outages: should be pairs [from, to] in seconds")
    return pairs
