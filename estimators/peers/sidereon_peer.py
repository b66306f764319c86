"""`sidereon-ekf`: the loosely coupled extended Kalman filter of the package ``sidereon`` (Rust), as a peer.

Fed with the specifications, initial state and fixes of `indirect-kf`; needs the optional extra ``oracles``. Its navigation frame is
ECEF, and so are its error states; everything is turned at this edge. A fix between two IMU samples is taken at its own time: the
sample is cut in two there. Its biases are Gauss-Markov processes about zero, so those of the start are taken off the samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from estimators.aiding.gnss import require_gnss
from estimators.blocks.imu import noise_model
from estimators.peers.loose_fixes import fix_covariance, initial_std
from testbed.base.errors import MissingExtra
from testbed.data.records import STATE_NAMES, NavSolution, SensorLog
from testbed.physics.ecef import directions, to_ecef, to_geodetic
from testbed.physics.rotations import quat_to_matrix

Array = NDArray[np.float64]

SAME_TIME = 1e-7
"""Times (s) closer than this are one."""
LEAST_DECAY = 1e-9
"""1/s, of a bias that does not return to anything: no log lasts as long as its correlation time of thirty years."""
LEAST_DENSITY = 1e-24
"""Of white noise, and of a bias that nothing drives, SI² / s: the package wants numbers above zero, and this makes 3e-10 in a day."""
SATELLITES = 9
"""The fixes do not say of how many satellites they are; the package refuses fewer than four."""
SIGMAS_S = 0.1
"""How often the covariance is read, s: no sigma changes by more than a few percent in it, but at a fix, after which it is read."""
SNAPSHOT_S = 1.0


@dataclass(frozen=True)
class SidereonEkf:
    """15 states, position and velocity fixes, the package's own options: no gate, no reweighting, no coning correction."""

    name: ClassVar[str] = "sidereon-ekf"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError without GNSS fixes or without the package."""
        package = _package()
        gnss, imu, s = require_gnss(log, self.name), log.imu, log.initial
        ekf, keep = _filter(package, log), _Keep(len(imu.t))
        measurement = _measurements(package, log)
        fix_t = gnss.t - gnss.spec.latency_s
        fix, now = int(np.searchsorted(fix_t, s.t - SAME_TIME)), s.t
        accel, gyro = imu.accel - s.accel_bias, imu.gyro - s.gyro_bias
        for k, t in enumerate(imu.t):
            fixed = False
            while fix < len(fix_t) and fix_t[fix] <= t + SAME_TIME:
                now = _advance(package, ekf, now, min(fix_t[fix], t), accel[k], gyro[k])
                ekf = _corrected(package, ekf, measurement(fix, now))
                fix, fixed = fix + 1, True
            now = _advance(package, ekf, now, t, accel[k], gyro[k])
            keep.row(k, t, ekf.state, fixed)
        return keep.solution(log)


def _package() -> Any:
    try:
        import sidereon
    except ImportError:
        raise MissingExtra(
            "the peer sidereon-ekf needs the package sidereon: pip install 'navigation-testbed[oracles]'"
        ) from None
    return sidereon


def _filter(package: Any, log: SensorLog) -> Any:
    """The filter at the start of the log."""
    s, q = log.initial, noise_model(log)
    c_en = directions(np.array([s.lat]), np.array([s.lon]))[0].T
    attitude = c_en @ np.array(quat_to_matrix(s.q_nb))
    state = package.NavState(s.t, to_ecef(*np.array([[s.lat], [s.lon], [s.h]]))[0], c_en @ s.v_n, attitude)
    turn = _turn(c_en)
    p = turn @ np.diag(initial_std(log) ** 2) @ turn.T
    # Gauss-Markov of drive q and inverse time d: sigma² = q / (2 d)
    decay, drive = np.maximum(q.decay, LEAST_DECAY), np.maximum(q.q[[6, 9]], LEAST_DENSITY)
    sigma = np.sqrt(drive / (2.0 * decay))
    spec = package.ImuSpec(*np.sqrt(np.maximum(q.q[[0, 3]], LEAST_DENSITY)), *sigma, *(1.0 / decay))
    filtered = package.InsFilterState.from_covariance(state, package.ErrorStateLayout.FIFTEEN, p)
    lever = [float(x) for x in require_gnss(log, SidereonEkf.name).spec.lever_arm_b]
    loose = package.LooseCouplingConfig(lever_arm_body_m=lever)
    config = package.InertialFilterConfig(spec, package.FusionFilterKind.EKF, loose=loose)
    return package.InertialFilter.with_config(filtered, config)


def _turn(c: Array) -> Array:
    """(15,15): position, velocity and attitude errors through a matrix, biases as they are."""
    turn = np.eye(15)
    for first in (0, 3, 6):
        turn[first : first + 3, first : first + 3] = c
    return turn


def _measurements(package: Any, log: SensorLog) -> Any:
    """``made(fix, now)``: the package's measurement of a fix, with its covariance turned to e, to be taken at the time ``now``."""
    gnss = require_gnss(log, SidereonEkf.name)
    places = to_ecef(gnss.lat, gnss.lon, gnss.h)
    c_en = np.swapaxes(directions(gnss.lat, gnss.lon), 1, 2)

    def made(fix: int, now: float) -> Any:
        turn = _turn(c_en[fix])[:6, :6]
        covariance = turn @ fix_covariance(gnss, fix) @ turn.T
        covariance = 0.5 * (covariance + covariance.T)
        v_e = c_en[fix] @ gnss.v_n[fix]
        return package.GnssFixMeasurement.position_velocity(now, places[fix], v_e, covariance, SATELLITES)

    return made


