"""`lkf9`: the INS runs free, a 9-state linear Kalman filter estimates its error, the estimate is subtracted (open loop).

Source: "Error Rate Reduction of a Low-Cost Integrated Navigation System Using Neural Networks" (2018); error model of
Titterton & Weston, 2nd ed., chapter 12. NED, SI units and radians; errors are INS minus truth.

It shares the time line, the update and the recording of `estimators.core`, and keeps a state of its own: the filter from
parts feeds its estimates back into the INS at every fix, which is what the paper's open loop is compared with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from estimators.methods.ins import Ins
from testbed.base.errors import InputError
from testbed.data.records import NAVIGATION_STATES, GnssFixes, Innovations, NavSolution, SensorLog
from testbed.physics import earth
from testbed.physics.rotations import quats_to_matrices

if TYPE_CHECKING:
    from estimators.core.recording import Recording

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FreeIns:
    """The uncorrected INS with its start in row 0: ``t`` (N+1,), ``lla`` (N+1,3), ``velocity`` (N+1,3), ``q_nb`` (N+1,4)."""

    t: Array
    lla: Array
    velocity: Array
    q_nb: Array

    def at(self, t: Array) -> tuple[Array, Array]:
        """Position (M,3) and velocity (M,3) at times ``t``, linear between samples."""
        lla = np.column_stack([np.interp(t, self.t, column) for column in self.lla.T])
        return lla, np.column_stack([np.interp(t, self.t, column) for column in self.velocity.T])

    def lever_arm(self, t: Array, lever: Array) -> tuple[Array, Array]:
        """The arm ``lever`` (3,) of the body in n at times ``t`` (M,3), m, and how fast its end moves (M,3), m/s.

        From the attitudes alone, as the paper's filter has the INS's outputs and no IMU: `estimators.aiding.gnss` takes the
        sweep from the gyro, which differs by what the Earth turns and by the sample's own noise (1e-4 m/s and more).
        """
        arm = quats_to_matrices(self.q_nb) @ lever
        sweep = np.gradient(arm, self.t, axis=0)
        return tuple(np.column_stack([np.interp(t, self.t, c) for c in x.T]) for x in (arm, sweep))  # type: ignore[return-value]


@dataclass(frozen=True)
class Measurements:
    """What the filter is fed, in time order.

    ``t`` (M,); ``value`` (M,6) INS minus GNSS: velocity NED (m/s), latitude, longitude (rad), height (m); ``std`` (M,6) in
    the same units; ``first`` (M,): 0 uses all rows, 3 only the position, 6 nothing.
    """

    t: Array
    value: Array
    std: Array
    first: NDArray[np.int64]


@dataclass(frozen=True)
class OpenLoop:
    """Parameters of the open-loop 9-state filter, which knows no biases: what they do looks like attitude noise to it."""

    process_noise: Literal["printed", "density"] = "printed"
    """``printed``: Qk = Phi G Q G' Phi' dt with the sample variances in Q, as the paper has it, which exceeds white noise
    of that size by the IMU rate. ``density``: Q holds the spectral densities of the data sheet."""
    gyro_noise_scale: float = 1.0
    """Factor on the gyros' standard deviation in Q."""
    accel_noise_scale: float = 1.0
    """Factor on the accelerometers' standard deviation in Q."""
    earth_radius_m: float = earth.A
    name: ClassVar[str] = "lkf9"
    parameter_space: ClassVar[dict[str, tuple[float, float, str]]] = {
        "gyro_noise_scale": (1e-3, 1e3, "log"),
        "accel_noise_scale": (1e-3, 1e3, "log"),
    }

    def __post_init__(self) -> None:
        if self.process_noise not in ("printed", "density"):
            raise InputError(f"{self.name}: process_noise is '{self.process_noise}', expected 'printed' or 'density'")
        for key in ("gyro_noise_scale", "accel_noise_scale", "earth_radius_m"):
            if not 0.0 < getattr(self, key) < np.inf:
                raise InputError(f"{self.name}: {key} is {getattr(self, key)}, expected a positive number")


