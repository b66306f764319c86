"""`nnckf` and `nnakf`: NARX networks that carry an EKF or UKF through GNSS outages.

The NARX thesis (2021). While there is GNSS, a second copy of the solution runs free and is re-set every ``longest_outage_s``;
six networks learn what it lacks. Coordinates of `direct`; SI units and radians, NED.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from estimators.learning import pretrained
from estimators.learning.narx_flight import NarxFlight, Stretch
from estimators.learning.narx_networks import (
    CANDIDATES,
    P_DP,
    SINCE_RESET,
    TARGETS,
    Drift,
    DriftNetworks,
    Structure,
    select_inputs,
    select_lags,
)
from estimators.learning.networks.levenberg_marquardt import Training
from estimators.methods.direct import Array, check_range
from estimators.methods.working_copy import Fixes, Kind
from testbed.base.errors import InputError
from testbed.data.records import NavSolution, SensorLog, Trajectory

HELD_BACK = 3
"""Of the drifts of the offline flights every third is kept from training: the simulated outages of the statistics."""


@dataclass(frozen=True)
class NarxAiding:
    """Parameters of both schemes. Weights come from `fit`, or by the name ``networks`` from what `learn` stored."""

    filter: Kind = "ukf"
    inputs: str | Sequence[str] = "mrmr"
    """``mrmr``: the ``input_count`` best of the thesis's ten, per target; ``all`` ten; ``p-dp``: own channel and time;
    ``since-reset``: angles, time, and what changed since the re-set; or a list of names for every target."""
    input_count: int = 4
    output_lags: int = -1
    """-1: from the Lipschitz curve; 0: a plain feed-forward network."""
    input_lags: int = -1
    neurons: int = 8
    seed: int = 0
    step_s: float = 1.0
    """Interval of the networks' epochs: a multiple of the GNSS interval."""
    longest_outage_s: float = 60.0
    settle_s: float = 100.0
    """The filter's own convergence, before the first lesson."""
    epochs: int = 100
    """Offline."""
    online_epochs: int = 10
    """Per window; 0 leaves the networks as they came from the offline flight."""
    online_windows: int = 1
    """Windows that one on-line update is trained on: the newest, and those before it."""
    goal: float = 1e-6
    """Mean square normalised error at which an update ends."""
    decay: float = 0.0
    """Weight of the squared network weights against the mean square normalised error."""
    held_back: Literal["windows", "rows"] = "windows"
    """What stops the training off line: whole windows, or ``rows`` drawn from all of them, which do not see that the windows are
    learnt by heart."""
    accel_noise_scale: float = 1.0
    """Factor on the accelerometers' standard deviation in the filter's Q, as in `direct`."""
    gyro_noise_scale: float = 1.0
    """Factor on the gyros'."""
    networks: str = ""
    """Name of stored networks; empty: those of `fit`, or on-line learning from nothing."""

    name: ClassVar[str] = "narx"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")
    _trained: DriftNetworks | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.filter not in ("ekf", "ukf"):
            raise InputError(f"{self.name}: filter is '{self.filter}', expected 'ekf' or 'ukf'")
        if isinstance(self.inputs, str) and self.inputs not in ("mrmr", "all", "p-dp", "since-reset"):
            raise InputError(
                f"{self.name}: inputs is '{self.inputs}', expected 'mrmr', 'all', 'p-dp', 'since-reset' or a list"
            )
        if self.held_back not in ("windows", "rows"):
            raise InputError(f"{self.name}: held_back is '{self.held_back}', expected 'windows' or 'rows'")
        ranges = {
            "accel_noise_scale": (1e-3, 1e3),
            "gyro_noise_scale": (1e-3, 1e3),
            "input_count": (1, 17),
            "output_lags": (-1, 10),
            "input_lags": (-1, 10),
            "neurons": (1, 100),
            "step_s": (1e-3, 60.0),
            "longest_outage_s": (2.0, 3600.0),
            "settle_s": (0.0, 1e5),
            "online_windows": (1, 1000),
            "online_epochs": (0, 10_000),
        }
        for key, (low, high) in ranges.items():
            check_range(self.name, key, getattr(self, key), low, high)
        if self.output_lags == 0 and self.input_lags < 0:
            raise InputError(f"{self.name}: output_lags = 0 needs input_lags of 0 or more")
        Training(epochs=self.epochs, decay=self.decay)

    @property
    def uncorrected(self) -> bool:
        """Whether the free copy keeps attitude and biases of its own through its re-sets."""
        return False

    # ------------------------------------------------------------------ learning before the flight
    def fit(self, flights: Iterable[tuple[SensorLog, Trajectory | None]]) -> None:
        """Choose inputs and lags, train, and take the statistics, on flights without outages. Truth is not looked at."""
        drifts = [drift for log, _ in flights for drift in self.lessons(log)]
        if len(drifts) < HELD_BACK:
            raise InputError(
                f"{self.name}: {len(drifts)} windows of {self.longest_outage_s:g} s to learn from, needs {HELD_BACK}"
            )
        known, held_back = split_windows(drifts)
        networks = DriftNetworks(self.structure(known)).train(known, self._offline(known))
        object.__setattr__(self, "_trained", networks.with_statistics(held_back))

    def learn(self, flights: pretrained.TrainingFlights) -> None:
        """Train on the scenario's training flights and store the networks, unless that is done already."""
        if self.networks:
            pretrained.learn(self, flights)

    def store(self, path: Path, meta: dict[str, Any]) -> None:
        """Write the networks of `fit` as safetensors."""
        assert self._trained is not None
        self._trained.save(path, meta)

    def lessons(self, log: SensorLog) -> Iterator[Drift]:
        """Every re-set of the free copy in a log."""
        flight = NarxFlight(self, log)
        for stretch in flight.plan():
            if stretch.kind == "lesson":
                yield flight.lesson(stretch)
            else:
                flight.pass_over(stretch)

    def learning_data(self, flights: Iterable[tuple[SensorLog, Trajectory | None]]) -> Any:
        """Candidate inputs and targets of flights without outages, for `testbed features`."""
        from testbed.features.learning import LearningData

        drifts = [drift for log, _ in flights for drift in self.lessons(log)]
        if not drifts:
            raise InputError(f"{self.name}: no window of {self.longest_outage_s:g} s in these flights")
        y = np.vstack([drift.y for drift in drifts])
        candidates = np.vstack([drift.columns(CANDIDATES) for drift in drifts])
        return LearningData(CANDIDATES, candidates, dict(zip(TARGETS, y.T, strict=True)))

    def structure(self, drifts: Sequence[Drift]) -> Structure:
        """Inputs and lags as the parameters say, chosen from the data where they say so."""
        if self.inputs == "mrmr":
            inputs = select_inputs(drifts, self.input_count)
        elif self.inputs == "since-reset":
            inputs = (("roll", "pitch", "yaw", "t", *SINCE_RESET),) * 6
        elif self.inputs == "p-dp":
            inputs = P_DP
        else:
            inputs = (CANDIDATES if self.inputs == "all" else tuple(self.inputs),) * 6
        ny, nu = self.output_lags, self.input_lags
        if ny >= 0 and nu >= 0:
            return Structure(inputs, ((ny, nu),) * 6, self.neurons, self.seed)
        found = select_lags(drifts, inputs)
        return Structure(
            inputs, tuple((ny if ny >= 0 else a, nu if nu >= 0 else b) for a, b in found), self.neurons, self.seed
        )

    def _offline(self, drifts: Sequence[Drift]) -> Training:
        whole, decay = self.held_back == "windows", self.decay * _rows(drifts)
        return Training(epochs=self.epochs, goal=self.goal, decay=decay, whole_groups=whole)

    def _online(self, drifts: Sequence[Drift]) -> Training:
        decay = self.decay * _rows(drifts)
        return Training(epochs=self.online_epochs, goal=self.goal, decay=decay, validation_share=0.0)

    def initial_networks(self, log: SensorLog) -> DriftNetworks | None:
        """What is known before take-off. Raises InputError when the named networks were never trained."""
        if self._trained is not None or not self.networks:
            return self._trained
        return DriftNetworks.load(pretrained.stored(self, log))[0]

    # ------------------------------------------------------------------ in flight
    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log, learning while there is GNSS. Raises InputError when it has no GNSS."""
        flight = NarxFlight(self, log)
        networks = self.initial_networks(log)
        seen: list[Drift] = []
        outputs: list[tuple[Array, Array]] = []
        limits: list[tuple[float, int]] = []
        for stretch in flight.plan():
            if stretch.kind == "lesson" and (networks is None or self.online_epochs):
                drift = flight.lesson(stretch, spread=networks is None)
                seen = [*seen, drift][-self.online_windows :]
                if networks is None:
                    networks = (
                        DriftNetworks(self.structure(seen)).train(seen, self._offline(seen)).with_statistics(seen)
                    )
                elif self.online_epochs:
                    networks = networks.train(seen, self._online(seen))
            elif stretch.kind == "outage" and networks is not None and len(stretch.t) > 1:
                drift = flight.free_drift(stretch)
                output, limited = networks.closed_loop(drift)
                self.bridge(flight, stretch, drift, output, networks)
                outputs.append((stretch.t, output))
                limits.append((stretch.t[0], limited))
            else:
                flight.pass_over(stretch)
        return flight.solution(outputs, limits)

    def bridge(
        self, flight: NarxFlight, stretch: Stretch, drift: Drift, output: Array, networks: DriftNetworks
    ) -> None:
        """Take the main copy through an outage with the networks' output (E,6) on the free copy's drift."""
        raise NotImplementedError

    def lacking(self, flight: NarxFlight, t: Array, main: Array) -> Array:
        """Targets (E,6) at epochs ``t`` of a lesson, where ``main`` (E,15) is the filter's state."""
        raise NotImplementedError


