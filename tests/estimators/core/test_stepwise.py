"""The filter led step by step from Python: the numbers of the compiled loop, and what a user can do between steps."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import sensor_log, weaving_flight

from estimators.methods.eskf import Eskf
from estimators.methods.indirect_kf import IndirectKf
from testbed.base.errors import InputError
from testbed.data.registry import make_estimator


@pytest.fixture(scope="module")
def log():
    """Fixes between and on IMU samples, some before the start and after the end, one of them far off."""
    made = sensor_log(weaving_flight(12.0), 5, gyro_bias=1e-3, std=(10.0, 0.5, 0.01))
    gnss = made.gnss
    t, h = gnss.t.copy(), gnss.h.copy()
    t[::2] -= 0.0043
    t[0], t[-1], h[20] = -0.5, 12.5, h[20] + 300.0
    return replace(made, gnss=replace(gnss, t=t, h=h))


def lead(estimator, log):
    f = estimator.start(log)
    for k in range(len(log.imu.t)):
        while event := f.predict(k):
            f.update(*event)
    return f


@pytest.mark.parametrize(
    "estimator",
    [
        IndirectKf(gyro_bias_scale=2.0),
        Eskf(
            states=("accel-bias", "gyro-bias", "gyro-scale"), aiding=("gnss-position", "gnss-velocity"), policy="gate"
        ),
        Eskf(error="invariant", policy="sage-husa"),
    ],
    ids=["indirect-kf", "gated", "adaptive"],
)
def test_a_whole_log_by_hand_is_the_compiled_loop_bit_for_bit(estimator, log):
    by_hand, run = lead(estimator, log).solution(), estimator.run(log)
    for key in ("t", "lat", "lon", "h", "v_n", "q_nb", "accel_bias", "gyro_bias", "std", "covariance_t", "covariance"):
        np.testing.assert_array_equal(getattr(by_hand, key), getattr(run, key))
    assert by_hand.states == run.states and by_hand.estimates.keys() == run.estimates.keys()
    for name, innovations in run.innovations.items():
        for key in ("t", "value", "covariance", "rejected"):
            np.testing.assert_array_equal(getattr(by_hand.innovations[name], key), getattr(innovations, key))
    if isinstance(estimator, Eskf) and estimator.policy == "gate":
        assert run.innovations["gnss-position"].rejected.sum() == 1


def test_what_a_user_sees(log):
    f = make_estimator("eskf").start(log)
    assert f.predict(0) is None and f.t == pytest.approx(0.01)
    assert f.state.lat == pytest.approx(log.initial.lat, abs=1e-6) and f.state.v_n.shape == (3,)
    assert f.state.accel_bias_x_mps2 == 0.0 and "gyro_bias_z_radps" in dir(f.state) and "q_nb = [" in repr(f.state)
    np.testing.assert_allclose(np.sqrt(np.diag(f.P))[:3], 10.0, rtol=1e-3)
    k = 1
    while (event := f.predict(k)) is None:
        k += 1
    assert event == ("gnss", 1)
    residual, s = f.innovation(*event)
    north = (log.gnss.lat[1] - f.state.lat) * 6.36e6
    assert residual[0] == pytest.approx(north, rel=0.01)
    # The receiver's sigma of 10 m beside the filter's own variance.
    assert s[0, 0] == pytest.approx(f.P[0, 0] + 100.0) and f.R(*event)[0] == pytest.approx(100.0)
    before = f.P[0, 0]
    assert f.update(*event)
    assert f.P[0, 0] == pytest.approx(1.0 / (1.0 / before + 1.0 / 100.0), rel=0.02)


def test_own_noise_of_an_update(log):
    """A fix of one update counts as much as its R says, and the next one as the receiver says again."""
    left = []
    for factor in (1.0, 1e6):
        f = Eskf().start(log)
        k = 0
        while not (event := f.predict(k)):
            k += 1
        before = f.P[0, 0]
        f.update(*event, R=factor * f.R(*event))
        left.append(f.P[0, 0] / before)
        np.testing.assert_allclose(f.R(*event)[:3], 100.0)
    assert left[0] < 0.6 and left[1] == pytest.approx(1.0, abs=1e-5)


def test_the_state_may_be_set(log):
    f = Eskf().start(log)
    f.state.h = 1234.0
    f.state.v_n = [1.0, 2.0, 3.0]
    f.state.v_n[2] = -4.0
    f.P[2, 2] = 0.25
    assert f.state.h == 1234.0 and list(f.state.v_n) == [1.0, 2.0, -4.0]
    with pytest.raises(AttributeError, match="no state 'height'"):
        f.state.height = 0.0
    with pytest.raises(AttributeError, match="did you mean 'accel_bias_x_mps2'"):
        _ = f.state.accel_bias_x


def test_an_event_may_be_passed_over(log):
    """Without all fixes it is a free INS, but for the steps that end where a fix lies: second order, micrometres here."""
    f = Eskf().start(log)
    for k in range(len(log.imu.t)):
        while f.predict(k):
            pass
    early = {key: getattr(log.gnss, key)[:1] for key in ("t", "lat", "lon", "h", "v_n")}
    free = Eskf().run(replace(log, gnss=replace(log.gnss, **early)))  # the only fix lies before the start
    assert f.solution().h[-1] == pytest.approx(free.h[-1], abs=1e-4)


def test_mistakes_have_messages(log):
    f = Eskf().start(log)
    for call, word in (
        (lambda: f.update("gnss", 3), r"predict\(0\) comes before"),
        (lambda: f.predict(3), r"expected predict\(0\) until it returns None"),
        (lambda: f.solution(), "has done 0 of 1200"),
        (lambda: f.predict(0), None),
        (lambda: f.predict(2), r"expected predict\(0\) or predict\(1\)"),
        (lambda: f.update("gns", 3), "did you mean 'gnss'"),
        (lambda: f.update("gnss", 120), "samples 0 to 119, not 120"),
        (lambda: f.update("gnss", 3, R=[1.0]), "R must be 6 positive variances"),
        (lambda: f.update("gnss", 3, R=np.zeros(6)), "R must be 6 positive variances"),
        (lambda: make_estimator("update-ins").start(log), "start 'indirect-kf'"),
    ):
        if word is None:
            call()
            continue
        with pytest.raises(InputError, match=word):
            call()
