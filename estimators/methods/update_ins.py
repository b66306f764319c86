"""`update-ins`: a Kalman filter while there is GNSS; in an outage the INS starts at the last corrected state and runs free.

The method of "Update INS" in comparisons of outage bridging. NED frame, SI units and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from estimators.aiding.gnss import require_gnss
from estimators.core.stepwise import Stepwise
from estimators.methods.indirect_kf import IndirectKf
from testbed.base.errors import InputError
from testbed.data.records import NavSolution, SensorLog


@dataclass(frozen=True)
class UpdateIns(IndirectKf):
    """`indirect-kf` with a free INS in every gap of the fixes.

    A gap is an outage when it is longer than ``outage_after_s``. With ``keep_biases`` the free INS goes on with the
    bias estimates of the filter; without, it has only those of ``log.initial``, as an INS that nobody corrects.
    """

    outage_after_s: float = 2.0
    keep_biases: bool = False
    name: ClassVar[str] = "update-ins"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.outage_after_s > 0.0:
            raise InputError(f"{self.name}: outage_after_s = {self.outage_after_s}, must be above 0 s")

    def start(self, log: SensorLog) -> Stepwise:
        """Raises InputError: what it does in an outage is no step of its filter."""
        raise InputError(f"{self.name}: does not go step by step; start '{IndirectKf.name}'")

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log, then replace each outage by free integration. ``std`` in an outage is the filter's own."""
        return self._restarted(log, super().run(log))

    def run_many(self, logs: Sequence[SensorLog]) -> list[NavSolution]:
        """`run` on each of some logs with the same times, side by side."""
        return [self._restarted(*pair) for pair in zip(logs, super().run_many(logs), strict=True)]

    def _restarted(self, log: SensorLog, solution: NavSolution) -> NavSolution:
        from estimators.core.strapdown import integrate

        lla = np.column_stack([solution.lat, solution.lon, solution.h])
        v_n, q_nb = solution.v_n.copy(), solution.q_nb.copy()
        assert solution.accel_bias is not None and solution.gyro_bias is not None
        biases = {"accel_bias": solution.accel_bias.copy(), "gyro_bias": solution.gyro_bias.copy()}
        imu, t = log.imu, log.imu.t
        for first, last in outage_rows(log, self.outage_after_s, self.name):
            rows = slice(first + 1, last)
            for key, values in biases.items():
                values[rows] = values[first] if self.keep_biases else getattr(log.initial, key)
            integrate(
                t[first],
                t[rows],
                imu.gyro[rows],
                imu.accel[rows],
                lla[first, 0],
                lla[first, 1],
                lla[first, 2],
                v_n[first],
                q_nb[first],
                biases["accel_bias"][first + 1],
                biases["gyro_bias"][first + 1],
                lla[rows],
                v_n[rows],
                q_nb[rows],
            )
        return replace(
            solution,
            lat=lla[:, 0],
            lon=lla[:, 1],
            h=lla[:, 2],
            v_n=v_n,
            q_nb=q_nb,
            accel_bias=biases["accel_bias"],
            gyro_bias=biases["gyro_bias"],
        )


def outage_rows(log: SensorLog, longer_than_s: float, name: str) -> list[tuple[int, int]]:
    """For every gap: the IMU row that holds the last corrected state, and the first row after the gap."""
    gnss, t = require_gnss(log, name), log.imu.t
    fixes = gnss.t - gnss.spec.latency_s
    fixes = np.append(fixes[(fixes >= log.initial.t) & (fixes <= t[-1])], np.inf)
    out = []
    for begin, end in zip(fixes[:-1], fixes[1:], strict=True):
        if min(end, t[-1]) - begin > longer_than_s:
            first, last = int(np.searchsorted(t, begin - 1e-7)), int(np.searchsorted(t, end - 1e-7))
            if last > first + 1:
                out.append((first, last))
    return out
