"""From names of parts and a log to a filter that can run: `compose`, and what a run leaves behind as a `NavSolution`.

Order of the sensor-error states: see `estimators.core.structure`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.aiding import Aiding, Measurements
from estimators.blocks import Block
from estimators.blocks.imu import white_density
from estimators.core import calls, structure
from estimators.core.calls import address
from estimators.core.event_order import in_order, mixes, stacked
from estimators.core.model import (
    AUX,
    INVARIANT,
    PHI,
    REJECTED,
    Blocks,
    Events,
    Inputs,
    Model,
    Work,
)
from estimators.core.parts import find_aiding, find_block, find_policy
from estimators.core.propagate import NAV, Coupling, make_covariance, make_covariances
from estimators.core.recording import Recording, empty_recording
from estimators.core.timeline import Timeline, make_timeline, walk
from estimators.policies import Policy
from testbed.base.errors import InputError, nearest
from testbed.data.records import (
    ACCEL_BIAS_STATES,
    GYRO_BIAS_STATES,
    NAVIGATION_STATES,
    Innovations,
    NavSolution,
    SensorLog,
)
from testbed.kernels.tables import side_by_side, zeros

Array = NDArray[np.float64]

ERRORS = {"phi": PHI, "invariant": INVARIANT}
SNAPSHOT_INTERVAL_S = 1.0


@dataclass(frozen=True)
class Composition:
    """Names of the parts of a filter, as a scenario gives them."""

    states: tuple[str, ...] = ("accel-bias", "gyro-bias")
    aiding: tuple[str, ...] = ("gnss",)
    policy: Any = "plain"
    """One for all aidings, or a table with one per aiding."""
    error: str = "phi"
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Options of an aiding, by its name."""
    consider: tuple[str, ...] = ()
    """Blocks of ``states`` whose states are never corrected, but whose uncertainty the filter counts (Schmidt)."""

    def blocks(self) -> list[Block]:
        """The blocks in the order of their states. Raises InputError for a name that is unknown or given twice."""
        return sorted((find_block(name) for name in _once(self.states, "states")), key=structure.group)

    def aidings(self) -> list[Aiding]:
        """Raises InputError for a name that is unknown, given twice, or lacks a block that it needs."""
        found = [find_aiding(name) for name in _once(self.aiding, "aiding")]
        for aiding in found:
            for need in aiding.needs:
                if need not in self.states:
                    raise InputError(f"the aiding '{aiding.name}' needs the block '{need}' among the states")
        for name in self.options:
            if name not in self.aiding:
                raise InputError(f"options: '{name}' is no aiding of this filter; {nearest(name, self.aiding)}")
        for aiding in found:
            # behind the log and the columns
            known = list(inspect.signature(aiding.samples).parameters)[2:]
            for option in self.options.get(aiding.name, {}):
                if option not in known:
                    hint = nearest(option, known) if known else "it has none"
                    raise InputError(f"options: the aiding '{aiding.name}' has no option '{option}'; {hint}")
        return found

    def policy_of(self, aiding: Aiding) -> tuple[Policy, dict[str, Any]]:
        """The policy of an aiding and its options. Raises InputError for a table that names something else."""
        setting = self.policy
        if isinstance(setting, Mapping) and set(setting) & set(self.aiding):
            for name in setting:
                if name not in self.aiding:
                    raise InputError(f"policy: '{name}' is no aiding of this filter; {nearest(name, self.aiding)}")
            setting = setting.get(aiding.name, "plain")
        return find_policy(setting)

    def policy_memory(self, aiding: Aiding) -> Array:
        """What an aiding's policy starts with. Raises InputError for options that it does not take."""
        policy, options = self.policy_of(aiding)
        known = list(inspect.signature(policy.memory).parameters)[1:]
        for option in options:
            if option not in known:
                hint = nearest(option, known) if known else "it has none"
                raise InputError(f"policy '{policy.name}' has no option '{option}'; {hint}")
        return policy.memory(len(aiding.channels), **options)

    def check_considered(self) -> None:
        """Raises InputError for a considered block that is not among the states."""
        for name in _once(self.consider, "consider"):
            if name not in self.states:
                raise InputError(f"consider: '{name}' is none of the states; {nearest(name, self.states)}")

    def error_code(self) -> int:
        """Raises InputError for an unknown error definition."""
        if self.error not in ERRORS:
            raise InputError(f"error = '{self.error}'; {nearest(self.error, ERRORS)}")
        return ERRORS[self.error]


