"""`direct-ekf`, `stekf`, `rstekf`: loosely coupled INS/GNSS by 15-state total-state extended Kalman filters.

The IMM-RSTEKF paper (2023) with the accelerated motion model alone; steps in `direct_kernels`. Inside: position in
metres about the start, Euler angles (of axes that are switched above a pitch of 80°, see `body_axes`); at the edges the
bench's conventions. SI, radians, NED.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from estimators.aiding.gnss import MINIMUM_STD, require_gnss
from estimators.blocks.imu import noise_model
from estimators.core.composition import SNAPSHOT_INTERVAL_S
from estimators.core.recording import Recording
from estimators.core.side_by_side import recording_in_lanes
from estimators.core.strong_tracking import FILTERS
from estimators.core.timeline import Timeline, make_timeline, require_one_timeline, walk
from estimators.methods.body_axes import HALF, TURN, Axes, near_pole, turn_noise, turn_setting, turned_angles
from estimators.methods.direct_kernels import MEASUREMENTS, Ekf, Inputs, Tracking, make_work
from estimators.methods.motion_models import ACCELERATED, Motion, Setting
from testbed.base.errors import InputError
from testbed.data.records import STATE_NAMES, InitialState, Innovations, NavSolution, SensorLog
from testbed.kernels.lanes import WIDTH
from testbed.kernels.tables import combined, of_lane
from testbed.physics import earth
from testbed.physics.rotations import euler_error_matrix, eulers_to_quats, quat_multiply, quat_to_euler, wrap

Array = NDArray[np.float64]

SHARED = frozenset(["decay", "lever", "noise", "transition", "since"])
"""Fields of the models that are the same in all runs of a scenario."""
FRESH = frozenset(["work", "points", "mixing", "figures", "theta"])
"""Fields that are written before they are read."""
CEILING_SCALES = (1e-3, 1e3, "log")
"""Of 10 m and of 10,000 km, for example: below, what a fix says in one step; above, no ceiling at all."""


@dataclass(frozen=True)
class DirectFilter:
    """What every direct filter declares: scales of the specification's standard deviations (1 is the data sheet)."""

    accel_noise_scale: float = 1.0
    gyro_noise_scale: float = 1.0
    accel_bias_scale: float = 1.0
    gyro_bias_scale: float = 1.0
    position_std_scale: float = 1.0
    velocity_std_scale: float = 1.0

    name: ClassVar[str] = "direct"
    parameter_space: ClassVar[dict[str, tuple[float, float, str]]] = {
        "accel_noise_scale": (1e-3, 1e3, "log"),
        "gyro_noise_scale": (1e-3, 1e3, "log"),
        "accel_bias_scale": (1e-3, 1e3, "log"),
        "gyro_bias_scale": (1e-3, 1e3, "log"),
        "position_std_scale": (1e-3, 1e3, "log"),
        "velocity_std_scale": (1e-3, 1e3, "log"),
    }

    def __post_init__(self) -> None:
        for key, (low, high, _) in self.parameter_space.items():
            check_range(self.name, key, getattr(self, key), low, high)

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError when it has no GNSS."""
        task = self.problem(log)
        model, line = self.model(task), task.timeline()
        walk(line, model, len(task.t))
        return self.answer(task, model, int(line.place[1]))

    def run_many(self, logs: Sequence[SensorLog]) -> list[NavSolution]:
        """`run` on each of some logs with one time line, `WIDTH` at a time in lanes (`testbed.kernels.tables`).

        What comes out for a log depends on no other; a filter near the pole of its angles goes by itself. Raises
        InputError for logs whose samples and fixes are not of the same times.
        """
        tasks = [self.problem(log) for log in logs]
        together = [k for k, task in enumerate(tasks) if not task.axes.turned[0]]
        found: dict[int, NavSolution] = {}
        for first in range(0, len(together), WIDTH):
            block = together[first : first + WIDTH]
            found |= zip(block, self._side_by_side([tasks[k] for k in block]), strict=True)
        lost = [k for k in range(len(logs)) if k not in found or not np.isfinite(found[k].lat).all()]
        return [self.run(log) if k in lost else found[k] for k, log in enumerate(logs)]

    def _side_by_side(self, tasks: list[DirectProblem]) -> list[NavSolution]:
        require_one_timeline([task.timeline() for task in tasks], self.name)
        line, keep = tasks[0].timeline(), recording_in_lanes(tasks[0].keep)
        models = [self.model(task)._replace(keep=()) for task in tasks]
        model = combined(models, SHARED, FRESH)._replace(keep=keep)
        walk(line, model, len(line.t))
        used, answers, walked = int(line.place[1]), [], model._replace(inputs=())
        for lane, task in enumerate(tasks):
            own = of_lane(walked, lane)
            answers.append(self.answer(replace(task, keep=own.keep, axes=own.axes), own, used))
        return answers

    def model(self, task: DirectProblem) -> Any:
        """The filter at the start of a task, for `estimators.core.timeline.walk`."""
        raise NotImplementedError

    def answer(self, task: DirectProblem, model: Any, used: int) -> NavSolution:
        """The solution of ``model``, which has walked the task and used so many fixes."""
        raise NotImplementedError

    def problem(self, log: SensorLog) -> DirectProblem:
        """The log in the filters' own coordinates, with Q and R scaled as declared."""
        scales = (self.accel_noise_scale, self.gyro_noise_scale, self.accel_bias_scale, self.gyro_bias_scale)
        return DirectProblem.of(log, self.name, scales, (self.position_std_scale, self.velocity_std_scale))


