"""The three nouns: checks at construction, and exact round trips through files."""

import numpy as np
import pytest

from testbed.base.errors import InputError
from testbed.data.columns import exact_columns, write_table
from testbed.data.records import (
    STATE_NAMES,
    BaroSamples,
    GnssFixes,
    ImuSamples,
    InitialState,
    Innovations,
    MagSamples,
    NavSolution,
    Phase,
    SensorLog,
    Trajectory,
)
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec, TriadSpec


def navigation_columns(n: int, rng: np.random.Generator) -> dict:
    q = rng.standard_normal((n, 4))
    return {
        "t": 0.01 * np.arange(n),
        "lat": 0.5 + 1e-6 * rng.standard_normal(n),
        "lon": -1.0 + 1e-6 * rng.standard_normal(n),
        "h": 100.0 + rng.standard_normal(n),
        "v_n": rng.standard_normal((n, 3)),
        "q_nb": q / np.linalg.norm(q, axis=1, keepdims=True),
    }


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(1)
    columns = navigation_columns(50, rng)
    f_b, w_ib_b = rng.standard_normal((50, 3)), rng.standard_normal((50, 3))
    phases = (Phase("straight", 0.0, 0.2), Phase("turn", 0.2, 0.49))
    return Trajectory(**columns, f_b=f_b, w_ib_b=w_ib_b, extra={"throttle": rng.random(50)}, phases=phases, name="x")


@pytest.fixture
def log() -> SensorLog:
    rng = np.random.default_rng(2)
    spec = ImuSpec("unit", 100.0, TriadSpec(white_noise=1e-3, range=6.0), TriadSpec(true_bias=(1.0, 2.0, 3.0)))
    imu = ImuSamples(0.01 * np.arange(1, 50), rng.standard_normal((49, 3)), rng.standard_normal((49, 3)), spec)
    place = [0.1 * np.arange(4), 0.5 + 1e-7 * np.arange(4), np.full(4, -1.0), np.arange(4.0)]
    gnss = GnssFixes(*place, v_n=rng.standard_normal((4, 3)), spec=GnssSpec("g", 5.0, 1.0), outages=((0.1, 0.2),))
    mag = MagSamples(np.arange(3.0), rng.standard_normal((3, 3)), MagSpec())
    baro = BaroSamples(np.arange(3.0), 101325.0 + rng.standard_normal(3), BaroSpec())
    initial = InitialState(0.0, 0.5, -1.0, 3.0, np.zeros(3), np.eye(4)[0], np.zeros(3), np.zeros(3), np.ones(15))
    return SensorLog(imu, initial, gnss, mag, baro, "demo")


def assert_same_arrays(a, b):
    for name, value in vars(a).items():
        if isinstance(value, np.ndarray) and name not in ("lat", "lon"):
            np.testing.assert_array_equal(getattr(b, name), value)


def test_trajectory_round_trip(trajectory, tmp_path):
    """Bit-equal but for the angles, which pass through degrees: two roundings of 1e-16 relative."""
    trajectory.save(tmp_path / "t.parquet")
    loaded = Trajectory.load(tmp_path / "t.parquet")
    assert_same_arrays(trajectory, loaded)
    np.testing.assert_allclose(loaded.lat, trajectory.lat, rtol=5e-16)
    np.testing.assert_array_equal(loaded.extra["throttle"], trajectory.extra["throttle"])
    assert loaded.phases == trajectory.phases


def test_log_round_trip(log, tmp_path):
    log.save(tmp_path / "log")
    loaded = SensorLog.load(tmp_path / "log")
    for part in ("imu", "gnss", "mag", "baro", "initial"):
        assert_same_arrays(getattr(log, part), getattr(loaded, part))
        if part != "initial":
            assert getattr(loaded, part).spec == getattr(log, part).spec
    np.testing.assert_array_equal(loaded.gnss.lat, log.gnss.lat)
    assert loaded.gnss.outages == log.gnss.outages


def test_solution_round_trip(tmp_path):
    rng = np.random.default_rng(3)
    names = ("accel_scale_x", "attitude_north_rad", "baro_bias_m")
    solution = NavSolution(
        **navigation_columns(20, rng),
        accel_bias=rng.random((20, 3)),
        std=rng.random((20, 3)),
        states=names,
        estimates={"baro_bias_m": rng.random(20)},
    )
    solution.save(tmp_path / "s.parquet")
    loaded = NavSolution.load(tmp_path / "s.parquet")
    assert_same_arrays(solution, loaded)
    assert loaded.gyro_bias is None and loaded.states == names
    np.testing.assert_array_equal(loaded.estimates["baro_bias_m"], solution.estimates["baro_bias_m"])


def test_a_solution_of_version_0_1_is_read(tmp_path):
    """It has the 15 states in their order and no list of them."""
    rng = np.random.default_rng(3)
    solution = NavSolution(**navigation_columns(20, rng), std=rng.random((20, 15)), states=STATE_NAMES)
    exact = exact_columns(solution.lat, solution.lon, solution.q_nb)
    write_table(solution.to_frame().assign(**exact), tmp_path / "s.parquet", "NavSolution", {})
    loaded = NavSolution.load(tmp_path / "s.parquet")
    assert loaded.states == STATE_NAMES
    np.testing.assert_array_equal(loaded.std, solution.std)


