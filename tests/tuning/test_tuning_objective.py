"""The objective of a search: coordinates and parameters, the fast path against the general one, likelihood, divergence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from synthetic import sensor_log, weaving_flight

from testbed.base.errors import InputError
from testbed.data import estimator, registry
from testbed.scenario.windows import Window
from testbed.tuning.config import RMSE_METRICS, TuneConfig
from testbed.tuning.objective import DEVIANCE, Objective, Recording, full_score
from testbed.tuning.space import AxisConfig, make_space

LOG_AXIS = {"size": 3, "low": 1e-3, "high": 1e3, "axis": "log", "squared": True}
EIGHTEEN = [
    AxisConfig(name=name, **LOG_AXIS)
    for name in (
        "position_std_scale",
        "velocity_std_scale",
        "accel_noise_scale",
        "gyro_noise_scale",
        "accel_bias_scale",
        "gyro_bias_scale",
    )
]


def recording(seed=0, duration=20.0, run=0, std=(10.0, 0.2, 0.001)):
    truth = weaving_flight(duration, rate=50.0)
    log = sensor_log(truth, seed, std=std, position_sigma=3.0, velocity_sigma=0.1, gnss_rate=5.0)
    return Recording("one", run, log, truth, None, (Window("all", ((-1.0, duration),)),), 1e5)


@pytest.fixture(scope="module")
def flight():
    return recording()


def objective(recordings, metrics=RMSE_METRICS, **options):
    return Objective("indirect-kf", {}, make_space("indirect-kf", EIGHTEEN), recordings, metrics, **options)


def test_origin_of_the_log_box_is_the_data_sheet():
    space = make_space("indirect-kf", EIGHTEEN)
    assert len(space.names) == 18
    np.testing.assert_allclose(space.bounds.low, -3.0)
    np.testing.assert_allclose(space.bounds.high, 3.0)
    assert set(map(tuple, space.decode(np.zeros(18)).values())) == {(1.0, 1.0, 1.0)}
    rng = np.random.default_rng(0)
    x = rng.uniform(-3.0, 3.0, 18)
    np.testing.assert_allclose(space.encode(space.decode(x)), x, atol=1e-12)


def test_squared_axis_is_a_variance():
    space = make_space("indirect-kf", [AxisConfig(name="measurement_noise", size=6, low=0.0, high=1.0, squared=True)])
    np.testing.assert_allclose(space.decode(np.full(6, 0.25))["measurement_noise"], 0.5)


def test_declared_space_is_the_default():
    space = make_space("indirect-kf", [])
    assert len(space.names) == 6
    np.testing.assert_allclose(space.bounds.high, 3.0)
    assert all(isinstance(v, float) for v in space.decode(np.zeros(6)).values())


def test_wrong_spaces_are_refused():
    with pytest.raises(InputError, match="did you mean 'gyro_noise_scale'"):
        make_space("indirect-kf", [AxisConfig(name="gyro_noise_scal")])
    with pytest.raises(InputError, match="give low and high"):
        make_space("indirect-kf", [AxisConfig(name="process_noise", size=12)])
    with pytest.raises(InputError, match="must be below"):
        make_space("indirect-kf", [AxisConfig(name="gyro_noise_scale", low=2.0, high=1.0)])
    with pytest.raises(InputError, match="positive on a log axis"):
        make_space("indirect-kf", [AxisConfig(name="gyro_noise_scale", low=0.0)])
    with pytest.raises(InputError, match="declares no parameter_space"):
        make_space("ins", [])


def test_three_scales_turn_single_axes(flight):
    """Three equal scales are one; a scale per axis multiplies its own density only."""

    def noise(**scales):
        """White noise (6,) and the variances of the first fix (6,), as a run takes them."""
        prepared = registry.make_estimator("indirect-kf", **scales).prepared(flight.log)
        return prepared.white, prepared.r[0]

    (white, r), (one, _), (three, _) = noise(), noise(gyro_noise_scale=2.0), noise(gyro_noise_scale=[2.0, 2.0, 2.0])
    np.testing.assert_array_equal(one, three)
    np.testing.assert_allclose(one, white * [1.0, 1.0, 1.0, 4.0, 4.0, 4.0])
    _, single = noise(position_std_scale=[1.0, 1.0, 5.0])
    np.testing.assert_allclose(single / r, [1.0, 1.0, 25.0, 1.0, 1.0, 1.0])
    for wrong in ([1.0, 2.0], [1.0, 0.0, 1.0], "two", True):
        with pytest.raises(InputError, match=r"a positive number|should be a number"):
            registry.make_estimator("indirect-kf", gyro_noise_scale=wrong)


def test_fast_path_equals_the_scorer(flight):
    """Same filter, same formula: with every sample counted only rounding differs (1e-9 of a metre, m/s or degree)."""
    x = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 18))
    for metrics in (RMSE_METRICS, ["rmse_yaw_deg", "rmse_down_m"], [DEVIANCE]):
        fast = objective([flight], metrics, stride=1)
        assert fast.fast
        params = [fast.space.decode(row) for row in x]
        slow = [sum(full_score("indirect-kf", p, flight)[m] for m in metrics) for p in params]
        np.testing.assert_allclose(fast(x), slow, atol=1e-8)


def test_stride_changes_little():
    """Without a transient at the start the error is smooth over ten samples (one fix interval): within 5 %."""
    settled, x = recording(std=(0.5, 0.02, 0.001)), np.zeros((1, 18))
    assert objective([settled], stride=10)(x)[0] == pytest.approx(objective([settled], stride=1)(x)[0], rel=0.05)


def test_threads_change_nothing(flight):
    x = np.random.default_rng(2).uniform(-2.0, 2.0, (6, 18))
    with objective([flight, recording(1)], jobs=3) as threaded:
        np.testing.assert_array_equal(threaded(x), objective([flight, recording(1)])(x))


def test_cases_add_and_runs_average(flight):
    """Two cases: the sum; two runs of one case: the mean."""
    x = np.zeros((1, 18))
    other = recording(1, run=1)
    single = [objective([r])(x)[0] for r in (flight, other)]
    assert objective([flight, other])(x)[0] == pytest.approx(np.mean(single), rel=1e-12)
    assert objective([flight, replace(other, case="two")])(x)[0] == pytest.approx(np.sum(single), rel=1e-12)


def test_innovations_are_likeliest_at_the_true_noise():
    """White fixes with 3 m and 0.1 m/s: over 150 fixes the likelihood must prefer the true R to 2 times more or less."""
    flight = recording(3, duration=30.0)
    space = make_space("indirect-kf", [AxisConfig(name="position_std_scale"), AxisConfig(name="velocity_std_scale")])
    likelihood = Objective("indirect-kf", {}, space, [flight], [DEVIANCE])
    x = np.log10([[1.0, 1.0], [2.0, 1.0], [0.5, 1.0], [1.0, 2.0], [1.0, 0.5]])
    assert np.argmin(likelihood(x)) == 0


@dataclass(frozen=True)
class Shifted:
    """The strapdown's answer from the true start, moved up by ``up_m``; raises above 5, NaN above 3."""

    up_m: float = 0.0
    name = "shifted"
    parameter_space = {"up_m": (-1.0, 6.0, "linear")}

    def run(self, log):
        if self.up_m > 5.0:
            raise ArithmeticError("as told")
        solution = registry.make_estimator("ins").run(log)
        lift = np.nan if self.up_m > 3.0 else self.up_m - 0.5
        return replace(solution, h=solution.h + lift)


