"""Plug-in whose north error is a function of three parameters, known in closed form, plus noise of the run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from testbed.base.streams import stream
from testbed.data.records import NavSolution
from testbed.data.registry import load_plugin
from testbed.physics import earth

load_plugin(Path(__file__).with_name("monte_carlo.py"))  # the flight of its tests, which costs nothing

LINEAR = (4.0, 2.0, 1.0)
OFFSET_M = 20.0
"""Keeps the error positive, so that its RMSE is the function itself."""


@dataclass(frozen=True)
class Known:
    """Truth that is shifted north by ``OFFSET_M`` + f(x1, x2, x3) + a draw of the run.

    ``kind``: ``linear`` (`LINEAR` times x) or ``ishigami`` (sin x1 + 7 sin² x2 + 0.1 x3⁴ sin x1). A run is lost where x1 is above
    ``lost_above``.
    """

    kind: str = "linear"
    x1: float = 0.0
    x2: float = 0.0
    x3: float = 0.0
    noise_m: float = 0.0
    lost_above: float = 1e9
    name = "known"

    def run(self, log):
        if self.x1 > self.lost_above:
            raise ArithmeticError("too far out")
        if self.kind == "linear":
            f = LINEAR[0] * self.x1 + LINEAR[1] * self.x2 + LINEAR[2] * self.x3
        else:
            f = np.sin(self.x1) + 7.0 * np.sin(self.x2) ** 2 + 0.1 * self.x3**4 * np.sin(self.x1)
        seed, run = map(int, log.name.split())
        shift = OFFSET_M + f + self.noise_m * stream(seed, run, "known").normal()
        t = log.imu.t
        n = len(t)
        flat = np.zeros(n)
        lat = 0.8 + 50.0 * t / earth.metres_per_radian(0.8, 100.0)[0]  # as the plug-in's flight
        north = earth.metres_per_radian(lat, 100.0 + flat)[0]
        velocity = np.tile([50.0, 0.0, 0.0], (n, 1))
        still = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        return NavSolution(t, lat + shift / north, flat + 0.1, flat + 100.0, velocity, still, *np.zeros((2, n, 3)))
