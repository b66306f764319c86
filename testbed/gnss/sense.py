"""What a GNSS receiver records on a flight, satellite by satellite, and the fixes that it makes of that alone.

The observations of an epoch describe the geometry at its stamp: what a receiver clock's bias shifts the moment of sampling
(a metre at a millisecond) is left out, here and in the receiver. Range rates carry no change of the delays, as if they
were corrected for it; by the models it is at most 3 cm/s, near the horizon.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.observations import GnssObservations
from testbed.data.records import GnssFixes, Trajectory
from testbed.data.specs import GnssSpec, SignalSpec, SpaceSpec
from testbed.gnss import signals as s
from testbed.gnss.config import SatellitesConfig, Stretch
from testbed.gnss.constellation import Sky, code_of, nominal_sky
from testbed.gnss.receiver import Fixes, Received, solve
from testbed.gnss.rinex import read_navigation
from testbed.gnss.tracking import BLOCKED, SETTLING_S, fresh_state, jammed, track
from testbed.physics.interpolate import point_state, state_at
from testbed.sensors.draws import Draws

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLOCK = 2048
"""Epochs that are simulated at a time: memory stays below some tens of megabytes."""
MINIMUM_SIGMA, MINIMUM_RATE_SIGMA = 1e-3, 1e-4
"""m and m/s: what a receiver without errors states, as weights must be finite."""
GLANCE_S, BELOW = 60.0, np.radians(2.0)
"""How often satellites are looked for, and below the horizon how far: in a minute they rise by half a degree, and an aircraft
of 300 m/s sees another 0.2 degrees."""
IONO_KNOWN = 0.9
"""A receiver's sigma of the ionosphere over the sigma of the zenith residual times the mapping: the residual of a line of
sight is not known better than its part that all satellites share."""


def space_of(config: SatellitesConfig) -> SpaceSpec:
    """What is known of the errors in space, without those that are left out."""
    off = config.disable
    return SpaceSpec(
        gps_sigma=0.0 if "orbit_clock" in off else config.gps_sigma_m,
        galileo_sigma=0.0 if "orbit_clock" in off else config.galileo_sigma_m,
        iono_sigma=0.0 if "iono" in off else config.iono_sigma_m,
        tropo_sigma=0.0 if "tropo" in off else config.tropo_sigma_m,
    )


def signals_of(config: SatellitesConfig, own: SignalSpec) -> SignalSpec:
    """The receiver's figures without the sources that are left out."""
    off: dict[str, float] = {}
    if "multipath" in config.disable:
        off |= {"multipath_zenith": 0.0, "multipath_horizon": 0.0}
    if "code_noise" in config.disable:
        off["dll_bandwidth_hz"] = 0.0
    if "rate_noise" in config.disable:
        off["rate_sigma"] = 0.0
    if "clock" in config.disable:
        off |= {"clock_h0_s": 0.0, "clock_hm2_ps": 0.0}
    return replace(own, **off)


def sky_of(config: SatellitesConfig) -> Sky:
    """The satellites above a flight. Raises InputError for a navigation file that has none."""
    if config.navigation is not None:
        return read_navigation(config.navigation).sky(config.moment(), config.systems)
    return nominal_sky(config.moment(), config.systems, config.expanded)


class Antenna(NamedTuple):
    """An antenna on its flight."""

    trajectory: Trajectory
    arm_b: Array
    """From the trajectory's reference point, m"""
    moments: Array
    """When it is listened to"""
    silent: Mask
    """Moments when nothing is received at all"""


def sense_satellites(
    config: SatellitesConfig, spec: GnssSpec, antenna: Antenna, draws: Draws
) -> tuple[GnssObservations, dict[str, Any]]:
    """Observations, stamped ``spec.latency_s`` after they are made; and the truth behind them, for scoring only."""
    trajectory, moments = antenna.trajectory, antenna.moments
    sky, disable = sky_of(config), config.disable
    _check(config, sky, trajectory)
    sky = above(sky, antenna, spec.rate_hz)
    step = 1.0 / spec.rate_hz
    errors = s.Errors(sky, spec.space, spec.signals, draws, step)
    clock = s.ReceiverClock(spec.signals, draws, step, "clock" not in disable)
    state, parts, clocks = fresh_state(len(sky.codes)), [], []
    for first in range(0, len(moments), BLOCK):
        part = slice(first, first + BLOCK)
        t = moments[part]
        seen = s.look(_site(trajectory, t, antenna.arm_b), _broadcast(sky), spec.signals.pattern_drop)
        clocks.append(clock(len(t)))
        block = _Block(t, seen, clocks[-1], errors, state, antenna.silent[part])
        parts.append(_observe(config, spec, sky, block))
    table = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]} if parts else _nothing()
    table["t"] = table["t"] + spec.latency_s
    observations = GnssObservations(**table, spec=spec)
    truth = np.concatenate(clocks) if clocks else np.zeros((0, 2))
    return observations, {"gnss_clock_bias_m": truth[:, 0], "gnss_clock_drift_mps": truth[:, 1]}