@dataclass(frozen=True)
class DirectEkf(DirectFilter):
    """Extended Kalman filter; prediction at every IMU sample, GNSS at its own time."""

    name: ClassVar[str] = "direct-ekf"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")
    filter_name: ClassVar[str] = "ekf"

    def tracking(self) -> Tracking:
        """Strong tracking: the plain filter has none."""
        return make_tracking(self.filter_name)

    def model(self, task: DirectProblem) -> Ekf:
        return make_ekf(task, self.tracking())

    def answer(self, task: DirectProblem, model: Ekf, used: int) -> NavSolution:
        extras = {"test_statistic": (task.gnss_t[:used], model.theta[:used])}
        if self.filter_name != "ekf":
            extras["fading_factor"] = (task.gnss_t[:used], task.keep.fading[:used])
        return task.solution(used, extras)


@dataclass(frozen=True)
class Stekf(DirectEkf):
    """Strong-tracking EKF: the covariance is faded at every fix whose smoothed innovations exceed the prediction."""

    forgetting: float = 0.95
    """rho of the paper: weight of the past innovations."""
    raw_trace: bool = False
    """The fading factor's traces as printed, metres and m/s added; else each channel is divided by its R, as no sum of units
    may depend on whether they are metres or kilometres."""
    ceiling_scale: float = 1.0
    """Of the sigma up to which a state is faded: 1 is 10 km, 1 km/s, 180°, 10 m/s² and 1 rad/s, from where on nothing is known."""

    name: ClassVar[str] = "stekf"
    filter_name: ClassVar[str] = "stekf"
    parameter_space: ClassVar[dict[str, tuple[float, float, str]]] = DirectFilter.parameter_space | {
        "forgetting": (0.0, 1.0, "linear"),
        "ceiling_scale": CEILING_SCALES,
    }

    def tracking(self) -> Tracking:
        return make_tracking(self.filter_name, self.forgetting, np.inf, self.raw_trace, self.ceiling_scale)


@dataclass(frozen=True)
class Rstekf(Stekf):
    """Refined strong-tracking EKF: fades only when the chi-square test of the innovation fails."""

    significance: float = 0.05
    """alpha of the test with 6 degrees of freedom: 0.05 is a threshold of 12.592; 0 never fades."""

    name: ClassVar[str] = "rstekf"
    filter_name: ClassVar[str] = "rstekf"
    parameter_space: ClassVar[dict[str, tuple[float, float, str]]] = Stekf.parameter_space | {
        "significance": (0.0, 1.0, "linear")
    }

    def tracking(self) -> Tracking:
        return super().tracking()._replace(threshold=chi_square_threshold(self.significance))


