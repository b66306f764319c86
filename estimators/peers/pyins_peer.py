"""`pyins`: the feedback filter of the package python-ins (N. Matveev), as a peer for accuracy and speed.

Fed with the same specifications, initial state and fixes as `indirect-kf`; needs the optional extra ``peers``.
python-ins works in degrees and pandas; everything is converted at this edge. Two things it does not take, and gets in a form
that it does: it subtracts longitudes without wrapping them, so they count from the start here, and its matrices want even
sampling, so a gap of the IMU is filled with parts of the interval that bridges it. Its sigmas of position and velocity are told;
those of the attitude are of roll, pitch and heading one by one, of which the bench's rotation vector cannot be had.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from estimators.aiding.gnss import MINIMUM_STD, require_gnss
from estimators.blocks.imu import noise_model
from testbed.base.errors import InputError, MissingExtra
from testbed.data.records import NAVIGATION_STATES, NavSolution, SensorLog
from testbed.physics.rotations import eulers_to_quats, quats_to_eulers, wrap

if TYPE_CHECKING:
    import pandas as pd

LLA = ["lat", "lon", "alt"]
VELOCITY = ["VN", "VE", "VD"]
EULER = ["roll", "pitch", "heading"]


@dataclass(frozen=True)
class PyIns:
    """python-ins 1.x: 15 states, position and velocity fixes.

    ``time_step_s`` is the interval of its covariance propagation. Its bias is a random walk without decay, its initial
    deviations are one figure for all axes of position and of velocity (the largest is taken) and two for attitude.
    """

    time_step_s: float = 0.1
    name: ClassVar[str] = "pyins"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")

    def __post_init__(self) -> None:
        if not 0.0 < self.time_step_s <= 1.0:
            raise InputError(f"{self.name}: time_step_s = {self.time_step_s}, must be above 0 and at most 1 s")

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError without GNSS fixes or without the package."""
        filters, measurements, sensors = _pyins()
        gnss = require_gnss(log, self.name)
        q, _, _, covariance = noise_model(log)
        std = np.sqrt(np.diag(covariance))
        gyro = sensors.EstimationModel(bias_sd=std[12:], noise=np.sqrt(q[3:6]), bias_walk=np.sqrt(q[9:12]))
        accel = sensors.EstimationModel(bias_sd=std[9:12], noise=np.sqrt(q[:3]), bias_walk=np.sqrt(q[6:9]))
        fix_std = np.maximum(gnss.measurement_std()[0], MINIMUM_STD)
        lever = np.array(gnss.spec.lever_arm_b, dtype=float)
        place, motion = fix_frames(log)
        result = filters.run_feedback_filter(
            initial_pva(log),
            float(std[:3].max()),
            float(std[3:6].max()),
            float(np.degrees(std[6:8].max())),
            float(np.degrees(std[8])),
            imu_increments(log),
            gyro,
            accel,
            [measurements.Position(place, fix_std[:3], lever), measurements.NedVelocity(motion, fix_std[3:], lever)],
            self.time_step_s,
        )
        return _solution(log, result)


def _pyins() -> tuple[Any, Any, Any]:
    try:
        from pyins import filters, inertial_sensor, measurements
    except ImportError:
        raise MissingExtra("estimator 'pyins' needs the package python-ins: install the extra 'peers'") from None
    return filters, measurements, inertial_sensor


def initial_pva(log: SensorLog) -> pd.Series:
    """The initial state as python-ins' Pva."""
    import pandas as pd

    s = log.initial
    euler = np.degrees(quats_to_eulers(np.atleast_2d(s.q_nb))[0])
    place = [np.degrees(s.lat), 0.0, s.h]  # longitude counts from here
    return pd.Series([*place, *s.v_n, *euler], index=LLA + VELOCITY + EULER, name=s.t)


def imu_increments(log: SensorLog) -> pd.DataFrame:
    """The IMU means as python-ins' Increments, with its own coning and sculling; initial biases subtracted."""
    import pandas as pd
    from pyins.strapdown import compute_increments_from_imu

    imu, s = log.imu, log.initial
    t = np.concatenate([[s.t], imu.t])
    rates = np.hstack([imu.gyro - s.gyro_bias, imu.accel - s.accel_bias])
    t, rates = without_gaps(t, rates)
    values = rates * np.diff(t)[:, None]
    names = [f"{kind}_{axis}" for kind in ("gyro", "accel") for axis in "xyz"]
    frame = pd.DataFrame(np.vstack([np.zeros(6), values]), index=t, columns=names)
    return compute_increments_from_imu(frame, "increment")


def without_gaps(t: Any, rates: Any) -> tuple[Any, Any]:
    """Times (N+1,) and means (N,k) over the intervals between them, those across a gap cut to the usual length."""
    from testbed.data.shapes import gaps_of

    if not gaps_of(t):
        return t, rates
    steps = np.diff(t)
    counts = np.where(np.isin(t[:-1], [before for before, _ in gaps_of(t)]), np.round(steps / np.median(steps)), 1)
    counts = counts.astype(int)
    ends = np.concatenate([t[k] + steps[k] * np.arange(1, n + 1) / n for k, n in enumerate(counts)])
    ends[np.cumsum(counts) - 1] = t[1:]
    return np.concatenate([t[:1], ends]), np.repeat(rates, counts, axis=0)


def fix_frames(log: SensorLog) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Position and velocity fixes as python-ins wants them, at the time that they describe."""
    import pandas as pd

    gnss = require_gnss(log, "pyins")
    t = gnss.t - gnss.spec.latency_s
    east = np.degrees(wrap(gnss.lon - log.initial.lon))
    place = pd.DataFrame(np.column_stack([np.degrees(gnss.lat), east, gnss.h]), index=t, columns=LLA)
    return place, pd.DataFrame(gnss.v_n, index=t, columns=VELOCITY)


def _solution(log: SensorLog, result: Any) -> NavSolution:
    table = result.trajectory.iloc[1:]
    table = table[np.isin(table.index.to_numpy(), log.imu.t)]
    euler = np.radians(table[EULER].to_numpy())
    t = table.index.to_numpy()

    def latest(frame: pd.DataFrame) -> Any:
        return frame.to_numpy()[np.searchsorted(frame.index.to_numpy(), t, side="right") - 1]

    return NavSolution(
        t,
        np.radians(table["lat"].to_numpy()),
        wrap(np.radians(table["lon"].to_numpy()) + log.initial.lon),
        table["alt"].to_numpy(),
        table[VELOCITY].to_numpy(),
        eulers_to_quats(euler),
        accel_bias=latest(result.accel) + log.initial.accel_bias,
        gyro_bias=latest(result.gyro) + log.initial.gyro_bias,
        std=latest(result.trajectory_sd)[:, :6],
        states=NAVIGATION_STATES[:6],
    )
