"""The GNSS receiver: position and velocity of the antenna in n, with noise, latency, outages and wrong fixes.

Errors: white plus first-order Gauss-Markov (Groves, 2nd ed., section 9.4), in metres north, east, down and m/s. Times in
s from the start of the flight; a fix may fall anywhere between the samples of the trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.columns import columns, stack
from testbed.data.records import Array, GnssFixes, Samples, Trajectory
from testbed.data.specs import GnssSpec, Vector
from testbed.sensors.config import GnssConfig, OutlierBursts, RandomOutages
from testbed.sensors.draws import Draws
from testbed.sensors.sensor import Column, Sensor

Windows = tuple[tuple[float, float], ...]
_SNAP_S = 1e-9


def sense_gnss(
    config: GnssConfig, trajectory: Trajectory, draws: Draws, arm_b: Vector
) -> tuple[GnssFixes | dict[str, Samples], dict[str, Any]]:
    """The fixes, and what was drawn. Every fix draws its errors whether it is lost or not.

    Down to the satellites: fixes and observations by their kinds.
    """
    from testbed.physics.earth import metres_per_radian
    from testbed.physics.interpolate import point_state

    if config.mode == "satellites":
        return _sense_satellites(config, trajectory, draws, arm_b)
    spec = config.spec()
    outages = outage_windows(config, trajectory, draws)
    moments = fix_moments(spec, config.time_offset_s, trajectory)
    stamps = moments + spec.latency_s
    factor, reported = _dilution(config, trajectory, stamps)
    lat, lon, h, v_n = point_state(trajectory, moments, np.array(arm_b) + np.array(spec.lever_arm_b))
    errors = factor[:, None] * _errors(spec, len(moments), draws)
    constants: dict[str, Any] = {}
    if config.outliers is not None:
        bursts = _bursts(config.outliers, trajectory, len(moments), draws)
        constants["gnss_outlier_bursts"] = bursts
        errors += _burst_errors(config.outliers, bursts, stamps, draws)
    north, east = metres_per_radian(lat, h)
    seen = (stamps >= trajectory.t[0] + config.start_up_s) & ~_inside(outages, stamps)
    fixes = GnssFixes(
        stamps[seen],
        (lat + errors[:, 0] / north)[seen],
        (lon + errors[:, 1] / east)[seen],
        (h - errors[:, 2])[seen],
        (v_n + errors[:, 3:])[seen],
        spec,
        outages,
    )
    if config.degraded:
        fixes = GnssFixes(**{**vars(fixes), "std": fixes.measurement_std() * reported[seen, None]})
    return fixes, constants


def _sense_satellites(
    config: GnssConfig, trajectory: Trajectory, draws: Draws, arm_b: Vector
) -> tuple[dict[str, Samples], dict[str, Any]]:
    """Observations, and the fixes that the receiver makes of them alone."""
    from testbed.gnss.config import SatellitesConfig
    from testbed.gnss.sense import Antenna, fixes_of, sense_satellites, signals_of, space_of

    sky = config.satellites or SatellitesConfig()
    spec = config.spec()
    spec = replace(spec, space=space_of(sky), signals=signals_of(sky, spec.signals))
    outages = outage_windows(config, trajectory, draws)
    moments = fix_moments(spec, config.time_offset_s, trajectory)
    stamps = moments + spec.latency_s
    silent = _inside(outages, stamps) | (stamps < trajectory.t[0] + config.start_up_s)
    antenna = Antenna(trajectory, np.array(arm_b) + np.array(spec.lever_arm_b), moments, silent)
    observations, drawn = sense_satellites(sky, spec, antenna, draws)
    fixes, observations, _ = fixes_of(observations, outages, sky.false_alarm, sky.accuracy_scale)
    return {"gnss": fixes, "gnss_raw": observations}, drawn


def fix_moments(spec: GnssSpec, offset_s: float, trajectory: Trajectory) -> Array:
    """The moments that the fixes describe; those within a nanosecond of a sample of the trajectory fall on it exactly.

    Without an offset the first is one interval after the start. The last is stamped before the end.
    """
    start, end = trajectory.t[0] + offset_s, trajectory.t[-1] - spec.latency_s
    moments = (
        start + np.arange(0 if offset_s else 1, math.floor((end - start) * spec.rate_hz + 1e-6) + 1) / spec.rate_hz
    )
    k = np.clip(np.searchsorted(trajectory.t, moments - _SNAP_S), 0, len(trajectory.t) - 1)
    moments = np.minimum(moments, end)
    return np.where(np.abs(trajectory.t[k] - moments) <= _SNAP_S, trajectory.t[k], moments)


def outage_windows(config: GnssConfig, trajectory: Trajectory, draws: Draws) -> Windows:
    """The outages as (start, end), in order. Raises InputError for one outside of the flight."""
    start, end = trajectory.t[0], trajectory.t[-1]
    if config.random_outages is not None:
        return _random_windows(config.random_outages, start, end, draws)
    for a, b in config.outages:
        if a < start or b > end:
            raise InputError(
                f"[sensors.gnss] outages: [{a:g}, {b:g}] lies outside of the flight, which lasts from {start:g} to {end:g} s"
            )
    return tuple((a, b) for a, b in config.outages)


def _random_windows(wanted: RandomOutages, start: float, end: float, draws: Draws) -> Windows:
    """Uniform over all placements that keep the gaps."""
    if not wanted.count or not wanted.duration_s:
        return ()
    first, period = start + wanted.after_s, wanted.duration_s + wanted.gap_s
    free = end - first - wanted.count * period
    if free < 0.0:
        raise InputError(
            f"[sensors.gnss.random_outages] {wanted.count} outages of {wanted.duration_s:g} s with gaps of {wanted.gap_s:g} s"
            f" after {wanted.after_s:g} s need {end - start - free:g} s, but the flight lasts {end - start:g} s"
        )
    places = np.sort(draws.outages("gnss.outages").uniform(0.0, free, wanted.count))
    return tuple(
        (float(first + p + i * period), float(first + p + i * period + wanted.duration_s)) for i, p in enumerate(places)
    )


def _inside(windows: Windows, t: Array) -> NDArray[np.bool_]:
    inside = np.zeros(len(t), dtype=bool)
    for start, end in windows:
        inside |= (t >= start) & (t < end)
    return inside


def _errors(spec: GnssSpec, n: int, draws: Draws) -> Array:
    """(n,6) errors: m north, east, down, then m/s."""
    from testbed.sensors import kernels

    h, v = spec.horizontal_sigma, spec.vertical_sigma
    s = spec.velocity_sigma
    errors = np.array([h, h, v, s, s, s]) * draws.noise("gnss.white").standard_normal((n, 6))
    if spec.horizontal_markov_sigma or spec.vertical_markov_sigma:
        process = draws.noise("gnss.markov").standard_normal((n, 3))
        decay = math.exp(-1.0 / (spec.rate_hz * spec.markov_time_s))
        kernels.markov(process, decay, math.sqrt(1.0 - decay * decay))
        errors[:, :3] += process * [
            spec.horizontal_markov_sigma,
            spec.horizontal_markov_sigma,
            spec.vertical_markov_sigma,
        ]
    return errors


def _dilution(config: GnssConfig, trajectory: Trajectory, t: Array) -> tuple[Array, Array]:
    """Factor of the errors, and the part of it that the receiver states."""
    factor, reported = np.ones(len(t)), np.ones(len(t))
    for stretch in config.degraded:
        if stretch.start_s < trajectory.t[0] or stretch.end_s > trajectory.t[-1]:
            raise InputError(
                f"[sensors.gnss] degraded: [{stretch.start_s:g}, {stretch.end_s:g}] lies outside of the flight,"
                f" which lasts from {trajectory.t[0]:g} to {trajectory.t[-1]:g} s"
            )
        inside = (t >= stretch.start_s) & (t < stretch.end_s)
        factor[inside] *= stretch.factor
        reported[inside] *= stretch.factor if stretch.reported else 1.0
    return factor, reported


def _bursts(wanted: OutlierBursts, trajectory: Trajectory, fixes: int, draws: Draws) -> Windows:
    if not wanted.count:
        return ()
    if wanted.count > fixes:
        raise InputError(
            f"[sensors.gnss.outliers] {wanted.count} bursts are more than the {fixes} fixes of this flight"
        )
    first, last = trajectory.t[0] + wanted.after_s, trajectory.t[-1] - wanted.duration_s
    if last < first:
        raise InputError(
            f"[sensors.gnss.outliers] no room for a burst of {wanted.duration_s:g} s after {wanted.after_s:g} s in this flight"
        )
    starts = np.sort(draws.outages("gnss.outliers").uniform(first, last, wanted.count))
    return tuple((float(s), float(s + wanted.duration_s)) for s in starts)


def _burst_errors(wanted: OutlierBursts, bursts: Windows, t: Array, draws: Draws) -> Array:
    """Each burst is an offset in a random direction, the same for all its fixes."""
    errors = np.zeros((len(t), 6))
    directions = draws.noise("gnss.outliers.direction").standard_normal((len(bursts), 2, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    for burst, (position, velocity) in zip(bursts, directions, strict=True):
        inside = slice(*np.searchsorted(t, burst))
        errors[inside, :3] += wanted.offset_m * position
        errors[inside, 3:] += wanted.offset_mps * velocity
    return errors


_NED = ("north", "east", "down")


def _stored(fixes: GnssFixes) -> tuple[dict[str, Array], dict[str, Any]]:
    """A stored log keeps radians, which degrees would round, the receiver's accuracy and its outages."""
    table = SENSOR.table(fixes) | {"lat_rad": fixes.lat, "lon_rad": fixes.lon}
    for name, values in (("std_{}", fixes.std), ("correlation_{}", fixes.correlation)):
        table |= {} if values is None else columns(name, range(6), values)
    return table, {"outages": list(fixes.outages)}