@dataclass(frozen=True)
class Nnckf(NarxAiding):
    """Compensated: the networks learn filter minus free copy, and in an outage are added to the coasting filter's answer.

    The covariance stays the filter's own.
    """

    name: ClassVar[str] = "nnckf"

    def lacking(self, flight: NarxFlight, t: Array, main: Array) -> Array:
        return main[:, :6] - flight.free_states[1:, :6]

    def bridge(
        self, flight: NarxFlight, stretch: Stretch, drift: Drift, output: Array, networks: DriftNetworks
    ) -> None:
        first, task = flight.main.row, flight.task
        flight.main.run_to(stretch.end)
        rows = slice(first, stretch.end)
        for k in range(6):
            task.keep.state[rows, k] += np.interp(task.t[rows], stretch.t, output[:, k])


@dataclass(frozen=True)
class Nnakf(NarxAiding):
    """Aided: the networks learn GNSS minus the free copy; in an outage both together are the filter's measurement.

    Its variance, a bias and the filter's P at the start of the outage are set by the networks' simulated outages.
    """

    tune_p: bool = True
    """Whether P is enlarged at the start of an outage by what the drifts of the offline flight exceeded it."""
    correlated: bool = False
    """Whether R takes the errors of one outage for one error and not, as the thesis, for as many as there are epochs."""
    resets: Literal["all", "position-velocity"] = "all"
    """What of the free copy (*INS 2*) the thesis's correction by GNSS every 60 s re-sets: the filter's whole state, attitude and
    biases included; or what GNSS measures, so that attitude and biases are those of an INS that nobody ever corrected."""

    name: ClassVar[str] = "nnakf"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.resets not in ("all", "position-velocity"):
            raise InputError(f"{self.name}: resets is '{self.resets}', expected 'all' or 'position-velocity'")

    @property
    def uncorrected(self) -> bool:
        return self.resets == "position-velocity"

    def lacking(self, flight: NarxFlight, t: Array, main: Array) -> Array:
        return flight.fixes.z[np.searchsorted(flight.fixes.t, t - 1e-6)] - flight.free_readings[1:]

    def bridge(
        self, flight: NarxFlight, stretch: Stretch, drift: Drift, output: Array, networks: DriftNetworks
    ) -> None:
        z = flight.free_readings + output + networks.mean
        last_fix = np.searchsorted(flight.fixes.t, stretch.t[0] + 1e-6) - 1
        r = np.maximum(networks.std**2, flight.fixes.r[last_fix])
        if self.correlated:
            r = r * (len(z) - 1)
        if self.tune_p:
            flight.main.p[:] *= max(1.0, networks.growth)
        flight.main.run_to(stretch.end, Fixes.of(stretch.t[1:], z[1:], np.tile(r, (len(z) - 1, 1))))


def split_windows(drifts: Sequence[Drift]) -> tuple[list[Drift], list[Drift]]:
    """Of the windows of offline flights those that the networks learn from, and those that set R and P (every `HELD_BACK`-th)."""
    learned = [drift for k, drift in enumerate(drifts) if k % HELD_BACK != HELD_BACK - 1]
    return learned, list(drifts[HELD_BACK - 1 :: HELD_BACK])


def _rows(drifts: Sequence[Drift]) -> int:
    return sum(len(drift.t) for drift in drifts)
