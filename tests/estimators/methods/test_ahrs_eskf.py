"""`ahrs-eskf` against numerical derivatives, its own model, turns, magnets and rest."""

import numpy as np
import pytest
from numba import njit
from scipy.stats import t as student

from estimators.methods.ahrs_eskf import AhrsEskf
from estimators.methods.ahrs_eskf_kernels import HeadingFilter, add_correction, make_work, predict, spread, use_speed
from testbed.base.errors import InputError
from testbed.data.records import (
    ATTITUDE_STATES,
    GYRO_BIAS_STATES,
    GnssFixes,
    ImuSamples,
    InitialState,
    MagSamples,
    SensorLog,
)
from testbed.data.specs import GnssSpec, ImuSpec, MagSpec
from testbed.physics.earth import gravity
from testbed.physics.rotations import attitude_errors, eulers_to_quats, quat_multiply, quats_to_matrices, rotvec_to_quat
from testbed.sensors.airspeed import AirspeedSamples, AirspeedSpec

predict, use_speed = njit(predict), njit(use_speed)  # the filter has them only inside of its loop
LATITUDE, HEIGHT = 0.9, 100.0
G = float(gravity(LATITUDE, HEIGHT))
FIELD_N = np.array([18.0, 2.0, 45.0])
DECLINATION = float(np.arctan2(2.0, 18.0))


def log_of(t, euler, accel_n, std_deg=(1.0, 1.0, 3.0), bias_std_dps=0.1, gyro_bias=(0.0, 0.0, 0.0), **aiding):
    """A log without errors but a gyro bias: attitude (N+1,3) Euler angles at 0 and ``t`` (N,), acceleration (N,3) in n."""
    q = eulers_to_quats(np.asarray(euler, dtype=float))
    dt = float(t[1] - t[0])
    turn = np.array([quat_multiply((a[0], -a[1], -a[2], -a[3]), b) for a, b in zip(q[:-1], q[1:], strict=True)])
    turn *= np.where(turn[:, :1] < 0.0, -1.0, 1.0)
    angle = 2.0 * np.arctan2(np.linalg.norm(turn[:, 1:], axis=1), turn[:, 0])
    rate = turn[:, 1:] * (angle / np.maximum(np.sin(0.5 * angle), 1e-12) / dt)[:, None]
    half = np.array([quat_multiply(a, rotvec_to_quat(0.5 * dt * w)) for a, w in zip(q[:-1], rate, strict=True)])
    force = np.einsum("kji,kj->ki", quats_to_matrices(half), accel_n - np.array([0.0, 0.0, G]))
    field = np.einsum("kji,j->ki", quats_to_matrices(q[1:]), FIELD_N)
    std = np.concatenate([np.ones(6), np.radians(std_deg), np.full(3, 1e-6), np.full(3, np.radians(bias_std_dps))])
    initial = InitialState(0.0, LATITUDE, 0.2, HEIGHT, np.zeros(3), q[0], np.zeros(3), np.zeros(3), std)
    imu = ImuSamples(t, rate + np.radians(gyro_bias), force, ImuSpec("made", 1.0 / dt))
    mag = MagSamples(t, field, MagSpec("made", 1.0 / dt, declination=DECLINATION, field_n=tuple(FIELD_N)))
    return SensorLog(imu, initial, aiding={"mag": mag} | aiding), q[1:]


def level(n):
    """(N+1,3): no turn at all."""
    return np.zeros((n + 1, 3))


def model_of(estimator, log):
    inputs = estimator.inputs(log)[1]
    state, p = estimator.start(log)
    return HeadingFilter(inputs, estimator.settings(log), estimator.watch(), state, p, make_work(len(p)), None)


@pytest.fixture
def tumbling():
    """Ten samples of a body that turns about all axes and accelerates."""
    t = 0.02 * np.arange(1, 11)
    grid = np.linspace(0.0, 0.2, 11)
    euler = np.column_stack([0.3 + 1.5 * grid, -0.2 + grid, 2.0 - 2.0 * grid])
    return log_of(t, euler, np.tile([3.0, -2.0, 1.0], (10, 1)))[0]


