"""What a recording shows that cannot be: each kind is refused, or told in a sentence that names file and place."""

from __future__ import annotations

import json
from pathlib import Path

import formats_flight
import numpy as np
import pandas as pd
import pytest

from testbed.base.errors import InputError
from testbed.data.records import SensorLog, Trajectory
from testbed.formats import export_log, import_log
from testbed.formats.recording import Recording, seconds

IMU = {
    "gyro_turn_on_bias_dps": 0.05,
    "gyro_arw_dpsqrth": 0.6,
    "accel_turn_on_bias_mg": 3.0,
    "accel_vrw_mpspsqrth": 0.06,
}
GNSS = {"horizontal_sigma_m": 1.5, "vertical_sigma_m": 2.5, "velocity_sigma_mps": 0.05, "lever_arm_m": [0.3, 0.0, -0.1]}


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """A climbing turn of 90 s."""
    return formats_flight.make_trajectory(90.0, turn=0.12)


@pytest.fixture(scope="module")
def log(trajectory: Trajectory) -> SensorLog:
    return formats_flight.make_log(trajectory)


def tables(log: SensorLog, trajectory: Trajectory | None, folder: Path) -> Path:
    """The log as a practitioner has it: tables without log.json, fixes without sigmas."""
    export_log(log, folder, "csv", reference=trajectory)
    (folder / "log.json").unlink()
    change(folder, "gnss", lambda f: f.drop(columns=[c for c in f if c.startswith("std_")]))
    return folder


def change(folder: Path, part: str, edit) -> None:
    path = folder / f"{part}.csv"
    edit(pd.read_csv(path)).to_csv(path, index=False)


def scaled(prefix: str, factor: float):
    return lambda f: f.assign(**{c: f[c] * factor for c in f if c.startswith(prefix)})


def read(folder: Path, **options) -> Recording:
    return import_log("table", folder, **({"imu": IMU, "gnss": GNSS} | options))


REFUSED = {
    "accelerometer in g": ("imu", scaled("accel_", 1 / 9.80665), ["imu.csv", "1 g", "unit were g"]),
    "accelerometer in mg": ("imu", scaled("accel_", 1e3 / 9.80665), ["imu.csv", "unit were mg"]),
    "velocity increments": ("imu", scaled("accel_", 0.01), ["imu.csv", "increments"]),
    "gyro in deg/s": ("imu", scaled("gyro_", 180 / np.pi), ["imu.csv", "°/s named rad/s"]),
    "gyro in rad/s named deg/s": ("imu", scaled("gyro_", np.pi / 180), ["imu.csv", "rad/s named °/s"]),
    "accelerometer's sign": ("imu", scaled("accel_", -1.0), ["imu.csv", "sign"]),
    "another clock": (
        "gnss",
        lambda f: f.assign(time_s=f["time_s"] + 1e6),
        ["gnss.csv", "does not overlap", "clock_s"],
    ),
    "magnetometer's clock": ("mag", lambda f: f.assign(time_s=f["time_s"] - 1e6), ["mag.csv", "does not overlap"]),
    "reference of another day": (
        "reference",
        lambda f: f.assign(time_s=f["time_s"] + 1e5),
        ["reference.csv", "does not overlap"],
    ),
    "reference elsewhere": ("reference", lambda f: f.assign(lat_deg=f["lat_deg"] + 0.5), ["reference.csv", "beside"]),
    "latitude beyond 90": ("gnss", lambda f: f.assign(lat_deg=f["lat_deg"] + 50.0), ["gnss.csv", "±90°"]),
    "sigma of zero": ("gnss", lambda f: f.assign(**sigmas(0.0)), ["gnss.csv", "std_north_m is 0 at sample 0"]),
    "negative sigma": ("gnss", lambda f: f.assign(**sigmas(-1.0)), ["gnss.csv", "std_north_m is -1 at sample 0"]),
    "milliseconds named seconds": (
        "imu",
        lambda f: f.assign(time_s=f["time_s"] * 1e3),
        ["imu.csv", "0.1 samples a second", "1 to 40000", "time_ms"],
    ),
    "seconds named milliseconds": (
        "imu",
        lambda f: f.assign(time_s=f["time_s"] * 1e-3),
        ["imu.csv", "1e+05 samples a second", "time_s"],
    ),
    "fixes in milliseconds": (
        "gnss",
        lambda f: f.assign(time_s=(f["time_s"] - f["time_s"][0]) * 1e3),
        ["gnss.csv", "1 of its 450 rows", "time_ms"],
    ),
    "repeated stamp": ("imu", lambda f: pd.concat([f[:50], f[49:]]), ["imu.csv", "sample 50", "increase"]),
}


