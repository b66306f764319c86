"""The barometer: static pressure of the standard atmosphere, with bias, drift, noise, limits and resolution.

ISO 2533 / ICAO Doc 7488, troposphere and lower stratosphere (to 20 km); the ellipsoidal height is taken as the
geopotential height. Pressures in Pa.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from testbed.records import Array, BaroSamples, Trajectory
from testbed.sensors.config import BaroConfig
from testbed.sensors.draws import Draws
from testbed.sensors.sensor import Column, Sensor
from testbed.specs import BaroSpec, Vector

SEA_LEVEL_PRESSURE = 101325.0
SEA_LEVEL_TEMPERATURE = 288.15
LAPSE_RATE = 0.0065
GAS_CONSTANT = 287.05287
TROPOPAUSE = 11000.0


def isa_pressure(h: Array) -> Array:
    """Pressure (Pa) at height ``h`` (m)."""
    from testbed.earth import G0

    exponent = G0 / (GAS_CONSTANT * LAPSE_RATE)
    temperature = SEA_LEVEL_TEMPERATURE - LAPSE_RATE * np.minimum(h, TROPOPAUSE)
    below = SEA_LEVEL_PRESSURE * (temperature / SEA_LEVEL_TEMPERATURE) ** exponent
    return below * np.exp(-G0 * np.maximum(h - TROPOPAUSE, 0.0) / (GAS_CONSTANT * temperature))


def isa_height(pressure: Array) -> Array:
    """Height (m) at which the standard atmosphere has this pressure (Pa): what a filter makes of a sample."""
    from testbed.earth import G0

    exponent = G0 / (GAS_CONSTANT * LAPSE_RATE)
    below = SEA_LEVEL_TEMPERATURE / LAPSE_RATE * (1.0 - (pressure / SEA_LEVEL_PRESSURE) ** (1.0 / exponent))
    top = SEA_LEVEL_TEMPERATURE - LAPSE_RATE * TROPOPAUSE
    above = TROPOPAUSE - GAS_CONSTANT * top / G0 * np.log(pressure / isa_pressure(np.array(TROPOPAUSE)))
    return np.where(below <= TROPOPAUSE, below, above)


def sense_baro(
    config: BaroConfig, trajectory: Trajectory, draws: Draws, arm_b: Vector
) -> tuple[BaroSamples, dict[str, Any]]:
    """Samples, and what was drawn; taken at the reference point of the trajectory."""
    from testbed.interpolate import sample_times, state_at

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
