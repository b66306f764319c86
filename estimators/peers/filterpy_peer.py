"""`filterpy-ukf`: a loosely coupled INS/GNSS filter on the unscented Kalman filter of the package ``filterpy`` (R. Labbe), as a peer.

The package filters; what is filtered is written here. The state is the error (15,) of a strapdown solution: position (m), velocity
and rotation vector in n, then accelerometer and gyro bias; each sigma point is a strapdown of its own over the interval between
two predictions, and after each the mean goes into the solution (Crassidis, *IEEE Trans. AES* 42(2), 2006, in its structure). Noise,
biases and initial state are those of `indirect-kf`; needs the optional extra ``peers``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.aiding.gnss import require_gnss
from estimators.blocks.imu import NoiseModel, noise_model
from estimators.core.strapdown import integrate
from estimators.peers.loose_fixes import fix_covariance, initial_std
from estimators.peers.quaternions import conjugates, of_rotations, products, to_rotations
from testbed.base.errors import InputError, MissingExtra
from testbed.data.records import STATE_NAMES, NavSolution, SensorLog
from testbed.physics.earth import metres_per_radian, position_difference
from testbed.physics.rotations import quat_rotate, wrap

Array = NDArray[np.float64]
Samples = tuple[Array, Array, Array]
"""Ends (K,) of some IMU intervals, rates (K,3) and specific forces (K,3)."""

SAME_TIME = 1e-7
"""Times (s) closer than this are one."""


class Solution(NamedTuple):
    """Where a strapdown solution stands, or many of one time: radians, metres, m/s, b to n, and its biases."""

    t: float
    place: Array
    v_n: Array
    q_nb: Array
    accel_bias: Array
    gyro_bias: Array


@dataclass(frozen=True)
class FilterpyUkf:
    """Unscented filter with position and velocity fixes.

    ``time_step_s``: longest interval between two predictions. Within 0.1 s an aircraft that turns at 1 rad/s under 20 m/s²
    turns a tilt error by 0.1 rad, which the sigma points follow; what noise enters is then of one direction to 0.5 %.
    Sigma points lie at sqrt(15) sigma with equal weights (alpha = 1, beta = 0, kappa = 0, the cubature rule): the only choice
    of the three that leaves no weight negative and none that depends on a guess of higher moments.
    """

    time_step_s: float = 0.1
    name: ClassVar[str] = "filterpy-ukf"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")

    def __post_init__(self) -> None:
        if not 0.0 < self.time_step_s <= 1.0:
            raise InputError(f"{self.name}: time_step_s = {self.time_step_s}, must be above 0 and at most 1 s")

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError without GNSS fixes or without the package."""
        gnss = require_gnss(log, self.name)
        model = noise_model(log)
        solution = _start(log)
        ukf = _filter(initial_std(log))
        keep = _Keep(len(log.imu.t))
        fix_t = gnss.t - gnss.spec.latency_s
        fix = int(np.searchsorted(fix_t, solution.t - SAME_TIME))
        for end in _ends(log, fix_t[fix:], self.time_step_s):
            try:
                solution = _predict(ukf, solution, log, end, model, keep)
            except np.linalg.LinAlgError:  # a covariance without sigma points: the rest stays without numbers
                break
            if fix < len(fix_t) and abs(fix_t[fix] - end) < SAME_TIME:
                _update(ukf, solution, log, fix)
                fix += 1
            solution = _fold(ukf, solution)
            keep.end(solution, ukf.P, log)
        return keep.solution(log)


def _filter(std: Array) -> Any:
    """The package's filter, its state the error of a solution, with the sigma points of a prediction carried side by side."""
    try:
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
    except ImportError:
        raise MissingExtra("estimator 'filterpy-ukf' needs the package filterpy: install the extra 'peers'") from None

    class Ukf(UnscentedKalmanFilter):
        def compute_process_sigmas(self, dt: float, fx: Any = None, **arguments: Any) -> None:
            self.sigmas_f[:] = self.fx(self.points_fn.sigma_points(self.x, self.P), **arguments)

    points = MerweScaledSigmaPoints(15, alpha=1.0, beta=0.0, kappa=0.0)
    ukf = Ukf(15, 6, 0.0, hx=_antenna, fx=_carry, points=points)
    ukf.x, ukf.P = np.zeros(15), np.diag(std**2)
    return ukf


def _start(log: SensorLog) -> Solution:
    s = log.initial
    place = np.array([s.lat, s.lon, s.h])
    return Solution(s.t, place, s.v_n, s.q_nb, s.accel_bias, s.gyro_bias)


