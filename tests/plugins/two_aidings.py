"""`two-aidings`: `indirect-kf` with innovations at a barometer beside its own, every tenth of them rejected, and one state more."""

from dataclasses import replace

import numpy as np

from testbed.data.records import Innovations, NavSolution, SensorLog
from testbed.data.registry import make_estimator


class TwoAidings:
    """What a filter with several aidings and a policy leaves behind, without being one."""

    name = "two-aidings"

    def run(self, log: SensorLog) -> NavSolution:
        found = make_estimator("indirect-kf").run(log)
        m, n = len(log.baro.t), len(log.imu.t)
        z, rejected = np.where(np.arange(m) % 2, 1.0, -1.0)[:, None], np.arange(m) % 10 == 0
        z[rejected] *= 30.0
        baro = Innovations(log.baro.t, z, np.ones((m, 1, 1)), ("height, m",), rejected)
        return replace(
            found,
            innovations={**found.innovations, "baro": baro},
            states=(*found.states, "baro_bias_m"),
            std=np.column_stack([found.std, np.ones(n)]),
            covariance=np.pad(found.covariance, ((0, 0), (0, 1), (0, 1))) + np.diag([0.0] * 15 + [1.0]),
            estimates={"baro_bias_m": np.zeros(n)},
        )
