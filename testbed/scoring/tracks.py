"""Other people's solutions against a truth: RMSE, CEP and R95, drift over distances, as they are or aligned.

Errors are estimate minus truth in north-east-down metres about the truth's first row, at the solution's own times (the
truth's, where it is known at its rows only). CEP and R95 are the medians and 95 % quantiles of the horizontal error, counted
from the data, not from a normal distribution. The relative error over a distance d (Geiger et al., CVPR 2012, and evo's RPE
by path length) takes every row and the first one that is d further along the true path, and compares the ways between both:
in the body of the first where the solution has attitudes, which a wrong heading at the start does not spoil, else in n.

Alignment (Umeyama, PAMI 13(4), 1991, without scale): ``translation``; ``yaw``: and a turn about the vertical; ``rigid``: and
any turn. What was taken out is told, since it is an error of the solution where both are in one frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, Trajectory
from testbed.data.shapes import gaps_of
from testbed.formats.kinematics import multiply
from testbed.formats.recording import seconds, thousandfold
from testbed.formats.reference_motion import COVERED, rms, velocity_doubts
from testbed.formats.solutions import Track, local, origin_of
from testbed.physics import rotations
from testbed.physics.interpolate import state_at

ALIGNMENTS = ("none", "translation", "yaw", "rigid")
DISTANCES = (10.0, 50.0, 100.0, 500.0, 1000.0)
"""m."""
NOISY_WAY_M = 30.0
"""Of a solution: single-point fixes scatter by up to 5 m about each axis, their level differences by 10 m, a third of it."""
FEWEST = 10
"""Rows of one file within the times of the other, below which a ratio of 1000 between both is a unit's, not a day's to a minute's."""


class Scored(NamedTuple):
    """Metrics of one solution by name, what was taken out by the alignment, in words, and what is to be told of it."""

    name: str
    metrics: dict[str, float]
    aligned: str
    notes: tuple[str, ...] = ()


def score_track(truth: Trajectory, track: Track, alignment: str = "none") -> Scored:
    """Metrics of a solution. Raises InputError where it does not overlap the truth."""
    if alignment not in ALIGNMENTS:
        raise InputError(f"alignment '{alignment}'; valid: {', '.join(ALIGNMENTS)}")
    whole = track
    t, true, v_true, q_true, track = _matched(truth, track)
    notes = (*whole.notes, *_left_out(truth, whole, t), *_doubts(truth, whole))
    rotation, shift, told = _alignment(track.ned, true, alignment)
    ned = track.ned @ rotation.T + shift
    q_turn = _quaternion(rotation)
    q_nb = None if track.q_nb is None else multiply(np.tile(q_turn, (len(t), 1)), track.q_nb)
    v_n = None if track.v_n is None else track.v_n @ rotation.T
    error = ned - true
    flat = np.hypot(error[:, 0], error[:, 1])
    out = {"samples": float(len(t))}
    out |= {f"rmse_{a}_m": rms(error[:, i]) for i, a in enumerate(("north", "east", "down"))}
    out |= {"rmse_position_2d_m": rms(flat), "rmse_position_3d_m": rms(np.linalg.norm(error, axis=1))}
    out |= {
        "cep_m": float(np.median(flat)),
        "r95_m": float(np.quantile(flat, 0.95)),
        "max_position_3d_m": float(np.linalg.norm(error, axis=1).max()),
    }
    if v_n is not None and "velocity" in truth.known:
        out["rmse_velocity_3d_mps"] = rms(np.linalg.norm(v_n - v_true, axis=1))
    with_attitude = q_nb is not None and "attitude" in truth.known
    if q_nb is not None and with_attitude:
        phi = np.degrees(rotations.attitude_errors(q_nb, q_true))
        out |= {"rmse_attitude_deg": rms(np.linalg.norm(phi, axis=1)), "rmse_heading_deg": rms(phi[:, 2])}
    out |= relative_errors(true, ned, q_true if with_attitude else None, q_nb if with_attitude else None)
    return Scored(track.name, out, told, notes)