def test_the_covariance_follows_the_numerical_derivative_of_the_motion(tumbling):
    """Without noise P becomes Phi P Phi': Phi from errors of the start that `predict` carries through five samples."""
    estimator, rng = AhrsEskf(bias_limit_dps=1e6), np.random.default_rng(0)
    root, phi, step = 1e-3 * rng.standard_normal((8, 8)), np.empty((8, 8)), 1e-6
    plain = model_of(estimator, tumbling)
    quiet = {"gyro_density": 0.0, "scale_density": 0.0, "bias_walk": 0.0, "velocity_walk": 0.0, "velocity_density": 0.0}
    settings = plain.settings._replace(**quiet)
    plain.p[:] = root @ root.T
    for i in range(5):
        predict(plain, i, 0.02, 1.0)
        spread(plain.p, plain.state, settings, plain.work)
    for k in range(8):
        moved, error = model_of(estimator, tumbling), np.zeros(8)
        error[k] = step
        add_correction(moved.state, error)
        for i in range(5):
            predict(moved, i, 0.02, 1.0)
        turn = attitude_errors(moved.state[None, :4], plain.state[None, :4])[0]
        phi[:, k] = np.concatenate([turn, moved.state[4:] - plain.state[4:]]) / step
    expected = phi @ root @ root.T @ phi.T
    # what is left out is the turn of an error of bias within a sample: 0.01 s against the 0.1 s of the whole
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((plain.p - expected) / scale).max() < 0.02


@pytest.mark.parametrize("speed", ["airspeed", "gnss"])
def test_a_speed_has_the_jacobian_of_its_numerical_derivative(tumbling, speed):
    """What `use_speed` puts into H against central differences of its residual."""
    t = tumbling.imu.t[4:5]
    fixes = GnssFixes(
        t, *(np.array([x]) for x in (LATITUDE, 0.2, HEIGHT)), np.array([[8.0, 3.0, 0.0]]), GnssSpec(velocity_sigma=0.1)
    )
    aiding = {"airspeed": AirspeedSamples(t, np.array([30.0]), AirspeedSpec(noise_sigma=0.3)), "gnss": fixes}
    log = SensorLog(tumbling.imu, tumbling.initial, aiding={"mag": tumbling.mag, **aiding})
    estimator = AhrsEskf(speed=speed)
    event = int(np.flatnonzero(estimator.inputs(log)[1].kind)[0])

    def residual(error):
        model = model_of(estimator, log)
        add_correction(model.state, error)
        use_speed(model, 4, event)
        return model.work.residual[:2].copy(), model.work.h[:2].copy()

    states = 10 if speed == "airspeed" else 8
    h, numerical = residual(np.zeros(states))[1], np.empty((2, states))
    for k in range(states):
        d = np.zeros(states)
        d[k] = 1e-6
        numerical[:, k] = (residual(-d)[0] - residual(d)[0]) / 2e-6
    np.testing.assert_allclose(h, numerical, atol=1e-6 * 30.0)  # 30 m/s times round-off over the step


def drawn(seed, estimator, duration_s=30.0):
    """A log drawn from the filter's own model at 50 Hz: a velocity that is white, and white noise on all that it measures."""
    rng, dt = np.random.default_rng(seed), 0.02
    n = round(duration_s / dt)
    t, grid = dt * np.arange(1, n + 1), dt * np.arange(n + 1)
    euler = np.column_stack([0.5 * np.sin(0.7 * grid), 0.4 * np.sin(0.5 * grid), 0.6 * grid])
    velocity = np.zeros((n + 1, 3))
    velocity[1:, :2] = estimator.velocity_mps / np.sqrt(dt) * rng.standard_normal((n, 2))
    bias = np.radians(0.1) * rng.standard_normal(3)
    log, truth = log_of(t, euler, np.diff(velocity, axis=0) / dt)
    turns = np.linalg.norm(log.imu.gyro, axis=1)[:, None]
    density = np.hypot(np.radians(estimator.gyro_dps), estimator.gyro_scale * turns)
    walk = bias + np.radians(estimator.bias_walk_dps) * np.sqrt(dt) * np.cumsum(rng.standard_normal((n, 3)), axis=0)
    gyro = log.imu.gyro + walk + density / np.sqrt(dt) * rng.standard_normal((n, 3))
    accel = log.imu.accel + estimator.velocity_walk_mps / np.sqrt(dt) * rng.standard_normal((n, 3))
    about = np.radians(estimator.heading_deg) / np.sqrt(dt) * rng.standard_normal(n)
    field_n = np.column_stack([np.cos(about + DECLINATION), np.sin(about + DECLINATION), np.full(n, 2.5)]) * 18.0
    field = np.einsum("kji,kj->ki", quats_to_matrices(truth), field_n)
    off = rotvec_to_quat(log.initial.std[6:9] * rng.standard_normal(3))
    initial = log.initial.__class__(**{**vars(log.initial), "q_nb": np.array(quat_multiply(off, log.initial.q_nb))})
    imu = ImuSamples(t, gyro, accel, log.imu.spec)
    return SensorLog(imu, initial, aiding={"mag": MagSamples(t, field, log.mag.spec)}), truth, walk