def _once(names: Sequence[str], key: str) -> Sequence[str]:
    for name in names:
        if list(names).count(name) > 1:
            raise InputError(f"{key}: '{name}' is given twice")
    return names


@dataclass(frozen=True)
class Prepared:
    """A log as the parts of a filter see it: all numbers that a run starts from, and none that it changes.

    ``states``: names of the n error states; ``start`` (10+k,) nominal state; ``covariance`` (n,n); ``q_white`` (6,) and
    ``drive`` (k,) spectral densities; ``measurements`` per aiding; ``events`` (E,2) aiding and its sample, by time.
    """

    composition: Composition
    log: SensorLog
    blocks: list[Block]
    aidings: list[Aiding]
    states: tuple[str, ...]
    start: Array
    covariance: Array
    white: Array
    drive: Array
    decay: Array
    centre: Array
    measurements: list[Measurements]
    event_t: Array
    events: NDArray[np.int64]
    r: Array
    """(E,m) noise variances of the events."""
    mix: Array | None = None
    """(E,m,m) of `Measurements`, where some noise is correlated."""

    def kept_states(self) -> tuple[str, ...]:
        """Those that a solution has, which are the first."""
        return self.states[: len(self.states) - structure.not_kept(self.blocks)]


def prepare(composition: Composition, log: SensorLog) -> Prepared:
    """Raises InputError where the composition is not sound or the log lacks what it needs."""
    blocks, aidings = [block.on(log) for block in composition.blocks()], composition.aidings()
    composition.error_code()
    composition.check_considered()
    processes = [block.process(log) for block in blocks]
    sizes = [len(block.states) for block in blocks]
    firsts = NAV + np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    columns = {block.name: int(first) for block, first in zip(blocks, firsts, strict=False)}
    initial, spec = log.initial, log.imu.spec
    covariance = np.zeros((firsts[-1], firsts[-1]))
    covariance[:NAV, :NAV] = np.diag(np.asarray(initial.std, dtype=float)[:NAV] ** 2)
    for first, size, process in zip(firsts, sizes, processes, strict=False):
        covariance[first : first + size, first : first + size] = process.covariance
    dt = (log.imu.t[-1] - initial.t) / len(log.imu.t)
    measurements = [a.samples(log, columns, **composition.options.get(a.name, {})) for a in aidings]
    event_t, events = in_order(measurements)
    nav = [[initial.lat, initial.lon, initial.h], initial.v_n, initial.q_nb]

    def joined(column: int) -> Array:
        return np.concatenate([np.zeros(0), *(process[column] for process in processes)])

    return Prepared(
        composition,
        log,
        blocks,
        aidings,
        states=(*NAVIGATION_STATES, *(name for block in blocks for name in block.states)),
        start=np.concatenate([*nav, joined(0)]).astype(float),
        covariance=covariance,
        white=np.repeat([white_density(spec.accel, dt), white_density(spec.gyro, dt)], 3),
        drive=joined(2),
        decay=joined(3),
        centre=joined(4),
        measurements=measurements,
        event_t=event_t,
        events=events,
        r=stacked(measurements, events, 2),
        mix=mixes(measurements, events),
    )


def run(prepared: Prepared) -> NavSolution:
    """Filter a prepared log from its start to its end."""
    recording, line = make_recording(prepared), make_timeline_of(prepared)
    walk(line, make_model(prepared, recording), len(line.t))
    return solution_of(prepared, recording)


