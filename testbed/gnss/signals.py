"""Signals as they reach the antenna, and the errors that they carry.

Ionosphere and troposphere: what the broadcast models leave, correlated between satellites; orbits and clocks: one
Gauss-Markov range error per satellite; multipath: Gauss-Markov, larger towards the horizon; code noise: Kaplan and Hegarty,
2nd ed., eq. 5.23; oscillator: Brown and Hwang, 4th ed., section 9.3. Every source has a random stream of its own for every
satellite, which is drawn whether the satellite is seen or not. Arrays are (E,S): epochs, satellites; m, m/s, rad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.data.satellites import GPS
from testbed.data.specs import SignalSpec, SpaceSpec
from testbed.gnss import orbits
from testbed.gnss.atmosphere import klobuchar, saastamoinen
from testbed.gnss.constellation import Sky
from testbed.gnss.tracking import antenna_gain
from testbed.kernels import njit
from testbed.physics.delays import GRADIENT_SHARE, RIPPLE_SHARE, RIPPLE_TIME_S, iono_mapping, iono_tilt, tropo_mapping
from testbed.physics.ecef import geodetic_to_ecef, north_east_down
from testbed.physics.ranging import C, range_rate, sight
from testbed.physics.rotations import quat_rotate_inverse
from testbed.sensors.draws import Draws

Array = NDArray[np.float64]

CHIP_M = C / 1.023e6
FADING_DB, FADING_TIME_S = 1.0, 30.0

(X, Y, Z, VX, VY, VZ, CLOCK, CLOCK_RATE, RANGE, RATE, ELEVATION, AZIMUTH, GAIN, ANGLE, IONO, TROPO) = range(16)
TROPO_SLANT, IONO_SLANT, TILT = 16, 17, 18
COLUMNS = 19


class Site(NamedTuple):
    """The antenna at the epochs of a block."""

    t: Array
    """(E,) s from the start of the flight"""
    place: Array
    """(E,3) latitude, longitude, height"""
    v_n: Array
    """(E,3) m/s"""
    q_nb: Array
    """(E,4)"""


class Broadcast(NamedTuple):
    """What all receivers know of the sky."""

    ephemerides: Array
    """(S,23)"""
    klobuchar: Array
    """(8,)"""
    second_of_day: float


@njit(cache=True)
def look(site, broadcast, drop):
    """(E,S,19) of every satellite as the antenna receives it, above the horizon or not; ``drop`` of `antenna_gain`."""
    epochs, satellites = site.t.shape[0], broadcast.ephemerides.shape[0]
    out = np.zeros((epochs, satellites, COLUMNS))
    for k in range(epochs):
        lat, lon, h = site.place[k, 0], site.place[k, 1], site.place[k, 2]
        r, axes = geodetic_to_ecef(lat, lon, h), north_east_down(lat, lon)
        v = (site.v_n[k, 0], site.v_n[k, 1], site.v_n[k, 2])
        v_e = (
            axes[0][0] * v[0] + axes[1][0] * v[1] + axes[2][0] * v[2],
            axes[0][1] * v[0] + axes[1][1] * v[1] + axes[2][1] * v[2],
            axes[0][2] * v[0] + axes[1][2] * v[1] + axes[2][2] * v[2],
        )
        dry, wet = saastamoinen(lat, h)
        for s in range(satellites):
            row = out[k, s]
            x, xv, distance, (offset, rate) = orbits.received(broadcast.ephemerides[s], site.t[k], r)
            _, u = sight(x, r)
            row[X], row[Y], row[Z], row[VX], row[VY], row[VZ] = x[0], x[1], x[2], xv[0], xv[1], xv[2]
            row[CLOCK], row[CLOCK_RATE], row[RANGE] = offset, rate, distance
            row[RATE] = range_rate(u, x, xv, v_e)
            u_n = (
                axes[0][0] * u[0] + axes[0][1] * u[1] + axes[0][2] * u[2],
                axes[1][0] * u[0] + axes[1][1] * u[1] + axes[1][2] * u[2],
                axes[2][0] * u[0] + axes[2][1] * u[1] + axes[2][2] * u[2],
            )
            row[ELEVATION], row[AZIMUTH] = np.arcsin(-u_n[2]), np.mod(np.arctan2(u_n[1], u_n[0]), 2.0 * np.pi)
            up = -quat_rotate_inverse(site.q_nb[k], u_n)[2]
            row[ANGLE] = np.arccos(min(max(up, -1.0), 1.0))
            row[GAIN] = antenna_gain(row[ANGLE], drop)
            if row[ELEVATION] > 0.0:
                direction = (row[ELEVATION], row[AZIMUTH])
                moment = broadcast.second_of_day + site.t[k]
                row[IONO] = klobuchar(broadcast.klobuchar, (lat, lon), direction, moment)
                row[TROPO_SLANT], row[IONO_SLANT] = tropo_mapping(row[ELEVATION]), iono_mapping(row[ELEVATION])
                row[TILT] = iono_tilt(row[ELEVATION])
                row[TROPO] = (dry + wet) * row[TROPO_SLANT]
    return out


class Markov:
    """Gauss-Markov processes of sigma 1 side by side, one stream each, drawn block by block; exact at the epochs."""

    def __init__(self, draws: Draws, names: Sequence[str], time_s: Array | float, step_s: float) -> None:
        self._streams = [draws.noise(name) for name in names]
        self._decay = np.exp(-step_s / np.broadcast_to(np.asarray(time_s, dtype=float), len(names)))
        self._last = np.full(len(names), np.nan)

    def __call__(self, epochs: int) -> Array:
        """(E,len(names)) of the next epochs."""
        x = np.empty((epochs, len(self._streams)))
        for column, rng in enumerate(self._streams):
            x[:, column] = rng.standard_normal(epochs)
        _go_on(x, self._decay, self._last)
        return x


class White:
    """White noise, otherwise as `Markov`; ``exponential`` draws of mean 1 on demand."""

    def __init__(self, draws: Draws, names: Sequence[str], exponential: bool = False) -> None:
        self._streams, self._exponential = [draws.noise(name) for name in names], exponential

    def __call__(self, epochs: int) -> Array:
        """(E,len(names)) of the next epochs."""
        drawn = [
            rng.standard_exponential(epochs) if self._exponential else rng.standard_normal(epochs)
            for rng in self._streams
        ]
        return np.column_stack(drawn)


@njit(cache=True)
def _go_on(x, decay, last):
    for s in range(x.shape[1]):
        keep, drive, before = decay[s], np.sqrt(1.0 - decay[s] * decay[s]), last[s]
        for k in range(x.shape[0]):
            before = x[k, s] if np.isnan(before) else keep * before + drive * x[k, s]
            x[k, s] = before
        last[s] = before


class ReceiverClock:
    """Bias (m) and drift (m/s) of an oscillator: white noise and random walk of frequency, exact from epoch to epoch.

    It starts within half a millisecond, as receivers steer it, with a drift of 100 m/s (1 sigma, a third of a ppm).
    """

    BIAS_M, DRIFT_MPS = 5e-4 * C, 100.0

    def __init__(self, signals: SignalSpec, draws: Draws, step_s: float, on: bool) -> None:
        start = draws.turn_on("gnss.clock")
        bias, drift = start.uniform(-self.BIAS_M, self.BIAS_M), self.DRIFT_MPS * start.standard_normal()
        self._state = np.array([bias, drift]) if on else np.zeros(2)
        white, walk = signals.clock_densities() if on else (0.0, 0.0)
        self._step, self._stream = step_s, draws.noise("gnss.clock")
        drift_std = math.sqrt(walk * step_s)
        self._factor = np.array(
            [[math.sqrt(white * step_s + walk * step_s**3 / 12.0), 0.5 * step_s * drift_std], [0.0, drift_std]]
        )

    def __call__(self, epochs: int) -> Array:
        """(E,2) of the next epochs: the covariance of a step is [[Sf T + Sg T³/3, Sg T²/2], [., Sg T]]."""
        noise = self._stream.standard_normal((epochs, 2)) @ self._factor.T
        return _clock_steps(self._state, noise, self._step)


@njit(cache=True)
def _clock_steps(state, noise, step):
    out = np.empty_like(noise)
    for k in range(noise.shape[0]):
        out[k, 0], out[k, 1] = state[0], state[1]
        state[0] += step * state[1] + noise[k, 0]
        state[1] += noise[k, 1]
    return out


def code_noise(signals: SignalSpec, cn0: Array) -> Array:
    """Sigma (m) of a noncoherent early-late code loop at ``cn0`` (dB-Hz), 20 ms of predetection time."""
    ratio = 10.0 ** (cn0 / 10.0)
    d = signals.correlator_chips
    squaring = 1.0 + 2.0 / ((2.0 - d) * 0.02 * ratio)
    return CHIP_M * np.sqrt(signals.dll_bandwidth_hz * d / (2.0 * ratio) * squaring)


def rate_noise(signals: SignalSpec, cn0: Array) -> Array:
    """Sigma (m/s) of a range rate: the specification's at 45 dB-Hz, and as the square root of the noise elsewhere."""
    return signals.rate_sigma * 10.0 ** ((45.0 - cn0) / 20.0)


