"""The barometer: static pressure of the standard atmosphere, with bias, drift, noise, limits and resolution.

`testbed.physics.atmosphere`, at the ellipsoidal height. Pressures in Pa.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from testbed.data.records import BaroSamples, Trajectory
from testbed.data.specs import BaroSpec, Vector
from testbed.sensors.config import BaroConfig
from testbed.sensors.draws import Draws
from testbed.sensors.sensor import Column, Sensor


def sense_baro(
    config: BaroConfig, trajectory: Trajectory, draws: Draws, arm_b: Vector
) -> tuple[BaroSamples, dict[str, Any]]:
    """Samples, and what was drawn; taken at the reference point of the trajectory."""
    from testbed.physics.atmosphere import isa_pressure
    from testbed.physics.interpolate import sample_times, state_at

    spec = config.spec()
    t = sample_times(trajectory, spec.rate_hz)
    _, _, h, _, _ = state_at(trajectory, t)
    bias = spec.turn_on_bias * draws.turn_on("baro.turn_on_bias").standard_normal()
    steps = spec.drift / math.sqrt(spec.rate_hz) * draws.noise("baro.drift").standard_normal(len(t))
    pressure = isa_pressure(h) + bias + np.cumsum(steps)
    pressure += spec.noise_sigma * draws.noise("baro.white").standard_normal(len(t))
    if spec.resolution:
        pressure = np.rint(pressure / spec.resolution) * spec.resolution
    return BaroSamples(t, np.clip(pressure, spec.minimum, spec.maximum), spec), {"baro_turn_on_bias": bias}


SENSOR = Sensor(
    kind="baro",
    title="Barometer",
    spec=BaroSpec,
    config=BaroConfig,
    samples=BaroSamples,
    sense=sense_baro,
    columns=(Column("pressure", "pressure_pa", "pressure"),),
    rows={
        "noise_sigma": ("Noise, 1σ", 1.0, "Pa"),
        "turn_on_bias": ("Bias, 1σ", 1.0, "Pa"),
        "drift": ("Drift", 1.0, "Pa/√s"),
        "resolution": ("Resolution", 1.0, "Pa"),
    },
    rank=2,
)