def solution_of(prepared: Prepared, recording: Recording) -> NavSolution:
    """A recording of every sample as the bench wants it."""
    t, state = prepared.log.imu.t, recording.state
    states = prepared.kept_states()
    columns = {name: AUX + k for k, name in enumerate(states[NAV:])}

    def taken(names: tuple[str, ...]) -> Array | None:
        return state[:, [columns.pop(name) for name in names]] if names[0] in columns else None

    return NavSolution(
        t,
        state[:, 0],
        state[:, 1],
        state[:, 2],
        state[:, 3:6],
        state[:, 6:10],
        accel_bias=taken(ACCEL_BIAS_STATES),
        gyro_bias=taken(GYRO_BIAS_STATES),
        std=recording.std,
        covariance_t=t[recording.snapshot_stride - 1 :: recording.snapshot_stride],
        covariance=recording.covariance,
        innovations=_innovations(prepared, recording),
        states=states,
        estimates={name: state[:, k] for name, k in columns.items()},
    )


def _innovations(prepared: Prepared, recording: Recording) -> dict[str, Innovations]:
    """Per aiding those of the samples within the IMU's time."""
    out = {}
    for k, aiding in enumerate(prepared.aidings):
        mine = (prepared.events[:, 0] == k) & np.isfinite(recording.fading)
        m = len(aiding.channels)
        value, covariance = recording.innovation[mine, :m], recording.innovation_covariance[mine, :m, :m]
        if prepared.mix is not None:
            mix = prepared.mix[mine, :m, :m]
            value, covariance = np.einsum("kab,kb->ka", mix, value), mix @ covariance @ mix.transpose(0, 2, 1)
        refused = recording.fading[mine] == REJECTED
        rejected = refused if prepared.composition.policy_of(aiding)[0].judge is not None else None
        out[aiding.name] = Innovations(prepared.event_t[mine], value, covariance, aiding.channels, rejected)
    return out


def make_timeline_of(prepared: Prepared) -> Timeline:
    """The time line of the prepared log."""
    return make_timeline(prepared.log.initial.t, prepared.log.imu.t, prepared.event_t)


def make_model(prepared: Prepared, keep: Any) -> Model:
    """A single filter, at its start."""
    k, m, n = len(prepared.drive), _rows(prepared), len(prepared.states)
    spans, eager = structure.spans(prepared.blocks), structure.eager(prepared.blocks)
    p, scratch = make_covariance(prepared.covariance, eager, spans[3])
    blocks = _blocks(prepared, np.zeros((k, 3)), np.zeros((k, 3)), calls.COUPLE)
    work = _work(lambda *shape: np.zeros(shape), m, n)
    coupling = Coupling(spans, np.zeros((k, 3)), np.zeros((k, 3)), np.zeros(k))
    inputs = Inputs(
        _imu(prepared.log),
        prepared.white,
        prepared.drive,
        prepared.decay,
        prepared.centre,
        structure.chain(prepared.blocks),
        eager,
        structure.estimated(prepared.blocks, prepared.composition.consider),
    )
    events, error = _events(prepared, prepared.r, calls.MEASURE), prepared.composition.error_code()
    return Model(inputs, blocks, events, error, prepared.start.copy(), p, scratch, coupling, work, keep)


def make_lanes(prepared: Sequence[Prepared], keep: Any, imu: Any = None) -> Model:
    """Up to `WIDTH` filters side by side on one time line; their samples are ``imu`` where it is made already."""
    first = prepared[0]
    p, scratch = make_covariances([each.covariance for each in prepared])
    k, m, n = len(first.drive), _rows(first), len(first.states)
    blocks = _blocks(first, zeros(k, 3), zeros(k, 3), calls.COUPLE_LANES)
    work = _work(zeros, m, n)
    coupling = Coupling(structure.spans(first.blocks), zeros(k, 3), zeros(k, 3), np.zeros(k))
    white, drive, r, state, centre = (
        side_by_side([getattr(each, key) for each in prepared]) for key in ("white", "drive", "r", "start", "centre")
    )
    chain, estimated = structure.chain(first.blocks), structure.estimated(first.blocks, first.composition.consider)
    inputs = Inputs(imu or imu_of(prepared), white, drive, first.decay, centre, chain, n, estimated)
    z = [stacked(each.measurements, each.events, 1) for each in prepared]
    mix = zeros(0, m, m) if first.mix is None else side_by_side([each.mix for each in prepared])
    events = _events(first, r, calls.MEASURE_LANES)._replace(z=side_by_side(z), mix=mix)
    error: int = first.composition.error_code()
    return Model(inputs, blocks, events, error, state, p, scratch, coupling, work, keep)


