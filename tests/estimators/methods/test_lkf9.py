"""The open-loop 9-state filter: its matrix against a numerical derivative, its covariance against the closed loop."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import sensor_log, weaving_flight

from estimators.methods import lkf9_kernels
from estimators.methods.indirect_kf import IndirectKf
from estimators.methods.ins import Ins
from estimators.methods.lkf9 import FreeIns, Lkf9, gnss_measurements
from testbed.base.errors import InputError
from testbed.data.records import GnssFixes, SensorLog
from testbed.data.specs import GnssSpec
from testbed.physics import earth
from testbed.physics.interpolate import point_state
from testbed.physics.rotations import attitude_errors

R = 6371000.0
STEPS = np.array([1e-4] * 3 + [1e-1] * 3 + [1e-4, 1e-4, 10.0])
SCALE = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, R, R, 1.0])


@pytest.fixture(scope="module")
def flight():
    return weaving_flight()


def derivative(lat, h, v, c_nb, f_b, w_ib_b):
    """Mechanization on a sphere of radius R + h (Titterton & Weston, eq. 3.27 to 3.34): rates of C, v, lat, lon, h.

    Gravity is g0 R²/(R+h)², all that a height error does to it.
    """
    vn, ve, vd = v
    sine, cosine = np.sin(lat), np.cos(lat)
    w_ie = earth.RATE * np.array([cosine, 0.0, -sine])
    w_en = np.array([ve, -vn, -ve * sine / cosine]) / (R + h)
    gravity = np.array([0.0, 0.0, earth.GRAVITY_EQUATOR * (R / (R + h)) ** 2])
    c_rate = c_nb @ skew(w_ib_b) - skew(w_ie + w_en) @ c_nb
    v_rate = c_nb @ f_b - np.cross(2.0 * w_ie + w_en, v) + gravity
    return c_rate, v_rate, np.array([vn / (R + h), ve / ((R + h) * cosine), -vd])


def skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def numerical_error_matrix(lat, v, c_nb, f_b, w_ib_b):
    """Central differences of the mechanization about a state, in the filter's coordinates (C_ins = (I - [psi x]) C).

    psi' follows from d/dt of C_ins C' at psi: -[psi' x] = C_ins' C' + C_ins C'' (first order, antisymmetric part).
    """
    rate0 = derivative(lat, 0.0, v, c_nb, f_b, w_ib_b)[0]
    out = np.empty((9, 9))
    for j in range(9):
        sides = []
        for sign in (1.0, -1.0):
            x = np.zeros(9)
            x[j] = sign * STEPS[j]
            # exp(-[psi x]) to second order: what is left cancels in the central difference or is below 1e-12
            turn = np.eye(3) - skew(x[:3]) + 0.5 * skew(x[:3]) @ skew(x[:3])
            c_ins = turn @ c_nb
            c_rate, v_rate, p_rate = derivative(lat + x[6], x[8], v + x[3:6], c_ins, f_b, w_ib_b)
            spin = c_rate @ c_nb.T + c_ins @ rate0.T
            sides.append(np.concatenate([-0.5 * np.array([spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]]), v_rate, p_rate]))  # fmt: skip
        out[:, j] = (sides[0] - sides[1]) / (2.0 * STEPS[j])
    return out


def test_error_matrix_is_the_derivative_of_the_mechanization():
    """Every entry, at three states of a hard-manoeuvring aircraft.

    Central differences: relative truncation of the step squared, at most (1e-4 rad)² = 1e-8 times some tens; rounding
    is a few 1e-16 of the rate (1 rad/s, 100 m/s², 1e-4 rad/s, 400 m/s) over the step.
    """
    rng = np.random.default_rng(0)
    for lat in (-0.9, 0.2, 0.95):
        v, f_b, w = 200.0 * rng.standard_normal(3), 40.0 * rng.standard_normal(3), 0.5 * rng.standard_normal(3)
        q = rng.standard_normal((3, 3))
        c_nb = np.linalg.qr(q)[0]
        c_nb *= np.sign(np.linalg.det(c_nb))
        ours = np.empty((9, 9))
        lkf9_kernels.error_matrix(lat, v, c_nb @ f_b, R, ours)
        printed_units = ours / SCALE[:, None] * SCALE[None, :]
        expected = numerical_error_matrix(lat, v, c_nb, f_b, w)
        floor = 2e-15 * np.array([1.0] * 3 + [100.0] * 3 + [1e-4, 1e-4, 400.0])[:, None] / STEPS[None, :]
        assert np.all(np.abs(printed_units - expected) <= 1e-6 * np.abs(expected) + floor)


def run_errors(flight, solution):
    place = earth.position_difference(
        solution.lat, solution.lon, solution.h, flight.lat[1:], flight.lon[1:], flight.h[1:]
    )
    return np.column_stack([*place, solution.v_n - flight.v_n[1:], attitude_errors(solution.q_nb, flight.q_nb[1:])])


def test_open_loop_is_consistent_with_white_noise(flight):
    """With what it models, its normalised error squared averages 9.

    Over 12 seeds and 3 well separated times the mean of a chi-square of 9 has a standard deviation of √(18/36) = 0.7.
    """
    nees = []
    for seed in range(12):
        solution = Lkf9(process_noise="density").run(sensor_log(flight, seed))
        errors = run_errors(flight, solution)
        for second in (50, 100, 149):
            p = solution.covariance[second][:9, :9]
            e = errors[np.searchsorted(solution.t, solution.covariance_t[second] - 1e-9)]
            nees.append(e @ np.linalg.solve(p, e))
    assert np.mean(nees) == pytest.approx(9.0, abs=3 * 0.71)


def test_printed_process_noise_is_too_large_by_the_imu_rate(flight):
    """Qk with sample variances times dt: with 100 Hz the attitude's covariance grows 100 times as fast."""
    log = sensor_log(flight, std=(1e-6, 1e-6, 1e-9))
    blind = SensorLog(log.imu, log.initial, type(log.gnss)(*(a[:0] for a in (log.gnss.t, log.gnss.lat, log.gnss.lon, log.gnss.h, log.gnss.v_n)), log.gnss.spec))  # fmt: skip
    grown = [Lkf9(process_noise=kind).run(blind).covariance[99, 8, 8] for kind in ("printed", "density")]
    assert grown[0] / grown[1] == pytest.approx(100.0, rel=0.02)


def test_innovations_are_white_with_the_filters_covariance(flight):
    """1500 innovations per channel: their normalised variance is 1 within 4√(2/1500), their lag-1 correlation 4/√1500."""
    solution = Lkf9(process_noise="density").run(sensor_log(flight, 3))
    sigma = np.sqrt(np.einsum("kii->ki", solution.innovations["gnss"].covariance))
    normalised = solution.innovations["gnss"].value / sigma
    assert np.all(np.abs(normalised.var(axis=0) - 1.0) < 4.0 * np.sqrt(2.0 / 1500))
    lagged = np.mean(normalised[1:] * normalised[:-1], axis=0)
    assert np.all(np.abs(lagged) < 4.0 / np.sqrt(1500))


def test_open_and_closed_loop_agree_for_small_errors(flight):
    """Same noise, no biases: the covariances differ by what the models differ in, sphere against ellipsoid (0.5 %) and
    first against second order in dt (1 % of attitude into velocity at 1 rad/s). The estimates agree within a small part
    of their own sigma, but the sphere costs the open loop its share of the whole error of the free INS, not of the rest.
    """
    log = sensor_log(flight, 5, std=(10.0, 0.2, 0.001))
    open_loop, closed, free = Lkf9(process_noise="density").run(log), IndirectKf().run(log), Ins().run(log)
    for row in (2000, 8000, 14900):
        ratio = open_loop.std[row, :9] / closed.std[row, :9]
        assert np.all(np.abs(ratio - 1.0) < 0.03), ratio
        difference = run_errors(flight, open_loop)[row] - run_errors(flight, closed)[row]
        sphere = 0.005 * np.abs(run_errors(flight, free)[row])
        assert np.all(np.abs(difference) < 0.1 * closed.std[row, :9] + sphere)


def test_perfect_sensors_stay_on_truth(flight):
    """Without errors the free INS is the truth and the filter has nothing to subtract but GNSS noise it is told of."""
    log = sensor_log(flight, 0, accel_noise=0.0, gyro_noise=0.0, std=(1e-6, 1e-6, 1e-9))
    errors = run_errors(flight, Lkf9().run(log))
    assert np.abs(errors[:, :3]).max() < 1e-3 and np.abs(errors[:, 3:6]).max() < 1e-4


def test_parameters_out_of_range_are_refused():
    with pytest.raises(InputError, match="process_noise"):
        Lkf9(process_noise="white")
    with pytest.raises(InputError, match="gyro_noise_scale"):
        Lkf9(gyro_noise_scale=0.0)


def test_a_lever_arm_is_taken_off_the_difference_to_the_fixes(flight):
    """An INS that is right and an antenna two metres off: nothing is left of the arm but interpolation, 1 % of it."""
    lever = np.array([1.5, -0.8, -1.2])
    times = np.arange(1.0, 100.0, 0.5)
    fixes = GnssFixes(times, *point_state(flight, times, lever), GnssSpec(lever_arm_b=tuple(lever)))
    lla = np.column_stack([flight.lat, flight.lon, flight.h])
    z = gnss_measurements(FreeIns(flight.t, lla, flight.v_n, flight.q_nb), fixes).value
    north, east = earth.metres_per_radian(fixes.lat, fixes.h)
    place, velocity = z[:, 3:] * np.column_stack([north, east, np.ones(len(times))]), z[:, :3]
    assert np.abs(place).max() < 0.01 * np.linalg.norm(lever)
    swing = np.linalg.norm(flight.w_ib_b, axis=1).max() * np.linalg.norm(lever)
    assert np.abs(velocity).max() < 0.01 * swing
