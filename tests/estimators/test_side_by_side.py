"""Eight runs in lanes are the eight runs: the same numbers as alone, whoever runs beside whom."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import sensor_log, weaving_flight

from estimators.methods.direct import DirectEkf, Rstekf, Stekf
from estimators.methods.direct_ukf import DirectUkf
from estimators.methods.eskf import Eskf
from estimators.methods.imm import ImmRstekf
from estimators.methods.indirect_kf import IndirectKf
from estimators.methods.update_ins import UpdateIns
from testbed.base.errors import InputError
from testbed.data.records import NavSolution, SensorLog

FILTERS = [IndirectKf(), UpdateIns(), DirectEkf(), Stekf(), Rstekf(), DirectUkf(), ImmRstekf()]
FIELDS = ("lat", "lon", "h", "v_n", "q_nb", "accel_bias", "gyro_bias", "std", "covariance")


@pytest.fixture(scope="module")
def logs() -> list[SensorLog]:
    """Five runs of 20 s at 50 Hz that differ in noise and start; an outage, an antenna 1 m away, fixes between two samples."""
    truth = weaving_flight(20.0, rate=50.0)
    made = []
    for seed in range(5):
        log = sensor_log(
            truth,
            seed,
            std=(10.0, 0.2, 0.05),
            gnss_rate=5.0,
            position_sigma=3.0,
            velocity_sigma=0.1,
            outages=((8.0, 11.0),),
        )
        assert log.gnss is not None
        spec = replace(log.gnss.spec, lever_arm_b=(1.0, 0.3, -0.5), latency_s=0.013)
        start = replace(log.initial, v_n=log.initial.v_n + 0.1 * seed, lat=log.initial.lat + 1e-7 * seed)
        made.append(replace(log, gnss=replace(log.gnss, spec=spec), initial=start))
    return made


def assert_same(one: NavSolution, other: NavSolution, tolerance: float) -> None:
    """Each field to ``tolerance`` of its largest number; 0: the same bytes."""
    pairs = [(getattr(one, name), getattr(other, name)) for name in FIELDS]
    for name, innovations in one.innovations.items():
        pairs += [
            (innovations.value, other.innovations[name].value),
            (innovations.covariance, other.innovations[name].covariance),
        ]
    pairs += [(values, other.extras[name][1]) for name, (_, values) in (one.extras or {}).items()]
    for a, b in pairs:
        np.testing.assert_allclose(b, a, rtol=0.0, atol=tolerance * np.abs(np.nan_to_num(a)).max())


@pytest.mark.parametrize("estimator", FILTERS, ids=lambda e: e.name)
def test_lanes_are_the_runs(estimator, logs):
    """To 1e-9: series for sines and another order of sums, through 1000 steps; and alone the same bytes as in company."""
    many = estimator.run_many(logs)
    for log, made in zip(logs, many, strict=True):
        assert_same(estimator.run(log), made, 1e-9)
    assert_same(estimator.run_many([logs[3]])[0], many[3], 0.0)
    assert_same(estimator.run_many(logs[::-1] + logs)[1], many[3], 0.0)


def test_a_lane_that_is_lost_harms_no_other(logs):
    """Specific force that overflows: that run alone ends in NaN, and so it does by itself."""
    broken = logs[2].imu.accel.copy()
    broken[400:] = 1e200
    mixed = [*logs[:2], replace(logs[2], imu=replace(logs[2].imu, accel=broken)), *logs[3:]]
    for estimator in (IndirectKf(), DirectEkf(), DirectUkf(), ImmRstekf()):
        many, whole = estimator.run_many(mixed), estimator.run_many(logs)
        assert not np.isfinite(many[2].h).all()
        for k in (0, 1, 3, 4):
            assert_same(whole[k], many[k], 0.0)


def test_a_run_at_the_pole_goes_by_itself(logs):
    """A start with the nose up at 85 degrees takes the other axes; its neighbours do not."""
    q = np.array([np.cos(np.radians(42.5)), 0.0, np.sin(np.radians(42.5)), 0.0])
    steep = replace(logs[1], initial=replace(logs[1].initial, q_nb=tuple(q)))
    many = DirectEkf().run_many([logs[0], steep, logs[2]])
    assert_same(DirectEkf().run(steep), many[1], 0.0)
    assert_same(DirectEkf().run_many(logs[:1])[0], many[0], 0.0)


def test_a_policy_that_decides_goes_by_itself(logs):
    gated = Eskf(policy="gate")
    for one, other in zip([gated.run(log) for log in logs], gated.run_many(logs), strict=True):
        assert_same(one, other, 0.0)


def test_times_must_agree(logs):
    assert logs[0].gnss is not None
    late = replace(logs[0].gnss, spec=replace(logs[0].gnss.spec, latency_s=0.1))
    for estimator in (IndirectKf(), DirectEkf()):
        with pytest.raises(InputError, match="same times"):
            estimator.run_many([logs[1], replace(logs[0], gnss=late)])
