"""Tables as loggers write them, and KF-GINS's text files: all give the log that the plain table gives."""

from __future__ import annotations

from pathlib import Path

import formats_flight
import numpy as np
import pandas as pd
import pytest

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.data.records import SensorLog, Trajectory
from testbed.formats import export_log, import_log, load_recording
from testbed.formats.config import RecordingConfig
from testbed.physics.rotations import quats_to_eulers

GIVEN = {"imu": {"model": "ADIS16448"}, "gnss": {"model": "Garmin16x"}}


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return formats_flight.make_trajectory(20.0)


@pytest.fixture(scope="module")
def log(trajectory: Trajectory) -> SensorLog:
    return formats_flight.make_log(trajectory)


@pytest.fixture
def folder(log: SensorLog, tmp_path: Path) -> Path:
    export_log(log, tmp_path, "csv")
    for name in ("log.json", "mag.csv", "baro.csv"):
        (tmp_path / name).unlink()
    gnss = pd.read_csv(tmp_path / "gnss.csv")
    gnss[[c for c in gnss if not c.startswith("std_")]].to_csv(tmp_path / "gnss.csv", index=False)
    return tmp_path


def same(a: SensorLog, b: SensorLog) -> None:
    for part in ("imu", "gnss"):
        one, other = getattr(a, part), getattr(b, part)
        for name, values in vars(one).items():
            if isinstance(values, np.ndarray):
                assert np.abs(values - getattr(other, name)).max() < 1e-12, (part, name)
    assert np.abs(a.initial.q_nb - b.initial.q_nb).max() < 1e-12


def rewrite(folder: Path, part: str, **how) -> None:
    path = folder / f"{part}.csv"
    pd.read_csv(path).to_csv(path, index=False, **how)


@pytest.mark.parametrize(
    "how",
    [
        {"sep": ";"},
        {"sep": "\t"},
        {"sep": " "},
        {"sep": ";", "decimal": ","},
        {"sep": "\t", "decimal": ","},
        {"sep": " ", "decimal": ","},
        {"sep": "|"},
    ],
)
def test_separators_and_decimal_commas(how: dict, folder: Path) -> None:
    plain = import_log("table", folder, **GIVEN).log
    rewrite(folder, "imu", **how)
    rewrite(folder, "gnss", **how)
    same(import_log("table", folder, **GIVEN).log, plain)


def test_columns_in_blanks_of_any_number(folder: Path) -> None:
    plain = import_log("table", folder, **GIVEN).log
    path = folder / "imu.csv"
    path.write_text("\n".join("  " + line.replace(",", "    ") for line in path.read_text().splitlines()) + "\n")
    same(import_log("table", folder, **GIVEN).log, plain)


def test_a_file_without_a_header_is_named_by_numbers(folder: Path) -> None:
    plain = import_log("table", folder, **GIVEN).log
    names = list(pd.read_csv(folder / "imu.csv").columns)
    rewrite(folder, "imu", header=False)
    with pytest.raises(InputError, match=r"imu\.csv: no column for time"):
        import_log("table", folder, **GIVEN)
    columns = {"imu": {str(k + 1): name for k, name in enumerate(names)}}
    same(import_log("table", folder, columns=columns, **GIVEN).log, plain)


def test_speed_and_course_instead_of_velocity(folder: Path, log: SensorLog) -> None:
    """North and east are exact; down comes from the heights, within its stated sigma."""
    gnss = pd.read_csv(folder / "gnss.csv")
    north, east = gnss.pop("v_north_mps"), gnss.pop("v_east_mps")
    gnss = gnss.drop(columns="v_down_mps").assign(
        speed_kmph=3.6 * np.hypot(north, east), course_deg=np.degrees(np.arctan2(east, north)) % 360.0
    )
    gnss.to_csv(folder / "gnss.csv", index=False)
    recording = import_log("table", folder, **GIVEN)
    read = recording.log.gnss
    n = len(read.t)
    assert np.abs(read.v_n[:, :2] - log.gnss.v_n[-n:, :2]).max() < 1e-9
    error = (read.v_n[:, 2] + 1.0) / read.std[:, 5]  # the flight climbs with 1 m/s
    assert np.sqrt(np.mean(error**2)) < 1.5
    assert any("no vertical velocity" in note for note in recording.notes)


@pytest.mark.parametrize("angles", [[180.0, 0.0, 0.0], [10.0, -20.0, 130.0]])
def test_a_mounting_is_turned_back(angles: list[float], folder: Path) -> None:
    """scipy turns the samples into the sensor's axes; the angles are the sensor's attitude in the vehicle."""
    from scipy.spatial.transform import Rotation

    plain = import_log("table", folder, **GIVEN).log
    sensor = Rotation.from_euler("ZYX", angles[::-1], degrees=True).inv()
    imu = pd.read_csv(folder / "imu.csv")
    for prefix in ("gyro", "accel"):
        names = [c for c in imu if c.startswith(prefix)]
        imu[names] = sensor.apply(imu[names].to_numpy())
    imu.to_csv(folder / "imu.csv", index=False)
    turned = import_log("table", folder, imu=GIVEN["imu"] | {"mounting_deg": angles}, gnss=GIVEN["gnss"]).log
    assert np.abs(turned.imu.accel - plain.imu.accel).max() < 1e-9
    assert np.abs(turned.imu.gyro - plain.imu.gyro).max() < 1e-12