@dataclass(frozen=True)
class Lkf9(OpenLoop):
    """The filter alone."""

    restart: bool = False
    """In an outage: False propagates the error estimate; True starts the INS anew at the last corrected state and lets it
    run free (the paper's *Update INS*). ``std`` is the filter's either way."""
    restores: Literal["all", "position-velocity"] = "all"
    """What a restart takes from the corrected state, which the paper does not say: ``position-velocity`` leaves the INS the
    attitude that it has. ``all``: a state is all of it."""

    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.restores not in ("all", "position-velocity"):
            raise InputError(f"{self.name}: restores is '{self.restores}', expected 'all' or 'position-velocity'")
        if self.restores != "all" and not self.restart:
            raise InputError(f"{self.name}: restores = '{self.restores}' needs restart = true")

    def run(self, log: SensorLog) -> NavSolution:
        """Corrected navigation at the IMU times."""
        ins = free_ins(log)
        solution = run_filter(self, log, ins, gnss_measurements(ins, fixes_of(log, self.name)))
        if not self.restart:
            return solution
        return _restarted(log, solution, self.name, None if self.restores == "all" else ins.q_nb[1:])


def fixes_of(log: SensorLog, name: str) -> GnssFixes:
    """The log's GNSS fixes. Raises InputError when it has no receiver."""
    if log.gnss is None:
        raise InputError(f"{name}: the log has no GNSS, which this method needs")
    return log.gnss


def free_ins(log: SensorLog) -> FreeIns:
    """Run the INS from the initial state to the end without any correction."""
    start, solution = log.initial, Ins().run(log)
    return FreeIns(
        np.concatenate([[start.t], solution.t]),
        np.vstack([[start.lat, start.lon, start.h], np.column_stack([solution.lat, solution.lon, solution.h])]),
        np.vstack([start.v_n, solution.v_n]),
        np.vstack([start.q_nb, solution.q_nb]),
    )


def gnss_measurements(ins: FreeIns, gnss: GnssFixes) -> Measurements:
    """z = INS minus GNSS at every fix within the INS's time, with the receiver's standard deviations.

    A lever arm carries the INS to the antenna, as far as its attitude can be trusted.
    """
    t = gnss.t - gnss.spec.latency_s
    inside = (t > ins.t[0]) & (t <= ins.t[-1])
    lla, velocity = ins.at(t[inside])
    place = lla - np.column_stack([gnss.lat, gnss.lon, gnss.h])[inside]
    place[:, 1] = np.mod(place[:, 1] + np.pi, 2.0 * np.pi) - np.pi
    std = gnss.measurement_std()[inside]
    north, east = earth.metres_per_radian(lla[:, 0], lla[:, 2])
    if any(gnss.spec.lever_arm_b):
        arm, sweep = ins.lever_arm(t[inside], np.array(gnss.spec.lever_arm_b))
        velocity += sweep
        place += arm / np.column_stack([north, east, -np.ones(len(arm))])
    std = np.column_stack([std[:, 3:], std[:, 0] / north, std[:, 1] / east, std[:, 2]])
    value = np.hstack([velocity - gnss.v_n[inside], place])
    return Measurements(t[inside], value, std, np.zeros(int(inside.sum()), dtype=np.int64))


def run_filter(settings: OpenLoop, log: SensorLog, ins: FreeIns, fed: Measurements) -> NavSolution:
    """Run the kernel and subtract its estimates from the INS. Innovations are those of the log's own fixes only."""
    from estimators.core.recording import empty_recording
    from estimators.core.timeline import make_timeline, walk
    from estimators.methods import lkf9_kernels

    imu, radius = log.imu, settings.earth_radius_m
    rate = imu.spec.rate_hz if settings.process_noise == "printed" else 1.0
    noise = np.array(
        [
            rate * (settings.accel_noise_scale * imu.spec.accel.white_noise) ** 2,
            rate * (settings.gyro_noise_scale * imu.spec.gyro.white_noise) ** 2,
        ]
    )
    scale = np.array([1.0, 1.0, 1.0, radius, radius, 1.0])
    every = max(1, round(imu.spec.rate_hz))
    sizes = lkf9_kernels.N_STATES, lkf9_kernels.N_STATES, lkf9_kernels.N_ROWS
    kept = empty_recording(len(imu.t), len(fed.t), sizes, every)
    rows = lkf9_kernels.FreeRows(imu.accel, ins.lla, ins.velocity, ins.q_nb)
    differences = lkf9_kernels.Differences(fed.value * scale, (fed.std * scale) ** 2, fed.first)
    p = initial_covariance(log, radius)
    line = make_timeline(ins.t[0], ins.t[1:], fed.t)
    walk(line, lkf9_kernels.make_filter(rows, differences, noise, radius, p, kept), len(imu.t))
    snapshots = np.arange(every - 1, len(imu.t), every)
    return corrected(
        ins, kept.state, radius,
        std=_bench_sigmas(kept.std, ins.lla[1:, 0]),
        covariance_t=imu.t[snapshots],
        covariance=_bench_covariance(kept.covariance, ins.lla[snapshots + 1, 0]),
        innovations={"gnss": _innovations(ins, fixes_of(log, settings.name), fed, kept)},
        states=NAVIGATION_STATES,
    )  # fmt: skip