def test_states_must_fit_what_is_said_of_them():
    columns = navigation_columns(20, np.random.default_rng(4))
    with pytest.raises(InputError, match="of 3 states; name them"):
        NavSolution(**columns, std=np.ones((20, 3)))
    with pytest.raises(InputError, match=r"'std' has shape \(20, 15\), expected \(20, 2\)"):
        NavSolution(**columns, std=np.ones((20, 15)), states=("a", "b"))
    with pytest.raises(
        InputError, match=r"'covariance' has shape \(4, 3, 3\) and 'covariance_t' \(4,\), expected \(K, 2, 2\)"
    ):
        NavSolution(**columns, covariance_t=np.arange(4.0), covariance=np.ones((4, 3, 3)), states=("a", "b"))
    with pytest.raises(InputError, match="'states' names b twice"):
        NavSolution(**columns, states=("a", "b", "b"))
    with pytest.raises(InputError, match="estimate 'baro_bias_m' has shape"):
        NavSolution(**columns, estimates={"baro_bias_m": np.ones(3)})
    with pytest.raises(InputError, match="'rejected' is float64"):
        Innovations(np.arange(3.0), np.ones((3, 1)), np.ones((3, 1, 1)), rejected=np.zeros(3))
    with pytest.raises(InputError, match="'covariance' has shape"):
        Innovations(np.arange(3.0), np.ones((3, 2)), np.ones((3, 1, 1)))


def test_sigmas_are_not_negative_and_nothing_is_complex():
    """A square root of a negative variance is a mistake of the filter; the imaginary part of an array would be lost."""
    columns = navigation_columns(20, np.random.default_rng(4))
    std = np.ones((20, 2))
    std[7, 1] = -0.5
    with pytest.raises(
        InputError, match=r"'std' is 1 sigma and must not be negative, but that of b is -0.5 at sample 7"
    ):
        NavSolution(**columns, std=std, states=("a", "b"))
    std[7, 1] = np.nan  # divergence
    NavSolution(**columns, std=std, states=("a", "b"))
    snapshots = {"covariance_t": np.arange(4.0), "covariance": np.ones((4, 2, 2)) + 0j, "states": ("a", "b")}
    for wrong, named in (
        (columns | {"h": columns["h"] + 0j}, "'h'"),
        (columns | {"t": columns["t"] + 0j}, "'t'"),
        (columns | snapshots, "'covariance'"),
        (columns | {"estimates": {"own": columns["h"] + 0j}}, r"'estimates\.own'"),
        (columns | {"extras": {"gain": (np.arange(4.0), np.ones(4) + 0j)}}, r"'extras\.gain'"),
    ):
        with pytest.raises(InputError, match=f"NavSolution: {named} is complex"):
            NavSolution(**wrong)
    with pytest.raises(InputError, match="NavSolution: 'h' is no array of numbers"):
        NavSolution(**columns | {"h": ["high"] * 20})


def test_a_solution_without_names_is_told_how_to_give_them():
    columns = navigation_columns(20, np.random.default_rng(4))
    with pytest.warns(FutureWarning, match=r"states=testbed.data.records.STATE_NAMES"):
        solution = NavSolution(**columns, std=np.ones((20, 15)))
    assert solution.states == STATE_NAMES
    alone = Innovations(np.arange(3.0), np.ones((3, 6)), np.ones((3, 6, 6)))
    assert NavSolution(**columns, innovations=alone).innovations == {"gnss": alone}


def test_wrong_shape_is_refused(trajectory):
    with pytest.raises(InputError, match=r"'v_n' has shape \(50, 2\), expected \(50, 3\)"):
        Trajectory(**vars(trajectory) | {"v_n": trajectory.v_n[:, :2]})


def test_nan_is_refused_with_its_place(trajectory):
    h = trajectory.h.copy()
    h[17] = np.nan
    with pytest.raises(InputError, match="'h' is not finite at sample 17"):
        Trajectory(**vars(trajectory) | {"h": h})


def test_decreasing_time_is_refused_with_its_place(trajectory):
    t = trajectory.t.copy()
    t[30] = t[10]
    with pytest.raises(InputError, match="time must increase, but sample 30"):
        Trajectory(**vars(trajectory) | {"t": t})


def test_a_file_of_another_kind_is_refused(trajectory, tmp_path):
    trajectory.save(tmp_path / "t.parquet")
    with pytest.raises(InputError, match="holds Trajectory, expected NavSolution"):
        NavSolution.load(tmp_path / "t.parquet")
    (tmp_path / "broken.parquet").write_bytes(b"PAR1 nothing here")
    with pytest.raises(InputError, match="not a readable Parquet file"):
        Trajectory.load(tmp_path / "broken.parquet")
    with pytest.raises(InputError, match="no such file"):
        Trajectory.load(tmp_path / "absent.parquet")