def sigmas(value: float) -> dict[str, float]:
    ned = ("north", "east", "down")
    return {f"std_{a}_m": value for a in ned} | {f"std_v_{a}_mps": value for a in ned}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_no_filter_could_use_is_refused(kind: str, log: SensorLog, trajectory: Trajectory, tmp_path: Path) -> None:
    part, edit, words = REFUSED[kind]
    change(tables(log, trajectory, tmp_path), part, edit)
    own = {} if "sigma" in kind else {"gnss": GNSS}
    with pytest.raises(InputError) as caught:
        import_log("table", tmp_path, imu=IMU, **own)
    assert caught.value.exit_code == 2
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize("kind", ["gyro in deg/s", "gyro in rad/s named deg/s", "accelerometer's sign"])
def test_turns_of_the_fixes_show_it_without_a_reference(kind: str, log: SensorLog, tmp_path: Path) -> None:
    part, edit, words = REFUSED[kind]
    change(tables(log, None, tmp_path), part, edit)
    with pytest.raises(InputError) as caught:
        read(tmp_path)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_a_sound_recording_raises_no_word(log: SensorLog, trajectory: Trajectory, tmp_path: Path) -> None:
    tables(log, trajectory, tmp_path)
    for part in ("mag", "baro"):
        (tmp_path / f"{part}.csv").unlink()
    assert read(tmp_path).notes == ()


def test_rows_without_a_fix_are_left_out(log: SensorLog, trajectory: Trajectory, tmp_path: Path) -> None:
    """Rows of zeros at the start and inside: the log is that without them."""
    tables(log, trajectory, tmp_path)
    sound = read(tmp_path).log
    change(tmp_path, "gnss", lambda f: pd.concat([zero(f, 0.05), f[:50], zero(f, 10.05), f[50:]]))
    recording = read(tmp_path)
    assert np.array_equal(recording.log.gnss.t, sound.gnss.t)
    assert np.array_equal(recording.log.initial.q_nb, sound.initial.q_nb)
    assert any(
        "gnss.csv: sample 0 lies at latitude 0, longitude 0" in note and "2 such" in note for note in recording.notes
    )


def test_times_since_an_epoch_are_told_with_their_offset(log, tmp_path: Path) -> None:
    """Fixes of Unix time beside an IMU that counts from 0: what the message offers as clock_s mends it."""
    tables(log, None, tmp_path)
    change(tmp_path, "gnss", lambda f: f.assign(time_s=f["time_s"] + 1714560000.0))
    with pytest.raises(InputError) as caught:
        read(tmp_path)
    assert "gnss.csv: 1714560000.2 to 1714560090 s does not overlap the IMU, 0 to 90 s" in str(caught.value)
    offset = float(str(caught.value).split("clock_s says by how much (")[1].split()[0])
    assert offset == pytest.approx(-1714560000.2, abs=1e-6)
    assert read(tmp_path, gnss=GNSS | {"clock_s": offset}).log.gnss.t[-1] == pytest.approx(89.8, abs=1e-6)


def test_times_keep_their_milliseconds() -> None:
    assert [seconds(t) for t in (1714560000.02, 29.990000000000002, 20.0, -1e-9)] == [
        "1714560000.02",
        "29.99",
        "20",
        "0",
    ]


def test_hardly_any_common_time_is_doubted(log, trajectory, tmp_path: Path) -> None:
    tables(log, trajectory, tmp_path)
    change(tmp_path, "mag", lambda f: f.assign(time_s=f["time_s"] + 85.0))
    (told,) = [note for note in read(tmp_path).notes if "do the clocks differ" in note]
    assert "mag.csv" in told and "within the times of the IMU, 0 to 90 s" in told


def test_an_initial_state_after_the_first_sample_is_refused(log, tmp_path: Path) -> None:
    export_log(log, tmp_path, "csv")
    change(tmp_path, "imu", lambda f: f.assign(time_s=f["time_s"] - f["time_s"][0]))
    with pytest.raises(
        InputError, match=r"imu.csv: the first sample is at 0 s, and the initial state \(log.json\) at 0 s"
    ):
        import_log("table", tmp_path)


