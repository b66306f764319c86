"""A trajectory of one's own as truth: places and attitudes of a file, splined and differentiated.

The place is a spline of fifth degree in e, so that acceleration and its slope are continuous and neither the poles nor the
date line matter; velocity is its derivative, attitude the file's (cubic splines of the quaternion) or that of a vehicle that
looks along its track. At the rows of the truth these become what a flight's samples are: `testbed.flight.truth`. SI, radians.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.records import Trajectory
from testbed.flight.own import TrajectoryConfig
from testbed.flight.track_files import Track, checked, read_track
from testbed.physics import earth
from testbed.physics.ecef import directions, to_ecef, to_geodetic
from testbed.physics.rotations import eulers_to_quats, quats_to_matrices

Array = NDArray[np.float64]
DEGREE = 5
USUAL_GAP = 5.0
"""Usual intervals that a file may miss: a receiver that loses a few fixes."""
SLOWEST_ROWS_S = 1.0
"""Rows further apart leave the manoeuvres between them, which take seconds, to the spline; the documents ask for 1 Hz."""
FASTEST_MPS = 1000.0
"""As fast as flights of the bench may be."""
SLOW_MPS = 0.5
"""Below it the direction of the velocity is that of the noise of a position fix, and the heading is held."""


def fly_track(config: TrajectoryConfig) -> Trajectory:
    """The truth of a file. Raises InputError that names the row which no vehicle can have moved through."""
    return _splined(read_track(config), config, Path(config.trajectory).stem)


def sensed_anew(reference: Trajectory, imu_rate_hz: float | None) -> Trajectory:
    """A recording's reference as the truth that sensors are simulated on, at its own rate, on its own clock.

    Where the IMU is given a rate, at the smallest multiple of it that the reference's rate does not exceed. Raises
    InputError as `fly_track` does.
    """
    own = min(1000.0, max(10.0, float(round(1.0 / np.median(np.diff(reference.t))))))
    rate = own if imu_rate_hz is None else imu_rate_hz * max(1, int(np.ceil(own / imu_rate_hz - 1e-9)))
    place = np.column_stack([reference.lat, reference.lon, reference.h])
    source = f"the reference {reference.name}".strip()
    track = checked(Track(reference.t - reference.t[0], place, reference.q_nb, False, source, recorded=True))
    config = TrajectoryConfig(trajectory=source, rate_hz=rate, attitude="file")
    truth = _splined(track, config, reference.name)
    return replace(truth, t=truth.t + reference.t[0])


def _splined(track: Track, config: TrajectoryConfig, name: str) -> Trajectory:
    from testbed.flight.truth import make_trajectory

    _check_gaps(track, config)
    ecef = _in_e(track, config)
    count = int(np.floor(track.t[-1] * config.rate_hz + 1e-6)) + 1
    if count < 4:
        raise InputError(f"{track.source}: {track.t[-1]:.3g} s are too short: they give {count} rows of the truth")
    t = np.minimum(np.arange(count) / config.rate_hz, track.t[-1])
    spline = _spline(track, ecef, config)
    place, v_e, a_e = (spline(t, order) for order in range(3))
    lat, lon, h = to_geodetic(place + ecef[0])
    _check_motion(track, t, v_e, a_e, config)
    to_n = directions(lat, lon)
    v_n = np.einsum("kij,kj->ki", to_n, v_e)
    if config.attitude == "file" and track.q_nb is None:
        raise InputError(f"{track.source}: attitude = 'file', but the file has none")
    if track.q_nb is not None and config.attitude in (None, "file"):
        q_nb = _interpolated(track, t, config)
    else:
        force = _specific_force(lat, h, to_n, v_e, a_e)
        q_nb = _along_track(t, v_n, force if config.attitude == "coordinated" else None)
    start = float(lat[0]), float(lon[0]), float(h[0])
    truth = make_trajectory(v_n, q_nb, config.rate_hz, start, name=name)
    _check_rates(track, truth, config)
    return truth


def notes_of_track(config: TrajectoryConfig) -> tuple[str, ...]:
    """What was taken for what in the file, and what was left out."""
    track = read_track(config)
    step = float(np.median(np.diff(track.t)))
    if step > SLOWEST_ROWS_S * 1.01:
        slow = f"{Path(config.trajectory).name}: its rows are {step:.4g} s apart ({1.0 / step:.3g} Hz); between rows of less than 1 Hz"
        track = replace(track, notes=(*track.notes, f"{slow} the motion is the spline's, not the vehicle's"))
    if track.q_nb is not None and config.attitude in ("level", "coordinated"):
        return (
            *track.notes,
            f"{Path(config.trajectory).name}: its attitude is not used: attitude = '{config.attitude}'",
        )
    return track.notes


def _in_e(track: Track, config: TrajectoryConfig) -> Array:
    """Places (N,3) in e."""
    if not track.local:
        if config.origin is not None:
            raise InputError(f"{track.source}: its places are geodetic; remove [flight.origin]")
        return to_ecef(*track.place.T)
    if config.origin is None:
        raise InputError(
            f"{track.source}: places north, east and down need [flight.origin] with lat_deg, lon_deg and alt_m"
        )
    lat, lon = np.radians([config.origin.lat_deg]), np.radians([config.origin.lon_deg])
    return to_ecef(lat, lon, np.array([config.origin.alt_m])) + track.place @ directions(lat, lon)[0]


def _check_gaps(track: Track, config: TrajectoryConfig) -> None:
    steps = np.diff(track.t)
    usual = float(np.median(steps))
    if not (track.recorded or Path(config.trajectory).suffix.lower() in (".gpx", ".kml")):
        usual = min(usual, SLOWEST_ROWS_S)  # those come at the rate that they have, at times whose unit is no question
    longest = config.max_gap_s if config.max_gap_s is not None else USUAL_GAP * usual
    if steps.max() > longest * (1.0 + 1e-9):
        k = int(np.argmax(steps > longest * (1.0 + 1e-9)))
        raise InputError(
            f"{track.source}: a gap of {steps[k]:.4g} s after {track.row(k)}; at most {longest:.4g} s are bridged"
            f"{track.key('max_gap_s')}"
        )


def _spline(track: Track, ecef: Array, config: TrajectoryConfig) -> Any:
    """Place from the first row on as a function of time and of the order of its derivative."""
    return _fit(track, ecef - ecef[0], config, DEGREE)


def _fit(track: Track, values: Array, config: TrajectoryConfig, degree: int) -> Any:
    """Spline through the rows, or nearest to them in the least squares with a knot every ``smooth_s``."""
    from scipy.interpolate import make_interp_spline, make_lsq_spline

    t = track.t
    if config.smooth_s is None:
        return make_interp_spline(t, values, k=min(degree, 5 if len(t) > 5 else 3))
    pieces = max(1, round(t[-1] / config.smooth_s))
    knots = np.concatenate([[t[0]] * degree, np.linspace(t[0], t[-1], pieces + 1), [t[-1]] * degree])
    rows = np.histogram(t, bins=np.linspace(t[0], t[-1], pieces + 1))[0]
    if rows.min() < 1 or len(t) < pieces + degree:
        raise InputError(
            f"{track.source}: smooth_s = {config.smooth_s:g}: a piece of the track has no row; take a longer one"
        )
    return make_lsq_spline(t, values, knots, k=degree)


def _check_motion(track: Track, t: Array, v_e: Array, a_e: Array, config: TrajectoryConfig) -> None:
    speed, size = np.linalg.norm(v_e, axis=1), np.linalg.norm(a_e, axis=1)
    for values, limit, what, key in (
        (speed, FASTEST_MPS, "{:.4g} m/s", ""),
        (size, config.max_acceleration_mps2, "an acceleration of {:.4g} m/s²", track.key("max_acceleration_mps2")),
    ):
        if values.max() > limit:
            k = int(np.argmax(values))
            row = int(np.argmin(np.abs(track.t - t[k])))
            hint = (
                "" if config.smooth_s else "; if the places are noisy or rounded, smooth_s fits a smooth track to them"
            )
            raise InputError(
                f"{track.source}: near {track.row(row)} the places need {what.format(values[k])}, and at most {limit:g} is "
                f"taken for motion{key}{hint}"
            )


def _check_rates(track: Track, truth: Trajectory, config: TrajectoryConfig) -> None:
    rate = np.degrees(np.linalg.norm(truth.w_ib_b, axis=1))
    if rate.max() > config.max_rate_dps:
        k = int(np.argmax(rate))
        row = int(np.argmin(np.abs(track.t - truth.t[k])))
        own = track.q_nb is not None and config.attitude in (None, "file")
        why = (
            ""
            if own
            else "; a vehicle that looks along its track cannot turn on the spot or back up: give its attitude"
        )
        raise InputError(
            f"{track.source}: near {track.row(row)} the attitude turns at {rate[k]:.4g} °/s, and at most "
            f"{config.max_rate_dps:g} is taken for motion{track.key('max_rate_dps')}{why}"
        )


def _interpolated(track: Track, t: Array, config: TrajectoryConfig) -> Array:
    """Attitude (M,4) at the times ``t``, by cubic splines of the quaternion's parts."""
    assert track.q_nb is not None
    q = np.asarray(_fit(track, track.q_nb, config, 3)(t))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def _specific_force(lat: Array, h: Array, to_n: Array, v_e: Array, a_e: Array) -> Array:
    """(M,3) in n: acceleration over the turning Earth, Coriolis, minus gravity (Groves eq. 5.28 in n)."""
    turn = np.array([0.0, 0.0, earth.RATE])
    force = np.einsum("kij,kj->ki", to_n, a_e + 2.0 * np.cross(turn, v_e))
    force[:, 2] -= earth.gravity(lat, h)
    return force


