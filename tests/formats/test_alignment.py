"""The start of a recording: rest, positions alone, headings from motion, keys that act. Truth is known in closed form."""

from __future__ import annotations

import re
from pathlib import Path

import formats_flight
import numpy as np
import pytest
from scipy.io import loadmat, savemat

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.data.records import GnssFixes, ImuSamples
from testbed.data.specs import GnssSpec, ImuSpec, TriadSpec
from testbed.formats import export_log, first_motion, import_log
from testbed.formats.alignment import Given, align
from testbed.formats.config import AlignmentConfig
from testbed.formats.first_motion import with_derived_velocity
from testbed.physics import earth
from testbed.physics.rotations import quat_to_euler, quats_to_eulers

IMU = ImuSpec(
    "test",
    100.0,
    TriadSpec(turn_on_bias=0.02, bias_instability=5e-5, white_noise=1e-4),
    TriadSpec(turn_on_bias=0.03, white_noise=1e-3),
)
SPEC = GnssSpec("test", 5.0, horizontal_sigma=0.02, vertical_sigma=0.03, velocity_sigma=0.05)
BIAS = np.array([0.01, -0.015, 0.02])
HEADING, REST = np.radians(130.0), 30.0


def car(top_speed: float, spec: GnssSpec = SPEC, turn: float = 0.0) -> tuple[ImuSamples, GnssFixes]:
    """At rest for 30 s with a heading of 130°, then at 1 m/s² up to ``top_speed``; yaw turns by ``turn`` (rad/s) from 20 s on."""
    rng = np.random.default_rng(5)
    t = np.arange(1, 9001) / 100.0
    speed = np.clip(t - REST, 0.0, top_speed)
    moving = ((t > REST) & (t < REST + top_speed)).astype(float)
    rate = np.where(t > REST, turn, 0.0)
    gyro = np.column_stack([0 * t, 0 * t, rate]) + BIAS + 1e-3 * rng.standard_normal((len(t), 3))
    accel = np.column_stack([moving, speed * rate, np.full_like(t, -9.8065)]) + 0.01 * rng.standard_normal((len(t), 3))
    yaw = HEADING + np.cumsum(rate) / 100.0
    v_n = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw), 0.0 * t])
    way = np.cumsum(v_n, axis=0) / 100.0
    k = slice(19, None, 20)
    noise = rng.standard_normal((len(t[k]), 6))
    per_lat, per_lon = earth.metres_per_radian(np.radians(45.0), 100.0)
    position = way[k] + noise[:, :3] * [spec.horizontal_sigma, spec.horizontal_sigma, spec.vertical_sigma]
    lat, lon = np.radians(45.0) + position[:, 0] / per_lat, np.radians(7.0) + position[:, 1] / per_lon
    gnss = GnssFixes(t[k], lat, lon, 100.0 - position[:, 2], v_n[k] + spec.velocity_sigma * noise[:, 3:], spec)
    return ImuSamples(t, gyro, accel, IMU), gnss


def test_rest_levels_and_gives_the_gyro_biases() -> None:
    """28 s of rest: 1e-4 rad/s/√Hz leave 2e-5 rad/s, the Earth 7e-5; the stated sigma covers both and is far below 0.02."""
    imu, gnss = car(10.0)
    aligned = align(AlignmentConfig(heading="none"), imu, gnss, None, None, 0.0, "test")
    error = aligned.initial.gyro_bias - BIAS
    assert (np.abs(error) < 3.0 * aligned.initial.std[12:]).all()
    assert aligned.initial.std[12:].max() < 2e-4
    roll, pitch, _ = quat_to_euler(aligned.initial.q_nb)
    assert max(abs(roll), abs(pitch)) < 3.0 * 0.01 / 9.8 / np.sqrt(200.0) + 1e-3
    assert any("at rest for the first" in note for note in aligned.notes)


@pytest.mark.parametrize("turn", [0.0, 0.2])
@pytest.mark.parametrize("top_speed", [12.0, 2.0])
def test_heading_at_rest_comes_from_the_first_motion(top_speed: float, turn: float) -> None:
    """Carried back over the turn since then; below 5 m/s too. Without a crab angle the error is that of the velocity."""
    imu, gnss = car(top_speed, turn=turn)
    aligned = align(AlignmentConfig(crab_deg=1.0), imu, gnss, None, None, 0.0, "test")
    yaw = quat_to_euler(aligned.initial.q_nb)[2]
    error = np.degrees((yaw - HEADING + np.pi) % (2 * np.pi) - np.pi)
    assert abs(error) < 3.0 * np.degrees(aligned.initial.std[8])
    assert np.degrees(aligned.initial.std[8]) < 6.0
    assert any("carried back by the gyros" in note for note in aligned.notes)


