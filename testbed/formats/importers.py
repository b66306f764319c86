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

from testbed.base.errors import InputError, shown
from testbed.data.observations import GnssObservations
from testbed.data.records import Array, GnssFixes, ImuSamples, SensorLog, Trajectory
from testbed.formats import magnetic_field, plausibility, reference_motion
from testbed.formats.alignment import LEVELLING, Given, align, cut_before, turned
from testbed.formats.config import RecordingConfig
from testbed.formats.first_motion import with_derived_velocity
from testbed.formats.raw import Raw
from testbed.formats.recording import Recording, mounting, reference_on_grid, seconds
from testbed.physics.earth import G0
from testbed.physics.rotations import quat_to_matrix

READERS = {
    "table": "testbed.formats.table_samples",
    "navego": "testbed.formats.navego",
    "ulog": "testbed.formats.ulog",
    "broad": "testbed.formats.broad",
    "kfgins": "testbed.formats.kfgins",
    "rtklib": "testbed.formats.rtklib",
    "ardupilot": "testbed.formats.ardupilot",
    "rosbag": "testbed.formats.rosbag",
    "mcap": "testbed.formats.rosbag",
    "nmea": "testbed.formats.nmea",
    "ubx": "testbed.formats.ubx",
    "euroc": "testbed.formats.euroc",
    "kitti": "testbed.formats.kitti",
    "rinex": "testbed.formats.rinex",
}
"""Format -> module with a function ``read(config, folder) -> Raw``."""
PLACEMENT = ("clock_s", "mounting_deg")
"""Keys of ``[recording.imu]`` and so on that say how the sensor's samples are to be read, not how good it is."""
BIASES = {"gyro_bias_dps": ("gyro", float(np.radians(1.0))), "accel_bias_mg": ("accel", 1e-3 * G0)}
"""Keys of ``[recording.imu]``: biases (3,) along the sensor's axes that were measured beforehand, and are taken off."""
OTHER_RATE = 0.02
"""Of a stated rate from the recorded one: sampling clocks of cheap sensors are off by a percent or two."""
FIELD_YEARS = (2010.0, 2029.9)
USUAL_YEAR = 2025.0
"""Of the magnetic field where no file tells the date: it turns by 0.1 to 0.2° a year, beside 5° of an uncalibrated compass."""


def load(config: RecordingConfig, folder: Path) -> Recording:
    """Read what ``config`` describes. Raises InputError that names the file and what is wrong with it."""
    reader = importlib.import_module(READERS[config.format])
    return finish(config, folder, reader.read(config, folder), str(folder / config.dir))


def finish(config: RecordingConfig, folder: Path, raw: Raw, place: str) -> Recording:
    """Specifications, plausibility, reference, initial state, wanted time."""
    _specify(config, folder, raw, place)
    notes = [*raw.notes, *plausibility.check(raw), *_derive_velocities(raw)]
    imu, gnss, t_start, initial = raw.imu, raw.gnss, raw.t_start, raw.initial
    assert imu is not None
    if config.start_s is not None and config.start_s > t_start:
        imu, t_start = cut_before(imu, t_start, config.start_s, place)
        gnss, initial = _after(gnss, t_start), None
    reference = _reference(raw, np.concatenate([[t_start], imu.t]), place)
    notes += _magnetic_field(config, raw, gnss, reference)
    asked = config.initial.model_fields_set
    if initial is None or asked & {*LEVELLING, "start"}:
        given = Given(raw.attitude, raw.gyro_bias, raw.gnss_position_only)
        aligned = align(config.initial, imu, gnss, raw.mag, reference, t_start, place, given)
        imu, gnss, initial = aligned.imu, aligned.gnss, aligned.initial
        notes += aligned.notes
    elif asked:
        initial = turned(initial, config.initial)
    if "gnss_raw" in raw.others and gnss is not None and len(gnss.t):
        # the epoch whose fix was the start is not used again
        raw.others["gnss_raw"] = _after(raw.others["gnss_raw"], float(gnss.t[0]))
    aiding = {"gnss": gnss, "mag": raw.mag, "baro": raw.baro, **raw.others}
    aiding = {kind: _after(samples, initial.t) for kind, samples in aiding.items()}
    log = SensorLog(imu, initial, name=raw.name, aiding=aiding)
    if not raw.field_known:
        log, told = magnetic_field.measured(log, config.initial.level_s)
        notes += told
    notes += magnetic_field.norm_note(log)
    recording = _cut(config, Recording(log, reference, (), raw.gnss_position_only), place)
    if recording.reference is not None:
        notes += reference_motion.covered(recording.reference, recording.log, raw.place("reference"))
    return replace(recording, notes=tuple(dict.fromkeys(notes)))


