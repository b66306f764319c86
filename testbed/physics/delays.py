"""How delays in ionosphere and troposphere grow towards the horizon, and what the broadcast ionosphere leaves of itself.

Mapping of the troposphere: RTCA DO-229. Kernels on numbers or arrays; angles in rad.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit

GRADIENT_SHARE = 0.5
"""Gradient of the ionosphere's residual over 1000 km, over the residual at zenith."""
RIPPLE_SHARE, RIPPLE_TIME_S = 0.2, 600.0
"""What each line of sight has for itself, over the residual at zenith, and how long that lasts."""


@njit(cache=True)
def tropo_mapping(elevation):
    """Slant over zenith delay of the troposphere (RTCA DO-229, appendix A.4.2.4)."""
    s = np.sin(elevation)
    return 1.001 / np.sqrt(0.002001 + s * s)


@njit(cache=True)
def iono_mapping(elevation):
    """Slant over zenith delay of a thin shell at 350 km: (1 - (0.948 cos E)²)^(-1/2)."""
    x = 0.948 * np.cos(elevation)
    return 1.0 / np.sqrt(1.0 - x * x)


@njit(cache=True)
def iono_tilt(elevation):
    """How a gradient of the ionosphere, per 1000 km, enters a slant delay before the mapping: 0.35 cot E, at most 1.

    The pierce point lies 350 km cot E from the antenna, and less as the Earth curves away: hence the limit.
    """
    s = np.sin(elevation)
    return np.minimum(0.35 * np.cos(elevation) / np.maximum(s, 1e-3), 1.0)