def test_heading_from_two_fixes_without_velocities() -> None:
    """2 m/s, positions of 2 cm alone: the line between two fixes, turned back."""
    imu, gnss = car(2.0)
    fixes = with_derived_velocity(GnssFixes(gnss.t, gnss.lat, gnss.lon, gnss.h, 0.0 * gnss.v_n, SPEC))
    aligned = align(AlignmentConfig(crab_deg=1.0), imu, fixes, None, None, 0.0, "test", Given(position_only=True))
    yaw = quat_to_euler(aligned.initial.q_nb)[2]
    assert abs(np.degrees(yaw - HEADING)) < 3.0 * np.degrees(aligned.initial.std[8])
    assert np.degrees(aligned.initial.std[8]) < 15.0


def test_a_heading_that_nothing_tells_is_said() -> None:
    imu, gnss = car(0.0)
    aligned = align(AlignmentConfig(), imu, gnss, None, None, 0.0, "test")
    assert aligned.initial.std[8] == pytest.approx(np.pi / np.sqrt(3.0))
    assert any("nothing tells the heading" in note for note in aligned.notes)


def test_derived_velocities_have_an_honest_sigma() -> None:
    """White positions of 2 cm at 5 Hz: the normalised errors of 440 velocities (110 independent) have unit variance."""
    _, gnss = car(12.0)
    derived = with_derived_velocity(GnssFixes(gnss.t, gnss.lat, gnss.lon, gnss.h, 0.0 * gnss.v_n, SPEC))
    true = np.clip(gnss.t - REST, 0.0, 12.0)
    error = derived.v_n[:, :2] - true[:, None] * [np.cos(HEADING), np.sin(HEADING)]
    spread = np.mean((error / derived.std[:, 3:5]) ** 2)
    assert spread == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 220.0))


def test_velocity_at_the_start_of_positions_alone(tmp_path: Path) -> None:
    """A turning flight at 30 m/s with fixes of 1.5 m: velocity within its sigma, which is below 3 m/s."""
    trajectory = formats_flight.make_trajectory(20.0)
    gnss = formats_flight.make_log(trajectory).gnss
    start = first_motion.at_first_fix(gnss)
    assert (np.abs(start.v_n - trajectory.v_n[20])[:2] < 3.0 * start.v_std).all()
    assert start.v_std < 3.0


@pytest.mark.parametrize(
    ("key", "value"), [("yaw_deg", 200.0), ("roll_deg", 5.0), ("yaw_std_deg", 33.0), ("roll_pitch_std_deg", 7.0)]
)
def test_keys_of_the_start_act_on_a_log_that_states_one(key: str, value: float, tmp_path: Path) -> None:
    trajectory = formats_flight.make_trajectory(10.0)
    export_log(formats_flight.make_log(trajectory), tmp_path, "csv", reference=trajectory)
    initial = import_log("table", tmp_path, initial={key: value}).log.initial
    angles = np.degrees(quats_to_eulers(initial.q_nb[None])[0])
    if key == "yaw_deg":
        assert angles[2] == pytest.approx(-160.0)
    elif key == "roll_deg":
        assert angles[0] == pytest.approx(5.0)
    else:
        axis = 8 if key == "yaw_std_deg" else 6
        assert np.degrees(initial.std[axis]) == pytest.approx(
            value, rel=0.05
        )  # roll and pitch of 20° and 3° mix by cos 20°


def test_asking_for_another_heading_aligns_anew(tmp_path: Path) -> None:
    trajectory = formats_flight.make_trajectory(10.0)
    export_log(formats_flight.make_log(trajectory), tmp_path, "csv", reference=trajectory)
    plain, turned = (
        import_log("table", tmp_path, initial={"heading": "mag", "declination_deg": d}).log.initial for d in (0.0, 3.0)
    )
    yaws = [np.degrees(quat_to_euler(x.q_nb)[2]) for x in (plain, turned)]
    assert (
        3.0 < yaws[1] - yaws[0] < 6.0
    )  # in a banked turn roll and pitch follow the heading, and take it further along


def navego_at_rest(folder: Path, bias: np.ndarray, stated: np.ndarray, ab_sta: np.ndarray) -> None:
    """A level unit at rest, 20 s: gyros off by ``bias``, accelerometers by ``ab_sta``; the struct states ``stated``."""
    n, one = 2001, np.ones(3)
    t, lat = np.arange(n) * 0.01, np.radians(45.0)
    rate = 7.292115e-5 * np.array([np.cos(lat), 0.0, -np.sin(lat)])
    imu = {"t": t[:, None], "wb": np.tile(rate + bias, (n, 1)), "fb": np.tile(ab_sta - [0.0, 0.0, 9.8062], (n, 1))}
    imu |= {"arw": 1e-4 * one, "vrw": 1e-3 * one, "gb_sta": stated, "ab_sta": ab_sta, "gb_dyn": 4e-5 * one}
    imu |= {"ab_dyn": 5e-5 * one, "gb_corr": 1e3 * one, "ab_corr": 1e3 * one, "freq": 100.0}
    imu |= {"ini_align": 0.0 * one, "ini_align_err": np.radians(one)}
    at = np.arange(0.0, 20.01, 1.0)
    one_column = np.ones((len(at), 1))
    gnss = {"t": at[:, None], "lat": lat * one_column, "lon": 0.0 * one_column, "h": 0.0 * one_column}
    gnss |= {"vel": np.zeros((len(at), 3)), "stdm": [1.0, 1.0, 2.0], "stdv": 0.05 * one, "larm": 0.0 * one, "freq": 1.0}
    savemat(folder / "imu.mat", {"imu": imu})
    savemat(folder / "gnss.mat", {"gnss": gnss})