def test_consistent_on_data_of_its_own_model():
    """Time averages of NEES over degrees of freedom, of attitude and bias: the 99 % t-interval over 30 seeds holds 1."""
    # white at 50 Hz, a mean of 0.1 m/s over a second is 0.7 m/s rms: faster, and products of errors would matter
    own = {"velocity_mps": 0.1, "heading_deg": 5.0, "velocity_walk_mps": 0.01, "bias_limit_dps": 5.0}
    estimator, means = AhrsEskf(**own, reject_field=False), []
    for seed in range(30):
        log, truth, bias = drawn(seed, estimator)
        solution = estimator.run(log)
        rows = np.searchsorted(log.imu.t, solution.covariance_t - 1e-6)
        errors = np.hstack([attitude_errors(solution.q_nb[rows], truth[rows]), solution.gyro_bias[rows] - bias[rows]])
        nees = []
        for part in (slice(0, 3), slice(3, 6)):
            e, p = errors[:, part], solution.covariance[:, part, part]
            nees.append(np.einsum("ki,ki->k", e, np.linalg.solve(p, e[..., None])[..., 0]).mean() / 3.0)
        means.append(nees)
    half = student.ppf(0.995, 29) * np.std(means, axis=0, ddof=1) / np.sqrt(30.0)
    assert (np.abs(np.mean(means, axis=0) - 1.0) < half).all(), (np.mean(means, axis=0), half)
    assert solution.states == (*ATTITUDE_STATES, *GYRO_BIAS_STATES)


def circle(duration_s=180.0, speed=30.0, radius=200.0, **aiding):
    """A coordinated turn of a small aircraft, straight for 20 s before it: (log, truth)."""
    t = 0.02 * np.arange(1, round(duration_s / 0.02) + 1)
    grid = np.concatenate([[0.0], t])
    rate = speed / radius * np.clip((grid - 20.0) / 5.0, 0.0, 1.0)
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * 0.02)])
    euler = np.column_stack([np.arctan(speed * rate / G), np.zeros(len(grid)), yaw])
    velocity = speed * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(grid))])
    every = slice(9, None, 10)
    n = len(t[every])
    place = (np.full(n, x) for x in (LATITUDE, 0.2, HEIGHT))
    fixes = GnssFixes(t[every], *place, velocity[1:][every], GnssSpec(velocity_sigma=0.05))
    pitot = AirspeedSamples(t[every], np.full(n, speed), AirspeedSpec(noise_sigma=0.3))
    log, truth = log_of(t, euler, np.diff(velocity, axis=0) / 0.02, gnss=fixes, airspeed=pitot)
    return log, truth


def test_in_a_sustained_turn_it_needs_a_speed():
    """A turn at 24° of bank for 150 s: with airspeed or GNSS roll and pitch hold to 0.3°, without they go towards the bank."""
    log, truth = circle()
    errors = {}
    for speed in ("", "airspeed", "gnss"):
        phi = attitude_errors(AhrsEskf(speed=speed).run(log).q_nb, truth)[-2500:, :2]
        errors[speed] = np.degrees(np.sqrt(np.mean(phi**2)))
    assert errors["airspeed"] < 0.3 and errors["gnss"] < 0.3 and errors[""] > 5.0


