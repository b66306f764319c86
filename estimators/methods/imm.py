"""`imm-ekf`, `imm-rstekf`: interacting multiple models over the direct filters, any list of (model, filter) branches.

The IMM-RSTEKF paper (2023): three branches (constant velocity, coordinated turn, accelerated) and their transition
probabilities by default; steps in `imm_kernels`. Coordinates as `direct`; SI units and radians inside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from estimators.core.strong_tracking import FILTERS
from estimators.methods.direct import (
    CEILING_SCALES,
    DirectFilter,
    DirectProblem,
    check_range,
    chi_square_threshold,
    make_tracking,
)
from estimators.methods.direct_kernels import MEASUREMENTS, Tracking, make_work
from estimators.methods.imm_kernels import Acceleration, Aiding, Bank, Branches, Mixing, Modes, interact
from estimators.methods.motion_models import MODELS
from testbed.base.errors import InputError, nearest
from testbed.data.records import NavSolution

Array = NDArray[np.float64]

VELOCITY_NOISE = {"cv": 0.2, "ct": 0.2, "singer": 0.2, "accelerated": 0.0}
"""Default of `Branch.velocity_noise`. An aircraft that holds course and speed in light turbulence still accelerates by
about 0.2 m/s² (0.02 g) rms, correlated over about half a second: density √(2 · 0.2² · 0.5) = 0.2 m/s/√s. The
accelerated model measures its acceleration and needs none."""


@dataclass(frozen=True)
class Branch:
    """One filter of the bank, as a table of the scenario states it."""

    model: str
    """cv | ct | accelerated | singer (constant acceleration when ``manoeuvre_time_s`` is large)."""
    filter: str = ""
    """ekf | stekf | rstekf; empty: the estimator's own."""
    velocity_noise: float | None = None
    """Unmodelled acceleration, m/s/√s; None: `VELOCITY_NOISE`."""
    noise_scale: float = 1.0
    """Multiplies the IMU's white-noise densities in this branch."""
    angle_aiding: bool | None = None
    """Roll and pitch from gravity, yaw from the course; None: in the cv model only."""

    @classmethod
    def of(cls, owner: str, place: str, table: Any) -> Branch:
        """From a table. Raises InputError on anything unknown."""
        if isinstance(table, Branch):
            return table
        if not isinstance(table, Mapping) or "model" not in table:
            raise InputError(f"{owner}: {place} = {table!r}, must be a table with the key 'model'")
        names = [f.name for f in fields(cls)]
        for key in table:
            if key not in names:
                raise InputError(f"{owner}: {place} has no key '{key}'; {nearest(str(key), names)}")
        branch = cls(**table)
        if branch.model not in MODELS:
            raise InputError(
                f"{owner}: {place}.model = '{branch.model}' is unknown; {nearest(str(branch.model), MODELS)}"
            )
        if branch.filter and branch.filter not in FILTERS:
            raise InputError(
                f"{owner}: {place}.filter = '{branch.filter}' is unknown; {nearest(str(branch.filter), FILTERS)}"
            )
        if branch.velocity_noise is not None:
            check_range(owner, f"{place}.velocity_noise", branch.velocity_noise, 0.0, 1e3)
        check_range(owner, f"{place}.noise_scale", branch.noise_scale, 1e-3, 1e3)
        return branch


PAPER_BRANCHES = ({"model": "cv"}, {"model": "ct"}, {"model": "accelerated"})
PAPER_PROBABILITY = (0.1, 0.1, 0.8)