@pytest.mark.parametrize(
    ("bias", "ab_sta", "words"),
    [
        ([-0.004, 0.002, -0.005], [0.0, 0.0, 0.0], "negative values"),
        ([0.004, 0.002, 0.005], [0.0, 0.0, 0.0], "is what the gyros show at rest"),
        ([0.004, 0.002, 0.005], [0.2, -0.019, 0.1], "negative values"),
    ],
)
def test_a_static_bias_of_navego_is_removed(bias: list, ab_sta: list, words: str, tmp_path: Path) -> None:
    """NaveGo's ins_gnss subtracts gb_sta and ab_sta: where they are biases a level unit stays level."""
    navego_at_rest(tmp_path, np.array(bias), np.array(bias), np.array(ab_sta))
    recording = import_log("navego", tmp_path)
    assert np.array_equal(recording.log.initial.gyro_bias, bias)
    assert any(words in note for note in recording.notes)
    corrected = np.degrees((recording.log.imu.gyro - recording.log.initial.gyro_bias).mean(axis=0) * 20.0)
    assert np.abs(corrected).max() < 0.1  # uncorrected it would be 5.7°
    assert np.abs(recording.log.imu.accel - [0.0, 0.0, -9.8062]).max() < 1e-9


def test_a_data_sheets_size_is_no_bias(tmp_path: Path) -> None:
    """0.005 rad/s all around, and the unit's own bias at rest is another one."""
    navego_at_rest(tmp_path, np.array([0.001, -0.003, 0.0049]), np.full(3, 0.005), np.zeros(3))
    recording = import_log("navego", tmp_path)
    assert not recording.log.initial.gyro_bias.any()
    assert recording.log.initial.std[12:15] == pytest.approx(0.005)
    assert not any("gb_sta" in note for note in recording.notes)


def test_in_motion_nothing_tells_a_bias_from_a_size(tmp_path: Path) -> None:
    """Which is said, with the way to take a bias off."""
    log = formats_flight.make_log(formats_flight.make_trajectory(5.0))
    export_log(log, tmp_path, "navego")
    struct = loadmat(tmp_path / "imu.mat")["imu"][0, 0]
    left = {key: struct[key] for key in struct.dtype.names if key not in ("testbed_spec", "ini_state", "ini_std")}
    savemat(tmp_path / "imu.mat", {"imu": left})
    told = import_log("navego", tmp_path)
    assert any("gb_sta has positive values alone" in note and "gyro_bias_dps" in note for note in told.notes)
    biases = {"gyro_bias_dps": [0.5, 0.0, -1.0], "accel_bias_mg": [0.0, 10.0, 0.0]}
    less = import_log("navego", tmp_path, imu=biases)
    assert not any("gb_sta" in note for note in less.notes)
    gyro, accel = (np.mean(getattr(told.log.imu, x) - getattr(less.log.imu, x), axis=0) for x in ("gyro", "accel"))
    assert np.degrees(gyro) == pytest.approx([0.5, 0.0, -1.0])
    assert accel == pytest.approx([0.0, 0.0980665, 0.0])
    with pytest.raises(InputError, match=r"gyro_bias_dps is 3, expected the biases \[x, y, z\]"):
        import_log("navego", tmp_path, imu={"gyro_bias_dps": 3})


def test_declination_of_place_and_date_or_of_the_log(tmp_path: Path) -> None:
    """47° N 8.5° E has 3.5° east in 2025 (published map, to half a degree); a log with an epoch in its stamps tells the date."""
    trajectory = formats_flight.make_trajectory(10.0)
    log = formats_flight.make_log(trajectory)
    export_log(log, tmp_path, "csv")
    (tmp_path / "log.json").unlink()
    given = {"imu": {"model": "ADIS16448"}, "gnss": {"model": "Garmin16x"}}
    recording = import_log("table", tmp_path, initial={"heading": "mag"}, **given)
    assert np.degrees(recording.log.mag.spec.declination) == pytest.approx(3.5, abs=0.5)
    assert any("World Magnetic Model" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"attitude": "reference", "heading": "mag"}, "heading would have no effect beside attitude = 'reference'"),
        ({"attitude": "reference", "level_s": 3.0}, "level_s would have no effect beside attitude = 'reference'"),
        ({"yaw_deg": 10.0, "heading": "course"}, "heading would have no effect beside yaw_deg"),
        ({"yaw_deg": 10.0, "crab_deg": 3.0}, "crab_deg would have no effect beside yaw_deg"),
        ({"heading": "none", "crab_deg": 3.0}, "crab_deg would have no effect beside heading = 'none'"),
    ],
)
def test_a_key_without_effect_is_refused(keys, told):
    with pytest.raises(InputError, match=re.escape(told)):
        validate(AlignmentConfig, keys, "recording.initial")