def test_a_multirotor_in_a_circle_states_its_own_velocity():
    """6 m/s on a radius of 25 m tilt by 8.4°, of which a hand's velocity takes more than half for level (4.2° of one vector,

    3° per axis). The carrier's own lengthens the filter's time constant by (6 / 0.5)^1/2 = 3.5, and what turns faster than the
    filter follows is damped by at least as much.
    """
    log, truth = circle(speed=6.0, radius=25.0)
    tilt = {
        velocity: np.degrees(
            np.sqrt(np.mean(attitude_errors(AhrsEskf(velocity_mps=velocity).run(log).q_nb, truth)[-2500:, :2] ** 2))
        )
        for velocity in (0.5, 6.0)
    }
    assert tilt[0.5] > 3.0 and tilt[6.0] < tilt[0.5] / 3.5, tilt


def gusty(seed, estimator, log, truth):
    """The circle again in gusts of the filter's own model, which move the aircraft and not its airspeed; noise and a start likewise."""
    rng, t, dt = np.random.default_rng(seed), log.imu.t, 0.02
    n, decay = len(t), np.exp(-30.0 * 0.02 / estimator.gust_length_m)
    gust = np.zeros((n + 1, 3))
    gust[0, :2] = estimator.gust_mps * rng.standard_normal(2)
    for k in range(n):
        gust[k + 1, :2] = decay * gust[k, :2] + estimator.gust_mps * np.sqrt(1.0 - decay**2) * rng.standard_normal(2)
    felt = np.einsum("kji,kj->ki", quats_to_matrices(truth), np.diff(gust, axis=0) / dt)
    gyro = log.imu.gyro + np.radians(estimator.gyro_dps) / np.sqrt(dt) * rng.standard_normal((n, 3))
    imu = ImuSamples(t, gyro, log.imu.accel + felt, log.imu.spec)
    pitot = log.airspeed
    speed = pitot.speed + pitot.spec.noise_sigma * rng.standard_normal(len(pitot.t))
    about = np.radians(estimator.heading_deg) / np.sqrt(dt) * rng.standard_normal(n)
    field_n = np.column_stack([np.cos(about + DECLINATION), np.sin(about + DECLINATION), np.full(n, 2.5)]) * 18.0
    field = np.einsum("kji,kj->ki", quats_to_matrices(truth), field_n)
    off = rotvec_to_quat(log.initial.std[6:9] * rng.standard_normal(3))
    initial = log.initial.__class__(**{**vars(log.initial), "q_nb": np.array(quat_multiply(off, log.initial.q_nb))})
    aiding = {"mag": MagSamples(t, field, log.mag.spec), "airspeed": AirspeedSamples(pitot.t, speed, pitot.spec)}
    return SensorLog(imu, initial, aiding=aiding)


def test_consistent_in_gusts_that_an_airspeed_does_not_see():
    """NEES over degrees of freedom of attitude in a turn: the 99 % t-interval over 20 seeds holds 1."""
    own = {"gyro_scale": 1e-5, "slip_deg": 0.1, "heading_deg": 5.0, "velocity_walk_mps": 1e-3, "bias_walk_dps": 1e-5}
    estimator, (log, truth), means = AhrsEskf(speed="airspeed", **own, reject_field=False), circle(), []
    known = log.initial.__class__(**{**vars(log.initial), "std": log.initial.std * np.repeat([1.0, 1e-3], [12, 3])})
    log = SensorLog(log.imu, known, aiding={"mag": log.mag, "airspeed": log.airspeed})
    for seed in range(20):
        solution = estimator.run(gusty(seed, estimator, log, truth))
        rows = np.searchsorted(log.imu.t, solution.covariance_t - 1e-6)[20:]
        e, p = attitude_errors(solution.q_nb[rows], truth[rows]), solution.covariance[20:, :3, :3]
        means.append(np.einsum("ki,ki->k", e, np.linalg.solve(p, e[..., None])[..., 0]).mean() / 3.0)
    half = student.ppf(0.995, 19) * np.std(means, ddof=1) / np.sqrt(20.0)
    assert abs(np.mean(means) - 1.0) < half < 0.4, (np.mean(means), half)


