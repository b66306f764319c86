"""Filters that start without a heading find it, say how sure they are until then, and never look ahead."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import LAT, H, sensor_log, weaving_flight

from estimators.core.composition import Composition, prepare
from estimators.methods.indirect_kf import IndirectKf
from testbed import make_estimator
from testbed.base.errors import InputError
from testbed.data.records import Trajectory
from testbed.formats.kinematics import implied_imu
from testbed.montecarlo.first_run import heading_notes
from testbed.physics.rotations import attitude_errors, eulers_to_quats, quat_multiply, rotvec_to_quat

UNKNOWN = np.pi / np.sqrt(3.0)
"""Sigma of an angle of which nothing is known, as alignment states it."""


def without_heading(log, turn_deg):
    """The log with its start turned about the vertical, and no idea of it."""
    q = np.array(quat_multiply(rotvec_to_quat((0.0, 0.0, np.radians(turn_deg))), log.initial.q_nb))
    std = log.initial.std.copy()
    std[8] = UNKNOWN
    return replace(log, initial=replace(log.initial, q_nb=q, std=std))


@pytest.fixture(scope="module")
def flight():
    truth = weaving_flight(30.0, rate=50.0, speed=30.0)
    return truth, sensor_log(truth, 1, std=(3.0, 0.2, 0.01), position_sigma=3.0)


@pytest.mark.parametrize("turn_deg", [0.0, 22.0, 100.0, 180.0, -67.5])
@pytest.mark.parametrize(("name", "params"), [("indirect-kf", {}), ("eskf", {"error": "invariant"})])
def test_every_heading_is_found(name, params, turn_deg, flight):
    """In a turn of 0.3 g with velocities to 0.2 m/s, five seconds tell the heading to 0.8°; the error then lies within four
    sigma, and after 20 s the filter is the one that knew its heading."""
    truth, log = flight
    solution = make_estimator(name, **params).run(without_heading(log, turn_deg))
    error = attitude_errors(solution.q_nb, truth.q_nb[1:])[:, 2]
    sigma = solution.std[:, solution.states.index("attitude_down_rad")]
    after = truth.t[1:] > 5.0
    assert np.degrees(sigma[after]).max() < 1.0 and (np.abs(error) < 4.0 * sigma)[after].all()
    known = make_estimator(name, **params).run(log)
    late = truth.t[1:] > 20.0
    assert np.abs(solution.v_n - known.v_n)[late].max() < 0.05  # a quarter of the noise of one fix


def test_while_nothing_tells_the_heading_the_sigma_says_so():
    """At rest with gyros whose bias hides the Earth's rate all sectors are alike: eight headings over the circle spread by
    105.5° about each of them, and 13° within a sector; √(105.5² + 13²) = 106°."""
    n = 20 * 50 + 1
    t, still = np.arange(n) / 50.0, np.zeros((n, 3))
    q = np.tile(eulers_to_quats(np.array([[0.0, 0.0, 2.0]])), (n, 1))
    f_b, w_ib_b = implied_imu(t, np.full(n, LAT), np.full(n, H), still, q)
    truth = Trajectory(t, np.full(n, LAT), np.zeros(n), np.full(n, H), still, q, f_b, w_ib_b)
    log = without_heading(sensor_log(truth, 2, std=(3.0, 0.2, 0.01)), 150.0)
    log.initial.std[12:15] = 0.01
    solution = make_estimator("indirect-kf").run(log)
    sigma = np.degrees(solution.std[:, solution.states.index("attitude_down_rad")])
    assert abs(sigma[10] - 106.3) < 0.5
    assert sigma.min() > 80.0 and sigma.max() < 150.0
    _, weights = solution.extras["heading_probability"]
    assert weights.shape[1] == 8 and np.allclose(weights.sum(axis=1), 1.0)
    told = heading_notes({"final_heading_sigma_deg": {"indirect-kf": float(sigma[-1]), "other": 3.0}})
    assert len(told) == 1 and told[0].startswith(
        "indirect-kf: the heading was unknown at the start and never converged"
    )


def test_the_answer_does_not_look_ahead(flight):
    _, log = flight
    log = without_heading(log, 120.0)
    cut = replace(log, imu=replace(log.imu, t=log.imu.t[:400], gyro=log.imu.gyro[:400], accel=log.imu.accel[:400]))
    whole, part = make_estimator("indirect-kf").run(log), make_estimator("indirect-kf").run(cut)
    assert np.array_equal(whole.q_nb[:400], part.q_nb) and np.array_equal(whole.lat[:400], part.lat)
    assert np.array_equal(whole.std[:400], part.std)


def test_a_known_heading_goes_through_one_filter(flight):
    _, log = flight
    assert "heading_probability" not in make_estimator("indirect-kf").run(log).extras
    unknown = without_heading(log, 90.0)
    smoothed = make_estimator("eskf", smooth=True).run(unknown)
    known = make_estimator("eskf", smooth=True).run(log)
    assert np.abs(smoothed.v_n - known.v_n)[100:].max() < 0.1
    with pytest.raises(InputError, match="heading at the start is unknown"):
        IndirectKf.searcher(unknown, flight[0])
    assert prepare(Composition(), unknown).covariance[8, 8] == UNKNOWN**2
