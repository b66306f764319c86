"""Pseudoranges and range rates of single satellites: tightly coupled aiding.

Groves, 2nd ed., section 14.3.2. Each satellite is a measurement of its own, so that a gate judges satellites and two of them
still help. u: unit vector from the antenna to the satellite. SI units and radians; n.
"""

from __future__ import annotations

import numpy as np

from estimators.aiding import ABSENT, Aiding, Array, Columns, Measurements, add_aiding
from estimators.blocks.satellites import loop_time, observations, remembered
from estimators.core.lever_arm import lever_arm
from estimators.core.model import attitude, triple
from testbed.base.errors import InputError
from testbed.data.observations import GnssObservations
from testbed.data.records import SensorLog
from testbed.data.satellites import GALILEO, GPS
from testbed.kernels import njit
from testbed.physics import earth
from testbed.physics.delays import iono_mapping, iono_tilt, tropo_mapping
from testbed.physics.ecef import geodetic_to_ecef, north_east_down
from testbed.physics.ranging import OMEGA, C, sight
from testbed.physics.rotations import cross, matrix_rotate, matrix_rotate_inverse, quat_to_matrix

SLOW_ERRORS = ("inflate", "white", "states", "consider")
INFLATION_CAP = 100.0
"""Largest factor on the variance of a slow error: it stands for some tens of seconds at 5 Hz, what a filter of this class
averages over; without it the filter would forget the satellites in a minute's outage."""
CLOCK, ISB, GYRO_BIAS, DELAYS, RANGES, MULTIPATH, CODE = range(3, 10)
"""Places of first columns in the parameters, behind the lever arm; `ABSENT` where a block is not carried."""
OTHER_SYSTEM, IONO, NORTH, EAST, TROPO, SATELLITE, MULTIPATH_SIGMA, CODE_SIGMA = range(4, 12)
"""Places in z of a pseudorange, behind the range and the satellite: of which system, slants of the delays, its number, m."""
WHITE_M = 1e-3
"""Least white noise of a pseudorange, m: what files round it to. It keeps P regular where every other error has a state."""


def _parameters(raw: GnssObservations, columns: Columns) -> Array:
    blocks = ("gnss-clock", "gnss-isb", "gyro-bias", "gnss-delays", "gnss-ranges", "gnss-multipath", "gnss-code")
    return np.array([*raw.spec.lever_arm_b, *(columns.get(block, ABSENT) for block in blocks)], dtype=float)


def pseudoranges(log: SensorLog, columns: Columns, slow_errors: str = "inflate") -> Measurements:
    """Each pseudorange with the satellite's clock and the modelled delays taken out.

    ``slow_errors``: "white" takes the noise of the code alone for its error; "inflate" adds what lasts from epoch to epoch
    as white noise of the same density, up to a factor on its variance; "states" leaves that to the blocks
    'gnss-delays' and 'gnss-ranges', and so does "consider", for a filter that considers these blocks. What has a state
    in 'gnss-multipath' and 'gnss-code' is no noise; without them it is white noise of the same density.
    """
    if slow_errors not in SLOW_ERRORS:
        raise InputError(f"pseudorange: slow_errors = {slow_errors!r}, must be one of {', '.join(SLOW_ERRORS)}")
    if slow_errors in ("states", "consider") and not {"gnss-delays", "gnss-ranges"} <= set(columns):
        raise InputError(f"pseudorange: slow_errors = '{slow_errors}' needs the blocks 'gnss-delays' and 'gnss-ranges'")
    raw = observations(log, "the aiding 'pseudorange'")
    both = {GPS, GALILEO} <= set(np.unique(raw.systems()))
    if both and "gnss-isb" not in columns:
        raise InputError("the log has GPS and Galileo, whose clocks differ: add the block 'gnss-isb' to the states")
    z = np.column_stack(
        [
            raw.pseudorange + raw.clock - raw.iono - raw.tropo,
            raw.x_e,
            (raw.systems() == GALILEO) & both,
            iono_mapping(raw.elevation),
            iono_mapping(raw.elevation) * iono_tilt(raw.elevation) * np.cos(raw.azimuth),
            iono_mapping(raw.elevation) * iono_tilt(raw.elevation) * np.sin(raw.azimuth),
            tropo_mapping(raw.elevation),
            np.searchsorted(np.unique(raw.sv), raw.sv),
            _multipath(raw),
            raw.noise,
        ]
    ).astype(float)
    variance = _variance(raw, slow_errors, columns)
    return Measurements(raw.t - raw.spec.latency_s, z, variance[:, None], _parameters(raw, columns))


def _multipath(raw: GnssObservations) -> Array:
    """Sigma (M,) of the code's multipath, m."""
    own, elevation = raw.spec.signals, np.maximum(raw.elevation, 0.0)
    return own.multipath_zenith + own.multipath_horizon * np.exp(-elevation / own.multipath_angle)


def _variance(raw: GnssObservations, slow_errors: str, columns: Columns) -> Array:
    """R (M,) of the pseudoranges, m²."""
    noise, dt = raw.noise**2, 1.0 / raw.spec.rate_hz
    if slow_errors == "white":
        return noise
    code = remembered(loop_time(raw), dt) * noise
    if slow_errors == "inflate":
        return code + INFLATION_CAP * np.maximum(raw.sigma**2 - noise, 0.0)
    multipath = remembered(raw.spec.signals.multipath_time_s, dt) * _multipath(raw) ** 2
    return WHITE_M**2 + code * ("gnss-code" not in columns) + multipath * ("gnss-multipath" not in columns)