def _restored(table: Mapping[str, Array], meta: Mapping[str, Any], spec: GnssSpec) -> GnssFixes:
    return GnssFixes(
        t=table["time_s"],
        lat=table["lat_rad"],
        lon=table["lon_rad"],
        h=table["alt_m"],
        v_n=stack(table, "v_{}_mps", _NED),
        spec=spec,
        outages=tuple((a, b) for a, b in meta["outages"]),
        std=stack(table, "std_{}", range(6)) if "std_0" in table else None,
        correlation=stack(table, "correlation_{}", range(6)) if "correlation_0" in table else None,
    )


SENSOR = Sensor(
    kind="gnss",
    title="GNSS receiver",
    spec=GnssSpec,
    config=GnssConfig,
    samples=GnssFixes,
    sense=sense_gnss,
    columns=(
        Column("lat", "lat_deg", "angle", factor=math.degrees(1.0)),
        Column("lon", "lon_deg", "angle", factor=math.degrees(1.0)),
        Column("h", "alt_m", "length"),
        Column("v_n", "v_{}_mps", "speed", _NED),
    ),
    rows={
        "horizontal_sigma": ("Position noise, horizontal, 1σ", 1.0, "m"),
        "vertical_sigma": ("Position noise, vertical, 1σ", 1.0, "m"),
        "horizontal_markov_sigma": ("Slow error, horizontal, 1σ", 1.0, "m"),
        "vertical_markov_sigma": ("Slow error, vertical, 1σ", 1.0, "m"),
        "velocity_sigma": ("Velocity noise, 1σ", 1.0, "m/s"),
        "lever_arm_b": ("Lever arm, body axes", 1.0, "m"),
        "latency_s": ("Latency", 1.0, "s"),
    },
    rank=0,
    write=_stored,
    read=_restored,
)
