"""A receiver that stands still for days: the errors of its fixes, for a comparison with figures of another program."""

from __future__ import annotations

import datetime

import numpy as np

from testbed.data.specs import SignalSpec, SpaceSpec
from testbed.gnss import signals
from testbed.gnss.constellation import nominal_sky
from testbed.gnss.receiver import Received, solve
from testbed.physics import earth
from testbed.sensors.draws import Draws

LAT = np.radians(45.0)
SPACE = SpaceSpec(0.6, 7200.0, 0.2, 7200.0, 1.2, 1800.0, 0.12, 1800.0)
SIGNALS = SignalSpec(
    dll_bandwidth_hz=1.0,
    correlator_chips=0.5,
    rate_sigma=0.05,
    multipath_zenith=0.13,
    multipath_horizon=0.53,
    multipath_time_s=25.0,
)


def errors_of_fixes(seed, days=4.0, step=5.0, systems=("gps",), space=SPACE, own=SIGNALS):
    """(E,3) errors of the fixes (m north, east, down): C/N0 = 37 + 10 sin^0.7 E, GPS 24 in view of 45 N, mask 5 degrees."""
    sky = nominal_sky(datetime.datetime(2021, 9, 22), systems)
    draws = Draws(seed)
    errors = signals.Errors(sky, space, own, draws, step)
    out = []
    for first in np.arange(0.0, days * 86400.0, 2048 * step):
        t = first + step * np.arange(2048)
        n = len(t)
        site = signals.Site(
            t, np.tile([LAT, 0.0, 0.0], (n, 1)), np.zeros((n, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        )
        seen = signals.look(site, signals.Broadcast(sky.ephemerides, sky.klobuchar, sky.second_of_day), 10.0)
        elevation = np.maximum(seen[..., signals.ELEVATION], 0.0)
        noise = signals.code_noise(own, 37.0 + 10.0 * np.sin(elevation) ** 0.7)
        sigma = np.sqrt(
            (0.9 * space.iono_sigma * seen[..., signals.IONO_SLANT]) ** 2
            + (space.tropo_sigma * seen[..., signals.TROPO_SLANT]) ** 2
            + signals.multipath_sigma(own, elevation) ** 2
            + noise**2
            + signals.orbit_sigma(space, sky.codes // 100) ** 2
        )
        pseudorange = seen[..., signals.RANGE] + errors.slow(seen) + noise * errors.fast(noise)[0]
        k, s = np.nonzero(seen[..., signals.ELEVATION] > np.radians(5.0))
        rows = seen[k, s]
        received = Received(
            np.concatenate([[0], np.cumsum(np.bincount(k, minlength=n))]).astype(np.int64),
            sky.codes[s] // 100,
            np.ascontiguousarray(rows[:, signals.X : signals.Z + 1]),
            np.ascontiguousarray(rows[:, signals.VX : signals.VZ + 1]),
            pseudorange[k, s],
            rows[:, signals.RATE],
            sigma[k, s],
            np.ones(len(k)),
        )
        place = solve(received, 0.0).place
        out.append(np.column_stack(earth.position_difference(*place.T, LAT, 0.0, 0.0)))
    return np.concatenate(out)


def figures(errors, step=5.0):
    """H95, V95 (m), and the autocorrelation of north and down at 5, 60, 600, 1800 s."""

    def correlation(x, lag):
        x = x - x.mean()
        return (x[:-lag] * x[lag:]).mean() / (x * x).mean()

    lags = [round(lag / step) for lag in (5.0, 60.0, 600.0, 1800.0)]
    horizontal = np.percentile(np.hypot(errors[:, 0], errors[:, 1]), 95)
    vertical = np.percentile(np.abs(errors[:, 2]), 95)
    return np.array([horizontal, vertical, *(correlation(errors[:, axis], lag) for axis in (0, 2) for lag in lags)])
