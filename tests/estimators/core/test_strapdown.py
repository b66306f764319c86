"""Strapdown mechanization: a perfect IMU returns to the truth, and python-ins agrees on the same increments."""

import numpy as np
import pytest
from analytic_flight import analytic_flight

from estimators.methods.ins import Ins
from testbed.data.records import ImuSamples, InitialState, SensorLog
from testbed.physics import earth
from testbed.physics.rotations import attitude_errors, quat_rotate_inverse


def perfect_log(flight):
    zero = np.zeros(3)
    start = InitialState(
        flight.t[0], flight.lat[0], flight.lon[0], flight.h[0], flight.v_n[0], flight.q_nb[0], zero, zero, np.zeros(15)
    )
    return SensorLog(ImuSamples(flight.t[1:], flight.w_ib_b[1:], flight.f_b[1:]), start)


def position_errors(solution, flight):
    return np.column_stack(
        earth.position_difference(solution.lat, solution.lon, solution.h, flight.lat[1:], flight.lon[1:], flight.h[1:])
    )


@pytest.mark.parametrize(("lat_deg", "lon_deg"), [(45.0, 10.0), (-60.0, -120.0), (0.0, 0.0)])
def test_perfect_imu_returns_to_the_truth(lat_deg, lon_deg):
    """300 s at 100 Hz, up to 7 g and 45 °/s. The bounds are a fifth of what the bench promises (0.1 m, 0.5 m)."""
    flight = analytic_flight(300.0, 100.0, lat_deg, lon_deg)
    solution = Ins().run(perfect_log(flight))
    error = np.abs(position_errors(solution, flight)).max(axis=0)
    assert max(error[0], error[1]) < 0.02
    assert error[2] < 0.02
    assert np.abs(solution.v_n - flight.v_n[1:]).max() < 1e-3
    assert np.abs(attitude_errors(solution.q_nb, flight.q_nb[1:])).max() < 1e-5


def test_halving_the_step_divides_the_error_by_at_least_four():
    """Global order two or better: the corrections must not spoil the order of the trapezoid rule."""
    error = []
    for rate in (50.0, 100.0):
        flight = analytic_flight(100.0, rate)
        error.append(np.linalg.norm(position_errors(Ins().run(perfect_log(flight)), flight)[-1]))
    assert error[1] < error[0] / 3.9


def test_resting_imu_stays_put():
    """Earth rate and gravity alone: what is left after 600 s is rounding of 60,000 steps."""
    flight = analytic_flight(600.0, 100.0, vigour=0.0)
    solution = Ins().run(perfect_log(flight))
    assert np.abs(position_errors(solution, flight)[-1]).max() < 1e-4


def test_constant_bias_grows_as_half_t_squared():
    """A level accelerometer 1 cm/s² wrong is half b t² off: 18 m after 60 s, less Schuler's (w t)²/12 = 0.05 %."""
    flight = analytic_flight(60.0, 100.0, vigour=0.0)
    log = perfect_log(flight)
    log.imu.accel[:, 0] += 0.01
    error = position_errors(Ins().run(log), flight)[-1]
    assert error[0] == pytest.approx(18.0, rel=2e-3)
    assert abs(error[1]) < 0.1


def test_same_increments_through_python_ins():
    """python-ins' Integrator on our compensated increments, 60 s of hard manoeuvres: millimetres.

    Its gravity stops at first order in height: our accelerometer is given the difference along the truth. Its Coriolis
    acceleration is taken at the step's start, which is 2 Omega dt/2 (v - v_start) = 0.13 mm/s at most (170 m/s), 7 mm in
    60 s if it never changed sign.
    """
    pytest.importorskip("pyins")
    import pandas as pd
    from pyins import _numba_integrate, strapdown

    from estimators.core.strapdown import compensate, coning_sculling
    from testbed.physics.rotations import quats_to_eulers

    flight = analytic_flight(60.0, 100.0, alt_m=500.0)
    log = perfect_log(flight)
    rows, zero = [], (0.0, 0.0, 0.0)
    before = (zero, zero)
    for k, dt in enumerate(np.diff(flight.t)):
        angle, dv = tuple(log.imu.gyro[k] * dt), tuple(log.imu.accel[k] * dt)
        rows.append([dt, *np.ravel(compensate(angle, dv, *coning_sculling(angle, dv, *before)))])
        before = (angle, dv)
    names = ["dt", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"]
    increments = pd.DataFrame(rows, index=flight.t[1:], columns=names)

    ours = perfect_log(flight)
    for k in range(len(ours.imu.t)):
        lat, h = flight.lat[k], 0.5 * (flight.h[k] + flight.h[k + 1])
        difference = (0.0, 0.0, earth.gravity(lat, h) - _numba_integrate.gravity(np.degrees(lat), h))
        ours.imu.accel[k] -= quat_rotate_inverse(flight.q_nb[k], difference)
    solution = Ins().run(ours)

    start = [np.degrees(flight.lat[0]), np.degrees(flight.lon[0]), flight.h[0], *flight.v_n[0]]
    start += list(np.degrees(quats_to_eulers(flight.q_nb[:1])[0]))
    pva = pd.Series(start, index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"], name=flight.t[0])
    theirs = strapdown.Integrator(pva).integrate(increments).iloc[1:]
    difference = np.column_stack(
        earth.position_difference(
            solution.lat,
            solution.lon,
            solution.h,
            np.radians(theirs.lat.to_numpy()),
            np.radians(theirs.lon.to_numpy()),
            theirs.alt.to_numpy(),
        )
    )
    assert np.abs(difference).max() < 0.005
