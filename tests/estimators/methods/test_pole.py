"""Direct filters over the top: Euler states in switched axes follow a vehicle whose pitch passes 90°, as a quaternion does.

The yardstick is `indirect-kf`, whose attitude is a quaternion and has no pole; the same log gives both the same information.
"""

from functools import cache

import numpy as np
import pytest
from numba import njit
from synthetic import LAT, H, sensor_log, weaving_flight

from estimators.methods import body_axes
from estimators.methods.body_axes import Axes, near_pole, turned_angles
from estimators.methods.direct import DirectEkf, Rstekf
from estimators.methods.direct_ukf import DirectUkf
from estimators.methods.imm import ImmEkf
from estimators.methods.indirect_kf import IndirectKf
from testbed.data.records import Trajectory
from testbed.formats.kinematics import implied_imu
from testbed.montecarlo.first_run import pole_notes
from testbed.physics import earth
from testbed.physics.rotations import (
    attitude_error,
    attitude_errors,
    euler_to_quat,
    eulers_to_quats,
    quat_multiply,
    quats_to_eulers,
    rotvec_to_quat,
)

DURATION, RATE = 60.0, 50.0


@cache
def loops(upside_down: bool = False) -> Trajectory:
    """A body that turns over and over at 12°/s (or back over) while its place swings by some metres: through both poles."""
    t = np.arange(int(DURATION * RATE) + 1) / RATE
    turn = np.radians(12.0) * t * (-1.0 if upside_down else 1.0)
    q = np.array([quat_multiply(euler_to_quat(0.0, 0.0, 0.6), (np.cos(a / 2), 0.0, np.sin(a / 2), 0.0)) for a in turn])
    sway = np.array([rotvec_to_quat((0.1 * np.sin(0.7 * s), 0.0, 0.1 * np.sin(0.45 * s))) for s in t])
    q = np.array([quat_multiply(a, b) for a, b in zip(q, sway, strict=True)])
    phase = 2.0 * np.pi * t[:, None] / np.array([11.0, 7.0, 9.0])
    v_n, shift = 20.0 * np.cos(phase), 20.0 * np.sin(phase) * np.array([11.0, 7.0, 9.0]) / (2.0 * np.pi)
    north, east = earth.metres_per_radian(LAT, H)
    lat, lon, h = LAT + shift[:, 0] / north, shift[:, 1] / east, H - shift[:, 2]
    f_b, w_ib_b = implied_imu(t, lat, h, v_n, q)
    return Trajectory(t, lat, lon, h, v_n, q, f_b, w_ib_b)


def rms_degrees(estimator, log, truth, after_s=10.0):
    late = truth.t[1:] > after_s
    error = attitude_errors(estimator.run(log).q_nb, truth.q_nb[1:])[late]
    return np.degrees(np.sqrt(np.mean(np.sum(error**2, axis=1))))


@pytest.mark.parametrize("upside_down", [False, True])
def test_loops_through_both_poles(upside_down):
    """Within a tenth of the quaternion filter: both linearise about nearly the same estimate, and in 0.5° the second order of
    an error is a hundredth of it."""
    truth = loops(upside_down)
    log = sensor_log(truth, 3, std=(3.0, 0.2, 0.02), position_sigma=2.0, velocity_sigma=0.1, gyro_noise=2e-3)
    assert np.abs(quats_to_eulers(truth.q_nb)[:, 1]).max() > np.radians(84.0)
    yardstick = rms_degrees(IndirectKf(), log, truth)
    for estimator in (DirectEkf(), DirectUkf(), Rstekf(significance=0.0)):
        assert rms_degrees(estimator, log, truth) < 1.1 * yardstick, estimator.name
    single = ImmEkf(branches=[{"model": "accelerated", "angle_aiding": False}])
    assert rms_degrees(single, log, truth) < 1.1 * yardstick


def test_sigmas_near_the_pole_are_those_of_the_quaternion_filter():
    truth = loops()
    log = sensor_log(truth, 4, std=(3.0, 0.2, 0.02), position_sigma=2.0, velocity_sigma=0.1, gyro_noise=2e-3)
    log.initial.std[9:] = np.repeat([0.05, 0.002], 3)
    ekf, kf = DirectEkf().run(log), IndirectKf().run(log)
    late = truth.t[1:] > 20.0
    ratio = ekf.std[late] / kf.std[late]
    assert ratio.min() > 0.9 and ratio.max() < 1.1  # biases in b and rotations in n, whatever the axes inside
    turned = np.abs(quats_to_eulers(kf.q_nb)[:, 1]) > np.radians(82.0)
    k = [k for k, t in enumerate(kf.covariance_t) if t > 20.0 and turned[np.searchsorted(kf.t, t)]]
    scale = np.sqrt(np.einsum("kii->ki", kf.covariance[k]))
    apart = (ekf.covariance[k] - kf.covariance[k]) / (scale[:, :, None] * scale[:, None, :])
    assert len(k) > 2 and np.abs(apart).max() < 0.1


