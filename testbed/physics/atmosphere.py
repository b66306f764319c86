"""The standard atmosphere: pressure against height, with its lapse rate and the isothermal layer above.

ISO 2533 / ICAO Doc 7488, troposphere and lower stratosphere (to 20 km); the ellipsoidal height is taken as the
geopotential height. Pressures in Pa, heights in m.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.physics.earth import G0

Array = NDArray[np.float64]

SEA_LEVEL_PRESSURE = 101325.0
SEA_LEVEL_TEMPERATURE = 288.15
LAPSE_RATE = 0.0065
GAS_CONSTANT = 287.05287
TROPOPAUSE = 11000.0
_EXPONENT = G0 / (GAS_CONSTANT * LAPSE_RATE)


def isa_temperature(h: Array) -> Array:
    """Temperature (K) at height ``h`` (m)."""
    return SEA_LEVEL_TEMPERATURE - LAPSE_RATE * np.minimum(h, TROPOPAUSE)


def isa_pressure(h: Array) -> Array:
    """Pressure (Pa) at height ``h`` (m)."""
    temperature = isa_temperature(h)
    below = SEA_LEVEL_PRESSURE * (temperature / SEA_LEVEL_TEMPERATURE) ** _EXPONENT
    return below * np.exp(-G0 * np.maximum(h - TROPOPAUSE, 0.0) / (GAS_CONSTANT * temperature))


def isa_height(pressure: Array) -> Array:
    """Height (m) at which the standard atmosphere has this pressure (Pa): what a filter makes of a sample."""
    below = SEA_LEVEL_TEMPERATURE / LAPSE_RATE * (1.0 - (pressure / SEA_LEVEL_PRESSURE) ** (1.0 / _EXPONENT))
    top = SEA_LEVEL_TEMPERATURE - LAPSE_RATE * TROPOPAUSE
    above = TROPOPAUSE - GAS_CONSTANT * top / G0 * np.log(pressure / isa_pressure(np.array(TROPOPAUSE)))
    return np.where(below <= TROPOPAUSE, below, above)


def isa_gradient(h: Array) -> Array:
    """Fall of pressure with height, -dp/dh = g p / (R T), Pa/m: 12 at sea level."""
    return G0 * isa_pressure(h) / (GAS_CONSTANT * isa_temperature(h))