@dataclass(frozen=True)
class DirectProblem:
    """A log in the coordinates of the direct filters, and room for what a run leaves behind."""

    start: float
    t: Array
    """(N,) IMU times."""
    gnss_t: Array
    """(M,) times that the fixes describe."""
    inputs: Inputs
    x: Array
    """(15,) where a filter starts, and ``p`` (15,15)."""
    p: Array
    motion: Motion
    """Of the accelerated model."""
    reference: tuple[float, float, float]
    keep: Recording
    axes: Axes
    """At the start; the history is of the last filter that ran."""

    @classmethod
    def of(
        cls, log: SensorLog, name: str, noise_scales: tuple[float, ...], std_scales: tuple[float, ...]
    ) -> DirectProblem:
        """Convert ``log``. Raises InputError when it has no GNSS."""
        gnss, imu, first = require_gnss(log, name), log.imu, log.initial
        per_radian = earth.metres_per_radian(first.lat, first.h)
        model = noise_model(log)
        x, p, axes = _start(first, model.covariance, len(imu.t))
        place, lever = np.array([first.lat, first.h, *per_radian]), np.array(gnss.spec.lever_arm_b, dtype=float)
        setting = Setting(place, np.array(model.bias_mean), model.decay, lever)
        noise = np.append(model.q * np.repeat(noise_scales, 3) ** 2, 0.0)
        if axes.turned[0]:
            turn_setting(setting, 1.0)
            turn_noise(noise)
        fix_t = gnss.t - gnss.spec.latency_s
        fixes = fix_t >= first.t - 1e-7
        position = earth.position_difference(gnss.lat, gnss.lon, gnss.h, first.lat, first.lon, first.h)
        local = earth.metres_per_radian(gnss.lat, gnss.h)
        std = np.maximum(gnss.measurement_std(), MINIMUM_STD) * np.repeat(std_scales, 3)
        std[:, 0] *= per_radian[0] / local[0]
        std[:, 1] *= per_radian[1] / local[1]
        z = np.column_stack([*position, gnss.v_n])
        return cls(
            first.t,
            imu.t,
            fix_t[fixes],
            Inputs(np.column_stack([imu.gyro, imu.accel]), z[fixes], std[fixes] ** 2),
            x,
            p,
            Motion(ACCELERATED, setting, noise, np.zeros(3)),
            (first.lat, first.lon, first.h),
            make_keep(imu.t, int(fixes.sum())),
            axes,
        )

    def motion_of_run(self) -> Motion:
        """``motion`` with arrays that a filter may turn to other axes."""
        (model, setting, noise, held) = self.motion
        return Motion(
            model,
            setting._replace(centre=setting.centre.copy(), lever=setting.lever.copy()),
            noise.copy(),
            held.copy(),
        )

    def axes_of_run(self) -> Axes:
        """``axes`` for a filter that starts."""
        return self.axes._replace(turned=self.axes.turned.copy(), samples=np.zeros((2, 6)))

    def timeline(self) -> Timeline:
        """The time line at its start."""
        return make_timeline(self.start, self.t, self.gnss_t)

    def solution(self, used: int, extras: dict[str, tuple[Array, Array]], names: tuple[str, ...] = ()) -> NavSolution:
        """The answer in the bench's conventions, after ``used`` fixes; ``names`` of the columns of each extra."""
        states, every = self.keep.state, self.keep.snapshot_stride
        place, rows = self.motion.setting.place, slice(every - 1, None, every)
        lat, h = self.reference[0] + states[:, 0] / place[2], self.reference[2] - states[:, 2]
        # metres north and east here, of those at the reference
        stretch = np.column_stack(earth.metres_per_radian(lat, h)) / place[2:4]
        std = self.keep.std.copy()
        std[:, :2] *= stretch
        to_metres = np.ones((used, MEASUREMENTS))
        k = np.minimum(np.searchsorted(self.t, self.gnss_t[:used]), len(self.t) - 1)
        to_metres[:, :2] = stretch[k]
        covariance = _to_rotation_vector(self.keep.covariance, states[rows], stretch[rows])
        q_nb, biases, std, covariance = in_b(states, std, covariance, self.axes.history, rows)
        return NavSolution(
            self.t,
            lat,
            wrap(self.reference[1] + states[:, 1] / place[3]),
            h,
            states[:, 3:6],
            q_nb,
            accel_bias=biases[:, :3],
            gyro_bias=biases[:, 3:],
            std=std,
            covariance_t=self.t[rows],
            covariance=covariance,
            innovations={
                "gnss": Innovations(
                    self.gnss_t[:used],
                    self.keep.innovation[:used] * to_metres,
                    self.keep.innovation_covariance[:used] * to_metres[:, :, None] * to_metres[:, None, :],
                )
            },
            states=STATE_NAMES,
            extras=extras,
            extra_names=dict.fromkeys(extras, names) if names else {},
        )


def make_tracking(
    filter_name: str, forgetting: float = 1.0, threshold: float = np.inf, raw: bool = False, ceiling: float = 1.0
) -> Tracking:
    """Strong tracking at the start: rho, the threshold of the chi-square test, raw traces, and the scale of the ceiling."""
    return Tracking(FILTERS[filter_name], forgetting, threshold, raw, ceiling, np.zeros(MEASUREMENTS + 1))