def _corrected(package: Any, ekf: Any, measurement: Any) -> Any:
    """The filter after a fix, its gyro bias corrected the other way round than the package does it.

    Version 3.0.4 subtracts the bias from the rate, and its covariance has the correlations that go with that, but the correction
    of the bias has the wrong sign: at rest, with a bias of 0.001 rad/s that it does not know, the estimate runs to -0.003 rad/s
    in 5 s and away from there. Everything else of the update is as it should be, so the correction is turned round here.
    """
    before = np.array(ekf.state.nominal.gyro_bias_rps)
    ekf.update_loose(measurement)
    state = ekf.state
    turned = 2.0 * before - np.array(state.nominal.gyro_bias_rps)
    nominal = state.nominal.with_biases(state.nominal.accel_bias_mps2, turned)
    mended = package.InsFilterState.from_covariance(nominal, state.layout, state.covariance)
    return package.InertialFilter.with_config(mended, ekf.config)


def _advance(package: Any, ekf: Any, now: float, until: float, accel: Array, gyro: Array) -> float:
    """Carry the filter on with one sample's means; the time that it is at then."""
    if until - now < SAME_TIME:
        return now
    ekf.propagate(package.ImuSample.rate(until, accel, gyro))
    return until


class _Keep:
    """What the answer is made of, in e."""

    def __init__(self, n: int) -> None:
        self.place, self.v_e, self.c_eb = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3, 3))
        self.biases = np.empty((n, 6))
        self.read: list[tuple[float, Array]] = []

    def row(self, k: int, t: float, state: Any, fixed: bool) -> None:
        """The filter's state at IMU sample ``k``."""
        nominal = state.nominal
        self.place[k], self.v_e[k] = nominal.position_ecef_m, nominal.velocity_ecef_mps
        self.c_eb[k] = nominal.attitude_body_to_ecef
        self.biases[k, :3], self.biases[k, 3:] = nominal.accel_bias_mps2, nominal.gyro_bias_rps
        if fixed or not self.read or t >= self.read[-1][0] + SIGMAS_S - SAME_TIME:
            self.read.append((float(t), np.array(state.covariance)))

    def solution(self, log: SensorLog) -> NavSolution:
        """The answer, in n."""
        from scipy.spatial.transform import Rotation

        t, s = log.imu.t, log.initial
        lat, lon, h = to_geodetic(self.place)
        c_ne = directions(lat, lon)
        read_t = np.array([at for at, _ in self.read])
        rows = np.searchsorted(t, read_t - SAME_TIME)
        p = np.array([_turn(c) @ p @ _turn(c).T for c, (_, p) in zip(c_ne[rows], self.read, strict=True)])
        latest = np.searchsorted(read_t, t + SAME_TIME) - 1
        whole = np.flatnonzero(np.diff(np.floor(read_t / SNAPSHOT_S + SAME_TIME), prepend=-1.0))
        return NavSolution(
            t,
            lat,
            lon,
            h,
            np.einsum("kij,kj->ki", c_ne, self.v_e),
            Rotation.from_matrix(c_ne @ self.c_eb).as_quat()[:, [3, 0, 1, 2]],
            accel_bias=self.biases[:, :3] + s.accel_bias,
            gyro_bias=self.biases[:, 3:] + s.gyro_bias,
            std=np.sqrt(np.diagonal(p, axis1=1, axis2=2))[latest],
            covariance_t=read_t[whole],
            covariance=p[whole],
            states=STATE_NAMES,
        )