def test_the_whole_field_corrects_the_tilt_where_it_is_asked_to():
    """A start that is tilted by 3°, and a velocity of which so little is known that gravity says nothing: the dip finds it."""
    t = 0.02 * np.arange(1, 1501)
    yaw = np.column_stack([np.zeros((1501, 2)), np.concatenate([[0.0], 0.1 * t])])  # a turn, so that there is no rest
    log, truth = log_of(t, yaw, np.zeros((1500, 3)), std_deg=(5.0, 5.0, 5.0), bias_std_dps=1e-4)
    tilted = log.initial.__class__(
        **{**vars(log.initial), "q_nb": np.array(rotvec_to_quat((0.0, np.radians(3.0), 0.0)))}
    )
    log = SensorLog(log.imu, tilted, aiding={"mag": log.mag})
    deaf = {"velocity_mps": 500.0, "heading_deg": 2.0, "gyro_dps": 1e-3}
    tilt = [
        np.degrees(
            np.linalg.norm(attitude_errors(AhrsEskf(whole_field=whole, **deaf).run(log).q_nb[-1:], truth[-1:])[0, :2])
        )
        for whole in (True, False)
    ]
    assert tilt[0] < 0.3 and tilt[1] > 2.0


def test_the_field_moves_neither_tilt_nor_bias():
    """A field that swings by 20° about down leaves inclination and biases as they are to round-off of the turns."""
    t = 0.01 * np.arange(1, 3001)
    log, truth = log_of(t, level(3000), np.zeros((3000, 3)))
    about = np.radians(20.0) * np.sin(t)
    field = np.column_stack([18.0 * np.cos(about), 18.0 * np.sin(about), np.full(3000, 45.0)])
    swung = SensorLog(log.imu, log.initial, aiding={"mag": MagSamples(t, field, log.mag.spec)})
    phi = attitude_errors(AhrsEskf().run(swung).q_nb, truth)
    assert np.degrees(np.abs(phi[:, 2])).max() > 1.0
    assert np.abs(phi[:, :2]).max() < 1e-9 and np.abs(AhrsEskf().run(swung).gyro_bias).max() < 1e-9


def test_a_magnet_that_comes_near_is_left_out():
    """30 µT from the east for 20 s of a minute turn the field by 58°: the heading holds, and does not where all is taken."""
    t = 0.01 * np.arange(1, 6001)
    grid = np.concatenate([[0.0], t])
    euler = np.column_stack([0.3 * np.sin(grid), 0.2 * np.sin(0.7 * grid), np.sin(0.3 * grid)])
    log, truth = log_of(t, euler, np.zeros((6000, 3)))
    near = (t > 20.0) & (t < 40.0)
    magnet = np.einsum("kji,j->ki", quats_to_matrices(truth), np.array([0.0, 30.0, 0.0]))
    field = log.mag.field + near[:, None] * magnet
    log = SensorLog(log.imu, log.initial, aiding={"mag": MagSamples(t, field, log.mag.spec)})
    worst = [
        np.degrees(np.abs(attitude_errors(AhrsEskf(reject_field=reject).run(log).q_nb, truth)[:, 2])).max()
        for reject in (True, False)
    ]
    assert worst[0] < 2.0 and worst[1] > 10.0


def test_a_new_place_with_another_field_is_learned():
    """Steady for 20 s of turning, a field of another dip becomes the reference: its heading is used again."""
    t = 0.01 * np.arange(1, 12001)
    grid = np.concatenate([[0.0], t])
    log, truth = log_of(
        t, np.column_stack([0.4 * np.sin(grid), 0.3 * np.cos(grid), 1.5 * np.sin(grid)]), np.zeros((12000, 3))
    )
    there = np.einsum("kji,j->ki", quats_to_matrices(truth), np.array([30.0 * np.cos(0.5), 30.0 * np.sin(0.5), 25.0]))
    field = np.where((t > 10.0)[:, None], there, log.mag.field)
    log = SensorLog(log.imu, log.initial, aiding={"mag": MagSamples(t, field, log.mag.spec)})
    solution = AhrsEskf().run(log)
    used = ~solution.innovations["heading"].rejected
    at = solution.innovations["heading"].t
    assert used[at < 9.0].all() and not used[(at > 11.0) & (at < 25.0)].any() and used[at > 50.0].mean() > 0.9


