"""Withheld fixes: windows of a recording whose fixes no filter sees, and which are what its solutions are scored against.

A recording without a reference is scored like that; with a reference the windows are outages. The withheld fixes are of the
antenna, at the times that they describe; what lies between them is not known, so nothing is scored there.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from testbed.base.errors import InputError
from testbed.base.streams import stream
from testbed.data.records import GnssFixes, SensorLog, Trajectory
from testbed.formats.config import HoldoutConfig

Windows = tuple[tuple[float, float], ...]


def windows_of(config: HoldoutConfig, log: SensorLog, seed: int, run: int, place: str) -> Windows:
    """The withheld (start, end] of a run, s on the recording's clock. Raises InputError where one holds no fix."""
    gnss = log.gnss
    if gnss is None or not len(gnss.t):
        raise InputError(f"{place}: [recording.holdout] needs GNSS fixes to withhold")
    start, end = log.initial.t, float(min(log.imu.t[-1], gnss.t[-1]))
    if config.windows:
        spans = [(start + a, start + b) for a, b in config.windows]
    elif config.every_s is not None:
        count = max(0, math.floor((end - start - config.first_s - config.length_s) / config.every_s + 1e-9) + 1)
        firsts = start + config.first_s + config.every_s * np.arange(count)
        spans = [(float(a), float(a) + config.length_s) for a in firsts]
    else:
        spans = _drawn(config, start, end, seed, run, place)
    for a, b in spans:
        inside = int(((gnss.t > a) & (gnss.t <= b)).sum())
        if not inside:
            raise InputError(
                f"{place}: [recording.holdout] the window {a - start:g} to {b - start:g} s holds no fix;"
                f" the log lasts {end - start:.6g} s"
            )
    if not spans:
        raise InputError(f"{place}: [recording.holdout] no window fits into the {end - start:.6g} s of the log")
    return tuple(spans)


def _drawn(
    config: HoldoutConfig, start: float, end: float, seed: int, run: int, place: str
) -> list[tuple[float, float]]:
    """``draw`` windows without overlap, uniform among all such sets: gaps between them share the time that is left."""
    assert config.draw is not None
    free = end - start - config.first_s - config.draw * config.length_s
    if free < 0.0:
        raise InputError(
            f"{place}: [recording.holdout] {config.draw} windows of {config.length_s:g} s do not fit into"
            f" {end - start - config.first_s:.6g} s"
        )
    places = np.sort(stream(seed, run, "recording.holdout").uniform(0.0, free, config.draw))
    firsts = start + config.first_s + places + config.length_s * np.arange(config.draw)
    return [(float(a), float(a) + config.length_s) for a in firsts]


def withhold(log: SensorLog, windows: Windows) -> SensorLog:
    """The log without the fixes of the windows, which are its outages, and without what the receiver made them of."""
    gnss, aiding = log.gnss, dict(log.aiding)
    assert gnss is not None
    aiding["gnss"] = _rows(gnss, ~_inside(gnss.t, windows), windows)
    if (raw := aiding.get("gnss_raw")) is not None:
        keep = ~_inside(raw.t, windows)
        rows = {key: value[keep] for key, value in vars(raw).items() if isinstance(value, np.ndarray)}
        aiding["gnss_raw"] = replace(raw, **rows)
    return SensorLog(log.imu, log.initial, name=log.name, aiding=aiding)


def withheld(log: SensorLog, windows: Windows, position_only: bool) -> Trajectory:
    """The withheld fixes as a truth that knows position (and velocity), of the antenna, at its own times."""
    gnss = log.gnss
    assert gnss is not None
    kept = _rows(gnss, _inside(gnss.t, windows), windows)
    n = len(kept.t)
    if n < 2:
        raise InputError(f"{log.name}: [recording.holdout] withholds {n} fixes, at least 2 are needed")
    nothing, level = np.zeros((n, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    return Trajectory(
        kept.t - kept.spec.latency_s,
        kept.lat,
        kept.lon,
        kept.h,
        kept.v_n,
        level,
        nothing,
        nothing,
        name=f"{log.name}, withheld fixes",
        own_times=True,
        known=("position",) if position_only else ("position", "velocity"),
        arm_b=kept.spec.lever_arm_b,
    )


def _inside(t: np.ndarray, windows: Windows) -> np.ndarray:
    inside = np.zeros(len(t), dtype=bool)
    for a, b in windows:
        inside |= (t > a) & (t <= b)
    return inside


def _rows(gnss: GnssFixes, keep: np.ndarray, outages: Windows) -> GnssFixes:
    return gnss.taken(keep, outages=outages)