def _ends(log: SensorLog, fix_t: Array, step: float) -> Array:
    """Times at which a prediction ends: every fix within the log, and IMU samples between them, at most about ``step`` apart."""
    t, dt = log.imu.t, float(np.median(np.diff(log.imu.t)))
    every = max(1, round(step / dt))
    ends = np.union1d(t[every - 1 :: every], fix_t[fix_t <= t[-1] + SAME_TIME])
    ends = np.union1d(ends, t[-1:])
    apart = np.diff(ends, prepend=-np.inf) > SAME_TIME
    return ends[apart]


def _moved(solution: Solution, error: Array) -> Solution:
    """The solution with errors (...,15) added; arrays of the same leading shape."""
    north, east = metres_per_radian(solution.place[0], solution.place[2])
    place = solution.place + error[..., :3] / [north, east, -1.0]
    q = products(of_rotations(error[..., 6:9]), solution.q_nb)
    biases = solution.accel_bias + error[..., 9:12], solution.gyro_bias + error[..., 12:]
    return Solution(solution.t, place, solution.v_n + error[..., 3:6], q, *biases)


def _apart(a: Solution, b: Solution) -> Array:
    """The errors (...,15) that make ``a`` of one solution ``b``."""
    rotation = to_rotations(products(a.q_nb, conjugates(b.q_nb)))
    north, east = metres_per_radian(b.place[0], b.place[2])
    place = (a.place - b.place) * [north, east, -1.0]
    biases = a.accel_bias - b.accel_bias, a.gyro_bias - b.gyro_bias
    return np.concatenate([place, a.v_n - b.v_n, rotation, *biases], axis=-1)


def _integrated(solution: Solution, samples: Samples, model: NoiseModel) -> tuple[Solution, tuple[Array, ...]]:
    """The solution carried over samples, and its rows (place, velocity, attitude) at their ends."""
    t, gyro, accel = samples
    rows = np.empty((len(t), 3)), np.empty((len(t), 3)), np.empty((len(t), 4))
    start = (*solution.place, solution.v_n, solution.q_nb, solution.accel_bias, solution.gyro_bias)
    integrate(solution.t, t, gyro, accel, *start, *rows)
    place, v_n, q_nb = (row[-1] for row in rows)
    return Solution(float(t[-1]), place, v_n, q_nb, *_faded(solution, t[-1], model)), rows


def _faded(solution: Solution, t: float, model: NoiseModel) -> tuple[Array, Array]:
    """Accelerometer and gyro biases of a solution at a later time."""
    mean, keep = model.bias_mean, np.exp(-model.decay * (t - solution.t))
    accel = mean[:3] + keep[0] * (solution.accel_bias - mean[:3])
    return accel, mean[3:] + keep[1] * (solution.gyro_bias - mean[3:])


def _carry(errors: Array, solution: Solution, after: Solution, samples: Samples, model: NoiseModel) -> Array:
    """The filter's fx: errors (P,15) at the end of the samples, each by the strapdown of what it makes of the solution."""
    t, gyro, accel = samples
    rows = np.empty((len(t), 3)), np.empty((len(t), 3)), np.empty((len(t), 4))
    moved = _moved(solution, errors)
    ends = np.empty((len(errors), 3)), np.empty((len(errors), 3)), np.empty((len(errors), 4))
    for k in range(len(errors)):
        start = (*moved.place[k], moved.v_n[k], moved.q_nb[k], moved.accel_bias[k], moved.gyro_bias[k])
        integrate(solution.t, t, gyro, accel, *start, *rows)
        for end, row in zip(ends, rows, strict=True):
            end[k] = row[-1]
    return _apart(Solution(float(t[-1]), *ends, *_faded(moved, t[-1], model)), after)


def _antenna(error: Array, solution: Solution, lever: Array, rate: Array) -> Array:
    """The filter's hx: position (m) and velocity of the antenna, relative to those of the solution's IMU."""
    if not lever.any():
        return error[:6]
    q = products(of_rotations(error[6:9]), solution.q_nb)
    arm = np.array(quat_rotate(q, lever))
    sweep = np.array(quat_rotate(q, np.cross(rate - solution.gyro_bias - error[12:], lever)))
    return np.concatenate([error[:3] + arm, error[3:6] + sweep])