def test_at_rest_all_gyro_biases_are_found():
    """0.4 °/s about every axis, that of the vertical too: seen to 0.03 °/s, the mean of a second, after a minute at rest."""
    t = 0.01 * np.arange(1, 6001)
    log, truth = log_of(t, level(6000), np.zeros((6000, 3)), bias_std_dps=0.5, gyro_bias=(0.4, -0.4, 0.4))
    solution = AhrsEskf().run(log)
    np.testing.assert_allclose(np.degrees(solution.gyro_bias[-1]), [0.4, -0.4, 0.4], atol=0.03)
    assert np.degrees(np.abs(attitude_errors(solution.q_nb[-1:], truth[-1:]))).max() < 2.0
    assert solution.extras["at_rest"][1][5:].all()


def test_a_start_without_heading_finds_it_by_the_first_field():
    """Started 150° off with a sigma that says so, the heading is that of the field within a second."""
    t = 0.01 * np.arange(1, 201)
    log, truth = log_of(t, level(200), np.zeros((200, 3)), std_deg=(1.0, 1.0, 104.0))
    wrong = log.initial.__class__(
        **{**vars(log.initial), "q_nb": np.array(rotvec_to_quat((0.0, 0.0, np.radians(150.0))))}
    )
    solution = AhrsEskf().run(SensorLog(log.imu, wrong, aiding={"mag": log.mag}))
    assert np.degrees(np.abs(attitude_errors(solution.q_nb[-1:], truth[-1:]))).max() < 10.0


def test_triads_that_are_turned_are_in_the_stated_sigma():
    """Both triads turned by 1° (1 sigma per axis), drawn 200 times, on a carrier that rests level: the mean NEES of the attitude

    is that of three degrees of freedom, within four standard errors of 200 draws; without being told it is ten times that.
    """
    t, rng = 0.02 * np.arange(1, 501), np.random.default_rng(5)
    plain, truth = log_of(t, level(500), np.zeros((500, 3)), std_deg=(0.3, 0.3, 0.3), bias_std_dps=1e-3)
    means = {}
    for told in (0.0, 1.0):
        estimator, nees = AhrsEskf(misalignment_deg=told, heading_deg=0.5, gyro_dps=0.01, reject_field=False), []
        for _ in range(200):
            accel, field = (
                quats_to_matrices(np.array([rotvec_to_quat(np.radians(1.0) * rng.standard_normal(3))]))[0] for _ in "am"
            )
            imu = ImuSamples(t, plain.imu.gyro, plain.imu.accel @ accel.T, plain.imu.spec)
            wide = plain.initial.__class__(
                **{**vars(plain.initial), "std": np.where(np.arange(15) // 3 == 2, 0.1, plain.initial.std)}
            )
            log = SensorLog(imu, wide, aiding={"mag": MagSamples(t, plain.mag.field @ field.T, plain.mag.spec)})
            solution = estimator.run(log)
            e, p = attitude_errors(solution.q_nb[-1:], truth[-1:])[0], solution.covariance[-1, :3, :3]
            nees.append(e @ np.linalg.solve(p, e))
        means[told] = np.mean(nees)
    assert abs(means[1.0] - 3.0) < 4.0 * np.sqrt(6.0 / 200.0), means
    assert means[0.0] > 10.0 * means[1.0]


def test_what_it_cannot_use_is_refused():
    t = 0.01 * np.arange(1, 201)
    log, _ = log_of(t, level(200), np.zeros((200, 3)))
    with pytest.raises(InputError, match="magnetometer"):
        AhrsEskf().run(SensorLog(log.imu, log.initial))
    with pytest.raises(InputError, match=r"speed = 'airspeed'.*\[sensors.airspeed\]"):
        AhrsEskf(speed="airspeed").run(log)
    with pytest.raises(InputError, match="gnss"):
        AhrsEskf(speed="gps")
    with pytest.raises(InputError, match="heading_deg"):
        AhrsEskf(heading_deg=0.0)
    with pytest.raises(InputError, match="reject_field"):
        AhrsEskf(reject_field=1)
    with pytest.raises(InputError, match=r"misalignment_deg = -1\.0, must be within 0 to 45"):
        AhrsEskf(misalignment_deg=-1.0)
