"""`filterpy-ukf`: a loosely coupled INS/GNSS filter on the unscented Kalman filter of the package ``filterpy`` (R. Labbe), as a peer.

The package filters; what is filtered is written here. The state is the error (15,) of a strapdown solution: position (m), velocity
and rotation vector in n, then accelerometer and gyro bias; each sigma point is a strapdown of its own over the interval between
two predictions, and after each the mean goes into the solution (Crassidis, *IEEE Trans. AES* 42(2), 2006, in its structure). Noise,
biases and initial state are those of `indirect-kf`; needs the optional extra ``peers``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

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


@dataclass
class Solution:
    """Where the strapdown solution stands, overwritten: radians, metres, m/s, b to n, and its biases."""

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
            _predict(ukf, solution, log, end, model, keep)
            if fix < len(fix_t) and abs(fix_t[fix] - end) < SAME_TIME:
                _update(ukf, solution, log, fix)
                fix += 1
            _fold(ukf, solution)
            keep.filtered(solution, ukf.P, log)
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
    return Solution(s.t, place, s.v_n.copy(), s.q_nb.copy(), s.accel_bias.copy(), s.gyro_bias.copy())


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


def _predict(ukf: Any, solution: Solution, log: SensorLog, end: float, model: NoiseModel, keep: _Keep) -> None:
    """Carry filter and solution on to the time ``end``, and keep the solution's rows at the IMU samples on the way."""
    t, dt = log.imu.t, end - solution.t
    if dt < SAME_TIME:
        ukf.sigmas_f = ukf.points_fn.sigma_points(ukf.x, ukf.P)
        return
    first = int(np.searchsorted(t, solution.t + SAME_TIME))
    last = int(np.searchsorted(t, end - SAME_TIME))  # the sample whose interval holds the end
    part = slice(first, last + 1)
    samples = np.append(t[first:last], end), log.imu.gyro[part], log.imu.accel[part]
    after, rows = _integrated(solution, samples, model)
    ukf.Q = _process_noise(model.q, dt)
    ukf.predict(dt, solution=solution, after=after, samples=samples, model=model)
    solution.__dict__.update(after.__dict__)
    keep.rows(slice(first, last), rows, last - first)


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


def _fold(ukf: Any, solution: Solution) -> None:
    """Put the filter's mean into the solution, and leave it at zero."""
    solution.__dict__.update(_moved(solution, ukf.x).__dict__)
    solution.q_nb /= np.linalg.norm(solution.q_nb)
    ukf.x = np.zeros(15)
    ukf.P = 0.5 * (ukf.P + ukf.P.T)


class _Keep:
    """What the answer is made of, filled from the start on; sigmas are those of the last prediction or fix."""

    def __init__(self, n: int) -> None:
        self.done, self.known = 0, 0
        self.lla, self.v_n, self.q_nb = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
        self.biases, self.std = np.empty((n, 6)), np.empty((n, 15))
        self.snapshots: list[tuple[float, Array]] = []

    def rows(self, part: slice, rows: Any, count: int) -> None:
        """Rows of the solution at IMU samples that lie before the end of a prediction."""
        for kept, values in zip((self.lla, self.v_n, self.q_nb), rows, strict=True):
            kept[part] = values[:count]
        self.done = part.stop

    def filtered(self, solution: Solution, p: Array, log: SensorLog) -> None:
        """The filter's answer at the end of a prediction, which may be that of an IMU sample."""
        t = log.imu.t
        if self.done < len(t) and abs(t[self.done] - solution.t) < SAME_TIME:
            self.lla[self.done], self.v_n[self.done], self.q_nb[self.done] = solution.place, solution.v_n, solution.q_nb
            self.done += 1
            if not self.snapshots or solution.t >= self.snapshots[-1][0] + 1.0 - SAME_TIME:
                self.snapshots.append((float(t[self.done - 1]), p.copy()))
        part = slice(self.known, self.done)
        self.biases[part] = np.concatenate([solution.accel_bias, solution.gyro_bias])
        self.std[part] = np.sqrt(np.diag(p))
        self.known = self.done

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