def _reference(raw: Raw, grid: Array, place: str) -> Trajectory | None:
    reference = raw.reference
    if reference is None and raw.motion is not None:
        reference = reference_on_grid(grid, raw.motion, place, raw.own_times)
    return None if reference is None else replace(reference, phases=raw.phases)


def _specify(config: RecordingConfig, folder: Path, raw: Raw, place: str) -> None:
    """Samples at their place and time, with the specification that the scenario gives, else the files'."""
    assert raw.imu is not None
    for kind in ("imu", "gnss", "mag", "baro"):
        if (samples := getattr(raw, kind)) is None:
            continue
        table = dict(getattr(config, kind))
        clock, angles = (table.pop(key, None) for key in PLACEMENT)
        biases = {key: table.pop(key) for key in BIASES if kind == "imu" and key in table}
        before = samples.t
        if kind not in raw.stated and not table and kind in ("imu", "gnss"):
            raise InputError(
                f"{place}: nothing states how good the {kind} is; give [recording.{kind}] a model of the catalogue or its figures"
                f" (--set recording.{kind}.model=NAME)"
            )
        if clock is not None:
            shift = _number(clock, f"[recording.{kind}] clock_s")
            samples = replace(samples, t=samples.t + shift)
            raw.t_start += shift if kind == "imu" else 0.0
        for key, values in biases.items():
            samples = _less(samples, key, values)
        if angles is not None:
            samples = _mounted(kind, samples, angles)
        field = {key: table.pop(key) for key in magnetic_field.KEYS if kind == "mag" and key in table}
        if kind == "mag":
            raw.field_known = "field_ut" in field or magnetic_field.is_stated(samples.spec, "mag" in raw.stated)
        rate = table.get("rate_hz")
        samples = _respecify(config, folder, kind, samples, table)
        if isinstance(rate, int | float) and abs(rate / samples.spec.rate_hz - 1.0) > OTHER_RATE:
            raw.notes.append(
                f"[recording.{kind}] rate_hz = {rate:g} has no effect: {raw.place(kind)} has {samples.spec.rate_hz:.4g} samples a second"
            )
        if kind == "gnss" and "gnss_raw" in raw.others:
            raw.others["gnss_raw"] = _of_receiver(
                raw.others["gnss_raw"], samples, float(samples.t[0] - before[0]), "model" in config.gnss
            )
        if kind == "mag":
            if config.initial.declination_deg is not None:
                samples = magnetic_field.with_declination(samples, float(np.radians(config.initial.declination_deg)))
            raw.stated |= {"mag"} if field else set()
            samples = magnetic_field.stated_field(field, samples)
        setattr(raw, kind, samples)


def _of_receiver(observations: GnssObservations, fixes: GnssFixes, shift: float, known: bool) -> GnssObservations:
    """Observations ``shift`` s later, at the fixes' antenna; with the figures of a ``known`` receiver, where one is named."""
    spec = fixes.spec if known else replace(observations.spec, lever_arm_b=fixes.spec.lever_arm_b)
    return replace(observations, t=observations.t + shift, spec=replace(spec, rate_hz=observations.spec.rate_hz))


