"""KITTI raw data (Geiger et al., IJRR 32(11), 2013): the OXTS unit of a drive, folder ``oxts`` with one text file a sample.

Columns of a sample (``dataformat.txt`` of the data set): latitude, longitude (deg), altitude (m), roll, pitch, yaw (rad),
velocity north, east, forward, left, up (m/s), acceleration x, y, z and forward, left, up (m/s²), angular rate x, y, z and
forward, left, up (rad/s), accuracies of position and velocity, and five states of the receiver. x is forward, y left, z up;
yaw counts from east counter-clockwise, roll is positive with the left side up, pitch with the front down.

Place, velocity and attitude are the unit's own solution of RTK and inertial sensors: they are the reference, and there are
no fixes beside it. Samples are values at their times, 10 a second in the *sync* and 100 in the *extract* archives.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, ImuSamples
from testbed.data.specs import ImuSpec
from testbed.formats.config import RecordingConfig
from testbed.formats.frames import FLIP, attitudes, ned_of
from testbed.formats.raw import Raw
from testbed.formats.recording import check_finite, check_place, check_time, existing, interval_means, rate_of
from testbed.physics.rotations import eulers_to_quats

COLUMNS = 30
SLOW_HZ = 50.0
"""Below it the IMU is too slow for the motion of a car: turns of 1 Hz lose 1 - sinc(1/50) = 0.07 % of their angle, vibration all."""


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The drive in ``dir`` (its ``oxts`` folder, or the one that ``files`` names under ``oxts``)."""
    root = _oxts(folder / config.dir, config)
    rows, numbers = _samples(root)
    place = str(root)
    stamps = _stamps(root / "timestamps.txt", numbers)
    base = int(stamps[0]) // 1_000_000_000
    t = check_time((stamps - base * 1_000_000_000) * 1e-9, f"{root / 'timestamps.txt'}: time")
    if len(t) < 4:
        raise InputError(f"{root}: has {len(t)} samples, at least 4 are needed")
    raw = Raw(name=root.parent.name, places=dict.fromkeys(("imu", "reference"), place))
    sampling = config.sampling if "sampling" in config.model_fields_set else "instant"
    raw.t_start, t_imu, gyro, accel = interval_means(t, rows[:, 17:20] * FLIP, rows[:, 11:14] * FLIP, sampling)
    raw.imu = ImuSamples(t_imu, gyro, accel, ImuSpec("OXTS RT3003", rate_of(t)))
    raw.utc = float(base)
    lat, lon = np.radians(rows[:, 0]), np.radians(rows[:, 1])
    check_place(lat, lon, place)
    v_n = ned_of(rows[:, [7, 6, 10]])
    raw.motion = (t, lat, lon, rows[:, 2], v_n, attitudes(eulers_to_quats(rows[:, 3:6])))
    if raw.imu.spec.rate_hz < SLOW_HZ:
        raw.notes.append(
            f"{root}: the IMU has {raw.imu.spec.rate_hz:g} samples a second (a sync archive?); extract archives have 100"
        )
    return raw


def _oxts(root: Path, config: RecordingConfig) -> Path:
    options = [root / config.files["oxts"]] if "oxts" in config.files else [root / "oxts", root]
    for option in options:
        if (option / "data").is_dir():
            return option
    raise InputError(
        f"{options[0]}: no folder data with the samples of the OXTS unit; recording.dir names the folder of a drive"
    )


def _samples(root: Path) -> tuple[Array, list[int]]:
    """(N,30) and the numbers that the files have for names."""
    paths = sorted((root / "data").glob("*.txt"))
    if not paths:
        raise InputError(f"{root / 'data'}: holds no .txt files")
    words: list[str] = []
    for path in paths:
        try:
            found = path.read_text(encoding="ascii").split()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from None
        if len(found) != COLUMNS:
            raise InputError(f"{path}: has {len(found)} values, expected {COLUMNS} (KITTI's dataformat.txt names them)")
        words += found
    try:
        rows = np.array(words, dtype=np.float64).reshape(-1, COLUMNS)
    except ValueError as error:
        raise InputError(f"{root / 'data'}: a value is not a number ({error})") from None
    if named := [path for path in paths if not path.stem.isdecimal()]:
        raise InputError(f"{named[0]}: the name of a sample is its number, as in 0000000000.txt")
    return check_finite(rows, str(root / "data")), [int(path.stem) for path in paths]


def _stamps(path: Path, numbers: list[int]) -> Array:
    """Times (Unix, ns) of the samples: the file has a line for each number, from 0 on."""
    lines = existing(path, "times of the samples").read_text(encoding="ascii", errors="replace").split("\n")
    lines = [line.strip() for line in lines]
    if len(lines) <= numbers[-1]:
        raise InputError(f"{path}: has {len(lines)} lines, the last sample is number {numbers[-1]}")
    try:
        stamps = np.array([lines[k] for k in numbers], dtype="datetime64[ns]")
    except ValueError as error:
        raise InputError(f"{path}: a time is not of the form 2011-09-26 13:02:25.594360375 ({error})") from None
    if np.isnat(stamps).any():
        raise InputError(f"{path}: line {numbers[int(np.argmax(np.isnat(stamps)))] + 1} has no time")
    return stamps.astype(np.int64)