def kfgins(trajectory: Trajectory, log: SensorLog, folder: Path, start: float) -> dict[str, str]:
    """Written after the README of KF-GINS, as its users do; ``start`` in seconds of week."""
    week = 604800.0
    dt = np.diff(log.imu.t, prepend=0.0)[:, None]
    first = np.zeros((1, 7))
    first[0, 0] = start % week
    imu = np.column_stack([(start + log.imu.t) % week, log.imu.gyro * dt, log.imu.accel * dt])
    np.savetxt(folder / "imu.txt", np.vstack([first, imu]), fmt="%.12g")
    g = log.gnss
    sigma = np.tile([1.5, 1.5, 2.5], (len(g.t), 1))
    fixes = [(start + g.t) % week, np.degrees(g.lat), np.degrees(g.lon), g.h, sigma]
    np.savetxt(folder / "gnss.txt", np.column_stack(fixes), fmt="%.12f")
    r = trajectory
    euler = np.degrees(quats_to_eulers(r.q_nb))
    place = [np.full(len(r.t), 2374), (start + r.t) % week, np.degrees(r.lat), np.degrees(r.lon), r.h, r.v_n, euler]
    np.savetxt(folder / "truth.nav", np.column_stack(place), fmt="%.12f")
    return {"imu": "imu.txt", "gnss": "gnss.txt", "reference": "truth.nav"}


@pytest.mark.parametrize("start", [456300.0, 604790.0])
def test_kfgins_increments_and_positions(start: float, trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """Also over the end of the week; the digits of the files leave 1e-11 of an increment, 1e-9 of a rate."""
    files = kfgins(trajectory, log, tmp_path, start)
    recording = import_log("kfgins", tmp_path, files=files, imu={"model": "ADIS16448"})
    n, m = len(recording.log.imu.t), len(recording.log.gnss.t)
    assert n == 1980  # from the first fix on
    assert np.abs(recording.log.imu.gyro - log.imu.gyro[-n:]).max() < 1e-7
    assert np.abs(recording.log.imu.accel - log.imu.accel[-n:]).max() < 1e-6
    assert np.abs(recording.log.gnss.lat - log.gnss.lat[-m:]).max() < 1e-13
    assert recording.log.gnss.std[0, :3] == pytest.approx([1.5, 1.5, 2.5])
    k = np.searchsorted(trajectory.t, recording.reference.t - 1e-6)
    assert np.abs(recording.reference.v_n - trajectory.v_n[k]).max() < 1e-6
    assert any("states no velocity" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda d: (d / "imu.txt").write_text(""), "imu.txt: not a table of numbers"),
        (lambda d: (d / "imu.txt").write_text("1 2 3\n4 5 6\n"), "has 3 columns, expected 7"),
        (lambda d: (d / "gnss.txt").write_text("1 2 3 4 5 6 seven\n"), "column 7 of row 0 is 'seven'"),
        (lambda d: (d / "gnss.txt").unlink(), "gnss.txt: no such file"),
        (lambda d: (d / "gnss.txt").write_text("456300.2 97 8 400 1 1 1\n"), "±90°"),
        (lambda d: (d / "gnss.txt").write_text("456301.2 47 8 400 0 1 1\n456302 47 8 400 1 1 1\n"), "std_north_m is 0"),
        (lambda d: (d / "imu.txt").write_bytes(b"\xff\xfe\x00" * 50), "imu.txt"),
    ],
)
def test_damaged_kfgins_files_are_refused(damage, words: str, trajectory, log, tmp_path: Path) -> None:
    files = kfgins(trajectory, log, tmp_path, 456300.0)
    damage(tmp_path)
    with pytest.raises(InputError) as caught:
        import_log("kfgins", tmp_path, files={k: files[k] for k in ("imu", "gnss")}, imu={"model": "ADIS16448"})
    assert words in str(caught.value)