def _predict(ukf: Any, solution: Solution, log: SensorLog, end: float, model: NoiseModel, keep: _Keep) -> Solution:
    """Carry filter and solution on to the time ``end``, and keep the solution's rows at the IMU samples on the way."""
    t, dt = log.imu.t, end - solution.t
    if dt < SAME_TIME:
        ukf.sigmas_f = ukf.points_fn.sigma_points(ukf.x, ukf.P)
        return solution
    first = int(np.searchsorted(t, solution.t + SAME_TIME))
    last = int(np.searchsorted(t, end - SAME_TIME))  # the sample whose interval holds the end
    part = slice(first, last + 1)
    samples = np.append(t[first:last], end), log.imu.gyro[part], log.imu.accel[part]
    after, rows = _integrated(solution, samples, model)
    ukf.Q = _process_noise(model.q, dt)
    ukf.predict(dt, solution=solution, after=after, samples=samples, model=model)
    keep.before(slice(first, last), rows, after, ukf.P)
    return after


def _process_noise(q: Array, dt: float) -> Array:
    """(15,15) of densities (12,) over ``dt``: white noise of the accelerometers is the same in n as in b, as its axes are alike."""
    noise = np.diag(np.concatenate([q[:3] * dt**3 / 3.0, q[:6] * dt, q[6:] * dt]))
    for i in range(3):
        noise[i, 3 + i] = noise[3 + i, i] = q[i] * dt**2 / 2.0
    return noise


def _update(ukf: Any, solution: Solution, log: SensorLog, fix: int) -> None:
    gnss = require_gnss(log, FilterpyUkf.name)
    place = position_difference(gnss.lat[fix], gnss.lon[fix], gnss.h[fix], *solution.place)
    seen = np.concatenate([place, gnss.v_n[fix] - solution.v_n])
    k = min(int(np.searchsorted(log.imu.t, solution.t - SAME_TIME)), len(log.imu.t) - 1)
    lever = np.array(gnss.spec.lever_arm_b, dtype=float)
    ukf.update(seen, R=fix_covariance(gnss, fix), solution=solution, lever=lever, rate=log.imu.gyro[k])


def _fold(ukf: Any, solution: Solution) -> Solution:
    """The solution with the filter's mean in it, which is zero afterwards."""
    moved = _moved(solution, ukf.x)
    ukf.x = np.zeros(15)
    ukf.P = 0.5 * (ukf.P + ukf.P.T)
    return moved._replace(q_nb=moved.q_nb / np.linalg.norm(moved.q_nb))


class _Keep:
    """What the answer is made of, filled from the start on."""

    def __init__(self, n: int) -> None:
        self.done = 0
        self.lla, self.v_n, self.q_nb, self.biases, self.std = (np.full((n, k), np.nan) for k in (3, 3, 4, 6, 15))
        self.snapshots: list[tuple[float, Array]] = []

    def before(self, part: slice, rows: tuple[Array, ...], after: Solution, p: Array) -> None:
        """IMU samples before the end of a prediction: the solution's rows, and biases and sigmas as predicted."""
        for kept, values in zip((self.lla, self.v_n, self.q_nb), rows, strict=True):
            kept[part] = values[: part.stop - part.start]
        self._sigmas(part, after, p)
        self.done = part.stop

    def end(self, solution: Solution, p: Array, log: SensorLog) -> None:
        """The filter's answer at the end of a prediction, where that is the time of an IMU sample."""
        t, k = log.imu.t, self.done
        if k >= len(t) or abs(t[k] - solution.t) > SAME_TIME:
            return
        self.lla[k], self.v_n[k], self.q_nb[k] = solution.place, solution.v_n, solution.q_nb
        self._sigmas(slice(k, k + 1), solution, p)
        self.done += 1
        if not self.snapshots or t[k] >= self.snapshots[-1][0] + 1.0 - SAME_TIME:
            self.snapshots.append((float(t[k]), p.copy()))

    def _sigmas(self, part: slice, solution: Solution, p: Array) -> None:
        self.biases[part] = np.concatenate([solution.accel_bias, solution.gyro_bias])
        self.std[part] = np.sqrt(np.diag(p))

    def solution(self, log: SensorLog) -> NavSolution:
        """The answer."""
        lat, lon, h = self.lla.T
        times, covariances = zip(*self.snapshots, strict=True)
        return NavSolution(
            log.imu.t,
            lat,
            wrap(lon),
            h,
            self.v_n,
            self.q_nb,
            accel_bias=self.biases[:, :3],
            gyro_bias=self.biases[:, 3:],
            std=self.std,
            covariance_t=np.array(times),
            covariance=np.array(covariances),
            states=STATE_NAMES,
        )