@dataclass(frozen=True)
class ImmEkf(DirectFilter):
    """Interacting multiple models, EKF in every branch unless its table says otherwise."""

    branches: Sequence[Any] = PAPER_BRANCHES
    """Tables with the keys of `Branch`."""
    stay_probability: float = 0.96
    """Diagonal of the transition matrix per fix; the rest is shared equally."""
    transition_matrix: Sequence[Sequence[float]] | None = None
    """Instead of ``stay_probability``: row i, column j is the probability of going from branch i to j."""
    initial_probability: Sequence[float] | None = None
    """Per branch; None: the paper's for its three branches, else equal."""
    tilt_std_deg: float = 3.0
    """Roll and pitch from gravity (cv branch): 0.5 m/s² of manoeuvre left undetected is 3°."""
    course_std_deg: float = 5.0
    """Yaw from the course (cv branch): the crab angle of a 10 m/s cross wind at 115 m/s is 5°."""
    gravity_tolerance: float = 0.03
    """The cv branch's angles count while specific force is this close (relative) to gravity..."""
    rate_limit_dps: float = 2.0
    """...and the body turns slower than this..."""
    minimum_speed_mps: float = 3.0
    """...and, for yaw, while it moves faster than this (the paper's value)."""
    manoeuvre_time_s: float = 2.0
    """Time constant of the `singer` model."""
    forgetting: float = 0.95
    """rho of strong tracking."""
    significance: float = 0.05
    """alpha of the chi-square test of refined strong tracking."""
    raw_trace: bool = False
    """The fading factor's traces as printed, metres and m/s added; else each channel is divided by its R."""
    ceiling_scale: float = 1.0
    """Of the sigma up to which a state is faded: 1 is 10 km, 1 km/s, 180°, 10 m/s² and 1 rad/s, from where on nothing is known."""

    name: ClassVar[str] = "imm-ekf"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")
    filter_name: ClassVar[str] = "ekf"
    parameter_space: ClassVar[dict[str, tuple[float, float, str]]] = DirectFilter.parameter_space | {
        "stay_probability": (0.0, 1.0, "linear"),
        "tilt_std_deg": (0.01, 180.0, "log"),
        "course_std_deg": (0.01, 180.0, "log"),
        "gravity_tolerance": (0.0, 10.0, "linear"),
        "rate_limit_dps": (0.0, 1e4, "linear"),
        "minimum_speed_mps": (0.0, 1e3, "linear"),
        "manoeuvre_time_s": (1e-2, 1e6, "log"),
        "forgetting": (0.0, 1.0, "linear"),
        "significance": (0.0, 1.0, "linear"),
        "ceiling_scale": CEILING_SCALES,
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.branches, Sequence) or isinstance(self.branches, str) or not self.branches:
            raise InputError(f"{self.name}: branches must be a list of tables, got {self.branches!r}")
        self.bank()
        self.transition()
        self.probability()

    def bank(self) -> list[Branch]:
        """The branches, checked."""
        return [Branch.of(self.name, f"branches[{i}]", table) for i, table in enumerate(self.branches)]

    def branch_names(self) -> list[str]:
        """For legends: model and filter of every branch."""
        return [f"{branch.model} {branch.filter or self.filter_name}" for branch in self.bank()]

    def transition(self) -> Array:
        """(B,B) matrix of transition probabilities."""
        count = len(self.branches)
        if self.transition_matrix is None:
            if count == 1:
                return np.ones((1, 1))
            off = (1.0 - self.stay_probability) / (count - 1)
            return np.full((count, count), off) + (self.stay_probability - off) * np.eye(count)
        return self._stochastic("transition_matrix", self.transition_matrix, (count, count))

    def probability(self) -> Array:
        """(B,) initial mode probabilities."""
        count = len(self.branches)
        if self.initial_probability is not None:
            return self._stochastic("initial_probability", self.initial_probability, (count,))
        if [branch.model for branch in self.bank()] == [table["model"] for table in PAPER_BRANCHES]:
            return np.array(PAPER_PROBABILITY)
        return np.full(count, 1.0 / count)

    def _stochastic(self, key: str, value: Any, shape: tuple[int, ...]) -> Array:
        """Raises InputError unless ``value`` has ``shape``, no negative entry and rows that sum to one."""
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != shape or not (array >= 0.0).all() or not np.allclose(array.sum(axis=-1), 1.0, atol=1e-9):
            what = " x ".join(map(str, shape))
            raise InputError(f"{self.name}: {key} must be {what} probabilities whose rows sum to 1, got {value!r}")
        return array

    def answer(self, task: DirectProblem, model: Bank, used: int) -> NavSolution:
        """Extras at the fixes, one column per branch: ``mode_probability``, ``test_statistic``, ``fading_factor``."""
        names = ("mode_probability", "test_statistic", "fading_factor")
        extras = {name: (task.gnss_t[:used], model.figures[:used, i]) for i, name in enumerate(names)}
        return task.solution(used, extras, tuple(self.branch_names()))

    def model(self, task: DirectProblem) -> Bank:
        """The bank at the start of a task: its branches have interacted once."""
        branches, count = self._branches(task), len(self.branches)
        modes = Modes(self.transition(), self.probability(), np.zeros(count))
        shapes = (
            count,
            (count, 15),
            (count, 15, 15),
            count,
            (count, MEASUREMENTS),
            (count, MEASUREMENTS, MEASUREMENTS),
        )
        mixing = Mixing(*(np.zeros(shape) for shape in shapes))
        held = np.zeros(3), np.zeros(3), task.x[3:6].copy(), np.zeros(1)
        interact(modes, branches, mixing)
        return Bank(
            task.inputs,
            task.motion_of_run().setting,
            branches,
            modes,
            (self._tracking(), self._aiding()),
            Acceleration(self.manoeuvre_time_s, *held),
            task.x.copy(),
            task.p.copy(),
            mixing,
            make_work(),
            task.axes_of_run(),
            task.keep,
            np.full((len(task.gnss_t), 3, count), np.nan),
        )

    def _branches(self, task: DirectProblem) -> Branches:
        bank, count = self.bank(), len(self.branches)
        noise = np.tile(task.motion.noise, (count, 1))
        for row, branch in zip(noise, bank, strict=True):
            row[:6] *= branch.noise_scale**2
            velocity_noise = VELOCITY_NOISE[branch.model] if branch.velocity_noise is None else branch.velocity_noise
            row[12] = velocity_noise**2
        return Branches(
            np.array([MODELS[branch.model] for branch in bank]),
            np.array([FILTERS[branch.filter or self.filter_name] for branch in bank]),
            np.array([branch.model == "cv" if branch.angle_aiding is None else branch.angle_aiding for branch in bank]),
            noise,
            np.tile(task.x, (count, 1)),
            np.tile(task.p, (count, 1, 1)),
            np.zeros((count, MEASUREMENTS + 1)),
        )

    def _tracking(self) -> Tracking:
        """What the branches share."""
        threshold = chi_square_threshold(self.significance)
        return make_tracking("ekf", self.forgetting, threshold, self.raw_trace, self.ceiling_scale)

    def _aiding(self) -> Aiding:
        return Aiding(
            np.radians(self.tilt_std_deg) ** 2,
            np.radians(self.course_std_deg) ** 2,
            self.gravity_tolerance,
            np.radians(self.rate_limit_dps),
            self.minimum_speed_mps,
        )


@dataclass(frozen=True)
class ImmRstekf(ImmEkf):
    """Interacting multiple models with refined strong tracking in every branch: the paper's proposal."""

    name: ClassVar[str] = "imm-rstekf"
    filter_name: ClassVar[str] = "rstekf"
