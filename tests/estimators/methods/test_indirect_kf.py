"""The indirect Kalman filter: its error model against differences of the strapdown, its consistency, its aids."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from analytic_flight import analytic_flight
from numba import njit
from scipy.stats import chi2

from estimators.blocks.imu import MEMORY, noise_model
from estimators.core import strapdown
from estimators.core.nav_errors import coefficients, nav_errors
from estimators.core.propagate import Coupling, add_noise, make_covariance, make_covariances, propagate
from estimators.core.update import innovation_covariance, update
from estimators.methods.indirect_kf import SCALES, IndirectKf
from estimators.methods.ins import Ins
from estimators.methods.update_ins import UpdateIns, outage_rows
from testbed.base.errors import InputError
from testbed.data.records import GnssFixes, ImuSamples, InitialState, SensorLog
from testbed.data.specs import GnssSpec, ImuSpec, TriadSpec
from testbed.kernels.lanes import WIDTH
from testbed.kernels.tables import spread
from testbed.physics import earth
from testbed.physics.rotations import (
    attitude_error,
    attitude_errors,
    matrix_rotate,
    quat_multiply,
    quat_to_matrix,
    quats_to_eulers,
    quats_to_matrices,
    rotvec_to_quat,
)

NAVEGO = Path(__file__).parents[4] / "shared" / "data" / "navego"
IMU = ImuSpec(
    rate_hz=100.0,
    gyro=TriadSpec(turn_on_bias=2e-3, bias_instability=2e-4, correlation_time_s=60.0, white_noise=5e-4),
    accel=TriadSpec(turn_on_bias=0.05, bias_instability=2e-3, correlation_time_s=60.0, white_noise=3e-3),
)
GNSS = GnssSpec(
    rate_hz=5.0,
    horizontal_sigma=2.0,
    vertical_sigma=4.0,
    velocity_sigma=0.1,
    lever_arm_b=(0.6, -0.3, -0.8),
    latency_s=0.0,
)
FIX_OFFSET_S = 0.0037
"""Fixes fall between IMU samples."""


def initial_std(imu=IMU):
    biases = [np.hypot(s.turn_on_bias, s.gauss_markov_sigma()) for s in (imu.accel, imu.gyro)]
    return np.repeat([2.0, 0.1, np.radians(1.0), *biases], 3)


@cache
def flight(duration_s=90.0):
    return analytic_flight(duration_s, 100.0, vigour=0.3)


@cache
def antenna(duration_s=90.0, rate_hz=5.0):
    """Times, place and velocity of the antenna, from the closed form itself."""
    from analytic_flight import _state

    t = np.arange(1.0 / rate_hz + FIX_OFFSET_S, duration_s - 0.01, 1.0 / rate_hz)
    lat, lon, h, v_n, euler, _, w_ib = _state(t, np.radians(45.0), np.radians(10.0), 1000.0, 0.3)
    from testbed.physics.rotations import eulers_to_quats

    c_nb, arm = quats_to_matrices(eulers_to_quats(euler)), np.array(GNSS.lever_arm_b)
    place, sweep = c_nb @ arm, np.einsum("kij,kj->ki", c_nb, np.cross(w_ib, arm))
    w_ie = np.column_stack(earth.earth_rate_n(lat))
    north, east = earth.metres_per_radian(lat, h)
    return t, lat + place[:, 0] / north, lon + place[:, 1] / east, h - place[:, 2], v_n + sweep - np.cross(w_ie, place)


def draw_bias(spec, n, dt, rng):
    keep = np.exp(-dt / spec.correlation_time_s)
    noise = rng.standard_normal((n, 3)) * spec.gauss_markov_sigma()
    noise[1:] *= np.sqrt(1.0 - keep**2)
    for k in range(1, n):
        noise[k] += keep * noise[k - 1]
    return rng.standard_normal(3) * spec.turn_on_bias + noise


def draw_log(seed, errors=1.0, std=None, gap=None):
    """A log of the flight and its true biases; ``errors`` scales all that is drawn, ``gap`` leaves fixes out."""
    rng, truth = np.random.default_rng(seed), flight()
    n, dt = len(truth.t) - 1, truth.dt
    accel_bias, gyro_bias = (errors * draw_bias(s, n, dt, rng) for s in (IMU.accel, IMU.gyro))
    white = errors * rng.standard_normal((n, 6)) / np.sqrt(dt)
    imu = ImuSamples(
        truth.t[1:],
        truth.w_ib_b[1:] + gyro_bias + IMU.gyro.white_noise * white[:, 3:],
        truth.f_b[1:] + accel_bias + IMU.accel.white_noise * white[:, :3],
        IMU,
    )
    t, lat, lon, h, v_n = antenna()
    m = errors * rng.standard_normal((len(t), 6)) * [2.0, 2.0, 4.0, 0.1, 0.1, 0.1]
    north, east = earth.metres_per_radian(lat, h)
    keep = np.ones(len(t), bool) if gap is None else (t < gap[0]) | (t > gap[1])
    fixes = (t, lat + m[:, 0] / north, lon + m[:, 1] / east, h - m[:, 2], v_n + m[:, 3:])
    gnss = GnssFixes(*(x[keep] for x in fixes), spec=GNSS)
    std = initial_std() if std is None else std
    e = errors * rng.standard_normal(15) * std
    north, east = earth.metres_per_radian(truth.lat[0], truth.h[0])
    q = np.array(quat_multiply(rotvec_to_quat(e[6:9]), truth.q_nb[0]))
    zero = np.zeros(3)
    place = (truth.lat[0] + e[0] / north, truth.lon[0] + e[1] / east, truth.h[0] - e[2])
    start = InitialState(0.0, *place, truth.v_n[0] + e[3:6], q, zero, zero, std)
    return SensorLog(imu, start, gnss, name="drawn"), accel_bias, gyro_bias


def state_errors(solution, truth, accel_bias, gyro_bias, rows):
    k = rows + 1
    place = earth.position_difference(
        solution.lat[rows], solution.lon[rows], solution.h[rows], truth.lat[k], truth.lon[k], truth.h[k]
    )
    return np.column_stack(
        [
            *place,
            solution.v_n[rows] - truth.v_n[k],
            attitude_errors(solution.q_nb[rows], truth.q_nb[k]),
            solution.accel_bias[rows] - accel_bias[rows],
            solution.gyro_bias[rows] - gyro_bias[rows],
        ]
    )


def strapdown_end(state, gyro, accel, dt, steps):
    """Integrate constant readings from a state displaced by 15 errors; returns lat, lon, h, v, q."""
    base, e = state
    north, east = earth.metres_per_radian(base[0], base[2])
    q = quat_multiply(rotvec_to_quat(e[6:9]), base[6])
    now = (base[0] + e[0] / north, base[1] + e[1] / east, base[2] - e[2], tuple(np.array(base[3:6]) + e[3:6]), q)
    angle, dv = tuple((gyro - e[12:15]) * dt), tuple((accel - e[9:12]) * dt)
    zero = (0.0, 0.0, 0.0)
    for _ in range(steps):
        *now, _ = strapdown.advance(*now, *strapdown.compensate(angle, dv, zero, zero), dt)
    return now


@njit
def nav_columns(phi, c, m, force, v_n, dt):
    """Nine rows of Phi (9,15) for three accelerometer and three gyro biases, column by column."""
    for j in range(15):
        e = np.zeros(15)
        e[j] = 1.0
        r, u, p = (e[0], e[1], e[2]), (e[3], e[4], e[5]), (e[6], e[7], e[8])
        accel, gyro = matrix_rotate(m, (e[9], e[10], e[11])), matrix_rotate(m, (e[12], e[13], e[14]))
        after = nav_errors((r, u, p), gyro, accel, (c, force, v_n), dt)
        for g in range(3):
            for i in range(3):
                phi[3 * g + i, j] = after[g][i]


def transition_matrix(lat, h, v_n, q_nb, force, keep, dt):
    phi = np.diag(np.concatenate([np.ones(9), keep]))
    nav_columns(phi, coefficients(lat, h, v_n), quat_to_matrix(q_nb), force, v_n, dt)
    return phi


def test_transition_matrix_is_the_derivative_of_the_strapdown():
    """Central differences of 100 steps, 0.5 s, at 250 m/s and 60° N, against the product of Phi.

    Both are of second order in dt = 5 ms, and |w| dt = 3e-3: relative agreement 1e-4 of each column's largest entry.
    """
    dt, steps = 0.005, 100
    gyro, accel = np.array([0.3, -0.2, 0.5]), np.array([4.0, -3.0, -12.0])
    q0 = tuple(rotvec_to_quat((0.4, -0.3, 1.2)))
    base = (1.05, 0.2, 3000.0, 150.0, -200.0, 20.0, q0)
    phi = np.eye(15)
    now = [1.05, 0.2, 3000.0, (150.0, -200.0, 20.0), q0]
    zero = (0.0, 0.0, 0.0)
    increments = strapdown.compensate(tuple(gyro * dt), tuple(accel * dt), zero, zero)
    for _ in range(steps):
        *after, force = strapdown.advance(*now, *increments, dt)
        middle = np.array(now[4]) + np.array(after[4])
        middle = tuple(middle / np.linalg.norm(middle))
        phi = transition_matrix(now[0], now[2], now[3], middle, force, np.ones(6), dt) @ phi
        now = after
    north, east = earth.metres_per_radian(now[0], now[2])
    for j, step in enumerate(np.repeat([50.0, 1.0, 1e-4, 1e-2, 1e-4], 3)):
        e = np.zeros(15)
        e[j] = step
        plus, minus = (strapdown_end((base, s * e), gyro, accel, dt, steps) for s in (1.0, -1.0))
        numeric = [(plus[0] - minus[0]) * north, (plus[1] - minus[1]) * east, minus[2] - plus[2]]
        numeric += list(np.array(plus[3]) - np.array(minus[3])) + list(attitude_error(plus[4], minus[4]))
        numeric = np.array(numeric) / (2.0 * step)
        scale = max(np.abs(numeric).max(), 1e-12)
        assert np.abs(numeric - phi[:9, j]).max() < 1e-4 * scale, j


@njit
def propagate_once(p, scratch, coupling, motion, dt):
    lat, h, force, v_n = motion
    propagate(p, scratch, coupling, (coefficients(lat, h, v_n), force, v_n), dt)


@pytest.mark.parametrize("side_by_side", [False, True])
def test_structured_propagation_is_phi_p_phi_t_plus_q(side_by_side):
    """Columns of P as lanes, and filters as lanes, against the product of dense matrices."""
    rng = np.random.default_rng(1)
    a = rng.standard_normal((15, 15))
    p = a @ a.T
    q_nb, v_n, force = tuple(rotvec_to_quat((0.3, 0.2, -1.0))), (40.0, -20.0, 3.0), (1.0, -2.0, -9.0)
    keep = np.repeat([0.99, 0.98], 3)
    phi = transition_matrix(0.7, 500.0, v_n, q_nb, force, keep, 0.01)
    expected = phi @ p @ phi.T
    m, zero = np.array(quat_to_matrix(q_nb)), np.zeros((3, 3))
    accel, gyro = np.vstack([m.T, zero]), np.vstack([zero, m.T])
    spans = np.array([0, 3, 3, 6])
    if side_by_side:
        table, scratch = make_covariances([p])
        propagate_once(
            table, scratch, Coupling(spans, spread(accel), spread(gyro), keep), (0.7, 500.0, force, v_n), 0.01
        )
        made = [table.array[..., lane] for lane in range(WIDTH)]
    else:
        padded, scratch = make_covariance(p)
        propagate_once(padded, scratch, Coupling(spans, accel, gyro, keep), (0.7, 500.0, force, v_n), 0.01)
        made = [padded[:, :15]]
    for result in made:
        np.testing.assert_allclose(result, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
        assert (result == result.T).all()


def test_process_noise_is_van_loan_to_third_order():
    """White acceleration noise of density q over dt: q dt of velocity, q dt²/2 between, q dt³/3 of position variance."""
    m, dt = quat_to_matrix(tuple(rotvec_to_quat((0.3, 0.2, -1.0)))), 0.01
    white, drive = np.random.default_rng(1).uniform(0.0, 1e-3, 6), np.random.default_rng(2).uniform(0.0, 1e-3, 6)
    noise = np.zeros((15, 15))
    add_noise(noise, m, white, drive, dt)
    c = np.array(m)
    accel, gyro = c @ np.diag(white[:3]) @ c.T * dt, c @ np.diag(white[3:]) @ c.T * dt
    zero = np.zeros((3, 3))
    expected = np.block(
        [[accel * dt**2 / 3.0, accel * dt / 2.0, zero], [accel * dt / 2.0, accel, zero], [zero, zero, gyro]]
    )
    np.testing.assert_allclose(noise[:9, :9], expected, rtol=1e-12, atol=1e-30)
    np.testing.assert_allclose(np.diag(noise)[9:], drive * dt)
    assert np.linalg.eigvalsh(noise).min() > -1e-18


def test_sequential_joseph_update_is_the_textbook_update():
    rng = np.random.default_rng(2)
    a = rng.standard_normal((15, 15))
    p, h, r = a @ a.T, rng.standard_normal((6, 15)), rng.uniform(0.1, 2.0, 6)
    h[:, rng.random(15) < 0.5] = 0.0
    residual, x, s, scalars = rng.standard_normal(6), np.zeros(15), np.empty((6, 6)), np.empty((6, 2))
    expected_s = h @ p @ h.T + np.diag(r)
    gain = p @ h.T @ np.linalg.inv(expected_s)
    expected_p = (np.eye(15) - gain @ h) @ p
    innovation_covariance(p, h, r, s, np.empty((4, 15)))
    update(x, p, residual, h, r, scalars, np.empty((4, 15)))
    np.testing.assert_allclose(s, expected_s, rtol=1e-12)
    np.testing.assert_allclose(x, gain @ residual, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(p, expected_p, rtol=1e-9, atol=1e-9)
    assert (p == p.T).all()
    deviance = np.linalg.slogdet(expected_s)[1] + residual @ np.linalg.solve(expected_s, residual)
    assert np.sum(np.log(scalars[:, 1]) + scalars[:, 0] ** 2 / scalars[:, 1]) == pytest.approx(deviance)


def test_perfect_sensors_leave_the_truth_alone():
    """Lever arm, its velocity and fixes between samples: a filter that starts right and is told no lie stays right.

    The split of an interval takes the rate as constant over 10 ms: 1/8 of 2 rad/s² x (0.01 s)² x 60 m/s is 1.5 mm/s.
    """
    log, *_ = draw_log(0, errors=0.0)
    solution, truth = IndirectKf().run(log), flight()
    innovation = np.abs(solution.innovations["gnss"].value).max(axis=0)
    assert innovation[:3].max() < 5e-3
    assert innovation[3:].max() < 5e-3
    assert np.abs(attitude_errors(solution.q_nb, truth.q_nb[1:])).max() < 1e-4


def test_consistency_over_runs():
    """NEES per state group and NIS over 40 runs in their 95 % chi-square bounds for 90 % of the time after 30 s.

    Neighbouring seconds are dependent: 60 s hold some six independent values of a slow state, and one in six outside
    of its bounds is chance. So 70 % is asked for here; a model wrong by 15 % in sigma would score below 50 %.
    """
    runs, groups = 40, (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 15))
    nees, nis = np.zeros((4, 90)), 0.0
    for seed in range(runs):
        log, accel_bias, gyro_bias = draw_log(seed)
        solution = IndirectKf().run(log)
        rows = np.searchsorted(solution.t, solution.covariance_t)
        error = state_errors(solution, flight(), accel_bias, gyro_bias, rows)
        for g, part in enumerate(groups):
            e, p = error[:, part], solution.covariance[:, part, part]
            nees[g] += np.einsum("ki,kij,kj->k", e, np.linalg.inv(p), e)
        nu = solution.innovations["gnss"]
        nis = nis + np.einsum("ki,kij,kj->k", nu.value, np.linalg.inv(nu.covariance), nu.value)
    shares = []
    for total, dof in [(nees[0], 3), (nees[1], 3), (nees[2], 3), (nees[3], 6), (nis, 6)]:
        low, high = chi2.ppf([0.025, 0.975], dof * runs)
        late = total[len(total) // 3 :]
        shares.append(float(np.mean((late > low) & (late < high))))
    assert min(shares) > 0.7, shares


def test_stated_std_is_the_root_of_the_snapshots():
    solution = IndirectKf().run(draw_log(3)[0])
    rows = np.searchsorted(solution.t, solution.covariance_t)
    diagonal = np.diagonal(solution.covariance, axis1=1, axis2=2)
    np.testing.assert_allclose(solution.std[rows] ** 2, diagonal, rtol=1e-12)
    assert np.linalg.eigvalsh(solution.covariance).min() > 0.0


def test_bias_state_has_the_variance_of_constant_plus_markov():
    """The one-state stand-in: right growth over the filter's memory, right final variance, however the start is known.

    A line through 0 cannot follow 1 - exp(-x) up to x = 0.3 closer than 10 % (its slope falls from 1 to 0.86; the turn-on bias leaves a per cent).
    """
    spec = IMU.gyro
    markov, constant = spec.gauss_markov_sigma() ** 2, spec.turn_on_bias**2
    log, *_ = draw_log(0)
    known = replace(log, initial=replace(log.initial, std=np.full(15, 1e-12)))
    for case, final in (
        (log, constant + markov),
        (known, 2.0 * markov * constant / (constant + markov) + markov**2 / (constant + markov)),
    ):
        noise = noise_model(case)
        for x in np.linspace(0.02, MEMORY, 10):
            grown = 2.0 * markov * (1.0 - np.exp(-x))
            assert noise.q[9] * x * spec.correlation_time_s == pytest.approx(grown, rel=0.12)
        share = constant / (constant + markov)
        exact = (constant + markov) * (1.0 - share**2) + share**2 * case.initial.std[12] ** 2
        assert noise.q[9] / (2.0 * noise.decay[1]) == pytest.approx(exact)
        assert exact == pytest.approx(final, rel=0.05)


def test_update_ins_runs_free_in_the_outage_and_only_there():
    log, *_ = draw_log(5, gap=(40.0, 60.0))
    ours, filtered = UpdateIns(keep_biases=False).run(log), IndirectKf().run(log)
    ((first, last),) = outage_rows(log, 2.0, "update-ins")
    assert log.imu.t[first] == pytest.approx(40.0, abs=0.21)
    assert log.imu.t[last] == pytest.approx(60.0, abs=0.21)
    assert (ours.lat[: first + 1] == filtered.lat[: first + 1]).all()
    assert (ours.lat[last:] == filtered.lat[last:]).all()
    assert not ours.gyro_bias[first + 1 : last].any()
    start = InitialState(
        log.imu.t[first],
        *(x[first] for x in (filtered.lat, filtered.lon, filtered.h, filtered.v_n, filtered.q_nb)),
        np.zeros(3),
        np.zeros(3),
        np.zeros(15),
    )
    rows = slice(first + 1, last)
    free = Ins().run(SensorLog(ImuSamples(log.imu.t[rows], log.imu.gyro[rows], log.imu.accel[rows]), start))
    assert (free.lat == ours.lat[rows]).all()


def test_latency_moves_a_fix_to_the_moment_that_it_describes():
    log, *_ = draw_log(6)
    late = replace(log.gnss, t=log.gnss.t + 0.15, spec=replace(GNSS, latency_s=0.15))
    assert np.allclose(IndirectKf().run(replace(log, gnss=late)).lat, IndirectKf().run(log).lat, rtol=0.0, atol=1e-12)


def test_search_agrees_with_single_runs():
    log, *_ = draw_log(7)
    log = replace(log, gnss=replace(log.gnss, spec=replace(GNSS)))
    tuned = IndirectKf(gyro_noise_scale=3.0, velocity_std_scale=0.5)
    score = IndirectKf.searcher(log, flight(), stride=10)
    rows = np.arange(9, len(log.imu.t), 10)
    for f in (IndirectKf(), tuned):
        s, (rmse, _) = f.run(log), score(f)
        down = flight().h[rows + 1] - s.h[rows]
        assert rmse[2] == pytest.approx(np.sqrt(np.mean(down**2)), rel=1e-9)
        yaw = (quats_to_eulers(s.q_nb) - quats_to_eulers(flight().q_nb[1:]))[rows, 2]
        yaw = np.mod(yaw + np.pi, 2.0 * np.pi) - np.pi
        assert rmse[8] == pytest.approx(np.degrees(np.sqrt(np.mean(yaw**2))), rel=1e-9)


def test_explicit_noise_equals_the_specification_when_it_says_the_same():
    log, *_ = draw_log(8)
    same = IndirectKf(
        process_noise=tuple(np.sqrt(noise_model(log).q)), measurement_noise=tuple(log.gnss.measurement_std()[0])
    )
    np.testing.assert_allclose(same.run(log).lat, IndirectKf().run(log).lat, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("kind", [IndirectKf, UpdateIns])
def test_log_without_gnss_is_refused(kind):
    log, *_ = draw_log(0)
    with pytest.raises(InputError, match=f"'{kind.name}' needs GNSS"):
        kind().run(replace(log, gnss=None))


@pytest.mark.parametrize(
    "wrong", [{SCALES[0]: 0.0}, {SCALES[1]: float("nan")}, {"process_noise": (1.0,) * 11}, {SCALES[2]: "1"}]
)
def test_parameters_out_of_range_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        IndirectKf(**wrong)


@pytest.mark.skipif(not NAVEGO.is_dir(), reason="the recording is not part of the project")
def test_recording_of_others():
    """NaveGo's example: the RMSE of python-ins on the same files, with 5 % allowed (one noise draw, other initial step)."""
    from testbed.formats import import_log

    recording = import_log("navego", NAVEGO, initial={"start": "reference"})
    rmse, _ = IndirectKf.searcher(recording.log, recording.reference, stride=1)(IndirectKf())
    peer = np.array([0.333, 0.406, 0.515, 0.022, 0.021, 0.013, 0.211, 0.212, 0.925])
    assert (rmse < 1.05 * peer).all(), rmse
