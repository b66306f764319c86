"""Metrics: known errors come back as their names say, angles wrap, and consistency tests follow their definition."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from testbed.data.records import STATE_NAMES, GnssFixes, Innovations, NavSolution, SensorErrors, Trajectory
from testbed.physics import earth, rotations
from testbed.scenario.windows import Window
from testbed.scoring import metrics, quantities

ALL = [Window("all", ((-1.0, 100.0),))]


@pytest.fixture
def truth() -> Trajectory:
    t = np.linspace(0.0, 100.0, 1001)
    n = len(t)
    lat, lon = 0.8 + 1e-6 * t, np.mod(np.pi - 2e-6 + 1e-7 * t + np.pi, 2 * np.pi) - np.pi  # crosses the date line
    yaw = rotations.wrap(np.pi - 0.01 + 0.001 * t)  # crosses south
    q = rotations.eulers_to_quats(np.column_stack([0.1 * np.sin(t), 0.05 * np.cos(t), yaw]))
    return Trajectory(t, lat, lon, 500 + 0 * t, np.tile([6.0, 1.0, 0.0], (n, 1)), q, np.zeros((n, 3)), np.zeros((n, 3)))


def displaced(
    truth: Trajectory, ned=(0.0, 0.0, 0.0), dv=(0.0, 0.0, 0.0), euler_deg=(0.0, 0.0, 0.0), **more
) -> NavSolution:
    """Truth plus errors; each may be a constant or a series."""
    k = slice(1, None)
    north, east = earth.metres_per_radian(truth.lat, truth.h)
    lon = rotations.wrap(truth.lon + ned[1] / east)
    euler = rotations.quats_to_eulers(truth.q_nb) + np.radians(euler_deg)
    v_n = truth.v_n + np.column_stack([np.broadcast_to(d, truth.t.shape) for d in dv])
    place = (truth.lat + ned[0] / north, lon, truth.h - ned[2])
    return NavSolution(truth.t[k], *(np.asarray(x)[k] for x in (*place, v_n, rotations.eulers_to_quats(euler))), **more)


def table(*args, **kwargs) -> dict[tuple[str, str], float]:
    frame = metrics.score(*args, **kwargs)
    return {(w, m): v for w, m, v in frame.itertuples(index=False)}


def test_constant_errors_come_back(truth):
    found = table(truth, displaced(truth, (3.0, -4.0, 12.0), (0.1, -0.2, 0.2), (1.0, -2.0, 0.5)), ALL)
    expected = {
        **{
            "rmse_north_m": 3.0,
            "rmse_east_m": 4.0,
            "rmse_down_m": 12.0,
            "rmse_position_2d_m": 5.0,
            "rmse_position_3d_m": 13.0,
        },
        **{
            "mean_north_m": 3.0,
            "mean_east_m": -4.0,
            "mean_position_3d_m": 13.0,
            "final_east_m": 4.0,
            "max_east_m": 4.0,
        },
        **{
            "rmse_velocity_3d_mps": 0.3,
            "mean_v_east_mps": -0.2,
            "rmse_roll_deg": 1.0,
            "mean_pitch_deg": -2.0,
            "rmse_yaw_deg": 0.5,
        },
    }
    for name, value in expected.items():
        assert found["all", name] == pytest.approx(value, rel=1e-6), name


def test_attitude_error_is_the_rotation_angle(truth):
    found = table(truth, displaced(truth, euler_deg=(0.0, 0.0, 2.0)), ALL)
    assert found["all", "rmse_attitude_deg"] == pytest.approx(2.0, rel=1e-6)
    assert found["all", "max_yaw_deg"] < 2.1  # though yaw crosses 180°


def test_every_name_of_the_list_is_in_the_table(truth):
    innovations = Innovations(truth.t[1:], np.ones((1000, 2)), np.tile(np.eye(2), (1000, 1, 1)))
    std = np.ones((1000, 15))
    snapshots = {"covariance_t": truth.t[1:], "covariance": np.tile(np.eye(15), (1000, 1, 1))}
    biases = {"accel_bias": np.zeros((1000, 3)), "gyro_bias": np.zeros((1000, 3))}
    solution = displaced(truth, **snapshots, **biases, std=std, innovations=innovations, states=STATE_NAMES)
    fixes = GnssFixes(truth.t[5::5], truth.lat[5::5], truth.lon[5::5], truth.h[5::5], truth.v_n[5::5])
    errors = SensorErrors(truth.t[1:], np.zeros((1000, 3)), np.zeros((1000, 3)))
    names = {name for _, name in table(truth, solution, ALL, errors, fixes)}
    assert names == set(quantities.metric_names()) - {"diverged"}


def test_windows_score_their_own_samples(truth):
    ramp = 0.1 * truth.t
    windows = [
        Window("late", ((50.0, 100.0),)),
        Window("two", ((10.0, 20.0), (30.0, 40.0))),
        Window("outside", ((200.0, 210.0),)),
    ]
    found = table(truth, displaced(truth, (ramp, 0.0, 0.0)), windows)
    assert found["late", "max_north_m"] == pytest.approx(10.0)
    assert found["late", "mean_north_m"] == pytest.approx(7.505, rel=1e-6)  # (start, end]: 50.1 to 100 s
    assert found["two", "max_north_m"] == pytest.approx(4.0)
    assert found["two", "final_north_m"] == pytest.approx(np.sqrt((2.0**2 + 4.0**2) / 2), rel=1e-6)
    assert not any(window == "outside" for window, _ in found)


def test_solution_on_another_grid_meets_interpolated_truth(truth):
    pytest.importorskip("testbed.physics.interpolate")
    full = displaced(truth, (2.0, 0.0, 0.0))
    between = 0.5 * (full.t[:-1] + full.t[1:])
    middle = {k: 0.5 * (getattr(full, k)[:-1] + getattr(full, k)[1:]) for k in ("lat", "h", "v_n", "q_nb")}
    lon = rotations.wrap(0.5 * (np.unwrap(full.lon)[:-1] + np.unwrap(full.lon)[1:]))
    found = table(truth, NavSolution(between, middle["lat"], lon, middle["h"], middle["v_n"], middle["q_nb"]), ALL)
    assert found["all", "rmse_north_m"] == pytest.approx(2.0, abs=0.02)  # curvature of the path over 0.1 s


def test_nees_and_nis_follow_their_definition(truth):
    n = 1000
    variance = np.concatenate([[4.0, 9.0, 16.0], np.full(12, 1.0)])
    covariance = np.tile(np.diag(variance), (n, 1, 1))
    nu = np.tile([1.0, 2.0], (n, 1))
    nu[::2, 1] = np.nan  # a channel without a measurement does not count
    innovations = Innovations(truth.t[1:], nu, np.tile(np.diag([1.0, 4.0]), (n, 1, 1)))
    biases = {"accel_bias": np.full((n, 3), 2.0), "gyro_bias": np.zeros((n, 3))}
    solution = displaced(
        *(truth, (2.0, 3.0, 4.0)),
        covariance_t=truth.t[1:],
        covariance=covariance,
        innovations=innovations,
        **biases,
        states=STATE_NAMES,
    )
    errors = SensorErrors(truth.t[1:], np.full((n, 3), 1.0), np.zeros((n, 3)))
    found = table(truth, solution, ALL, errors)
    assert found["all", "nees_position"] == pytest.approx(3.0, rel=1e-5)
    assert found["all", "nees_bias"] == pytest.approx(3.0)
    assert found["all", "nis"] == pytest.approx(1.5)
    series = metrics.error_series(truth, solution)
    assert set(metrics.consistency(series, solution)["nis"].dof) == {1.0, 2.0}


def test_a_filter_is_scored_on_the_states_that_it_names(truth):
    """Attitude and gyro bias alone, in an order of its own: 2 degrees about down of sigma 1 degree, 3 sigma of one bias axis."""
    n = 1000
    names = ("gyro_bias_z_radps", "mag_bias_x_ut", "attitude_down_rad", "attitude_east_rad", "attitude_north_rad")
    sigma = np.array([1e-3, 5.0, np.radians(1.0), np.radians(1.0), np.radians(1.0)])
    solution = displaced(
        truth,
        (1e6, 0.0, 0.0),
        euler_deg=(0.0, 0.0, 2.0),
        covariance_t=truth.t[1:],
        covariance=np.tile(np.diag(sigma**2), (n, 1, 1)),
        std=np.tile(sigma, (n, 1)),
        gyro_bias=np.tile([0.0, 0.0, 3e-3], (n, 1)),
        states=names,
    )
    errors = SensorErrors(truth.t[1:], np.zeros((n, 3)), np.zeros((n, 3)))
    fixes = GnssFixes(truth.t[5::5], truth.lat[5::5], truth.lon[5::5], truth.h[5::5], truth.v_n[5::5])
    found = table(truth, solution, ALL, errors, fixes)
    quantity = {name.partition("_")[2] for _, name in found if not name.startswith("nees")}
    assert quantity == {"roll_deg", "pitch_deg", "yaw_deg", "attitude_deg", "heading_deg", "inclination_deg"}
    assert {name for _, name in found if name.startswith("nees")} == {"nees_attitude", "nees_bias"}
    assert found["all", "nees_attitude"] == pytest.approx(4.0, rel=1e-4)
    assert found["all", "nees_bias"] == pytest.approx(9.0, rel=1e-9)
    series = metrics.error_series(truth, solution)
    assert set(metrics.consistency(series, solution, errors)["nees_bias"].dof) == {1.0}
    assert metrics.divergence(series, 10.0) == ""  # 1000 km off, of which it says nothing


def test_aidings_are_tested_together_and_apart_without_what_was_rejected(truth):
    """Two updates of 3 sigma and four of 1 sigma; the fifth, of 10 sigma, was rejected."""
    baro = Innovations(
        np.arange(1.0, 6.0),
        np.array([[2.0], [2.0], [2.0], [2.0], [20.0]]),
        np.full((5, 1, 1), 4.0),
        rejected=np.arange(5) == 4,
    )
    gnss = Innovations(np.array([2.5, 3.5]), np.full((2, 1), 3.0), np.ones((2, 1, 1)))
    found = table(truth, displaced(truth, innovations={"baro": baro, "gnss": gnss}), ALL)
    assert found["all", "nis_baro"] == pytest.approx(1.0) and found["all", "nis_gnss"] == pytest.approx(9.0)
    assert found["all", "nis"] == pytest.approx((4 * 1.0 + 2 * 9.0) / 6)


def test_gnss_metrics_are_taken_at_the_antenna_at_the_time_of_the_fix(truth):
    solution, lever = displaced(truth), np.array([1.0, 0.5, -2.0])
    rows = slice(100, 900, 20)
    spec = dataclasses.replace(
        GnssFixes.__dataclass_fields__["spec"].default_factory(), lever_arm_b=tuple(lever), latency_s=0.1
    )
    ned = rotations.quats_to_matrices(truth.q_nb[rows]) @ lever + [5.0, 0.0, 0.0]
    north, east = earth.metres_per_radian(truth.lat[rows], truth.h[rows])
    lon = rotations.wrap(truth.lon[rows] + ned[:, 1] / east)
    fixes = GnssFixes(
        truth.t[rows] + 0.1, truth.lat[rows] + ned[:, 0] / north, lon, truth.h[rows] - ned[:, 2], truth.v_n[rows], spec
    )
    found = table(truth, solution, ALL, gnss=fixes)
    assert found["all", "rmse_gnss_north_m"] == pytest.approx(5.0, abs=1e-4)
    assert found["all", "mean_gnss_north_m"] == pytest.approx(-5.0, abs=1e-4)
    assert found["all", "rmse_gnss_down_m"] == pytest.approx(0.0, abs=1e-4)


def test_divergence_says_what_and_when(truth):
    assert metrics.divergence(metrics.error_series(truth, displaced(truth)), 10.0) == ""
    lost = metrics.error_series(truth, displaced(truth, (0.2 * truth.t, 0.0, 0.0)))
    assert metrics.divergence(lost, 10.01) == "position off by more than 10.01 m from 50.1 s"
    solution = displaced(truth)
    solution.v_n[500:] = np.nan
    assert metrics.divergence(metrics.error_series(truth, solution), 10.0) == "not finite from 50.1 s"


def test_an_attitude_error_is_a_heading_and_an_inclination(truth):
    """Turned by 3° about a horizontal axis and then by -10° about down, the errors are 3° and 10°, wherever north is."""
    for axis in (0.0, 1.0, 2.5):
        tilt = rotations.rotvec_to_quat((np.radians(3.0) * np.cos(axis), np.radians(3.0) * np.sin(axis), 0.0))
        turn = rotations.quat_multiply(rotations.rotvec_to_quat((0.0, 0.0, np.radians(-10.0))), tilt)
        q = np.array([rotations.quat_multiply(turn, row) for row in truth.q_nb])
        solution = NavSolution(truth.t, truth.lat, truth.lon, truth.h, truth.v_n, q)
        found = metrics.score(truth, solution, ALL).set_index("metric")["value"]
        assert found["rmse_heading_deg"] == pytest.approx(10.0) and found["rmse_inclination_deg"] == pytest.approx(3.0)