def _derive_velocities(raw: Raw) -> list[str]:
    """Velocities of a receiver that states none."""
    if raw.gnss is None or not (raw.gnss_position_only or raw.gnss_level_velocity):
        return []
    if raw.gnss_level_velocity:
        stated, std = raw.gnss.v_n, raw.gnss.measurement_std()
        derived = with_derived_velocity(raw.gnss)
        v_std = np.column_stack([std[:, :5], derived.measurement_std()[:, 5]])
        raw.gnss = replace(raw.gnss, v_n=np.column_stack([stated[:, :2], derived.v_n[:, 2]]), std=v_std)
        return [
            f"{raw.place('gnss')}: states no vertical velocity; it is the difference of the heights, with its sigma"
        ]
    raw.gnss = with_derived_velocity(raw.gnss)
    sigma = float(np.median(raw.gnss.measurement_std()[:, 3])) if len(raw.gnss.t) else 0.0
    return [
        f"{raw.place('gnss')}: states no velocity; velocities are differences of its positions, with a 1 sigma of"
        f" {sigma:.2g} m/s in the middle"
    ]


def _number(value: Any, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{key} is {shown(value)}, expected a number of seconds to add to its times")
    return float(value)


def _less(imu: ImuSamples, key: str, values: Any) -> ImuSamples:
    """Samples less a bias that was measured beforehand."""
    name, unit = BIASES[key]
    numbers = isinstance(values, list | tuple) and all(isinstance(v, int | float) and np.isfinite(v) for v in values)
    if not numbers or len(values) != 3:
        raise InputError(f"[recording.imu] {key} is {shown(values)}, expected the biases [x, y, z]")
    return replace(imu, **{name: getattr(imu, name) - unit * np.array(values, dtype=np.float64)})


def _mounted(kind: str, samples: Any, angles: Any) -> Any:
    """Samples turned from the sensor's axes to b by the sensor's roll, pitch and yaw in the vehicle."""
    fields = {"imu": ("gyro", "accel"), "mag": ("field",)}.get(kind)
    if fields is None:
        raise InputError(f"[recording.{kind}] mounting_deg: a {kind} has no axes")
    matrix = np.array(quat_to_matrix(mounting(kind, angles)))
    return replace(samples, **{name: getattr(samples, name) @ matrix.T for name in fields})


def _magnetic_field(
    config: RecordingConfig, raw: Raw, gnss: GnssFixes | None, reference: Trajectory | None
) -> list[str]:
    """Give the magnetometer the declination and field of the World Magnetic Model, where nothing states them."""
    if raw.mag is None or "mag" in raw.stated or config.initial.declination_deg is not None:
        return []
    source = gnss if gnss is not None and len(gnss.t) else reference
    if source is None:
        return []
    from testbed.sensors.magnetometer import field_n

    year = USUAL_YEAR if raw.utc is None else 1970.0 + raw.utc / (365.2425 * 86400.0)
    year = float(np.clip(year, *FIELD_YEARS))
    field = field_n(float(source.lat[0]), float(source.lon[0]), float(source.h[0]), year)
    declination = float(np.arctan2(field[1], field[0]))
    raw.mag = replace(raw.mag, spec=replace(raw.mag.spec, declination=declination, field_n=field))
    dated = f"in {year:.1f}" if raw.utc is not None else f"in {year:.1f} (no file tells the date)"
    return [f"declination {np.degrees(declination):.2f}° from the World Magnetic Model at the first fix, {dated}"]


def _respecify(config: RecordingConfig, folder: Path, kind: str, samples: Any, table: dict[str, Any]) -> Any:
    """Samples with the specification of ``table``, where it has one."""
    if not table:
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
            f"{place}: end_s = {config.end_s} leaves no data; the recording begins at {seconds(log.initial.t)} s"
        )
    if np.isfinite(end):
        aiding = {kind: _select(samples, samples.t <= end) for kind, samples in log.aiding.items()}
        log = SensorLog(_select(log.imu, log.imu.t <= end), log.initial, name=log.name, aiding=aiding)
    if reference is not None:
        keep = (reference.t >= log.initial.t - 1e-9) & (reference.t <= end)
        if keep.sum() < 2:
            raise InputError(f"{place}: the reference does not overlap the part that is used")
        if not keep.all():
            reference = _cut_trajectory(reference, keep)
    return replace(recording, log=log, reference=reference)


def _cut_trajectory(trajectory: Trajectory, keep: NDArray[np.bool_]) -> Trajectory:
    extra = {key: values[keep] for key, values in trajectory.extra.items()}
    return replace(_select(trajectory, keep), extra=extra)