def _along_track(t: Array, v_n: Array, force: Array | None) -> Array:
    """Attitude (M,4) of a vehicle that looks along its velocity: level across, or with ``force`` (M,3) banked into it."""
    level = np.hypot(v_n[:, 0], v_n[:, 1])
    moving = np.hypot(level, v_n[:, 2]) > SLOW_MPS
    pitch, yaw = np.zeros(len(t)), np.zeros(len(t))
    if moving.any():
        course = np.unwrap(np.arctan2(v_n[moving, 1], v_n[moving, 0]))
        climb = np.arctan2(-v_n[moving, 2], level[moving])
        yaw, pitch = _held(t, moving, course), _held(t, moving, climb)
    q_nb = eulers_to_quats(np.column_stack([np.zeros(len(t)), pitch, yaw]))
    if force is None:
        return q_nb
    f_b = np.einsum("kji,kj->ki", quats_to_matrices(q_nb), force)
    # rolled so that the force across the forward axis points up: no side force
    roll = np.unwrap(np.arctan2(f_b[:, 1], -f_b[:, 2]))
    return eulers_to_quats(np.column_stack([roll, pitch, yaw]))


def _held(t: Array, moving: NDArray[np.bool_], values: Array) -> Array:
    """``values`` at the rows that move; across those that stand, a monotone cubic from the last to the next."""
    from scipy.interpolate import PchipInterpolator

    rows = np.flatnonzero(moving)
    out = np.interp(t, t[rows], values)
    if len(rows) > 1 and not moving.all():
        inside = ~moving & (t > t[rows[0]]) & (t < t[rows[-1]])
        if inside.any():
            out[inside] = PchipInterpolator(t[rows], values)(t[inside])
    return out
