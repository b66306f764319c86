"""States of a tightly coupled filter: the receiver's clock, and the slow errors of satellite ranges.

Clock: Brown and Hwang, *Introduction to Random Signals and Applied Kalman Filtering*, 4th ed., section 9.3. Delays in the
atmosphere, errors of orbits, multipath and the noise of a code loop are first-order Gauss-Markov with the figures that the
log's specification states. The sigma of the last two follows elevation and C/N0, so that their states are of sigma 1 and
reach a range through the sigma of the moment. m, m/s.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimators.blocks import Block, Process, add_block
from testbed.base.errors import InputError
from testbed.data.observations import GnssObservations
from testbed.data.records import SensorLog
from testbed.data.satellites import GPS
from testbed.physics.delays import GRADIENT_SHARE, RIPPLE_SHARE, RIPPLE_TIME_S, iono_mapping
from testbed.physics.ecef import geodetic_to_ecef, north_east_down
from testbed.physics.ranging import range_rate, sight

Array = NDArray[np.float64]

CLOCK_STD, DRIFT_STD = 50.0, 1.0
"""What the start of the clock adds to three times the initial errors, m and m/s: ranges of a first epoch are that good."""
ISB_STD, ISB_WALK = 10.0, 1e-6
"""Between the clocks of two systems: m at the start (broadcast offsets reach it), and (1 mm/√s)²."""
OUTLASTS = 1.05
"""Least `remembered` of what is worth a state: below, white noise of 2 % more sigma is the same to a filter."""
SMALLEST_VARIANCE = 1e-12
"""m²: of an error that a specification does not have, so that P stays regular."""


def observations(log: SensorLog, part: str) -> GnssObservations:
    """The observations that ``part`` needs. Raises InputError where the log has none."""
    raw = log.aiding.get("gnss_raw")
    if raw is None or len(raw.t) == 0:
        raise InputError(
            f"{part} needs pseudoranges, but the log '{log.name}' has none; set [sensors.gnss] mode = \"satellites\""
        )
    assert isinstance(raw, GnssObservations)
    return raw


def clock(log: SensorLog) -> Process:
    """Bias and drift as the first epoch and the initial state have them: medians over its satellites.

    The bias is that of GPS, or of Galileo where the log has no GPS.
    """
    raw = observations(log, "the block 'gnss-clock'")
    rows = slice(0, int(raw.first_rows()[1]))
    initial, std = log.initial, np.asarray(log.initial.std, dtype=float)
    r, axes = geodetic_to_ecef(initial.lat, initial.lon, initial.h), north_east_down(initial.lat, initial.lon)
    v_e = tuple(np.array(axes).T @ np.asarray(initial.v_n, dtype=float))
    bias, drift = [], []
    for k in range(rows.start, rows.stop):
        distance, u = sight(raw.x_e[k], r)
        bias.append(raw.pseudorange[k] + raw.clock[k] - raw.iono[k] - raw.tropo[k] - distance)
        drift.append(raw.range_rate[k] + raw.clock_rate[k] - range_rate(u, raw.x_e[k], raw.v_e[k], v_e))
    white, walk = raw.spec.signals.clock_densities()
    # the first epoch lies a moment after the start
    start = np.array(
        [np.median(bias) - np.median(drift) * (raw.t[0] - raw.spec.latency_s - initial.t), np.median(drift)]
    )
    deviation = np.array([CLOCK_STD + 3.0 * std[:3].max(), DRIFT_STD + 3.0 * std[3:6].max()])
    zero = np.zeros(2)
    return Process(start, np.diag(deviation**2), np.array([white, walk]), zero, start)


def inter_system(log: SensorLog) -> Process:
    """Galileo's clock minus that of GPS: a random walk."""
    observations(log, "the block 'gnss-isb'")
    zero = np.zeros(1)
    return Process(zero, np.array([[ISB_STD**2]]), np.array([ISB_WALK]), zero, zero)


def _markov(sigma: Array, time_s: Array) -> Process:
    variance = np.maximum(sigma**2, SMALLEST_VARIANCE)
    zero = np.zeros(len(variance))
    return Process(zero, np.diag(variance), 2.0 * variance / time_s, 1.0 / time_s, zero)


def delays(log: SensorLog) -> Process:
    """What broadcast models leave of ionosphere (zenith, and its gradients over 1000 km) and troposphere (zenith)."""
    space = observations(log, "the block 'gnss-delays'").spec.space
    share = GRADIENT_SHARE * space.iono_sigma
    sigma = np.array([space.iono_sigma, share, share, space.tropo_sigma])
    return _markov(sigma, np.array([space.iono_time_s] * 3 + [space.tropo_time_s]))


