"""A start with unknown heading: one error-state filter for each of some headings, and the innovations tell which was right.

The circle is cut into `SECTORS`; each has a filter that starts in its middle with the sigma of a uniform angle in it. All see the
same samples; the log likelihood of a filter's innovations up to a time says how likely its sector is then (static multiple
models: Bar-Shalom, Li & Kirubarajan, 11.6.2). At every time the answer is that of one filter: it changes over to a likelier one
at odds of `ODDS`, and never looks ahead. Its covariance has the spread of the other filters in it, by their probability, so that it is
wide while the sectors cannot be told apart. SI units and radians, as in `estimators.core.filter`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.core.composition import Prepared, make_model, make_recording, make_timeline_of, run, solution_of
from estimators.core.model import AUX
from estimators.core.propagate import NAV
from estimators.core.recording import Recording
from estimators.core.timeline import walk
from testbed.base.errors import InputError
from testbed.data.records import NavSolution, SensorLog
from testbed.physics import earth
from testbed.physics.rotations import attitude_errors, quat_multiply, rotvec_to_quat, wrap

Array = NDArray[np.float64]

SECTORS = 8
"""The farthest heading is 22.5° from the middle of its sector: there sine and angle differ by 2.5 %."""
SECTOR_STD = 2.0 * np.pi / SECTORS / np.sqrt(12.0)
"""Of an angle that is uniform in a sector: 13°."""
ODDS = 20.0
"""To change over: a likelihood ratio of 20 to 1 is what a test at 5 % asks for."""


@dataclass(frozen=True)
class _Told:
    """What a filter says of its sector: log likelihood after each event (E,), and its rows at the times of the snapshots."""

    likelihood: Array
    recording: Recording


def require_heading(log: SensorLog, who: str) -> None:
    """Raises InputError where a log starts without a heading: one start is needed to compare filters from it."""
    if log.initial.heading_unknown:
        raise InputError(
            f"{who}: the heading at the start is unknown (1 sigma {np.degrees(log.initial.std[8]):.0f}°), and a search compares filters "
            "from one start; [recording.initial] yaw_deg gives it"
        )


def run_or_search(prepared: Prepared) -> NavSolution:
    """`estimators.core.composition.run`, or the bank where the heading is unknown."""
    return run_bank(prepared) if prepared.log.initial.heading_unknown and len(prepared.event_t) else run(prepared)


def likeliest_start(prepared: Prepared) -> Prepared:
    """The start of the sector that the whole log makes likeliest: for a smoother, which looks ahead anyway."""
    if not prepared.log.initial.heading_unknown or not len(prepared.event_t):
        return prepared
    starts = [_turned(prepared, k) for k in range(SECTORS)]
    return starts[int(np.argmax([_tell(start).likelihood[-1] for start in starts]))]


def run_bank(prepared: Prepared) -> NavSolution:
    """Filter a log from every sector; the answer as the head of this module says, and the probabilities as an extra."""
    starts = [_turned(prepared, k) for k in range(SECTORS)]
    told = [_tell(start) for start in starts]
    likelihood = np.column_stack([entry.likelihood for entry in told])
    chosen = _choices(likelihood)
    t, event_t = prepared.log.imu.t, prepared.event_t
    of_sample = _latest(chosen, event_t, t)
    merged: Recording | None = None
    for k in np.unique(np.concatenate([of_sample, chosen])):
        own = make_recording(starts[k])
        walk(make_timeline_of(starts[k]), make_model(starts[k], own), len(t))
        merged = own if merged is None else _taken(merged, own, of_sample == k, chosen == k)
    assert merged is not None
    every = merged.snapshot_stride
    snapshots = np.arange(every - 1, len(t), every)
    probability = np.vstack([np.full(SECTORS, 1.0 / SECTORS), _probabilities(likelihood)])
    weights = probability[np.searchsorted(event_t, t[snapshots] + 1e-7, side="right")]
    _spread(merged, told, weights, snapshots)
    solution = solution_of(prepared, merged)
    names = tuple(f"from {360.0 * k / SECTORS:g}°" for k in range(SECTORS))
    extras = {"heading_probability": (t[snapshots], weights)}
    return replace(solution, extras=extras, extra_names={"heading_probability": names})


def _turned(prepared: Prepared, sector: int) -> Prepared:
    """The start turned about the vertical by the angle of a sector, with the sigma of a sector."""
    start, covariance = prepared.start.copy(), prepared.covariance.copy()
    turn = np.array(rotvec_to_quat((0.0, 0.0, 2.0 * np.pi * sector / SECTORS)))
    start[6:10] = quat_multiply(turn, start[6:10])
    covariance[8, :] = covariance[:, 8] = 0.0
    covariance[8, 8] = SECTOR_STD**2
    return replace(prepared, start=start, covariance=covariance)


def _tell(start: Prepared) -> _Told:
    """Run one filter of the bank; only about a row a second is kept."""
    thin = make_recording(start)
    keep = make_recording(start, thin.snapshot_stride)
    count = len(start.log.imu.t)
    walk(make_timeline_of(start), make_model(start, keep), count)
    return _Told(np.cumsum(_log_likelihoods(start, keep)), keep)


def _log_likelihoods(start: Prepared, keep: Recording) -> Array:
    """(E,) of the innovations, also of those that a policy rejected: who must reject much is not likely. Zero for no event."""
    out = np.zeros(len(start.events))
    used = np.isfinite(keep.fading)
    for k, aiding in enumerate(start.aidings):
        mine, m = np.flatnonzero(used & (start.events[:, 0] == k)), len(aiding.channels)
        nu, s = keep.innovation[mine, :m], keep.innovation_covariance[mine, :m, :m]
        measured = np.isfinite(nu)
        both = measured[:, :, None] & measured[:, None, :]
        s = np.where(both, s, np.eye(m))
        nu = np.where(measured, nu, 0.0)
        with np.errstate(all="ignore"):
            square = np.einsum("ki,ki->k", nu, np.linalg.solve(s, nu[:, :, None])[:, :, 0])
            out[mine] = -0.5 * (square + np.linalg.slogdet(2.0 * np.pi * s)[1])
    return np.where(np.isfinite(out), out, -1e12)  # a filter that fell to pieces is not the right one


def _choices(likelihood: Array) -> NDArray[np.intp]:
    """(E,) the filter that answers after each event, from the first sector on."""
    chosen, now = np.zeros(len(likelihood), dtype=np.intp), 0
    for e, row in enumerate(likelihood):
        best = int(np.argmax(row))
        if row[best] - row[now] > np.log(ODDS):
            now = best
        chosen[e] = now
    return chosen


def _probabilities(likelihood: Array) -> Array:
    """(E,SECTORS) of the sectors after each event."""
    weights = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def _latest(chosen: NDArray[np.intp], event_t: Array, t: Array) -> NDArray[np.intp]:
    """(N,) the filter that answers at each sample."""
    before = np.searchsorted(event_t, t + 1e-7, side="right") - 1
    return np.where(before < 0, 0, chosen[np.clip(before, 0, None)])


def _taken(merged: Recording, own: Recording, samples: NDArray[np.bool_], events: NDArray[np.bool_]) -> Recording:
    """``merged`` with another filter's rows at its own samples and events, in place."""
    snapshots = samples[merged.snapshot_stride - 1 :: merged.snapshot_stride][: len(merged.covariance)]
    merged.state[samples], merged.std[samples] = own.state[samples], own.std[samples]
    merged.covariance[snapshots] = own.covariance[snapshots]
    merged.innovation[events] = own.innovation[events]
    merged.innovation_covariance[events] = own.innovation_covariance[events]
    merged.fading[events] = own.fading[events]
    return merged


