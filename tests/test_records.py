"""The three nouns: checks at construction, and exact round trips through files."""

import numpy as np
import pytest

from testbed.errors import InputError
from testbed.records import (
    BaroSamples,
    GnssFixes,
    ImuSamples,
    InitialState,
    MagSamples,
    NavSolution,
    Phase,
    SensorLog,
    Trajectory,
)
from testbed.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec, TriadSpec


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
    solution = NavSolution(**navigation_columns(20, rng), accel_bias=rng.random((20, 3)), std=rng.random((20, 15)))
    solution.save(tmp_path / "s.parquet")
    loaded = NavSolution.load(tmp_path / "s.parquet")
    assert_same_arrays(solution, loaded)
    assert loaded.gyro_bias is None


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