def test_a_slow_imu_is_doubted(log, tmp_path: Path) -> None:
    """Every 40th sample of 100 a second."""
    tables(log, None, tmp_path)
    change(tmp_path, "imu", lambda f: f[::40])
    assert any("imu.csv: has 2.5 samples a second, too few" in note for note in read(tmp_path).notes)


def zero(frame: pd.DataFrame, t: float) -> pd.DataFrame:
    return (frame[:1] * 0.0).assign(time_s=t)


def test_fixes_before_the_imu_change_nothing(log: SensorLog, trajectory: Trajectory, tmp_path: Path) -> None:
    """A receiver that was on 20 s before the IMU: the start is that of the fixes which the IMU covers."""
    tables(log, trajectory, tmp_path)
    change(tmp_path, "imu", lambda f: f[2000:])
    change(tmp_path, "gnss", lambda f: f[f["time_s"] > 19.995])
    expected = read(tmp_path)
    tables(log, trajectory, tmp_path)
    change(tmp_path, "imu", lambda f: f[2000:])
    recording = read(tmp_path)
    assert recording.log.initial.t == expected.log.initial.t
    assert np.array_equal(recording.log.initial.std, expected.log.initial.std)
    assert np.array_equal(recording.log.initial.q_nb, expected.log.initial.q_nb)
    assert np.array_equal(recording.log.gnss.t, expected.log.gnss.t)
    assert any("99 fixes lie before the IMU's first sample" in note for note in recording.notes)


@pytest.mark.parametrize("delay", [0.3, -0.125])
def test_a_delay_between_the_clocks_is_told(delay: float, log: SensorLog, tmp_path: Path) -> None:
    """Within 0.02 s: half a step of the fixes would be 0.1 s, their noise of 0.05 m/s in 30 m/s over 400 fixes far less."""
    swinging = formats_flight.swinging_turns(log)
    tables(swinging, None, tmp_path)
    assert not any("before" in n or "after" in n for n in read(tmp_path).notes)
    change(tmp_path, "gnss", lambda f: f.assign(time_s=f["time_s"] + delay))
    (told,) = [note for note in read(tmp_path).notes if "clock_s" in note]
    assert ("after" if delay > 0 else "before") in told
    assert float(told.split("clock_s = ")[1].split()[0]) == pytest.approx(-delay, abs=0.02)
    mended = read(tmp_path, gnss=GNSS | {"clock_s": -delay})
    assert not any("clock_s" in note for note in mended.notes)


def test_gaps_are_named_once(log: SensorLog, trajectory: Trajectory, tmp_path: Path) -> None:
    tables(log, trajectory, tmp_path)
    change(tmp_path, "imu", lambda f: f[(f["time_s"] < 30.0) | (f["time_s"] > 32.0)])
    (told,) = [note for note in read(tmp_path).notes if "gap" in note]
    assert "imu.csv: a gap from 29.99 to 32.01 s" in told


def test_a_gap_of_the_imu_is_not_the_filters_fault() -> None:
    """A solution at the IMU's times is silent in the gap for everybody; one that is silent elsewhere is still refused."""
    from testbed.data.records import NavSolution
    from testbed.scoring.metrics import coverage

    def solution(t: np.ndarray) -> NavSolution:
        n = len(t)
        return NavSolution(t, np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((n, 3)), np.tile([1.0, 0, 0, 0], (n, 1)))

    t = np.arange(0.0, 70.0, 0.01)
    with_gap = t[(t < 30.0) | (t > 35.0)]
    assert coverage(solution(with_gap), 0.0, 70.0, [(29.99, 35.01)]) == ""
    assert "says nothing between 29.99 and 35.01" in coverage(solution(with_gap), 0.0, 70.0)
    silent = with_gap[(with_gap < 50.0) | (with_gap > 55.0)]
    assert "says nothing between 49.99 and 55.01" in coverage(solution(silent), 0.0, 70.0, [(29.99, 35.01)])


def test_velocities_in_another_unit_or_upwards_are_told(log: SensorLog, trajectory: Trajectory, tmp_path: Path) -> None:
    tables(log, trajectory, tmp_path)
    change(tmp_path, "gnss", lambda f: f.assign(v_north_mps=f["v_north_mps"] * 3.6, v_east_mps=f["v_east_mps"] * 3.6))
    (told,) = [note for note in read(tmp_path).notes if "times as far as the velocities" in note]
    assert float(told.split("move ")[1].split()[0]) == pytest.approx(1.0 / 3.6, rel=0.02)
    tables(log, trajectory, tmp_path)
    change(tmp_path, "gnss", lambda f: f.assign(v_down_mps=-f["v_down_mps"]))
    assert any("is it the velocity upwards" in note for note in read(tmp_path).notes)


