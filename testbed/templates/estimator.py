"""`my-estimator`: a filter that trusts a fix the less the further off it is. A start to change."""

from dataclasses import dataclass

import numpy as np

from estimators.methods.eskf import Eskf
from testbed import NavSolution, SensorLog


@dataclass(frozen=True)
class MyEstimator:
    """``caution``: how fast the noise of a fix that surprises grows; 0 is the Kalman filter."""

    name = "my-estimator"  # of its row in every table
    caution: float = 1.0  # a scenario sets it with params = { caution = 2.0 }
    parameter_space = {"caution": (0.01, 10.0, "log")}  # what `testbed tune` may search

    def run(self, log: SensorLog) -> NavSolution:
        f = Eskf(states=("accel-bias", "gyro-bias"), aiding=("gnss",)).start(log)
        for k in range(len(log.imu.t)):
            while event := f.predict(k):  # an aiding and the number of its sample; f.state and f.P are of its time
                residual, s = f.innovation(*event)
                surprise = float(residual @ np.linalg.solve(s, residual)) / len(residual)  # 1 on average
                f.update(*event, R=f.R(*event) * (1.0 + self.caution * max(0.0, surprise - 1.0)))
        return f.solution()
