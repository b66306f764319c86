"""From a ``[recording]`` table to a Recording: read by format, specify the sensors, align, cut to the wanted time.

Specifications come, in this order, from the scenario, from the files, and for a PX4 log from documented defaults.
SI units and radians; frames as in `testbed.data.records`.
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.records import (
    SensorLog,
    Trajectory,
)
from testbed.formats.alignment import align, cut_before
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import Recording, reference_on_grid
from testbed.formats.table_samples import KINDS

READERS = {
    "table": "testbed.formats.table_samples",
    "ulog": "testbed.formats.ulog",
    "broad": "testbed.formats.broad",
}
"""Format -> module with a function ``read(config, folder) -> Raw``."""


def load(config: RecordingConfig, folder: Path) -> Recording:
    """Read what ``config`` describes. Raises InputError that names the file and what is wrong with it."""
    root = folder / config.dir
    if config.format == "navego":
        return _load_navego(config, root, folder)
    reader = importlib.import_module(READERS[config.format])
    return finish(config, folder, reader.read(config, folder), str(root))


def _load_navego(config: RecordingConfig, root: Path, folder: Path) -> Recording:
    from testbed.formats import navego

    recording = navego.load(root, config.files, config.sampling, config.initial.start)
    log = recording.log
    changed = {kind: _respecify(config, folder, kind, getattr(log, kind)) for kind in ("imu", "gnss", "mag", "baro")}
    given = config.initial.model_fields_set
    idle = without_effect(config, () if "start" in given and navego.states_initial(root, config.files) else ("start",))
    return _cut(config, Recording(replace(log, **changed), recording.reference, idle), str(root))


def without_effect(config: RecordingConfig, heeded: tuple[str, ...]) -> tuple[str, ...]:
    """A note on the keys of ``[recording.initial]`` that were given but not ``heeded``: the files state the initial state."""
    idle = sorted(set(config.initial.model_fields_set) - set(heeded))
    keys = ", ".join(f"recording.initial.{key}" for key in idle)
    return (f"{keys} has no effect: the files of the recording state the initial state",) if idle else ()


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
    reference = reference_on_grid(grid, raw.motion, place, raw.own_times) if raw.motion is not None else None
    if reference is not None:
        reference = replace(reference, phases=raw.phases)
    idle = () if initial is None else without_effect(config, ())
    if initial is None:
        aligned = align(config.initial, imu, gnss, samples["mag"], reference, t_start, place)
        imu, gnss, initial = aligned.imu, aligned.gnss, aligned.initial
    aiding = {kind: _after(values, initial.t) for kind, values in {**samples, **raw.others}.items() if kind != "imu"}
    log = SensorLog(imu, initial, name=raw.name, aiding=aiding | {"gnss": gnss})
    return _cut(config, Recording(log, reference, (*raw.notes, *idle)), place)


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
