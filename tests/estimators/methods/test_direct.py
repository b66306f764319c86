"""Direct (total-state) filters: Jacobians, linear equivalence, consistency, faults, and fixes off the IMU grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimators.methods import direct_kernels, motion_models, ukf_kernels
from estimators.methods.direct import DirectEkf, Rstekf, Stekf
from estimators.methods.direct_ukf import DirectUkf
from estimators.methods.indirect_kf import IndirectKf
from estimators.methods.motion_models import MODELS, Motion, Setting, Step
from testbed.base.errors import InputError
from testbed.data.records import NavSolution, SensorLog, Trajectory
from testbed.physics.earth import metres_per_radian, position_difference
from testbed.physics.rotations import attitude_errors, quats_to_matrices, wrap
from tests.phased_flight import phased_flight, with_accel_fault, with_biases
from tests.synthetic import sensor_log, weaving_flight

LEVEL = (0.9, 500.0)


def a_setting(lever: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Setting:
    place = np.array([*LEVEL, *metres_per_radian(*LEVEL)])
    return Setting(place, np.array([0.1, 0.2, -0.1, 1e-3, 2e-3, -1e-3]), np.array([0.01, 0.02]), np.array(lever))


def a_state(rng: np.random.Generator) -> np.ndarray:
    scale = np.repeat([1e3, 150.0, 0.8, 0.3, 0.01], 3)
    return scale * rng.uniform(-1.0, 1.0, 15)


def errors(solution: NavSolution, truth: Trajectory) -> np.ndarray:
    """(N,9) position (m), velocity (m/s) and attitude (rad) errors in n."""
    reference = (truth.lat[1:], truth.lon[1:], truth.h[1:])
    position = np.column_stack(position_difference(solution.lat, solution.lon, solution.h, *reference))
    attitude = attitude_errors(solution.q_nb, truth.q_nb[1:])
    return np.column_stack([position, solution.v_n - truth.v_n[1:], attitude])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


@pytest.mark.parametrize("model", MODELS)
def test_transition_is_the_jacobian_of_the_motion(model: str) -> None:
    # Phi = I + F dt leaves out F² dt² / 2 and the turning of F within the step (at most 4 rad/s here, which mixes the
    # elements of a 3 x 3 block): each element may differ by dt² (|F| |F| + 4 max |F| of its block). A latitude in
    # float64 is good to 1e-9 m, which the difference quotient magnifies.
    rng, dt, held = np.random.default_rng(1), 1e-3, np.array([0.3, -0.2, 0.1])
    steps = np.repeat([10.0, 1.0, 1e-4, 1e-3, 1e-4], 3)
    motion = Motion(MODELS[model], a_setting(), np.zeros(13), held)
    for _ in range(20):
        x, imu = a_state(rng), np.concatenate([rng.uniform(-1.0, 1.0, 3), rng.uniform(-20.0, 20.0, 3)])
        phi, numeric, step = np.zeros((15, 15)), np.zeros((15, 15)), Step(imu, np.zeros(6), dt)
        motion_models.transition(motion, x, step, phi)
        for j in range(15):
            ends = np.empty((2, 15))
            for row, sign in zip(ends, (1.0, -1.0), strict=True):
                moved = x.copy()
                moved[j] += sign * steps[j]
                motion_models.advance(motion, moved, step, row)
            difference = ends[0] - ends[1]
            difference[6:9] = wrap(difference[6:9])
            numeric[:, j] = difference / (2.0 * steps[j])
        f = np.abs(phi - np.eye(15)) / dt
        block = np.kron(f.reshape(5, 3, 5, 3).max(axis=(1, 3)), np.ones((3, 3)))
        allowed = dt * dt * (f @ f + 4.0 * block) + 2e-9
        allowed[:3] += 1e-9 / steps
        worst = np.unravel_index(np.argmax(np.abs(numeric - phi) - allowed), phi.shape)
        assert abs(numeric[worst] - phi[worst]) <= allowed[worst], worst


def test_antenna_sensitivity_is_the_jacobian_of_the_antenna() -> None:
    # Left out: the attitude in w_ie x arm, 7e-5 rad/s times 1.7 m.
    rng, setting = np.random.default_rng(2), a_setting((1.5, -0.7, 0.4))
    steps = np.repeat([1.0, 1.0, 1e-5, 1.0, 1e-3], 3)
    for _ in range(10):
        x, imu = a_state(rng), rng.uniform(-1.0, 1.0, 6)
        h, ends = np.zeros((6, 15)), np.empty((2, 6))
        direct_kernels.antenna_sensitivity(x, imu, setting, h)
        for j in range(15):
            for row, sign in zip(ends, (1.0, -1.0), strict=True):
                moved = x.copy()
                moved[j] += sign * steps[j]
                direct_kernels.antenna(moved, imu, setting, row)
            np.testing.assert_allclose(h[:, j], (ends[0] - ends[1]) / (2.0 * steps[j]), atol=1.5e-4)


def test_unscented_filter_equals_kalman_filter_on_a_linear_problem() -> None:
    rng, n, m = np.random.default_rng(3), 15, 6
    root = rng.standard_normal((n, n))
    x, p = rng.standard_normal(n), root @ root.T
    transition, sensitivity = rng.standard_normal((n, n)), rng.standard_normal((m, n))
    r, z = rng.uniform(0.5, 2.0, m), rng.standard_normal(m)
    for alpha, beta, kappa in ((1.0, 0.0, 0.0), (0.5, 2.0, 1.0)):
        width, weights = ukf_kernels.make_spread(n, alpha, beta, kappa)
        points, factor = np.empty((2 * n + 1, n)), np.empty((n, n))
        mean, covariance = np.empty(n), np.empty((n, n))
        ukf_kernels.sigma_points(x, p, width, factor, points)
        ukf_kernels.unscented_moments(points @ transition.T, weights, 0, 0, mean, covariance)
        wanted = transition @ p @ transition.T
        np.testing.assert_allclose(mean, transition @ x, atol=1e-11)
        np.testing.assert_allclose(covariance, wanted, atol=1e-11 * np.abs(wanted).max())

        work, predicted = direct_kernels.make_work(), np.empty(m)
        s = work.s.reshape(m, m)
        ukf_kernels.sigma_points(x, p, width, factor, points)
        readings = points @ sensitivity.T
        ukf_kernels.unscented_moments(readings, weights, 0, 0, predicted, s)
        s += np.diag(r)
        work.residual[:] = z - predicted
        by_ukf, p_ukf = x.copy(), p.copy()
        theta = ukf_kernels.unscented_correct(by_ukf, p_ukf, points - x, readings, weights, work)
        innovation, wanted_s = z - sensitivity @ x, sensitivity @ p @ sensitivity.T + np.diag(r)
        gain = np.linalg.solve(wanted_s, sensitivity @ p).T
        np.testing.assert_allclose(s, wanted_s, atol=1e-11 * np.abs(wanted_s).max())
        np.testing.assert_allclose(by_ukf, x + gain @ innovation, atol=1e-10)
        np.testing.assert_allclose(p_ukf, p - gain @ sensitivity @ p, atol=1e-11 * np.abs(p).max())
        assert theta == pytest.approx(innovation @ np.linalg.solve(wanted_s, innovation), rel=1e-9)


def test_unscented_mean_of_angles_is_on_the_circle() -> None:
    width, weights = ukf_kernels.make_spread(1, 1.0, 0.0, 0.0)
    points, factor = np.empty((3, 1)), np.empty((1, 1))
    mean, covariance = np.empty(1), np.empty((1, 1))
    ukf_kernels.sigma_points(np.array([np.pi - 0.01]), np.array([[0.04]]), width, factor, points)
    ukf_kernels.unscented_moments(wrap(points), weights, 0, 1, mean, covariance)
    assert wrap(mean[0] - np.pi + 0.01) == pytest.approx(0.0, abs=1e-12)
    assert covariance[0, 0] == pytest.approx(0.04, abs=1e-12)


@pytest.fixture(scope="module")
def flight() -> Trajectory:
    return weaving_flight(60.0, bank=0.7)


@pytest.fixture(scope="module")
def log(flight: Trajectory) -> SensorLog:
    raw = sensor_log(flight, 1, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, std=(3.0, 0.1, 0.02))
    return with_biases(raw, accel=0.1, gyro=1e-3)


@pytest.mark.parametrize("estimator", [DirectEkf(), DirectUkf()])
def test_total_state_and_error_state_filters_agree(estimator, flight: Trajectory, log: SensorLog) -> None:
    # Same model, same noise: they may differ by second-order terms of 1° errors, a small part of their own sigma.
    ours, theirs = estimator.run(log), IndirectKf().run(log)
    difference = errors(ours, flight) - errors(theirs, flight)
    late = ours.t > 20.0
    assert np.median(np.abs(difference[late]) / theirs.std[late, :9]) < 0.1
    np.testing.assert_allclose(ours.std[late], theirs.std[late], rtol=0.1)


@pytest.mark.parametrize("estimator", [DirectEkf(), DirectUkf()])
def test_errors_are_what_the_covariance_says(estimator) -> None:
    # Run-averaged NEES of 9 states over 20 runs, at times 5 s apart: chi-square(180)/20, so 99.9 % within 9 ± 3.2.
    truth = weaving_flight(60.0, bank=0.7)
    rows = np.arange(1999, 6000, 500)
    total = np.zeros(len(rows))
    for seed in range(20):
        raw = sensor_log(truth, seed, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, std=(3.0, 0.1, 0.02))
        solution = estimator.run(raw)
        e = errors(solution, truth)
        at = np.searchsorted(solution.covariance_t, solution.t[rows])
        for i, (k, s) in enumerate(zip(rows, at, strict=True)):
            total[i] += e[k] @ np.linalg.solve(solution.covariance[s, :9, :9], e[k])
    assert (np.abs(total / 20 - 9.0) < 3.2).mean() > 0.9
    assert abs(total.mean() / 20 - 9.0) < 1.5


def test_innovations_are_white_with_their_covariance(log: SensorLog) -> None:
    innovations = DirectEkf().run(log).innovations["gnss"]
    nis = np.einsum("ki,kij,kj->k", innovations.value, np.linalg.inv(innovations.covariance), innovations.value)
    assert abs(nis.mean() - 6.0) < 4.0 * np.sqrt(12.0 / len(nis))
    # The test statistic exceeds its 5 % threshold at 5 % of the fixes: binomial, four sigma.
    assert abs((nis > 12.592).mean() - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 / len(nis))


def test_fix_between_samples_counts_at_its_own_time() -> None:
    # 3 ms off the grid at 150 m/s is 0.45 m; exact sensors leave 1 mm of interpolation.
    truth = weaving_flight(20.0)
    exact = sensor_log(
        truth, 0, accel_noise=1e-4, gyro_noise=1e-6, gnss_rate=5.0, position_sigma=1e-3, velocity_sigma=1e-3
    )
    from scipy.interpolate import CubicHermiteSpline

    t = exact.gnss.t[:-1] + 0.003
    rates = np.column_stack([truth.v_n[:, 0], truth.v_n[:, 1], -truth.v_n[:, 2]])
    north, east = metres_per_radian(truth.lat, truth.h)
    rates[:, 0] /= north
    rates[:, 1] /= east
    lla = CubicHermiteSpline(truth.t, np.column_stack([truth.lat, truth.lon, truth.h]), rates)(t)
    v_n = np.column_stack([np.interp(t, truth.t, truth.v_n[:, i]) for i in range(3)])
    shifted = replace(exact, gnss=replace(exact.gnss, t=t, lat=lla[:, 0], lon=lla[:, 1], h=lla[:, 2], v_n=v_n))
    for estimator in (DirectEkf(), DirectUkf()):
        solution = estimator.run(shifted)
        assert np.abs(solution.innovations["gnss"].value[50:, :3]).max() < 0.02
        assert np.abs(errors(solution, truth)[1000:, :3]).max() < 0.02


@pytest.mark.parametrize("estimator", [DirectEkf(), DirectUkf()])
def test_lever_arm_is_removed(estimator) -> None:
    # A 3 m arm at 40° bank and up to 0.2 rad/s: left out, it would leave metres.
    truth = weaving_flight(30.0, bank=0.7)
    lever = np.array([2.0, 0.5, -2.0])
    clean = sensor_log(
        truth, 0, accel_noise=1e-3, gyro_noise=1e-5, gnss_rate=5.0, position_sigma=0.01, velocity_sigma=0.01
    )
    rows = np.searchsorted(truth.t, clean.gnss.t)
    c = quats_to_matrices(truth.q_nb[rows])
    arm, swing = c @ lever, np.einsum("kij,kj->ki", c, np.cross(truth.w_ib_b[rows], lever))
    north, east = metres_per_radian(truth.lat[rows], truth.h[rows])
    gnss = replace(
        clean.gnss,
        lat=clean.gnss.lat + arm[:, 0] / north,
        lon=clean.gnss.lon + arm[:, 1] / east,
        h=clean.gnss.h - arm[:, 2],
        v_n=clean.gnss.v_n + swing,
        spec=replace(clean.gnss.spec, lever_arm_b=tuple(lever)),
    )
    assert rms(errors(estimator.run(replace(clean, gnss=gnss)), truth)[1000:, :3]) < 0.03


def test_date_line_changes_nothing() -> None:
    # The same log moved in longitude until the flight crosses 180° gives the same answer, moved.
    truth = weaving_flight(30.0)
    plain = sensor_log(truth, 4, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, std=(1.0, 0.1, 0.01))
    half = 0.5 * (truth.lon[0] + truth.lon[-1])
    shift = np.pi - half
    gnss = replace(plain.gnss, lon=wrap(plain.gnss.lon + shift))
    moved = replace(plain, gnss=gnss, initial=replace(plain.initial, lon=float(wrap(plain.initial.lon + shift))))
    assert gnss.lon.min() < 0.0 < gnss.lon.max()
    for estimator in (DirectEkf(), DirectUkf()):
        a, b = estimator.run(plain), estimator.run(moved)
        np.testing.assert_allclose(wrap(b.lon - a.lon - shift), 0.0, atol=1e-11)
        np.testing.assert_allclose(b.v_n, a.v_n, atol=1e-6)


def test_refined_strong_tracking_that_never_fires_is_the_plain_filter(log: SensorLog) -> None:
    plain, refined = DirectEkf().run(log), Rstekf(significance=0.0).run(log)
    assert (refined.extras["fading_factor"][1] == 1.0).all()
    np.testing.assert_array_equal(refined.lat, plain.lat)
    np.testing.assert_array_equal(refined.std, plain.std)


def recovery_s(solution: NavSolution, truth: Trajectory, end: float, limit: float) -> float:
    """Seconds after ``end`` until the velocity error stays below ``limit`` (m/s) for good."""
    wrong = ~(np.linalg.norm(errors(solution, truth)[:, 3:6], axis=1) <= limit)
    wrong &= solution.t > end
    return float(solution.t[np.flatnonzero(wrong)[-1]] - end) if wrong.any() else 0.0


@pytest.mark.parametrize(("end", "size", "limit"), [(40.1, 100.0, 0.5), (80.0, 1.0, 0.5)], ids=["jump", "bias step"])
def test_strong_tracking_recovers_faster_from_a_fault(end: float, size: float, limit: float) -> None:
    # A velocity jump of 10 m/s in 0.1 s, and a bias step of 0.1 g against an expected drift of 1e-4 g.
    truth = phased_flight((("cv", 80.0, 0.0, 0.0),))
    times = {"ekf": [], "stekf": [], "rstekf": []}
    for seed in range(5):
        raw = sensor_log(truth, seed, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, std=(3.0, 0.1, 0.01))
        faulty = with_accel_fault(with_biases(raw, accel=0.1, gyro=1e-3), 40.0, end, size)
        for key, estimator in (("ekf", DirectEkf()), ("stekf", Stekf()), ("rstekf", Rstekf())):
            times[key].append(recovery_s(estimator.run(faulty), truth, 40.1, limit))
    assert np.mean(times["stekf"]) < 0.5 * np.mean(times["ekf"])
    assert np.mean(times["rstekf"]) < 0.5 * np.mean(times["ekf"])


def test_refinement_pays_less_for_false_alarms_than_strong_tracking() -> None:
    # Without a fault every fading is a false alarm: all fixes may fade in `stekf`, 5 % (binomial, four sigma) do in
    # `rstekf`, none do at alpha = 1e-9, which then costs nothing.
    truth = weaving_flight(60.0, bank=0.7)
    errors_of = {"ekf": [], "stekf": [], "rstekf": [], "strict": []}
    for seed in range(6):
        raw = sensor_log(truth, seed, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, std=(3.0, 0.1, 0.02))
        filters = {"ekf": DirectEkf(), "stekf": Stekf(), "rstekf": Rstekf(), "strict": Rstekf(significance=1e-9)}
        for key, estimator in filters.items():
            errors_of[key].append(rms(errors(estimator.run(raw), truth)[2000:, 3:6]))
    mean = {key: np.mean(values) for key, values in errors_of.items()}
    assert mean["ekf"] < mean["rstekf"] < mean["stekf"]
    assert mean["strict"] == pytest.approx(mean["ekf"], rel=1e-9)


def test_fading_stops_where_nothing_is_known_any_more() -> None:
    # Yaw is unobservable in straight flight: 400 fixes that fade by 1.3 each would take its sigma to 1e20 degrees.
    truth = phased_flight((("cv", 80.0, 0.0, 0.0),))
    raw = sensor_log(truth, 0, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, std=(3.0, 0.1, 0.01))
    solution = Stekf().run(with_biases(raw, accel=0.1, gyro=1e-3))
    assert np.isfinite(solution.std).all()
    assert np.degrees(solution.std[:, 8].max()) < 1000.0


@pytest.mark.parametrize("raw", [False, True])
def test_the_fading_factor_is_the_papers(raw: bool) -> None:
    """From what is recorded: Y_k = (rho Y + v v') / (1 + rho), L = tr(N (Y - R)) / tr(N H P H'), N = R^-1 or, raw, 1.

    The recorded innovation covariance is L H P H' + R, in metres of its own latitude; the filter's are of the first, off by 1e-6
    on this flight: of the 9 m² of R, that is 1e-3 of the least H P H'.
    """
    truth = weaving_flight(30.0, bank=0.7)
    log = sensor_log(truth, 3, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, std=(3.0, 0.1, 0.02))
    solution = Stekf(raw_trace=raw).run(log)
    (_, fading), seen = solution.extras["fading_factor"], solution.innovations["gnss"]
    r = np.repeat([9.0, 0.01], 3)
    weight = np.ones(6) if raw else 1.0 / r
    expected, y = [], None
    for value, s, factor in zip(seen.value, seen.covariance, fading, strict=True):
        y = value**2 if y is None else (0.95 * y + value**2) / 1.95
        expected.append(max(1.0, weight @ (y - r) / (weight @ (np.diag(s) - r) / factor)))
    assert (fading > 1.0).sum() > 10
    np.testing.assert_allclose(fading, expected, rtol=2e-3)


def test_the_ceiling_of_fading_is_a_parameter() -> None:
    """Straight flight, whose yaw is faded to its ceiling: 180°, or a tenth of it, and the 3°/s · 0.2 s of gyro bias between fixes."""
    truth = phased_flight((("cv", 80.0, 0.0, 0.0),))
    raw = sensor_log(truth, 0, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, std=(3.0, 0.1, 0.01))
    faulty = with_biases(raw, accel=0.1, gyro=1e-3)
    yaw = [np.degrees(Stekf(ceiling_scale=scale).run(faulty).std[:, 8].max()) for scale in (1.0, 0.1)]
    assert yaw[0] > 150.0 and 15.0 < yaw[1] < 30.0
    with pytest.raises(InputError, match="ceiling_scale"):
        Stekf(ceiling_scale=0.0)


def test_bad_parameters_and_logs_are_refused(log: SensorLog) -> None:
    with pytest.raises(InputError, match="significance"):
        Rstekf(significance=1.5)
    with pytest.raises(InputError, match="accel_noise_scale"):
        DirectUkf(accel_noise_scale=float("nan"))
    with pytest.raises(InputError, match="GNSS"):
        DirectEkf().run(replace(log, gnss=None))
