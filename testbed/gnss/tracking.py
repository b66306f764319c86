"""Which satellites a receiver has: antenna, loss of a signal, and how long it takes to find it again.

C/N0 in dB-Hz, angles in rad, times in s. Thresholds are those of common receivers: a signal of 22 dB-Hz is lost after half
a second, one of 30 dB-Hz is found again (28 while it is still expected). Kernels on (E,S) arrays: epochs, satellites.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.kernels import njit

Array = NDArray[np.float64]

LOST_DBHZ, LOST_AFTER_S = 22.0, 0.5
FOUND_DBHZ, FOUND_SOON_DBHZ = 30.0, 28.0
SOON_S, WARM_S = 10.0, 60.0
"""Absence below which a signal is searched with a lower threshold, and below which the search is short."""
SEARCH_S = 1.0
EPHEMERIS_S = 30.0
"""GPS repeats its ephemeris every 30 s; a satellite that was never received before is used after it."""
SETTLING_S = 2.0
"""After which the code loop has settled; until then its noise is twice as large."""
BLOCKED = np.radians(105.0)
"""Angle from the antenna's axis beyond which the airframe hides a satellite."""
CHIP_RATE = 1.023e6

ABSENT_SINCE, LOCKED_SINCE, WEAK_SINCE, READY_AT = range(4)
"""Columns of a satellite's state: times, not a number where they do not apply."""


@njit(cache=True)
def antenna_gain(angle, drop):
    """Gain (dB) relative to the axis: -drop (1 - cos) to 90 degrees, half a dB a degree beyond, at least -35."""
    if angle <= 0.5 * np.pi:
        return -drop * (1.0 - np.cos(angle))
    return max(-drop - 0.5 * np.degrees(angle - 0.5 * np.pi), -35.0)


def jammed(cn0: Array, js_db: Array, q: float) -> Array:
    """C/N0 (dB-Hz) that is left of ``cn0`` with a jammer ``js_db`` above the signal: Kaplan and Hegarty, 2nd ed., eq. 6.13."""
    return -10.0 * np.log10(10.0 ** (-cn0 / 10.0) + 10.0 ** (js_db / 10.0) / (q * CHIP_RATE))


def fresh_state(satellites: int) -> Array:
    """The state (S,4) of a receiver that has been on: what is open at the first epoch is tracked there."""
    return np.full((satellites, 4), np.nan)


@njit(cache=True)
def track(t, cn0, open_sky, luck, state):
    """Seconds since each satellite was found (E,S), not a number while it is not received.

    ``cn0`` (E,S), ``open_sky`` (E,S) whether anything is between, ``luck`` (E,S) exponential draws of mean 1, of which that
    at the epoch when a signal comes back counts; ``state`` (S,4) is carried from block to block.
    """
    lock = np.full(cn0.shape, np.nan)
    for s in range(cn0.shape[1]):
        own = state[s]
        for k in range(cn0.shape[0]):
            heard = open_sky[k, s] and cn0[k, s] >= LOST_DBHZ
            if not np.isnan(own[LOCKED_SINCE]):
                _keep(t[k], heard, own)
            elif np.isnan(own[ABSENT_SINCE]) and t[k] == t[0] and np.isnan(own[WEAK_SINCE]):
                _begin(t[k], open_sky[k, s] and cn0[k, s] >= FOUND_DBHZ, own)
            else:
                _search(t[k], open_sky[k, s], cn0[k, s], luck[k, s], own)
            if not np.isnan(own[LOCKED_SINCE]) and heard:
                lock[k, s] = t[k] - own[LOCKED_SINCE]
    return lock


@njit(cache=True)
def _begin(t, found, own):
    """The first epoch: satellites in view were found long ago."""
    if found:
        own[LOCKED_SINCE] = t - WARM_S
    else:
        own[ABSENT_SINCE] = -np.inf


@njit(cache=True)
def _keep(t, heard, own):
    """A signal that was tracked so far."""
    if heard:
        own[WEAK_SINCE] = np.nan
        return
    if np.isnan(own[WEAK_SINCE]):
        own[WEAK_SINCE] = t
    if t - own[WEAK_SINCE] >= LOST_AFTER_S:
        own[ABSENT_SINCE], own[LOCKED_SINCE], own[READY_AT] = own[WEAK_SINCE], np.nan, np.nan
        own[WEAK_SINCE] = np.nan


@njit(cache=True)
def _search(t, is_open, cn0, luck, own):
    """A signal that is looked for: it is there once it was strong enough for as long as the search takes."""
    away = t - own[ABSENT_SINCE]
    wanted = FOUND_SOON_DBHZ if away < SOON_S else FOUND_DBHZ
    if not (is_open and cn0 >= wanted):
        own[READY_AT] = np.nan
        return
    if np.isnan(own[READY_AT]):
        if away < WARM_S:
            own[READY_AT] = t + SEARCH_S * (1.0 + luck)
        else:
            own[READY_AT] = t + 3.0 + 2.0 * (1.0 - np.exp(-luck))
            if np.isinf(away):
                own[READY_AT] += EPHEMERIS_S
    if t >= own[READY_AT]:
        own[LOCKED_SINCE], own[WEAK_SINCE], own[READY_AT] = t, np.nan, np.nan