def _spread(merged: Recording, told: list[_Told], weights: Array, snapshots: NDArray[np.intp]) -> None:
    """Add to the covariance, and to the sigmas from each snapshot to the next, what the filters of the bank differ by."""
    answer, n = merged.state[snapshots], merged.covariance.shape[1]
    added = np.zeros((len(snapshots), n, n))
    for entry, weight in zip(told, weights.T, strict=True):
        d = _differences(entry.recording.state[: len(snapshots)], answer, n)
        # a sector that nobody believes in any more may have gone to where nothing is finite
        d = np.where((weight[:, None] > 0.0) & np.isfinite(d), d, 0.0)
        added += weight[:, None, None] * d[:, :, None] * d[:, None, :]
    merged.covariance[...] += added
    latest = np.searchsorted(snapshots, np.arange(len(merged.std)), side="right")
    before = np.zeros((1, n))  # the first second: all sectors alike
    before[0, 8] = np.mean(wrap(2.0 * np.pi * np.arange(SECTORS) / SECTORS) ** 2)
    merged.std[...] = np.sqrt(merged.std**2 + np.concatenate([before, np.einsum("kii->ki", added)])[latest])


def _differences(states: Array, answer: Array, n: int) -> Array:
    """(K,n) error states between two filters: metres, m/s and a rotation vector in n, then the sensors' own."""
    d = np.zeros((len(answer), n))
    d[:, :3] = np.column_stack(earth.position_difference(*states[:, :3].T, *answer[:, :3].T))
    d[:, 3:6] = states[:, 3:6] - answer[:, 3:6]
    d[:, 6:NAV] = attitude_errors(np.ascontiguousarray(states[:, 6:AUX]), np.ascontiguousarray(answer[:, 6:AUX]))
    d[:, NAV:] = states[:, AUX:] - answer[:, AUX:]
    return d