def imu_of(prepared: Sequence[Prepared]) -> Any:
    """Samples of the IMU (N,6) of each of some logs."""
    return side_by_side([_imu(each.log) for each in prepared])


def _work(array: Callable[..., Any], m: int, n: int) -> Work:
    """Room for n states and m measurements; ``array`` makes zeros of a shape."""
    return Work(
        whole=array(6),
        corrections=array(6),
        clean=array(6),
        sample=array(6),
        residual=array(m),
        r=array(m),
        s=array(m * m),
        h=array(m, n),
        x=array(n),
        scalars=array(m, 2),
        scratch=array(4, n),
        drive=array(n - NAV),
        dt=np.zeros(1),
    )


def _imu(log: SensorLog) -> Array:
    return np.ascontiguousarray(np.hstack([log.imu.gyro, log.imu.accel]))


def _rows(prepared: Prepared) -> int:
    return max([1, *(len(a.channels) for a in prepared.aidings)])


def _blocks(prepared: Prepared, accel: Any, gyro: Any, signature: Any) -> Blocks:
    """Couplings at rest filled in once; blocks that follow the IMU are left for the loop."""
    couples, places, first = [], [], 0
    for block in prepared.blocks:
        last = first + len(block.states)
        if block.couple is not None and block.follows_imu:
            couples.append(address(block.couple, signature))
            places.append((first, last))
        elif block.couple is not None:
            _couple_once(block, *(getattr(c, "array", c)[first:last] for c in (accel, gyro)))
        first = last
    return Blocks(np.array(couples, dtype=np.int64), np.array(places, dtype=np.int64).reshape(-1, 2), accel, gyro)


def _couple_once(block: Block, accel: Array, gyro: Array) -> None:
    """A coupling that does not change, by the compiled function."""
    k = len(block.states)
    plain = np.zeros((k, 3)), np.zeros((k, 3))
    calls.couple_now(address(block.couple, calls.COUPLE), np.zeros(k), np.zeros(6), *plain)
    for target, made in zip((accel, gyro), plain, strict=True):
        target[...] = made if target.ndim == 2 else made[..., None]


def _events(prepared: Prepared, r: Any, signature: Any) -> Events:
    aidings = prepared.aidings
    count = len(aidings)
    longest = max([1, *(len(m.parameters) for m in prepared.measurements)])
    parameters = np.zeros((count, longest))
    for k, measured in enumerate(prepared.measurements):
        parameters[k, : len(measured.parameters)] = measured.parameters
    policies, memories = np.zeros(count, dtype=np.int64), [np.zeros(1)]
    for k, aiding in enumerate(aidings):
        memories.append(prepared.composition.policy_memory(aiding))
        policies[k] = address(prepared.composition.policy_of(aiding)[0].judge, calls.POLICY)
    memory = np.zeros((count, max(len(m) for m in memories)))
    for k, values in enumerate(memories[1:]):
        memory[k, : len(values)] = values
    return Events(
        np.ascontiguousarray(prepared.events[:, 0]),
        stacked(prepared.measurements, prepared.events, 1),
        r,
        np.zeros((0, *prepared.r.shape[1:] * 2)) if prepared.mix is None else prepared.mix,
        np.array([len(a.channels) for a in aidings], dtype=np.int64),
        np.array([address(a.measure, signature) for a in aidings], dtype=np.int64),
        parameters,
        policies,
        memory,
    )


def make_recording(prepared: Prepared, stride: int = 1) -> Recording:
    """Room for what a run leaves behind: every ``stride``-th sample, and covariances about once a second."""
    t = prepared.log.imu.t
    every = min(len(t), max(1, round(SNAPSHOT_INTERVAL_S * (len(t) - 1) / (t[-1] - t[0]))))
    kept = len(prepared.kept_states())
    sizes = AUX - NAV + kept, kept, _rows(prepared)
    return empty_recording(len(t), len(prepared.events), sizes, every, stride)
