"""The magnetometer: the geomagnetic field along b, with hard and soft iron, misalignment, noise and disturbances.

Field: World Magnetic Model (package pygeomag) at points along the track, linear in between; errors after Groves, 2nd
ed., section 6.1.1. Fields in µT.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, MagSamples, Trajectory
from testbed.data.specs import MagSpec, Vector
from testbed.sensors.config import MagConfig
from testbed.sensors.draws import Draws
from testbed.sensors.sensor import Column, Sensor

TRACK_INTERVAL_S = 60.0
"""Between the points of the flight at which the field model is evaluated: over 10 km the field is linear to a few nT."""


def field_n(lat: float, lon: float, h: float, year: float) -> tuple[float, float, float]:
    """Geomagnetic field north, east, down (µT) at a place (rad, m) and decimal year (2010 to 2030)."""
    result = _model(int(5 * (year // 5))).calculate(
        glat=math.degrees(lat), glon=math.degrees(lon), alt=h / 1000.0, time=year
    )
    return result.x / 1000.0, result.y / 1000.0, result.z / 1000.0


@functools.cache
def _model(epoch: int) -> Any:
    from pygeomag import GeoMag

    return GeoMag(base_year=epoch)


def sense_mag(
    config: MagConfig, trajectory: Trajectory, draws: Draws, arm_b: Vector
) -> tuple[MagSamples, dict[str, Any]]:
    """Samples, and what was drawn; the field is the same all over the vehicle."""
    from testbed.physics.interpolate import sample_times, state_at
    from testbed.physics.rotations import quats_to_matrices

    spec = config.spec()
    t = sample_times(trajectory, spec.rate_hz)
    if not len(t):
        raise InputError(f"[sensors.mag] rate_hz: the flight is too short for a sample at {spec.rate_hz:g} Hz")
    lat, lon, h, _, q_nb = state_at(trajectory, t)
    local = _along_track(t, lat, lon, h, config.year)
    field = np.einsum("kji,kj->ki", quats_to_matrices(q_nb), local)
    distortion, hard_iron = _iron(spec, draws)
    field = field @ distortion.T + hard_iron
    field += spec.noise_sigma * draws.noise("mag.white").standard_normal(field.shape)
    _disturb(field, t, config, trajectory, draws)
    np.clip(field, -spec.range, spec.range, out=field)
    if spec.resolution:
        field = np.rint(field / spec.resolution) * spec.resolution
    start = field_n(trajectory.lat[0], trajectory.lon[0], trajectory.h[0], config.year)
    spec = replace(spec, field_n=start, declination=math.atan2(start[1], start[0]))
    return MagSamples(t, field, spec), {"mag_distortion": distortion, "mag_hard_iron": hard_iron}


def _along_track(t: Array, lat: Array, lon: Array, h: Array, year: float) -> Array:
    points = 2 + int((t[-1] - t[0]) / TRACK_INTERVAL_S)
    rows = np.unique(np.linspace(0, len(t) - 1, points).astype(int))
    knots = np.array([field_n(lat[k], lon[k], h[k], year) for k in rows])
    return np.stack([np.interp(t, t[rows], knots[:, axis]) for axis in range(3)], axis=1)


def _iron(spec: MagSpec, draws: Draws) -> tuple[Array, Array]:
    """Matrix of soft iron and misalignment, and the hard iron vector."""
    from testbed.physics.rotations import quat_to_matrix, rotvec_to_quat

    soft = np.eye(3) + spec.soft_iron * draws.turn_on("mag.soft_iron").standard_normal((3, 3))
    turn = spec.misalignment * draws.turn_on("mag.misalignment").standard_normal(3)
    hard = spec.turn_on_bias * draws.turn_on("mag.hard_iron").standard_normal(3)
    return np.array(quat_to_matrix(rotvec_to_quat(turn))).T @ soft, hard


def _disturb(field: Array, t: Array, config: MagConfig, trajectory: Trajectory, draws: Draws) -> None:
    rng = draws.noise("mag.disturbances")
    for burst in config.disturbances:
        if burst.end_s <= burst.start_s or burst.start_s < trajectory.t[0] or burst.end_s > trajectory.t[-1]:
            raise InputError(
                f"[sensors.mag] disturbances: [{burst.start_s:g}, {burst.end_s:g}] must rise and lie inside the flight,"
                f" which lasts from {trajectory.t[0]:g} to {trajectory.t[-1]:g} s"
            )
        inside = (t >= burst.start_s) & (t < burst.end_s)
        field[inside] += np.array(burst.field_ut) + burst.noise_ut * rng.standard_normal((int(inside.sum()), 3))


SENSOR = Sensor(
    kind="mag",
    title="Magnetometer",
    spec=MagSpec,
    config=MagConfig,
    samples=MagSamples,
    sense=sense_mag,
    columns=(Column("field", "mag_{}_ut", "magnetic field", ("x", "y", "z")),),
    rows={
        "noise_sigma": ("Noise, 1σ", 1.0, "µT"),
        "turn_on_bias": ("Hard iron, 1σ", 1.0, "µT"),
        "soft_iron": ("Soft iron, 1σ", 100.0, "%"),
        "misalignment": ("Misalignment, 1σ", math.degrees(1.0), "°"),
        "range": ("Range, ±", 1.0, "µT"),
        "resolution": ("Resolution", 1.0, "µT"),
        "field_n": ("Local field, north-east-down", 1.0, "µT"),
    },
    rank=1,
)
