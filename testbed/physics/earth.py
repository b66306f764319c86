"""The Earth: WGS-84 ellipsoid, Somigliana gravity, radii of curvature, Earth and transport rate.

Equations: Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*, 2nd ed., chapter 2;
constants: NIMA TR8350.2. Frames: n is north-east-down. SI units and radians.

Every function is compiled by numba and takes floats or arrays of one shape, so that kernels and whole-log code share
one definition. Three-vectors are returned as tuples (north, east, down).
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit

A = 6378137.0
"""Semi-major axis, m."""
F = 1.0 / 298.257223563
"""Flattening."""
E2 = F * (2.0 - F)
"""First eccentricity squared."""
GM = 3.986004418e14
"""Gravitational constant times mass, m³/s²."""
RATE = 7.292115e-5
"""Rotation rate, rad/s."""
GRAVITY_EQUATOR = 9.7803253359
"""Normal gravity at the equator, m/s²."""
SOMIGLIANA_K = 0.00193185265241
"""Somigliana's constant."""
G0 = 9.80665
"""Standard gravity, m/s²; only a unit ('g', 'mg') of data sheets."""

_M = RATE**2 * A**2 * A * (1.0 - F) / GM


@njit(cache=True)
def principal_radii(lat):
    """Meridian and transverse radii of curvature (m) at latitude ``lat`` (rad). Groves eq. 2.105 and 2.106."""
    return radii_of_sine(np.sin(lat))


@njit(cache=True)
def radii_of_sine(sine):
    """`principal_radii` at the latitude of this sine."""
    w2 = 1.0 - E2 * sine**2
    rn = A / np.sqrt(w2)
    return rn * (1.0 - E2) / w2, rn


@njit(cache=True)
def gravity(lat, h):
    """Normal gravity (m/s², positive down) at latitude (rad) and ellipsoidal height (m). Groves eq. 2.134 and 2.139."""
    s2 = np.sin(lat) ** 2
    surface = GRAVITY_EQUATOR * (1.0 + SOMIGLIANA_K * s2) / np.sqrt(1.0 - E2 * s2)
    return surface * (1.0 - 2.0 / A * (1.0 + F * (1.0 - 2.0 * s2) + _M) * h + 3.0 / A**2 * h * h)


@njit(cache=True)
def earth_rate_n(lat):
    """Earth rotation ``w_ie`` in n (rad/s). Groves eq. 2.123."""
    return RATE * np.cos(lat), 0.0 * lat, -RATE * np.sin(lat)


@njit(cache=True)
def transport_rate_n(lat, h, v_north, v_east):
    """Transport rate ``w_en`` in n (rad/s). Groves eq. 5.44."""
    rm, rn = principal_radii(lat)
    east = v_east / (rn + h)
    return east, -v_north / (rm + h), -east * np.tan(lat)


@njit(cache=True)
def position_rates(lat, h, v_north, v_east, v_down):
    """Time derivatives of latitude, longitude (rad/s) and height (m/s). Groves eq. 5.56."""
    rm, rn = principal_radii(lat)
    return v_north / (rm + h), v_east / ((rn + h) * np.cos(lat)), -v_down


@njit(cache=True)
def metres_per_radian(lat, h):
    """Length (m) of one radian of latitude and of longitude at (lat, h): how small angles become metres everywhere."""
    rm, rn = principal_radii(lat)
    return rm + h, (rn + h) * np.cos(lat)


@njit(cache=True)
def position_difference(lat, lon, h, lat_ref, lon_ref, h_ref):
    """Small difference (lat, lon, h) minus reference in metres north, east, down; longitude wraps at 180°."""
    north, east = metres_per_radian(lat_ref, h_ref)
    dlon = np.mod(lon - lon_ref + np.pi, 2.0 * np.pi) - np.pi
    return (lat - lat_ref) * north, dlon * east, h_ref - h
