"""BROAD, a benchmark for orientation estimation (Laidig et al., *Data* 6(7), 2021, doi 10.3390/data6070072): one trial.

A trial is a .mat file: ``imu_gyr`` (rad/s), ``imu_acc`` (m/s²), ``imu_mag`` (µT), (N,3) each at ``sampling_rate`` (Hz),
``opt_quat`` (sensor to east-north-up, scalar first) and ``opt_pos`` (m, east-north-up) of the optical reference, NaN where
the cameras lost the markers, and ``movement``, which marks the rows to score. The magnetometer is slower than the IMU;
the file repeats its samples.

Here b is the sensor turned by 180° about its x axis, so that z points down while it lies level, and n is the data set's
own frame turned to north-east-down: its north is that of the reference. Rows without a reference are not scored; the
phase ``movement`` runs from the first marked row to the last.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, ImuSamples, MagSamples, Phase
from testbed.data.specs import ImuSpec, MagSpec
from testbed.formats.config import RecordingConfig
from testbed.formats.frames import FLIP, attitudes, ned_of
from testbed.formats.raw import Raw
from testbed.formats.recording import check_finite, only_file, placed, read_mat

ORIGIN = (np.radians(52.51), np.radians(13.33), 80.0)
"""Latitude, longitude (rad) and height (m) of the recording, Berlin: it matters to gravity and the Earth's rate alone."""

FURTHEST = 1000.0
"""Metres; optical tracking reaches across a hall."""


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The trial that ``config`` names (part ``trial``; default: the only .mat file of the folder)."""
    path = only_file(folder / config.dir, config.files, "trial", (".mat",))
    content = read_mat(path)
    gyro, accel, field, quat, place = (
        _rows(path, content, name, width)
        for name, width in (("imu_gyr", 3), ("imu_acc", 3), ("imu_mag", 3), ("opt_quat", 4), ("opt_pos", 3))
    )
    movement = _rows(path, content, "movement", 1)[:, 0] != 0
    rate = float(_rows(path, content, "sampling_rate", 1)[0, 0])
    if not 1.0 <= rate <= 1e5:
        raise InputError(f"{path}: sampling_rate is {rate:g} Hz, expected 1 to 100000")
    n = len(gyro)
    for name, values in (("imu_acc", accel), ("imu_mag", field), ("opt_quat", quat), ("movement", movement)):
        if len(values) != n:
            raise InputError(f"{path}: {name} has {len(values)} rows, imu_gyr has {n}")
    for name, values in (("imu_gyr", gyro), ("imu_acc", accel), ("imu_mag", field)):
        check_finite(values, f"{path}: {name}")
    t = np.arange(n) / rate
    raw = Raw(name=path.stem, t_start=-1.0 / rate, places=dict.fromkeys(("imu", "mag", "reference"), str(path)))
    raw.stated = {"mag"}  # n is the reference's own frame
    raw.imu = ImuSamples(t, gyro * FLIP, accel * FLIP, ImuSpec("BROAD IMU", rate))
    raw.mag = MagSamples(t, field * FLIP, MagSpec("BROAD magnetometer", rate))
    seen = np.isfinite(quat).all(axis=1) & np.isfinite(place).all(axis=1)
    if seen.sum() < 3:
        raise InputError(
            f"{path}: opt_quat and opt_pos have {int(seen.sum())} rows that are numbers, at least 3 are needed"
        )
    raw.motion, raw.own_times = _motion(t[seen], quat[seen], place[seen], path), True
    if movement.any():
        marked = np.flatnonzero(movement)
        raw.phases = (Phase("movement", float(t[marked[0]]) - 0.5 / rate, float(t[marked[-1]])),)
    if lost := int(n - seen.sum()):
        raw.notes.append(f"{path}: the optical reference is missing in {lost} of {n} rows, which are not scored")
    return raw


def _rows(path: Path, content: dict[str, Array], name: str, width: int) -> Array:
    if name not in content:
        raise InputError(f"{path}: has no variable '{name}'; it holds {', '.join(sorted(content)) or 'none'}")
    values = content[name]
    if values.ndim != 2 or values.shape[1] != width or values.dtype.kind not in "fiub" or not len(values):
        raise InputError(f"{path}: {name} has shape {values.shape}, expected numbers of shape (N, {width})")
    return values.astype(np.float64)


def _motion(t: Array, quat: Array, place: Array, path: Path) -> tuple[Array, ...]:
    """t, lat, lon, h, v_n, q_nb: q_nb = (n from ENU) (ENU from sensor) (sensor from b); velocity by differences."""
    with np.errstate(over="ignore"):  # a norm beyond all numbers is none of a unit quaternion either
        norm = np.linalg.norm(quat, axis=1, keepdims=True)
    if (np.abs(norm - 1.0) > 1e-2).any():
        raise InputError(f"{path}: opt_quat at sample {int(np.argmax(np.abs(norm - 1.0)))} is no unit quaternion")
    if (far := np.abs(place).max(axis=1) > FURTHEST).any():
        raise InputError(
            f"{path}: opt_pos at sample {int(np.argmax(far))} lies more than {FURTHEST:g} m from the cameras' origin"
        )
    ned = ned_of(place)
    return (t, *placed(ORIGIN, ned), np.gradient(ned, t, axis=0), attitudes(quat / norm))