def above(sky: Sky, antenna: Antenna, rate_hz: float) -> Sky:
    """The satellites that come above the horizon while the antenna is listened to.

    The others are not received, and nothing that is drawn for them reaches any other: leaving them out changes no number.
    """
    t = antenna.moments
    if not len(t):
        return sky
    t = np.append(t[:: max(1, round(GLANCE_S * rate_hz))], t[-1])
    seen = s.look(_site(antenna.trajectory, t, antenna.arm_b), _broadcast(sky), 0.0)
    risen = (seen[..., s.ELEVATION] > -BELOW).any(axis=0)
    return replace(sky, codes=sky.codes[risen], ephemerides=sky.ephemerides[risen])


def _check(config: SatellitesConfig, sky: Sky, trajectory: Trajectory) -> None:
    """Stretches within the flight and satellites of the sky, or an InputError."""
    start, end = trajectory.t[0], trajectory.t[-1]
    stretches: list[tuple[str, Stretch]] = [("losses", loss) for loss in config.losses]
    stretches += [("walls", street) for street in config.walls]
    stretches += [("keep", keep) for keep in config.keep] + [("faults", fault) for fault in config.faults]
    for key, stretch in stretches:
        if stretch.start_s < start or stretch.end_s > end:
            raise InputError(
                f"[sensors.gnss.satellites] {key}: [{stretch.start_s:g}, {stretch.end_s:g}] lies outside of the flight,"
                f" which lasts from {start:g} to {end:g} s"
            )
    spells = {}
    if config.spoofing is not None:
        spells["spoofing"] = (config.spoofing.start_s, np.inf)
    if config.jamming is not None:
        spells["jamming"] = (config.jamming.js_db[0][0], config.jamming.js_db[-1][0])
    for key, spell in spells.items():
        if spell[0] > end or spell[1] < start:
            raise InputError(
                f"[sensors.gnss.satellites] {key}: begins at {spell[0]:g} s, but the flight lasts from {start:g} to {end:g} s:"
                " it has no effect"
            )
    named = [loss.sv for loss in (*config.losses, *config.faults)]
    named += [name for keep in config.keep for name in keep.satellites or ()]
    for name in named:
        if name not in sky.names:
            raise InputError(
                f"[sensors.gnss.satellites]: no satellite '{name}' in this sky; it has {', '.join(sky.names)}"
            )


def _site(trajectory: Trajectory, t: Array, arm_b: Array) -> s.Site:
    lat, lon, h, v_n = point_state(trajectory, t, arm_b)
    return s.Site(t, np.column_stack([lat, lon, h]), v_n, state_at(trajectory, t)[4])


def _broadcast(sky: Sky) -> s.Broadcast:
    return s.Broadcast(sky.ephemerides, sky.klobuchar, sky.second_of_day)


class _Block(NamedTuple):
    """Epochs that are simulated at a time."""

    t: Array
    seen: Array
    clock: Array
    errors: s.Errors
    state: Array
    silent: Mask