@pytest.fixture
def shifted(monkeypatch):
    monkeypatch.setitem(registry._plugins, "shifted", Shifted)


def test_any_estimator_and_metric(flight, shifted):
    """The general path: a metric and window of the scenario's; what raises or diverges costs the penalty."""
    late = replace(flight, windows=(*flight.windows, Window("late", ((10.0, 20.0),))))
    space = make_space("shifted", [])
    general = Objective("shifted", {}, space, [late], ["mean_down_m"], window="late", penalty=123.0)
    assert not general.fast
    f = general(np.array([[0.0], [1.0], [4.0], [5.5]]))
    table = full_score("shifted", {"up_m": 0.0}, late, "late")
    assert f[0] == table["mean_down_m"] != full_score("shifted", {"up_m": 0.0}, late)["mean_down_m"]
    assert list(f[2:]) == [123.0, 123.0]


def test_processes_change_nothing(flight):
    """Worker processes score as this one does (an estimator of the entry points: plug-ins are loaded by the driver)."""
    space = make_space("indirect-kf", EIGHTEEN[:1])
    x = np.zeros((1, 3))
    arguments = ("indirect-kf", {}, space, [flight], ["max_yaw_deg"])
    with Objective(*arguments, jobs=2) as pool:
        assert not pool.fast
        np.testing.assert_array_equal(pool(x), Objective(*arguments)(x))


def test_configuration_is_checked():
    from testbed.base.schema import validate

    for wrong, message in (
        ({"algorithms": ["ipo", "gaa"]}, "unknown algorithm"),
        ({"metrics": ["rmse_yaw"]}, "rmse_yaw_deg"),
        ({"train_runs": [0, 1], "test_runs": [1]}, "both"),
        ({"population": 1}, "greater than or equal to 2"),
        ({"population": 4, "algorithms": ["pso", "de"]}, "population is 4, but algorithm 'de' needs at least 5"),
        ({"population": 4, "innovation_search": "de"}, "population is 4, but algorithm 'de' needs at least 5"),
        ({"populaton": 10}, "did you mean 'population'"),
    ):
        with pytest.raises(InputError, match=message):
            validate(TuneConfig, wrong, "test")


def deaf_filter():
    """An `indirect-kf` whose own run ignores its parameters."""
    from estimators.methods.indirect_kf import IndirectKf

    @dataclass(frozen=True)
    class Deaf(IndirectKf):
        name = "deaf"

        def run(self, log):
            return IndirectKf().run(log)

    return Deaf


def test_a_subclass_with_its_own_run_is_scored_by_its_own_run(flight, monkeypatch):
    """The parent's fast path would tell its candidates apart; its own run cannot."""
    monkeypatch.setitem(registry._plugins, "deaf", deaf_filter())
    space = make_space("indirect-kf", EIGHTEEN)
    with Objective("deaf", {}, space, [flight], ["rmse_north_m"]) as own:
        assert not own.fast
        values = own(np.array([np.zeros(18), np.full(18, 1.5)]))
    assert values[0] == values[1]


def test_fast_paths_belong_to_the_class_that_defines_run():
    class Parent:
        name = "parent"

        def run(self, log):
            return self.gain(log)

        def gain(self, log):
            return log

        @staticmethod
        def searcher(log):
            return log

    relatives = {
        "renamed": type("A", (Parent,), {"name": "renamed", "step": 0.5}),
        "own run": type("B", (Parent,), {"run": lambda self, log: None}),
        "own part of run": type("C", (Parent,), {"gain": lambda self, log: None}),
        "own of both": type("D", (Parent,), {"run": lambda self, log: None, "searcher": staticmethod(abs)}),
        "below an own run": type("E", (type("F", (Parent,), {"run": lambda self, log: None}),), {}),
        "none at all": type("G", (), {"run": lambda self, log: None}),
    }
    allowed = {key: estimator.fast_path(kind, "searcher") is not None for key, kind in relatives.items()}
    assert [key for key, fast in allowed.items() if fast] == ["renamed", "own of both"]
