"""EuRoC's layout (ASL data set format; Burri et al., IJRR 35(10), 2016): ``imu0/data.csv`` and a ground truth, no fixes.

- imu0: time (ns), angular rate x y z (rad/s), specific force x y z (m/s²) along the sensor's axes S
- state_groundtruth_estimate0: time, position x y z (m), quaternion w x y z (S into R), velocity x y z (m/s), and biases;
  else mocap0 (TUM VI), which ends with the quaternion: velocities are then differences of its positions

R has z up and any heading, here its y axis is north. In EuRoC's vehicle S has x up, y right and z forward (as ``T_BS`` of its
cameras tells), and b is S turned so; another vehicle's ``[recording.imu] mounting_deg`` (roll, pitch, yaw of S in b) takes
the place of that turn. The data set's place is the ETH in Zurich: it matters to gravity and the Earth's rate alone.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, ImuSamples
from testbed.data.specs import ImuSpec
from testbed.formats.config import RecordingConfig
from testbed.formats.frames import into_ned, ned_of
from testbed.formats.kinematics import conjugate, multiply
from testbed.formats.raw import Raw
from testbed.formats.recording import check_finite, check_time, existing, interval_means, mounting, placed, rate_of

ORIGIN = (np.radians(47.377), np.radians(8.549), 450.0)
"""Latitude, longitude (rad) and height (m) of the ETH."""
SENSOR_TO_BODY = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Forward is S's z, right its y, down its x turned round."""
_BODY_TO_SENSOR = np.array([[np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0]])
"""The quaternion that takes b into S."""
TRUTHS = {"state_groundtruth_estimate0": 17, "mocap0": 8}
"""Folder of a ground truth -> its columns."""


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The sequence in ``dir`` (``mav0`` or the folder that holds it); ``files`` may name ``imu`` and ``reference``."""
    root = folder / config.dir
    root = root / "mav0" if (root / "mav0").is_dir() else root
    paths = {part: existing(root / name, part) for part, name in config.files.items()}
    imu = paths.get("imu") or existing(root / "imu0" / "data.csv", "imu")
    stamps, values = _table(imu, (7,))
    if len(stamps) < 4:
        raise InputError(f"{imu}: has {len(stamps)} rows, at least 4 are needed")
    base = int(stamps[0]) // 1_000_000_000
    raw = Raw(name=root.parent.name if root.name == "mav0" else root.name, places={"imu": str(imu)})
    turn = np.eye(3) if "mounting_deg" in config.imu else SENSOR_TO_BODY
    sampling = config.sampling if "sampling" in config.model_fields_set else "instant"
    t = _seconds(stamps, base, imu)
    raw.t_start, t, gyro, accel = interval_means(t, values[:, :3] @ turn.T, values[:, 3:6] @ turn.T, sampling)
    raw.imu = ImuSamples(t, gyro, accel, ImuSpec("unknown", rate_of(t)))
    found = [root / name / "data.csv" for name in TRUTHS if (root / name / "data.csv").is_file()]
    if truth := paths.get("reference") or next(iter(found), None):
        raw.places["reference"] = str(truth)
        raw.motion = _motion(truth, base, config)
    return raw


def _motion(path: Path, base: int, config: RecordingConfig) -> tuple[Array, ...]:
    stamps, values = _table(path, tuple(TRUTHS.values()))
    t = _seconds(stamps, base, path)
    if len(t) < 3:
        raise InputError(f"{path}: has {len(t)} rows, at least 3 are needed")
    q = values[:, 3:7]
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    if (np.abs(norm - 1.0) > 1e-2).any():
        raise InputError(f"{path}: the quaternion of row {int(np.argmax(np.abs(norm - 1.0)))} is no unit quaternion")
    ned = ned_of(values[:, :3])
    v_n = ned_of(values[:, 7:10]) if values.shape[1] >= 10 else np.gradient(ned, t, axis=0)
    return (t, *placed(ORIGIN, ned), v_n, multiply(into_ned(q / norm), _sensor_turn(config)))


def _sensor_turn(config: RecordingConfig) -> Array:
    """(1,4): the quaternion that takes b into S."""
    if "mounting_deg" not in config.imu:
        return _BODY_TO_SENSOR
    return conjugate(mounting("imu", config.imu["mounting_deg"])[None])


def _table(path: Path, widths: tuple[int, ...]) -> tuple[Array, Array]:
    """Stamps (N,) int64, ns, and the other columns (N,k) of a table of one of ``widths`` columns."""
    import pandas as pd

    try:
        frame = pd.read_csv(path, comment="#", header=None, skipinitialspace=True)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a table of numbers ({str(error).splitlines()[0]})") from None
    if frame.shape[1] not in widths:
        expected = " or ".join(str(width) for width in widths)
        raise InputError(f"{path}: has {frame.shape[1]} columns, expected {expected}")
    if frame[0].dtype.kind not in "iu":
        raise InputError(f"{path}: its first column is not a whole number of nanoseconds in each row")
    for k in range(1, frame.shape[1]):
        if not pd.api.types.is_numeric_dtype(frame[k]):
            row = int(np.argmax(pd.to_numeric(frame[k], errors="coerce").isna().to_numpy()))
            raise InputError(
                f"{path}: column {k + 1} of row {row} is '{str(frame[k].iloc[row])[:40]}', expected a number"
            )
    values = frame.iloc[:, 1:].to_numpy(dtype=np.float64)
    return frame[0].to_numpy(dtype=np.int64), check_finite(values, str(path))


def _seconds(stamps: Array, base: int, path: Path) -> Array:
    return check_time((stamps - base * 1_000_000_000) * 1e-9, f"{path}: time")