@pytest.mark.parametrize("zone", ["Z", "", "+02:00"])
def test_dates_as_times(zone: str, folder: Path, log: SensorLog) -> None:
    """ISO 8601 with as many digits as it takes; without a zone it is UTC. The log starts at the IMU's first whole second."""
    start = pd.Timestamp("2025-07-08T12:00:00")
    for part in ("imu", "gnss"):
        frame = pd.read_csv(folder / f"{part}.csv")
        dates = start + pd.to_timedelta((frame["time_s"] * 1e3).round().astype(int), unit="ms")
        frame.assign(time_s=[f"{date.isoformat()}{zone}" for date in dates]).to_csv(folder / f"{part}.csv", index=False)
    read = import_log("table", folder, **GIVEN).log
    assert np.abs(read.imu.t - log.imu.t[-len(read.imu.t) :]).max() < 1e-9
    assert np.abs(read.gnss.t - log.gnss.t[-len(read.gnss.t) :]).max() < 1e-9


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("time_s", "soon", "sample 3 is 'soon', expected a date"),
        ("gyro_x_radps", None, "holds dates, expected numbers"),
    ],
)
def test_dates_out_of_place(column: str, value: str | None, words: str, folder: Path) -> None:
    frame = pd.read_csv(folder / "imu.csv")
    dates = [date.isoformat() for date in pd.Timestamp("2025-07-08") + pd.to_timedelta(frame["time_s"], unit="s")]
    if value is not None:
        dates[3] = value
    frame.assign(**{column: dates}).to_csv(folder / "imu.csv", index=False)
    with pytest.raises(InputError) as caught:
        import_log("table", folder, **GIVEN)
    assert words in str(caught.value) and "imu.csv" in str(caught.value)


def test_a_mapping_that_maps_nothing_is_told(folder: Path) -> None:
    """A mistyped column beside a right one: the file's own name is read, and the mapping's is told with the nearest."""
    columns = {"gyro_x_radsp": "gyro_x_radps", "gnss": {"hoch": "alt_m"}}
    notes = import_log("table", folder, columns=columns, **GIVEN).notes
    assert any('"gyro_x_radsp" = "gyro_x_radps" has no effect: no file has' in n and "did you mean" in n for n in notes)
    assert any('"hoch" = "alt_m" has no effect: gnss has no column hoch' in note for note in notes)
    rename = {"gyro_x_radps": "wx"}
    pd.read_csv(folder / "imu.csv").rename(columns=rename).to_csv(folder / "imu.csv", index=False)
    assert not any("no effect" in n for n in import_log("table", folder, columns={"wx": "gyro_x_radps"}, **GIVEN).notes)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda f: f.drop(columns="gyro_z_radps"), "no column for gyro_z (such as gyro_z_radps); it has time_s"),
        (lambda f: f.rename(columns={"gyro_z_radps": "Gyro Z (rad/s)"}), "is it the column 'Gyro Z (rad/s)'"),
        (lambda f: f.rename(columns={"gyro_z_radps": "c7"}), "columns that are not read: 'c7'"),
    ],
)
def test_a_missing_column_names_only_what_is_not_read(edit, words: str, folder: Path) -> None:
    edit(pd.read_csv(folder / "imu.csv")).to_csv(folder / "imu.csv", index=False)
    with pytest.raises(InputError) as caught:
        import_log("table", folder, **GIVEN)
    assert words in str(caught.value) and "did you mean" not in str(caught.value)


def test_utf_16_is_named(folder: Path) -> None:
    (folder / "imu.csv").write_text((folder / "imu.csv").read_text(), encoding="utf-16")
    with pytest.raises(
        InputError, match=r"imu.csv: not text in UTF-8, but in UTF-16 or binary; save it as CSV in UTF-8"
    ):
        import_log("table", folder, **GIVEN)


def test_a_folder_for_a_file_and_a_file_for_a_folder(folder: Path) -> None:
    with pytest.raises(InputError, match=r"imu.csv: is a file; the key recording.dir names the folder"):
        load_recording(validate(RecordingConfig, {"format": "table", "dir": "imu.csv"} | GIVEN, "test"), folder)
    (folder / "gnss.csv").unlink()
    (folder / "gnss.csv").mkdir()
    with pytest.raises(InputError, match=r"gnss.csv: is a folder \(wanted a file for the gnss\)"):
        import_log("table", folder, **GIVEN)


def test_euler_angles_beside_another_quaternion_are_told(
    trajectory: Trajectory, log: SensorLog, tmp_path: Path
) -> None:
    """The yaw a quarter turn off; whole degrees are half a degree off about each axis and told by nobody."""
    export_log(log, tmp_path, "csv", reference=trajectory)
    frame = pd.read_csv(tmp_path / "reference.csv")
    frame.round({f"{a}_deg": 0 for a in ("roll", "pitch", "yaw")}).to_csv(tmp_path / "reference.csv", index=False)
    assert not any("q_nb" in note for note in import_log("table", tmp_path).notes)
    frame.assign(yaw_deg=frame["yaw_deg"] + 90.0).to_csv(tmp_path / "reference.csv", index=False)
    read = import_log("table", tmp_path)
    assert any(
        "reference.csv: roll, pitch and yaw are another attitude than q_nb" in n and "90°" in n for n in read.notes
    )
    assert np.abs(read.reference.q_nb - trajectory.q_nb).max() < 1e-12