def relative_errors(
    true: Array, ned: Array, q_true: Array | None = None, q_nb: Array | None = None
) -> dict[str, float]:
    """``rpe_100m_pct`` and so on: RMS of the relative error over each distance, in percent of it; no entry for longer ones."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
    out = {}
    for d in DISTANCES:
        end = np.searchsorted(way, way + d)
        start = np.flatnonzero(end < len(way))
        if not len(start):
            continue
        end = end[start]
        gone, shown = true[end] - true[start], ned[end] - ned[start]
        if q_true is not None and q_nb is not None:
            gone = np.einsum("kji,kj->ki", rotations.quats_to_matrices(q_true[start]), gone)
            shown = np.einsum("kji,kj->ki", rotations.quats_to_matrices(q_nb[start]), shown)
        share = np.linalg.norm(shown - gone, axis=1) / (way[end] - way[start])
        out[f"rpe_{d:g}m_pct"] = 100.0 * rms(share)
    return out


def _matched(truth: Trajectory, track: Track) -> tuple[Array, Array, Array, Array, Track]:
    """Times, true positions (N,3), velocities and attitudes there, and the track at them."""
    origin = origin_of(truth)
    times = truth.t if truth.own_times else track.t
    limits = (track.t if truth.own_times else truth.t)[[0, -1]]
    t = times[(times >= limits[0] - 1e-9) & (times <= limits[1] + 1e-9)]
    spans = (
        f"{track.place or track.name}: {seconds(track.t[0])} to {seconds(track.t[-1])} s {{}} the truth, {seconds(truth.t[0])} to"
        f" {seconds(truth.t[-1])} s"
    )
    asked = ""
    if thousandfold(float(track.t[-1] - track.t[0]), float(truth.t[-1] - truth.t[0])):
        whose = "its times" if track.t[-1] - track.t[0] > truth.t[-1] - truth.t[0] else "the truth's times"
        asked = f"; are {whose} in milliseconds? Such a column is called time_ms"
    if len(t) < 2:
        raise InputError(f"{spans.format('does not overlap')}{asked}")
    if asked and min(len(t), _count_within(truth.t, track.t)) < FEWEST:
        raise InputError(f"{spans.format('has hardly any row in common with')}{asked}")
    lat, lon, h, v_n, q_nb = state_at(truth, np.clip(t, truth.t[0], truth.t[-1]))
    if truth.own_times:
        ned = np.column_stack([np.interp(t, track.t, track.ned[:, i]) for i in range(3)])
        v = None if track.v_n is None else np.column_stack([np.interp(t, track.t, track.v_n[:, i]) for i in range(3)])
        q = None if track.q_nb is None else track.q_nb[np.clip(np.searchsorted(track.t, t), 0, len(track.t) - 1)]
        track = Track(track.name, t, ned, v, q)
    else:
        keep = np.isin(track.t, t)
        v, q = (None if x is None else x[keep] for x in (track.v_n, track.q_nb))
        track = Track(track.name, t, track.ned[keep], v, q)
    return t, local(lat, lon, h, origin), v_n, q_nb, track


def _count_within(t: Array, limits: Array) -> int:
    return int(((t >= limits[0] - 1e-9) & (t <= limits[-1] + 1e-9)).sum())


def _left_out(truth: Trajectory, track: Track, t: Array) -> list[str]:
    """What of the truth's and the solution's times is not scored, or between rows far apart; ``t`` are the scored ones."""
    notes = []
    scored = float(t[-1] - t[0])
    for whose, times in (("the truth's", truth.t), ("its", track.t)):
        if scored < COVERED * (whole := float(times[-1] - times[0])):
            notes.append(f"scored from {seconds(t[0])} to {seconds(t[-1])} s, {scored:.4g} s of {whose} {whole:.4g} s")
    known = truth.own_times
    for what, times, told in (
        ("the solution", track.t, "interpolated there" if known else "not scored there"),
        ("the truth", truth.t, "not scored there" if known else "the truth is interpolated there"),
    ):
        inside = times[(times >= t[0] - 1e-9) & (times <= t[-1] + 1e-9)]
        if found := gaps_of(inside):
            longest = max(found, key=lambda gap: gap[1] - gap[0])
            count = f"{len(found)} gaps, the longest" if len(found) > 1 else "a gap"
            notes.append(f"{what} has {count} from {seconds(longest[0])} to {seconds(longest[1])} s: {told}")
    return notes


def _doubts(truth: Trajectory, track: Track) -> list[str]:
    """Velocities that are not those of their places."""
    notes = []
    if "velocity" in truth.known and len(truth.t) >= 10:
        ned = local(truth.lat, truth.lon, truth.h, origin_of(truth))
        notes += velocity_doubts(truth.t, ned, truth.v_n, "the truth")
    if track.v_n is not None and len(track.t) >= 10:
        notes += velocity_doubts(track.t, track.ned, track.v_n, "the solution", NOISY_WAY_M)
    return notes


def _alignment(ned: Array, true: Array, kind: str) -> tuple[Array, Array, str]:
    """Rotation (3,3) and shift (3,) that bring ``ned`` to ``true``, and their words."""
    if kind == "none":
        return np.eye(3), np.zeros(3), "not aligned"
    a, b = ned - ned.mean(axis=0), true - true.mean(axis=0)
    rotation = np.eye(3)
    if kind == "yaw":
        angle = np.arctan2(float(a[:, 0] @ b[:, 1] - a[:, 1] @ b[:, 0]), float(a[:, 0] @ b[:, 0] + a[:, 1] @ b[:, 1]))
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    elif kind == "rigid":
        u, _, vt = np.linalg.svd(b.T @ a)
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    shift = true.mean(axis=0) - rotation @ ned.mean(axis=0)
    turn = float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0))))
    moved = rotation @ ned[0] + shift - ned[0]
    return (
        rotation,
        shift,
        f"aligned ({kind}): turned by {turn:.3g}°, its first row moved by {np.linalg.norm(moved):.4g} m",
    )


def _quaternion(rotation: Array) -> Array:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]])
