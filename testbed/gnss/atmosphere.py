"""Delays in ionosphere and troposphere: the models that receivers correct with.

Klobuchar: IS-GPS-200, figure 20-4. Saastamoinen with the standard atmosphere: *Bulletin géodésique* 107 (1973), as in the
usual receiver software (humidity 70 %). How
delays grow towards the horizon is in `testbed.physics.delays`. Delays in m, angles in rad.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit
from testbed.physics.ranging import C

HUMIDITY = 0.7


@njit(cache=True)
def klobuchar(coefficients, place, direction, t):
    """Delay on L1 (m); ``coefficients`` (8,) alpha then beta, ``place`` (lat, lon), ``direction`` (elevation, azimuth).

    ``t``: GPS time of day, s. Angles of the model are semicircles; the formula holds below the shell at 350 km.
    """
    e = direction[0] / np.pi
    psi = 0.0137 / (e + 0.11) - 0.022
    lat = min(max(place[0] / np.pi + psi * np.cos(direction[1]), -0.416), 0.416)
    lon = place[1] / np.pi + psi * np.sin(direction[1]) / np.cos(lat * np.pi)
    magnetic = lat + 0.064 * np.cos((lon - 1.617) * np.pi)
    local = np.mod(43200.0 * lon + t, 86400.0)
    amplitude, period, power = 0.0, 0.0, 1.0
    for k in range(4):
        amplitude += coefficients[k] * power
        period += coefficients[4 + k] * power
        power *= magnetic
    amplitude, period = max(amplitude, 0.0), max(period, 72000.0)
    slant = 1.0 + 16.0 * (0.53 - e) ** 3
    x = 2.0 * np.pi * (local - 50400.0) / period
    delay = 5e-9
    if np.abs(x) < 1.57:
        square = x * x
        delay += amplitude * (1.0 - 0.5 * square + square * square / 24.0)
    return C * slant * delay


@njit(cache=True)
def saastamoinen(lat, h):
    """Hydrostatic and wet delay at zenith (m), at latitude and height above the ellipsoid (negative heights count as 0)."""
    h = max(h, 0.0)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * h) ** 5.2568
    kelvin = 288.16 - 6.5e-3 * h
    vapour = 6.108 * HUMIDITY * np.exp((17.15 * kelvin - 4684.0) / (kelvin - 38.45))
    dry = 0.0022768 * pressure / (1.0 - 0.00266 * np.cos(2.0 * lat) - 0.00028 * h / 1e3)
    return dry, 0.002277 * (1255.0 / kelvin + 0.05) * vapour