def test_findings_stand_in_manifest_and_report(log: SensorLog, trajectory: Trajectory, tmp_path: Path) -> None:
    from testbed.base.notes import notes_of
    from testbed.scenario import load_scenario

    tables(log, trajectory, tmp_path / "data")
    change(tmp_path / "data", "imu", lambda f: f[(f["time_s"] < 30.0) | (f["time_s"] > 32.0)])
    scenario = {"scenario": 'name = "own"', "recording": 'format = "table"\ndir = "data"'}
    scenario |= {"recording.imu": "\n".join(f"{k} = {v}" for k, v in IMU.items())}
    scenario |= {"recording.gnss": "\n".join(f"{k} = {json.dumps(v)}" for k, v in GNSS.items())}
    text = "\n".join(f"[{k}]\n{v}" for k, v in scenario.items()) + '\n[[estimators]]\nname = "ins"\n'
    (tmp_path / "own.toml").write_text(text)
    assert any("a gap from 29.99" in note for note in notes_of(load_scenario(tmp_path / "own.toml")))


@pytest.mark.parametrize(("column", "value"), [("accel_x_mps2", 900.0), ("gyro_y_radps", -200.0)])
def test_a_single_sample_that_no_motion_explains(column: str, value: float, log, tmp_path: Path) -> None:
    """In the levelling, at the end of the file and nowhere else: the start is that of the sound file to 0.01°."""
    tables(log, None, tmp_path)
    sound = read(tmp_path).log

    def spoil(frame: pd.DataFrame) -> pd.DataFrame:
        frame.loc[[100, len(frame) - 1], column] = value
        return frame

    change(tmp_path, "imu", spoil)
    spoiled = read(tmp_path)
    (told,) = [note for note in spoiled.notes if "no motion does" in note]
    assert "imu.csv: sample 100" in told and "2 such" in told
    turn = 2.0 * np.arccos(min(1.0, abs(float(spoiled.log.initial.q_nb @ sound.initial.q_nb))))
    assert np.degrees(turn) < 0.01
    assert np.abs(spoiled.log.imu.accel).max() < 30.0 and np.abs(spoiled.log.imu.gyro).max() < 1.0


def test_one_wrong_velocity_does_not_tilt_the_start(log: SensorLog, tmp_path: Path) -> None:
    """20 m/s at the last fix of the levelling would be 10 m/s² and 45°; the median of the slopes is noisier by some 2°."""
    tables(log, None, tmp_path)
    sound = read(tmp_path).log

    def spoil(frame: pd.DataFrame) -> pd.DataFrame:
        last = int(np.searchsorted(frame["time_s"], frame["time_s"][0] + 2.0 + 1e-9, side="right")) - 1
        frame.loc[last, "v_east_mps"] += 20.0
        return frame

    change(tmp_path, "gnss", spoil)
    spoiled = read(tmp_path)
    assert any("do not agree with one another" in note for note in spoiled.notes)
    turn = 2.0 * np.arccos(min(1.0, abs(float(spoiled.log.initial.q_nb @ sound.initial.q_nb))))
    assert np.degrees(turn) < 2.0


def without(prefix: str):
    return lambda f: f.drop(columns=[c for c in f if c.startswith(prefix)])


def reference(folder: Path, **columns) -> list[str]:
    """Notes on the recording with the reference's columns changed, its attitude as Euler angles alone."""
    change(folder, "reference", lambda f: without("q_nb_")(f).assign(**{c: edit(f) for c, edit in columns.items()}))
    return [note for note in read(folder).notes if "reference.csv" in note]


def test_angles_of_the_reference_in_radians_are_asked_for(log, trajectory, tmp_path: Path) -> None:
    """The reference then turns 57 times slower than the gyros, and no angle of it is beyond one turn in radians."""
    tables(log, trajectory, tmp_path)
    radians = {f"{a}_deg": lambda f, a=a: np.radians(f[f"{a}_deg"]) for a in ("roll", "pitch", "yaw")}
    with pytest.raises(InputError, match=r"gyros turn 5\d\.?\d* times .*reference.csv \(at most .*°\) rad named deg\?"):
        reference(tmp_path, **radians)