def _observe(config: SatellitesConfig, spec: GnssSpec, sky: Sky, block: _Block) -> dict[str, Array]:
    """The rows of a block's observations."""
    seen, t, off = block.seen, block.t, config.disable
    cn0 = spec.signals.cn0_zenith + seen[..., s.GAIN]
    fading = s.FADING_DB * block.errors.fading(len(t))
    cn0 = cn0 if "fading" in off else cn0 + fading
    spoofed = _spoofed(config, t)
    if config.spoofing is not None:
        cn0 = np.where(spoofed[2][:, None], cn0 + config.spoofing.power_db, cn0)
    if config.jamming is not None:
        cn0 = _jammed(config, t, cn0)
    clear = _open(config, spec, sky, t, seen) & ~block.silent[:, None]
    lock = track(t, cn0, clear, block.errors.luck(len(t)), block.state)
    noise = s.code_noise(spec.signals, cn0) * np.where(lock < SETTLING_S, 2.0, 1.0)
    multipath = s.multipath_sigma(spec.signals, np.maximum(seen[..., s.ELEVATION], 0.0))
    rate_sigma = s.rate_noise(spec.signals, cn0)
    slow, (code, rate) = block.errors.slow(seen), block.errors.fast(cn0)
    step, ramp = _faults(config, sky, t)
    away, away_rate = _pull(seen, spoofed)
    pseudorange = seen[..., s.RANGE] - seen[..., s.CLOCK] + config.iono_scale * seen[..., s.IONO] + seen[..., s.TROPO]
    pseudorange += block.clock[:, :1] + slow + step + away + noise * code
    range_rate = seen[..., s.RATE] * (1.0 + seen[..., s.CLOCK_RATE] / s.C) - seen[..., s.CLOCK_RATE]
    range_rate = range_rate + block.clock[:, 1:] + ramp + away_rate + rate_sigma * rate
    space = spec.space
    sigma = (IONO_KNOWN * space.iono_sigma * seen[..., s.IONO_SLANT]) ** 2 + multipath**2 + noise**2
    sigma += (space.tropo_sigma * seen[..., s.TROPO_SLANT]) ** 2 + s.orbit_sigma(space, sky.codes // 100) ** 2
    k, j = np.nonzero(np.isfinite(lock))
    seen = seen[k, j]
    nothing = np.zeros(len(k))
    return {
        "t": t[k],
        "sv": sky.codes[j].astype(float),
        "pseudorange": pseudorange[k, j],
        "range_rate": range_rate[k, j],
        "cn0": cn0[k, j],
        "lock_time": lock[k, j],
        "x_e": seen[:, s.X : s.Z + 1],
        "v_e": seen[:, s.VX : s.VZ + 1],
        "clock": seen[:, s.CLOCK],
        "clock_rate": seen[:, s.CLOCK_RATE],
        "iono": seen[:, s.IONO],
        "tropo": seen[:, s.TROPO],
        "sigma": np.maximum(np.sqrt(sigma[k, j]), MINIMUM_SIGMA),
        "noise": np.maximum(noise[k, j], MINIMUM_SIGMA),
        "rate_sigma": np.maximum(rate_sigma[k, j], MINIMUM_RATE_SIGMA),
        "elevation": seen[:, s.ELEVATION],
        "azimuth": seen[:, s.AZIMUTH],
        "residual": nothing,
        "used": nothing,
    }


def _nothing() -> dict[str, Array]:
    """The rows of a flight without an epoch."""
    names = [name for name in GnssObservations.shapes if name not in ("x_e", "v_e")]
    return (
        {"t": np.zeros(0)} | {name: np.zeros(0) for name in names} | {"x_e": np.zeros((0, 3)), "v_e": np.zeros((0, 3))}
    )


def _open(config: SatellitesConfig, spec: GnssSpec, sky: Sky, t: Array, seen: Array) -> Mask:
    """(E,S) whether anything stands between a satellite and the antenna, or the scenario takes it away."""
    elevation, azimuth = seen[..., s.ELEVATION], seen[..., s.AZIMUTH]
    clear = (elevation >= spec.signals.mask) & (seen[..., s.ANGLE] <= BLOCKED)
    for street in config.walls:
        around, height = np.radians(np.array(street.skyline)).T
        inside = (t >= street.start_s) & (t < street.end_s)
        clear[inside] &= elevation[inside] >= np.interp(azimuth[inside], around, height, period=2.0 * np.pi)
    for loss in config.losses:
        clear[np.ix_((t >= loss.start_s) & (t < loss.end_s), sky.codes == code_of(loss.sv))] = False
    for keep in config.keep:
        inside = (t >= keep.start_s) & (t < keep.end_s)
        if inside.any():
            stay = _stay(keep.satellites, keep.highest, sky, elevation[np.argmax(inside)])
            clear[np.ix_(inside, ~stay)] = False
    return clear


def _stay(satellites: list[str] | None, highest: int | None, sky: Sky, elevation: Array) -> Mask:
    if satellites is not None:
        return np.isin(sky.codes, [code_of(name) for name in satellites])
    stay = np.zeros(len(sky.codes), dtype=bool)
    stay[np.argsort(-elevation, kind="stable")[:highest]] = True
    return stay


def _jammed(config: SatellitesConfig, t: Array, cn0: Array) -> Array:
    assert config.jamming is not None
    times, power = np.array(config.jamming.js_db).T
    js = np.interp(t, times, power, left=-np.inf, right=-np.inf)
    return jammed(cn0, js[:, None], config.jamming.q)


def _faults(config: SatellitesConfig, sky: Sky, t: Array) -> tuple[Array, Array]:
    """(E,S) what faults add to pseudoranges (m) and range rates (m/s)."""
    step, ramp = np.zeros((2, len(t), len(sky.codes)))
    for fault in config.faults:
        inside, which = (t >= fault.start_s) & (t < fault.end_s), sky.codes == code_of(fault.sv)
        step[np.ix_(inside, which)] += (fault.step_m + fault.ramp_mps * (t - fault.start_s))[inside, None]
        ramp[np.ix_(inside, which)] += fault.ramp_mps
    return step, ramp


def _spoofed(config: SatellitesConfig, t: Array) -> tuple[Array, Array, Mask]:
    """Horizontal displacement (E,2) m and its rate (E,2) m/s that counterfeit signals pretend, and whether they are there."""
    spoofing = config.spoofing
    if spoofing is None:
        return np.zeros((len(t), 2)), np.zeros((len(t), 2)), np.zeros(len(t), dtype=bool)
    angle = np.radians(spoofing.direction_deg)
    direction = np.array([np.cos(angle), np.sin(angle)])
    since = np.maximum(t - spoofing.start_s - spoofing.capture_s, 0.0)
    until = spoofing.rate_mps / spoofing.acceleration_mps2
    rate = spoofing.acceleration_mps2 * np.minimum(since, until)
    way = rate * since - 0.5 * spoofing.acceleration_mps2 * np.minimum(since, until) ** 2
    return way[:, None] * direction, rate[:, None] * direction, t >= spoofing.start_s


def _pull(seen: Array, spoofed: tuple[Array, Array, Mask]) -> tuple[Array, Array]:
    """(E,S) what a displacement of the fix is along each line of sight, minus u times it, and its rate."""
    azimuth, level = seen[..., s.AZIMUTH], np.cos(seen[..., s.ELEVATION])
    u = np.stack([np.cos(azimuth) * level, np.sin(azimuth) * level], axis=2)
    return -np.einsum("ksi,ki->ks", u, spoofed[0]), -np.einsum("ksi,ki->ks", u, spoofed[1])


def corrected(observations: GnssObservations) -> Received:
    """Observations as the receiver solves them: with the broadcast clock, without the modelled delays."""
    o = observations
    return Received(
        o.first_rows() if len(o.t) else np.zeros(1, dtype=np.int64),
        o.systems(),
        o.x_e,
        o.v_e,
        o.pseudorange + o.clock - o.iono - o.tropo,
        o.range_rate + o.clock_rate,
        o.sigma,
        o.rate_sigma,
    )


def fixes_of(
    observations: GnssObservations,
    windows: tuple[tuple[float, float], ...] = (),
    false_alarm: float = 1e-3,
    accuracy_scale: float = 1.0,
) -> tuple[GnssFixes, GnssObservations, Fixes]:
    """Fixes with the accuracy that the receiver states, the observations with its residuals and verdicts, and all else."""
    received = corrected(observations)
    fixes = solve(received, false_alarm)
    known = np.isfinite(fixes.place[:, 0])
    t = observations.t[received.first[:-1]][known]
    place = fixes.place[known]
    made = GnssFixes(
        t,
        np.ascontiguousarray(place[:, 0]),
        np.ascontiguousarray(place[:, 1]),
        np.ascontiguousarray(place[:, 2]),
        fixes.v_n[known],
        observations.spec,
        windows,
        accuracy_scale * fixes.std[known],
        fixes.correlation[known],
    )
    judged = {"residual": np.nan_to_num(fixes.residual), "used": fixes.used.astype(float)}
    return made, GnssObservations(**{**vars(observations), **judged}), fixes