def _innovations(ins: FreeIns, gnss: GnssFixes, fed: Measurements, kept: Recording) -> Innovations:
    """Those of the receiver's fixes and of nothing that stands in for them, position first, in metres NED."""
    full = (fed.first == 0) & np.isin(fed.t, gnss.t - gnss.spec.latency_s)
    order = [3, 4, 5, 0, 1, 2]
    metres = np.ones((int(full.sum()), 6))
    metres[:, 4] = np.cos(np.interp(fed.t[full], ins.t, ins.lla[:, 0]))
    metres[:, 5] = -1.0
    covariance = kept.innovation_covariance[full] * metres[:, :, None] * metres[:, None, :]
    return Innovations(fed.t[full], (kept.innovation[full] * metres)[:, order], covariance[:, order][:, :, order])


def initial_covariance(log: SensorLog, radius: float) -> Array:
    """P0 (9,9) in the kernel's units from the initial state's standard deviations."""
    std = log.initial.std
    north, east = earth.metres_per_radian(log.initial.lat, log.initial.h)
    return np.diag(np.concatenate([std[6:9], std[3:6], [std[0] * radius / north, std[1] * radius / east, std[2]]]) ** 2)


def corrected(ins: FreeIns, x: Array, radius: float, **rest: object) -> NavSolution:
    """The INS rows minus the error estimates ``x`` (N,9) of the kernel; ``rest`` goes into the solution."""
    from estimators.methods.lkf9_kernels import correct_attitudes

    return NavSolution(
        ins.t[1:],
        ins.lla[1:, 0] - x[:, 6] / radius,
        ins.lla[1:, 1] - x[:, 7] / radius,
        ins.lla[1:, 2] - x[:, 8],
        ins.velocity[1:] - x[:, 3:6],
        correct_attitudes(ins.q_nb[1:], x),
        **rest,  # type: ignore[arg-type]
    )


def _restarted(log: SensorLog, solution: NavSolution, name: str, attitude: Array | None) -> NavSolution:
    """The solution with a free INS in every gap of the fixes, from the last state that a fix corrected.

    Its attitude is that of the row in ``attitude`` (N,4), where that is given.
    """
    from estimators.core.strapdown import integrate
    from estimators.methods.update_ins import outage_rows

    imu, start = log.imu, log.initial
    lla = np.column_stack([solution.lat, solution.lon, solution.h])
    v_n, q_nb = solution.v_n.copy(), solution.q_nb.copy()
    for first, last in outage_rows(log, 1.5 / fixes_of(log, name).spec.rate_hz, name):
        rows, turned = slice(first + 1, last), q_nb[first] if attitude is None else attitude[first]
        integrate(
            imu.t[first], imu.t[rows], imu.gyro[rows], imu.accel[rows],
            lla[first, 0], lla[first, 1], lla[first, 2], v_n[first], turned,
            np.asarray(start.accel_bias, float), np.asarray(start.gyro_bias, float), lla[rows], v_n[rows], q_nb[rows],
        )  # fmt: skip
    return replace(solution, lat=lla[:, 0], lon=lla[:, 1], h=lla[:, 2], v_n=v_n, q_nb=q_nb)


def _bench_sigmas(sigma: Array, lat: Array) -> Array:
    """Sigmas (N,9) in the kernel's order and units to those of the bench (position NED, velocity, attitude)."""
    place = sigma[:, 6:9].copy()
    place[:, 1] *= np.cos(lat)
    return np.hstack([place, sigma[:, 3:6], sigma[:, :3]])


def _bench_covariance(covariance: Array, lat: Array) -> Array:
    """Covariances (K,9,9) in the kernel's order and units to those of the bench: metres NED, attitude phi = -psi."""
    turn = np.zeros((len(lat), 9, 9))
    turn[:, 0, 6], turn[:, 1, 7], turn[:, 2, 8] = 1.0, np.cos(lat), -1.0
    for i in range(3):
        turn[:, 3 + i, 3 + i], turn[:, 6 + i, i] = 1.0, -1.0
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))