@pytest.mark.parametrize(
    ("column", "edit", "words"),
    [
        ("yaw_deg", lambda f: 90.0 - f["yaw_deg"], "turns about y and z against the gyros"),
        ("yaw_deg", lambda f: 0.0 * f["yaw_deg"], "its attitude turns by"),
        ("v_north_mps", lambda f: 3.6 * f["v_north_mps"], "times the way that the places move"),
        ("v_down_mps", lambda f: -f["v_down_mps"], "is it the velocity upwards"),
    ],
)
def test_a_reference_that_contradicts_itself_or_the_gyros_is_doubted(
    column: str, edit, words: str, log, trajectory, tmp_path: Path
) -> None:
    tables(log, trajectory, tmp_path)
    assert any(words in note for note in reference(tmp_path, **{column: edit}))


@pytest.mark.parametrize(("factor", "words"), [(3.6, "are they km/h named m/s"), (0.0, "next to zero")])
def test_velocities_of_the_reference_in_another_unit(factor: float, words: str, log, trajectory, tmp_path) -> None:
    tables(log, trajectory, tmp_path)
    columns = {f"v_{a}_mps": lambda f, a=a: factor * f[f"v_{a}_mps"] for a in ("north", "east", "down")}
    (told,) = reference(tmp_path, **columns)
    assert words in told


def test_a_noisy_reference_with_resets_is_not_doubted(log, trajectory, tmp_path: Path) -> None:
    """1 m and 1° of noise, the place 300 m and the yaw 60° off for the first 5 s: a filter that found itself in flight."""
    tables(log, trajectory, tmp_path)
    rng = np.random.default_rng(2)

    def poor(f: pd.DataFrame) -> pd.DataFrame:
        early = f["time_s"] < 5.0
        n = len(f)
        angles = {f"{a}_deg": f[f"{a}_deg"] + rng.standard_normal(n) for a in ("roll", "pitch", "yaw")}
        angles["yaw_deg"] = angles["yaw_deg"] + 60.0 * early
        return without("q_nb_")(f).assign(
            **angles, lat_deg=f["lat_deg"] + 1e-5 * rng.standard_normal(n) + 0.003 * early
        )

    change(tmp_path, "reference", poor)
    assert not any("reference.csv" in note for note in read(tmp_path).notes)


def test_what_part_a_reference_covers_is_told(log, trajectory, tmp_path: Path) -> None:
    tables(log, trajectory, tmp_path)
    change(tmp_path, "reference", lambda f: f[f["time_s"] <= 20.0])
    (told,) = [note for note in read(tmp_path).notes if "scored" in note]
    assert "reference.csv: covers 0.2 to 20 s of the 0.2 to 90 s" in told and "19.8 s of 89.8 s are scored" in told


def test_gaps_of_a_reference_are_told(log, trajectory, tmp_path: Path) -> None:
    tables(log, trajectory, tmp_path)
    change(tmp_path, "reference", lambda f: f[(f["time_s"] < 30.0) | (f["time_s"] > 32.0)])
    (told,) = [note for note in read(tmp_path).notes if "scored" in note]
    assert "reference.csv: a gap from 29.99 to 32.01 s; 2.02 s of 90 s are not scored" in told


@pytest.mark.parametrize(("part", "given", "told"), [("imu", IMU, "100 samples"), ("gnss", GNSS, "5 samples")])
def test_a_rate_that_the_files_overrule_is_told(part: str, given: dict, told: str, log, tmp_path: Path) -> None:
    tables(log, None, tmp_path)
    notes = read(tmp_path, **{part: given | {"rate_hz": 333.0}}).notes
    assert any(f"[recording.{part}] rate_hz = 333 has no effect" in note and told in note for note in notes)
    rate = float(told.split()[0])
    assert not any("rate_hz" in note for note in read(tmp_path, **{part: given | {"rate_hz": rate}}).notes)


def test_exchanged_velocities_are_not_the_imus_fault(log, tmp_path: Path) -> None:
    """North and east exchanged mirror the course: its turns go against the IMU, and so do the positions against it."""
    tables(log, None, tmp_path)
    swapped = {"v_north_mps": "v_east_mps", "v_east_mps": "v_north_mps"}
    change(tmp_path, "gnss", lambda f: f.rename(columns=swapped))
    with pytest.raises(InputError) as caught:
        read(tmp_path)
    assert "gnss.csv: the positions move" in str(caught.value) and "north and east exchanged?" in str(caught.value)
    assert "gyro axis" not in str(caught.value)