def make_ekf(task: DirectProblem, tracking: Tracking) -> Ekf:
    """The filter at the start of a task."""
    theta = np.full(len(task.gnss_t), np.nan)
    arrays = task.x.copy(), task.p.copy(), make_work(), task.axes_of_run(), task.keep, theta
    return Ekf(task.inputs, task.motion_of_run(), tracking, *arrays)


def make_keep(t: Array, fixes: int) -> Recording:
    """Room for a row per IMU time, a covariance about once a second, and the innovations of so many fixes."""
    n, m = len(t), MEASUREMENTS
    every = max(1, round(SNAPSHOT_INTERVAL_S * (n - 1) / (t[-1] - t[0])))
    rows, snapshots = np.empty((2, n, 15)), np.empty((n // every, 15, 15))
    nu = np.full((fixes, m), np.nan), np.full((fixes, m, m), np.nan), np.full(fixes, np.nan)
    return Recording(1, rows[0], rows[1], every, snapshots, *nu)


def _start(first: InitialState, covariance: Array, samples: int) -> tuple[Array, Array, Axes]:
    """State (15,), its covariance (15,15) with Euler angles instead of a rotation vector, and the axes that both are in."""
    euler = quat_to_euler(np.asarray(first.q_nb, float))
    turned = near_pole(False, euler[0], euler[1])
    x = np.concatenate([np.zeros(3), first.v_n, euler, first.accel_bias, first.gyro_bias]).astype(float)
    to_state = np.eye(15)
    if turned:
        x[6:9] = turned_angles(*euler, 1.0)
        for k in (9, 12):
            x[k : k + 3] = TURN @ x[k : k + 3]
            to_state[k : k + 3, k : k + 3] = TURN
    to_state[6:9, 6:9] = np.linalg.inv(np.array(euler_error_matrix(*x[6:9])))
    axes = Axes(np.array([turned], dtype=np.uint8), np.zeros((2, 6)), np.zeros(samples, dtype=np.uint8))
    return x, to_state @ covariance @ to_state.T, axes


def in_b(
    states: Array, std: Array, covariance: Array, history: NDArray[np.uint8], rows: slice
) -> tuple[Array, Array, Array, Array]:
    """q_nb (N,4), biases (N,6), sigmas (N,15) and snapshots (K,15,15, of ``rows``) of what was recorded in changing axes."""
    q_nb, biases, turned = eulers_to_quats(states[:, 6:9]), states[:, 9:15], history.astype(bool)
    if not turned.any():
        return q_nb, biases, std, covariance
    biases, std, covariance = biases.copy(), std.copy(), covariance.copy()
    q = np.array(quat_multiply.py_func(q_nb[turned].T, (HALF, 0.0, HALF, 0.0))).T
    q_nb[turned] = q
    back = np.eye(15)
    for k in (9, 12):
        biases[turned, k - 9 : k - 6] = biases[turned, k - 9 : k - 6] @ TURN
        std[turned, k : k + 3] = std[turned, k : k + 3][:, ::-1]
        back[k : k + 3, k : k + 3] = TURN.T
    snapshots = turned[rows][: len(covariance)]
    covariance[snapshots] = back @ covariance[snapshots] @ back.T
    return q_nb, biases, std, covariance


def _to_rotation_vector(snapshots: Array, states: Array, stretch: Array) -> Array:
    """Covariances (K,15,15) of scaled positions, by ``stretch`` (K,2), and Euler angles as those of metres and a rotation
    vector in n."""
    jacobian = np.zeros((len(snapshots), 15, 15))
    jacobian[:] = np.eye(15)
    jacobian[:, [0, 1], [0, 1]] = stretch
    for k, row in enumerate(states):
        jacobian[k, 6:9, 6:9] = euler_error_matrix(row[6], row[7], row[8])
    with np.errstate(all="ignore"):  # a diverged filter holds no finite numbers, which the scorer will say
        return jacobian @ snapshots @ jacobian.transpose(0, 2, 1)


def chi_square_threshold(significance: float) -> float:
    """Value that a chi-square variable with 6 degrees of freedom exceeds with probability ``significance``."""
    from scipy.special import chdtri

    return float(chdtri(MEASUREMENTS, significance))


def check_range(owner: str, key: str, value: float, low: float, high: float) -> None:
    """Raises InputError when ``value`` is no number in [low, high]."""
    if not (np.isfinite(value) and low <= value <= high):
        raise InputError(f"{owner}: {key} = {value}, must lie between {low:g} and {high:g}")