@njit
def turn_state(x, p, sign):
    body_axes.turn_state(x, p, sign)


def test_a_change_of_axes_maps_errors_as_differences_do():
    """Numerically: the new state of a state that is a little off, by every state, against the covariance that came along."""
    rng = np.random.default_rng(1)
    x = np.concatenate([rng.normal(size=6), [0.3, 1.45, -2.0], 0.01 * rng.normal(size=6)])
    root = rng.normal(size=(15, 15))
    for sign in (1.0, -1.0):
        moved, p = x.copy(), root @ root.T
        turn_state(moved, p, sign)
        jacobian, step = np.empty((15, 15)), 1e-6
        for k in range(15):
            ends = []
            for side in (step, -step):
                shifted = x.copy()
                shifted[k] += side
                turn_state(shifted, np.eye(15), sign)
                ends.append(shifted)
            jacobian[:, k] = (ends[0] - ends[1]) / (2.0 * step)
        assert np.abs(p - jacobian @ (root @ root.T) @ jacobian.T).max() < 1e-6 * np.abs(p).max()
        x, root = moved, np.linalg.cholesky(p)  # and back, from the other axes


def test_turned_angles_are_the_same_attitude():
    for angles in ((0.2, np.pi / 2, 1.0), (-3.0, -np.pi / 2, 0.4), (0.1, 1.5, -2.9)):
        turned = turned_angles(*angles, 1.0)
        assert abs(turned[1]) < np.radians(11.0) and not near_pole(True, turned[0], turned[1])
        back = turned_angles(*turned, -1.0)
        assert np.linalg.norm(attitude_error(euler_to_quat(*back), euler_to_quat(*angles))) < 1e-12
    assert near_pole(False, 0.0, np.radians(80.1)) and not near_pole(False, 0.0, np.radians(79.9))
    assert near_pole(True, *turned_angles(0.1, np.radians(69.9), 0.0, 1.0)[:2])
    assert not near_pole(True, *turned_angles(0.1, np.radians(70.1), 0.0, 1.0)[:2])


def test_below_80_degrees_nothing_turns(monkeypatch):
    """The numbers there are those of version 0.1 to a part in 1e9 (`tests/parity`)."""
    task = DirectEkf().problem(sensor_log(weaving_flight(20.0, rate=50.0), 1))
    monkeypatch.setattr(DirectEkf, "problem", lambda self, log: task)
    DirectEkf().run(None)
    assert isinstance(task.axes, Axes) and not task.axes.history.any() and not task.axes.turned.any()
    monkeypatch.undo()
    task = DirectEkf().problem(sensor_log(loops(), 1))
    monkeypatch.setattr(DirectEkf, "problem", lambda self, log: task)
    DirectEkf().run(None)
    assert 0.1 < task.axes.history.mean() < 0.4  # 8 of 36 tens of degrees, and the ways back to 70


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
@pytest.mark.parametrize("estimator", [DirectEkf(), DirectUkf(), ImmEkf()])
def test_a_start_on_the_pole(pitch, estimator):
    """On the launch pad: nothing tells the roll about the vertical but the start, and everything else stays as it is."""
    n = int(20 * RATE) + 1
    t, still = np.arange(n) / RATE, np.zeros((n, 3))
    q = np.tile(eulers_to_quats(np.array([[0.0, pitch, 0.5]])), (n, 1))
    f_b, w_ib_b = implied_imu(t, np.full(n, LAT), np.full(n, H), still, q)
    truth = Trajectory(t, np.full(n, LAT), np.zeros(n), np.full(n, H), still, q, f_b, w_ib_b)
    log = sensor_log(truth, 2, std=(3.0, 0.2, 0.01), position_sigma=2.0, velocity_sigma=0.1)
    assert rms_degrees(estimator, log, truth, 0.0) < 2.0  # it starts within 3 sigma of √3 · 0.57°


def test_a_motion_near_the_singularity_is_told():
    (told,) = pole_notes(loops())
    assert "singular" in told and "one rotation" in told
    assert pole_notes(weaving_flight(10.0, rate=50.0)) == []