def ranges(log: SensorLog) -> Process:
    """Orbit and clock of each satellite, and its own part of the ionosphere at its mean elevation.

    The sum of two Gauss-Markov processes as one: their variances and the densities that drive them add.
    """
    raw = observations(log, "the block 'gnss-ranges'")
    space, codes = raw.spec.space, np.unique(raw.sv)
    gps = codes // 100 == GPS
    orbit = np.where(gps, space.gps_sigma, space.galileo_sigma)
    times = np.where(gps, space.gps_time_s, space.galileo_time_s)
    slant = np.array([np.mean(iono_mapping(raw.elevation[raw.sv == code])) for code in codes])
    ripple = RIPPLE_SHARE * space.iono_sigma * slant
    variance = np.maximum(orbit**2 + ripple**2, SMALLEST_VARIANCE)
    drive = 2.0 * orbit**2 / times + 2.0 * ripple**2 / RIPPLE_TIME_S
    zero = np.zeros(len(codes))
    return Process(zero, np.diag(variance), drive, drive / (2.0 * variance), zero)


def remembered(time_s: float, dt: float) -> float:
    """Variance of the mean of many samples of a Gauss-Markov process over that of as many independent ones."""
    keep = float(np.exp(-dt / time_s)) if time_s > 0.0 else 0.0
    return (1.0 + keep) / (1.0 - keep)


def loop_time(raw: GnssObservations) -> float:
    """How long a code loop remembers its noise (s): 1/(4 B) of a first-order loop of one-sided bandwidth B."""
    return 0.25 / raw.spec.signals.dll_bandwidth_hz if raw.spec.signals.dll_bandwidth_hz else 0.0


def lasting_noise(raw: GnssObservations) -> tuple[str, ...]:
    """Blocks of what a receiver adds to its ranges that outlasts an epoch; what does not is white noise."""
    own, dt = raw.spec.signals, 1.0 / raw.spec.rate_hz
    multipath = own.multipath_zenith > 0.0 or own.multipath_horizon > 0.0
    found = ["gnss-multipath"] if multipath and remembered(own.multipath_time_s, dt) > OUTLASTS else []
    return (*found, *(["gnss-code"] if remembered(loop_time(raw), dt) > OUTLASTS else []))


def multipath(log: SensorLog) -> Process:
    """Multipath of each satellite's code, over its sigma."""
    raw = observations(log, "the block 'gnss-multipath'")
    return _markov(np.ones(len(raw.satellites())), np.full(len(raw.satellites()), raw.spec.signals.multipath_time_s))


def code(log: SensorLog) -> Process:
    """Noise of each satellite's code loop, over its sigma."""
    raw = observations(log, "the block 'gnss-code'")
    return _markov(np.ones(len(raw.satellites())), np.full(len(raw.satellites()), max(loop_time(raw), 1e-3)))


def _each(pattern: str) -> Callable[[SensorLog], tuple[str, ...]]:
    """Names of a state per satellite that the log has."""
    return lambda log: tuple(pattern.format(name) for name in observations(log, "a block of satellites").satellites())


add_block(
    Block(
        "gnss-clock",
        ("gnss_clock_bias_m", "gnss_clock_drift_mps"),
        clock,
        summary="bias and drift of the receiver's clock",
        chain=((0, 1),),
    )
)
add_block(Block("gnss-isb", ("gnss_isb_m",), inter_system, summary="Galileo's clock minus that of GPS, a random walk"))
add_block(
    Block(
        "gnss-delays",
        ("gnss_iono_m", "gnss_iono_north_m", "gnss_iono_east_m", "gnss_tropo_m"),
        delays,
        summary="what models leave of ionosphere and troposphere, four states",
    )
)
for _name, _process, _pattern, _kept, _summary in (
    ("gnss-ranges", ranges, "gnss_range_{}_m", True, "orbit and clock error of each satellite, a state each"),
    (
        "gnss-multipath",
        multipath,
        "gnss_multipath_{}",
        False,
        "multipath of each satellite over its sigma, a state each",
    ),
    ("gnss-code", code, "gnss_code_{}", False, "noise of each satellite's code loop over its sigma, a state each"),
):
    add_block(Block(_name, (), _process, summary=_summary, named=_each(_pattern), kept=_kept))