def multipath_sigma(signals: SignalSpec, elevation: Array) -> Array:
    """Sigma (m) of the code's multipath."""
    return signals.multipath_zenith + signals.multipath_horizon * np.exp(-elevation / signals.multipath_angle)


def orbit_sigma(space: SpaceSpec, systems: NDArray[np.int64]) -> Array:
    """Sigma (m) of orbit and clock by system."""
    return np.where(systems == GPS, space.gps_sigma, space.galileo_sigma)


class Errors:
    """The slow errors and the noise of all satellites, block by block."""

    def __init__(self, sky: Sky, space: SpaceSpec, signals: SignalSpec, draws: Draws, step_s: float) -> None:
        names = sky.names
        self._space, self._signals = space, signals
        self._orbit_sigma = orbit_sigma(space, sky.codes // 100)
        times = np.where(sky.codes // 100 == GPS, space.gps_time_s, space.galileo_time_s)
        loop = 1.0 / (4.0 * signals.dll_bandwidth_hz) if signals.dll_bandwidth_hz else step_s
        common = ["gnss.iono.zenith", "gnss.iono.north", "gnss.iono.east"]

        def of_each(source: str) -> list[str]:
            return [f"gnss.{source}.{name}" for name in names]

        self._iono = Markov(draws, common, space.iono_time_s, step_s)
        self._tropo = Markov(draws, ["gnss.tropo"], space.tropo_time_s, step_s)
        self._ripple = Markov(draws, of_each("iono"), RIPPLE_TIME_S, step_s)
        self._orbit = Markov(draws, of_each("orbit_clock"), times, step_s)
        self._multipath = Markov(draws, of_each("multipath"), signals.multipath_time_s, step_s)
        self._code = Markov(draws, of_each("code"), loop, step_s)
        self._rate = White(draws, of_each("rate"))
        self.fading = Markov(draws, of_each("fading"), FADING_TIME_S, step_s)
        self.luck = White(draws, of_each("reacquisition"), exponential=True)

    def slow(self, seen: Array) -> Array:
        """(E,S) of ionosphere, troposphere, orbits and clocks, and multipath, for the directions in ``seen``."""
        epochs, space = len(seen), self._space
        iono, tropo, ripple = self._iono(epochs), self._tropo(epochs), self._ripple(epochs)
        tilt = seen[..., TILT] * GRADIENT_SHARE
        azimuth = seen[..., AZIMUTH]
        plane = tilt * (iono[:, 1:2] * np.cos(azimuth) + iono[:, 2:3] * np.sin(azimuth))
        total = space.iono_sigma * seen[..., IONO_SLANT] * (iono[:, :1] + plane + RIPPLE_SHARE * ripple)
        total += space.tropo_sigma * tropo * seen[..., TROPO_SLANT]
        total += self._orbit_sigma * self._orbit(epochs)
        return total + multipath_sigma(self._signals, np.maximum(seen[..., ELEVATION], 0.0)) * self._multipath(epochs)

    def fast(self, cn0: Array) -> tuple[Array, Array]:
        """(E,S) unit noise of the code and of the rate."""
        return self._code(len(cn0)), self._rate(len(cn0))