def rates(log: SensorLog, columns: Columns) -> Measurements:
    """Each range rate with the rate of the satellite's clock taken out."""
    raw = observations(log, "the aiding 'doppler'")
    z = np.column_stack([raw.range_rate + raw.clock_rate, raw.x_e, raw.v_e])
    return Measurements(raw.t - raw.spec.latency_s, z, raw.rate_sigma[:, None] ** 2, _parameters(raw, columns))


@njit(cache=True, nogil=True)
def _sight(state, parameters, z):
    """Range, u in n, the axes of n, the antenna's arm in n, and C_nb."""
    lat, lon, h = triple(state, 0)
    m, axes = quat_to_matrix(attitude(state)), north_east_down(lat, lon)
    arm = matrix_rotate(m, triple(parameters, 0))
    x, y, up = geodetic_to_ecef(lat, lon, h)
    lever = matrix_rotate_inverse(axes, arm)
    distance, u = sight(triple(z, 1), (x + lever[0], y + lever[1], up + lever[2]))
    return distance, matrix_rotate(axes, u), axes, arm, m


@njit(cache=True, nogil=True)
def _put_row(h, first, a, sign):
    for i in range(3):
        h[0, first + i] = sign * a[i]


def measure_pseudorange(state, imu, parameters, z, residual, h):
    """Range to a satellite (1,), m, with the receiver's clock and what else makes it too long."""
    distance, u, _, arm, _ = _sight(state, parameters, z)
    clock, isb = int(parameters[CLOCK]), int(parameters[ISB])
    predicted = distance + state[1 + clock]
    _put_row(h, 0, u, -1.0)
    _put_row(h, 6, cross(u, arm), 1.0)
    h[0, clock] = 1.0
    if isb >= 0:
        predicted = predicted + state[1 + isb] * z[OTHER_SYSTEM]
        h[0, isb] = z[OTHER_SYSTEM]
    delays, ranges = int(parameters[DELAYS]), int(parameters[RANGES])
    if delays >= 0:
        for k in range(4):
            predicted = predicted + state[1 + delays + k] * z[IONO + k]
            h[0, delays + k] = z[IONO + k]
    if ranges >= 0:
        own = ranges + int(z[SATELLITE])
        predicted = predicted + state[1 + own]
        h[0, own] = 1.0
    for k in range(2):
        first = int(parameters[MULTIPATH + k])
        if first >= 0:
            own = first + int(z[SATELLITE])
            predicted = predicted + state[1 + own] * z[MULTIPATH_SIGMA + k]
            h[0, own] = z[MULTIPATH_SIGMA + k]
    residual[0] = z[0] - predicted


def measure_doppler(state, imu, parameters, z, residual, h):
    """Range rate to a satellite (1,), m/s, with the drift of the receiver's clock."""
    distance, u, axes, arm, m = _sight(state, parameters, z)
    lever, drift = triple(parameters, 0), int(parameters[CLOCK]) + 1
    _, sweep, drag = lever_arm(m, lever, triple(imu, 0), state[0])
    moving = (sweep[0] - drag[0], sweep[1] - drag[1], sweep[2] - drag[2])
    v = triple(state, 3)
    own = (v[0] + moving[0], v[1] + moving[1], v[2] + moving[2])
    there = matrix_rotate(axes, triple(z, 4))
    u_e = matrix_rotate_inverse(axes, u)
    a = u[0] * there[0] + u[1] * there[1] + u[2] * there[2]
    b = OMEGA * (u_e[0] * z[2] - u_e[1] * z[1])
    along = u[0] * own[0] + u[1] * own[1] + u[2] * own[2]
    share = 1.0 / (1.0 + (a - b) / C)
    residual[0] = z[0] - ((a - along) * share + state[1 + drift])
    # a change of place turns the line of sight, and n under the velocity
    across = (
        there[0] - own[0] - u[0] * (a - along),
        there[1] - own[1] - u[1] * (a - along),
        there[2] - own[2] - u[2] * (a - along),
    )
    lat, _, height = triple(state, 0)
    per_north, per_east = earth.metres_per_radian(lat, height)
    turned = cross(v, u)
    cosine, sine = np.cos(lat), np.sin(lat)
    h[0, 0] = share * (turned[1] / per_north - across[0] / distance)
    h[0, 1] = share * ((turned[2] * sine - turned[0] * cosine) / per_east - across[1] / distance)
    h[0, 2] = -1.0 * share * across[2] / distance
    _put_row(h, 3, u, -1.0 * share)
    _put_row(h, 6, cross(u, moving), share)
    h[0, drift] = 1.0
    first = int(parameters[GYRO_BIAS])
    if first >= 0:
        for j in range(3):
            column = cross(arm, (m[0][j], m[1][j], m[2][j]))
            drop = u[0] * column[0] + u[1] * column[1] + u[2] * column[2]
            h[0, first + j] = -1.0 * share * drop


add_aiding(
    Aiding(
        "pseudorange",
        "gnss_raw",
        ("range, m",),
        measure_pseudorange,
        pseudoranges,
        needs=("gnss-clock",),
        summary="range to each satellite",
    )
)
add_aiding(
    Aiding(
        "doppler",
        "gnss_raw",
        ("range rate, m/s",),
        measure_doppler,
        rates,
        needs=("gnss-clock",),
        summary="range rate of each satellite",
    )
)
