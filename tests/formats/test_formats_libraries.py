"""Formats of other programs: a flight that their own libraries wrote comes back in the bench's units and frames."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import formats_flight
import formats_writers as writers
import numpy as np
import pytest

from testbed.base.errors import InputError
from testbed.data.records import SensorLog, Trajectory
from testbed.formats import import_log
from testbed.formats.recording import Recording
from testbed.physics.rotations import attitude_errors

IMU = {"model": "ADIS16448"}
FLOAT = 2.0**-23
"""Relative rounding of single precision."""
E7 = np.radians(1e-7)
"""rad: the last digit of latitudes that count 1e-7 degrees."""


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return formats_flight.make_trajectory(10.0)


@pytest.fixture(scope="module")
def log(trajectory: Trajectory) -> SensorLog:
    return formats_flight.make_log(trajectory)


def same_imu(read: Recording, log: SensorLog, gyro: float = 1e-12, accel: float = 1e-12) -> None:
    n = len(read.log.imu.t)
    assert n > 900
    assert np.ptp(read.log.imu.t - log.imu.t[-n:]) < 1e-6
    assert np.abs(read.log.imu.gyro - log.imu.gyro[-n:]).max() <= gyro
    assert np.abs(read.log.imu.accel - log.imu.accel[-n:]).max() <= accel


def same_fixes(read: Recording, log: SensorLog, place: float, height: float, undulation: float = 0.0) -> None:
    m = len(read.log.gnss.t)
    assert m >= len(log.gnss.t) - 2
    assert np.ptp(read.log.gnss.t - log.gnss.t[-m:]) < 1e-6
    for name, limit in (("lat", place), ("lon", place), ("h", height)):
        expected = getattr(log.gnss, name)[-m:] - (undulation if name == "h" else 0.0)
        assert np.abs(getattr(read.log.gnss, name) - expected).max() <= limit, name


def same_reference(
    read: Recording, trajectory: Trajectory, shift: float, metres: float, mps: float, angle: float
) -> None:
    """``shift``: what the times of the recording are less than the flight's."""
    r = read.reference
    assert r is not None
    k = np.searchsorted(trajectory.t, r.t + shift - 1e-6)
    assert np.abs((r.lat - trajectory.lat[k]) * 6.37e6).max() <= metres
    assert np.abs((r.lon - trajectory.lon[k]) * 6.37e6).max() <= metres
    assert np.abs(r.h - trajectory.h[k]).max() <= metres
    assert np.abs(r.v_n - trajectory.v_n[k]).max() <= mps
    assert np.abs(attitude_errors(r.q_nb, trajectory.q_nb[k])).max() <= angle


def ardupilot(trajectory: Trajectory, log: SensorLog, path: Path, **options) -> Recording:
    writers.write_ardupilot(path, writers.ardupilot_messages(trajectory, log, **options))
    return import_log("ardupilot", path, sampling="interval")


@pytest.mark.parametrize("simulated", [False, True])
def test_ardupilot_logs(simulated: bool, trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """Angles of XKF1 and SIM count 0.01°, places 1e-7°, heights of GPS 1 cm, the compass 0.1 µT."""
    read = ardupilot(trajectory, log, tmp_path / "flight.bin", simulated=simulated)
    same_imu(read, log, 2.0 * FLOAT, 20.0 * 2.0 * FLOAT)
    same_fixes(read, log, E7, 0.011)
    m = len(read.log.gnss.t)
    assert np.abs(read.log.gnss.v_n - log.gnss.v_n[-m:]).max() < 30.0 * 4.0 * FLOAT
    assert read.log.gnss.std[0] == pytest.approx([1.5, 1.5, 2.5, 0.1, 0.1, 0.1])
    assert read.log.gnss.spec.lever_arm_b == pytest.approx((0.3, 0.0, -0.1))
    assert read.log.gnss.spec.latency_s == pytest.approx(0.02)
    assert np.abs(read.log.mag.field - log.mag.field[-len(read.log.mag.t) :]).max() <= 0.05 + 1e-9
    assert np.abs(read.log.baro.pressure - log.baro.pressure[-len(read.log.baro.t) :]).max() < 1e5 * FLOAT
    assert read.log.mag.spec.declination == pytest.approx(writers.PARAMETERS["COMPASS_DEC"], abs=1e-8)
    # 25 rows a second: linear velocities bend by 30 m/s (0.12 rad/s 0.04 s)²/8, places with it
    height = 600.0 * FLOAT + 0.02
    same_reference(read, trajectory, -writers.BOOT_US * 1e-6, height, 3e-4, np.radians(0.02))


def test_of_several_sensors_the_first_is_used(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    messages = writers.ardupilot_messages(trajectory, log)
    second = [(t, 1, *(9.0 * x for x in rest[1:7]), *rest[7:]) for t, *rest in messages["IMU"]]
    messages["IMU"] = [row for pair in zip(messages["IMU"], second, strict=True) for row in pair]
    read = import_log("ardupilot", writers.write_ardupilot(tmp_path / "two.bin", messages), sampling="interval")
    same_imu(read, log, 2.0 * FLOAT, 20.0 * 2.0 * FLOAT)
    assert any("IMU: I = 0 is used, the others (1) are not" in note for note in read.notes)


def test_values_at_their_times_become_means(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """Unless the scenario says that they are means: half the sum of two neighbours, in the order of the log's digits."""
    path = writers.write_ardupilot(tmp_path / "flight.bin", writers.ardupilot_messages(trajectory, log))
    imu = import_log("ardupilot", path).log.imu
    expected = 0.5 * (log.imu.accel[1:] + log.imu.accel[:-1])[-len(imu.t) :]
    assert np.abs(imu.accel - expected).max() < 40.0 * FLOAT


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_bags(kind: str, trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    path = tmp_path / ("bag.bag" if kind == "ros1" else "bag")
    writers.write_bag(path, writers.bag_messages(trajectory, log), kind)
    read = import_log("rosbag", path, imu=IMU, sampling="interval")
    same_imu(read, log)
    same_fixes(read, log, 1e-15, 1e-9)
    assert read.log.gnss.std[0, :3] == pytest.approx([1.6, 1.5, 2.5])  # the covariance counts east first
    assert any("states no velocity" in note for note in read.notes)
    assert np.abs(read.log.mag.field - log.mag.field[-len(read.log.mag.t) :]).max() < 1e-9
    assert np.abs(read.log.baro.pressure - log.baro.pressure[-len(read.log.baro.t) :]).max() == 0.0
    # placed by the mean of 49 fixes of 1.5 and 2.5 m; their lever arm of 0.3 m stays in it
    same_reference(read, trajectory, 0.0, 4.0 * 2.5 / np.sqrt(49.0) + 0.3, 1e-3, 1e-5)
    assert not any("turned" in note for note in read.notes)


def test_an_mcap_file_alone(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    writers.write_bag(tmp_path / "bag", writers.bag_messages(trajectory, log), "mcap")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    same_imu(import_log("mcap", tmp_path / "bag", imu=IMU, sampling="interval"), log)


def test_an_odometry_of_any_heading_is_turned_to_the_fixes(
    trajectory: Trajectory, log: SensorLog, tmp_path: Path
) -> None:
    """To within four sigma of the fit: 1.5 m of 49 fixes about a way that spreads by 80 m."""
    writers.write_bag(tmp_path / "bag.bag", writers.bag_messages(trajectory, log, turned=1.2), "ros1")
    read = import_log("rosbag", tmp_path / "bag.bag", imu=IMU, sampling="interval")
    (told,) = [note for note in read.notes if "is turned back" in note]
    assert float(told.split("turned by ")[1].split("°")[0]) == pytest.approx(-np.degrees(1.2), abs=0.6)
    same_reference(read, trajectory, 0.0, 3.0, 30.0 * 0.011, 0.011)


def test_a_bag_without_stamps_or_fixes_says_so(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    messages = writers.bag_messages(trajectory, log)
    writers.write_bag(tmp_path / "bag.bag", messages, "ros1", stamped=False)
    read = import_log("rosbag", tmp_path / "bag.bag", imu=IMU)
    assert any("/imu/data: its headers have no stamps" in note for note in read.notes)
    writers.write_bag(tmp_path / "other.bag", [m for m in messages if m[0] != "/fix"], "ros1")
    with pytest.raises(InputError, match="without GNSS fixes"):
        import_log("rosbag", tmp_path / "other.bag", imu=IMU)


def test_one_of_several_topics(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    messages = writers.bag_messages(trajectory, log)
    raw = [
        ("/imu/raw", kind, t, {k: 2.0 * v for k, v in c.items()}) for _, kind, t, c in messages if kind.endswith("Imu")
    ]
    writers.write_bag(tmp_path / "bag.bag", [*messages, *raw[:-10]], "ros1")
    read = import_log("rosbag", tmp_path / "bag.bag", imu=IMU, sampling="interval")
    same_imu(read, log)
    assert any("/imu/data is used as imu, /imu/raw not" in note for note in read.notes)
    with pytest.raises(InputError, match="no topic '/imu/dat' of the type sensor_msgs/msg/Imu"):
        import_log("rosbag", tmp_path / "bag.bag", imu=IMU, topics={"imu": "/imu/dat"})
    other = import_log("rosbag", tmp_path / "bag.bag", imu=IMU, sampling="interval", topics={"imu": "/imu/raw"})
    assert np.abs(other.log.imu.gyro - 2.0 * log.imu.gyro[-len(other.log.imu.t) - 10 : -10]).max() < 1e-12


@pytest.mark.parametrize("sigmas", [True, False])
def test_nmea(sigmas: bool, log: SensorLog, tmp_path: Path) -> None:
    """1e-7 minutes are 1.7e-9 degrees; times of the IMU as doubles since 1970 end at 2.4e-7 s."""
    writers.table_of_imu(log, tmp_path, writers.START.timestamp())
    (tmp_path / "x.nmea").write_bytes(b"".join(writers.nmea_sentences(log, sigmas)))
    figures = {} if sigmas else {"gnss": {"model": "Garmin16x"}}
    read = import_log("nmea", tmp_path, imu=IMU, **figures)
    same_fixes(read, log, np.radians(1e-7 / 60.0), 6e-4)
    m = len(read.log.gnss.t)
    # knots and degrees to four digits
    assert np.abs(read.log.gnss.v_n[:, :2] - log.gnss.v_n[-m:, :2]).max() < 1e-4 + 30.0 * np.radians(1e-4)
    assert any("states no vertical velocity" in note for note in read.notes)
    if sigmas:
        assert read.log.gnss.std[0, :5] == pytest.approx([1.5, 1.6, 2.5, 0.1, 0.1])


@pytest.mark.parametrize("kind", [b"RMC", b"GST"])
def test_a_lost_sentence_costs_its_fix_alone(kind: bytes, log: SensorLog, tmp_path: Path) -> None:
    """Two sentences cut off among 200: the other fixes keep velocities and sigmas; of every second one alone none is used."""
    from testbed.formats.nmea import read_fixes

    sentences = writers.nmea_sentences(log)
    (tmp_path / "x.nmea").write_bytes(b"".join(sentences))
    whole = read_fixes(tmp_path / "x.nmea")
    rows = [k for k, sentence in enumerate(sentences) if sentence[3:6] == kind]
    for k in (rows[20], rows[41]):
        sentences[k] = sentences[k][:25] + b"\r\n"
    (tmp_path / "y.nmea").write_bytes(b"".join(sentences))
    found = read_fixes(tmp_path / "y.nmea")
    rest = np.delete(np.arange(len(whole.fixes.t)), [20, 41])
    assert np.array_equal(found.fixes.t, whole.fixes.t[rest]) and np.array_equal(found.fixes.v_n, whole.fixes.v_n[rest])
    assert np.array_equal(found.fixes.std, whole.fixes.std[rest]) and found.level_velocity
    assert any(f"2 of {len(rows)} fixes have no" in note and kind.decode() in note for note in found.notes)
    seldom = [s for k, s in enumerate(writers.nmea_sentences(log)) if k not in rows[::2]]
    (tmp_path / "z.nmea").write_bytes(b"".join(seldom))
    assert len(read_fixes(tmp_path / "z.nmea").fixes.t) == len(whole.fixes.t)


REAL_NMEA = """\
$GNRMC,103607.00,A,5327.03942,N,10214.42462,W,0.046,,060321,,,A,V*0E
$GNVTG,,T,,M,0.046,N,0.085,K,A*32
$GNGNS,103607.00,5327.03942,N,00214.42462,W,AANN,06,5.88,56.0,48.5,,,V*34
$GNGGA,103607.00,5327.03942,N,00214.42462,W,1,06,5.88,56.0,M,48.5,M,,*64
$GNGST,103607.00,38,60,38,89,15,24,31*63
$GNZDA,103607.00,06,03,2021,00,00*7F
$INGGA,103607.00,5327.03942,N,00214.42462,W,1,06,5.88,56.0,M,48.5,M,,*6A
"""
"""Of a u-blox receiver, from pynmeagps' tests/pygpsdata-nmea4.log (BSD 3-Clause)."""


def test_sentences_of_a_receiver(tmp_path: Path) -> None:
    from testbed.formats.nmea import read_fixes

    (tmp_path / "x.nmea").write_bytes(REAL_NMEA.replace("\n", "\r\n").encode())
    found = read_fixes(tmp_path / "x.nmea")
    assert found.fixes.t == pytest.approx([1615026967.0])  # date -u -d '2021-03-06 10:36:07' +%s
    assert np.degrees([found.fixes.lat[0], found.fixes.lon[0]]) == pytest.approx(
        [53 + 27.03942 / 60, -2 - 14.42462 / 60]
    )
    assert found.fixes.h == pytest.approx([104.5])  # PUBX,00 of the same second has 104.461
    assert found.fixes.std[0, :3] == pytest.approx([15.0, 24.0, 31.0])
    assert np.linalg.norm(found.fixes.v_n[0]) == pytest.approx(0.085 / 3.6, abs=2e-4)


def test_nmea_without_a_date_and_over_midnight(log: SensorLog, tmp_path: Path) -> None:
    from testbed.formats.nmea import read_fixes

    (tmp_path / "x.nmea").write_bytes(b"".join(writers.nmea_sentences(log, date=False)))
    found = read_fixes(tmp_path / "x.nmea")
    assert found.fixes.t == pytest.approx(43200.0 + log.gnss.t)
    assert any("tells no date" in note for note in found.notes)
    late = [b"$GPGGA,235959.50,", b"$GPGGA,000000.50,"]
    rest = b"4717.112,N,00833.915,E,1,08,1.0,499.6,M,48.0,M,,"
    (tmp_path / "y.nmea").write_bytes(b"".join(with_checksum(head + rest) for head in late))
    assert read_fixes(tmp_path / "y.nmea").fixes.t == pytest.approx([86399.5, 86400.5])


def with_checksum(sentence: bytes) -> bytes:
    """``$``...``*hh``: the exclusive or of what lies between."""
    total = 0
    for byte in sentence[1:]:
        total ^= byte
    return sentence + b"*%02X\r\n" % total


def test_ubx(log: SensorLog, tmp_path: Path) -> None:
    """Places count 1e-7°, heights and velocities 1 mm."""
    writers.table_of_imu(log, tmp_path, writers.START.timestamp())
    (tmp_path / "x.ubx").write_bytes(b"".join(writers.ubx_messages(log)))
    read = import_log("ubx", tmp_path, imu=IMU)
    same_fixes(read, log, E7, 6e-4)
    m = len(read.log.gnss.t)
    assert np.abs(read.log.gnss.v_n - log.gnss.v_n[-m:]).max() < 6e-4
    assert read.log.gnss.std[0] == pytest.approx([1.5, 1.5, 2.5, 0.05, 0.05, 0.05])


def test_bytes_of_a_ubx_message(tmp_path: Path) -> None:
    """NAV-PVT byte by byte after u-blox's interface description, with its Fletcher checksum: pyubx2 is not the only witness."""
    import struct

    from testbed.formats.ubx import read_fixes

    payload = struct.pack("<IHBBBBBBIiBBBB", 0, 2025, 7, 8, 12, 0, 1, 7, 30, -250_000_000, 3, 1, 0, 14)
    payload += struct.pack(
        "<iiiiIIiiiiiIIH", 85_000_000, 470_000_000, 500_123, 453_000, 1500, 2500, 1000, -2000, 300, 2236, 0, 50, 0, 120
    )
    payload += bytes(92 - len(payload))
    body = b"\x01\x07" + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for byte in body:
        a, b = (a + byte) % 256, (a + byte + b) % 256
    (tmp_path / "x.ubx").write_bytes(b"\xb5\x62" + body + bytes([a, b]))
    fixes = read_fixes(tmp_path / "x.ubx").fixes
    assert fixes.t == pytest.approx([writers.START.timestamp() + 0.75], abs=1e-6)
    assert np.degrees([fixes.lat[0], fixes.lon[0]]) == pytest.approx([47.0, 8.5], abs=1e-12)
    assert fixes.h == pytest.approx([500.123])
    assert fixes.v_n[0] == pytest.approx([1.0, -2.0, 0.3])
    assert fixes.std[0] == pytest.approx([1.5, 1.5, 2.5, 0.05, 0.05, 0.05])


def test_euroc(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """The way is that of the flight, from another place; its heading is kept, as R is east-north-up here."""
    writers.write_euroc(tmp_path, trajectory, log)
    read = import_log("euroc", tmp_path, imu=IMU, initial={"attitude": "reference"}, sampling="interval")
    same_imu(read, log)
    r = read.reference
    k = np.searchsorted(trajectory.t, r.t - 1e-6)
    assert np.abs(attitude_errors(r.q_nb, trajectory.q_nb[k])).max() < 1e-6
    assert np.abs(r.v_n - trajectory.v_n[k]).max() < 3e-3  # north turns by a way of 600 m over the Earth's radius
    north = (r.lat - r.lat[0]) * 6.37e6 - (trajectory.lat[k] - trajectory.lat[k][0]) * 6.37e6
    assert np.abs(north).max() < 1.0  # of 500 m: another latitude has another radius of curvature


def test_euroc_with_another_mounting(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """The turn of EuRoC's own vehicle, given as angles: forward is z, right y, down -x."""
    writers.write_euroc(tmp_path, trajectory, log)
    options = {"initial": {"attitude": "reference"}, "sampling": "interval"}
    plain = import_log("euroc", tmp_path, imu=IMU, **options)
    turned = import_log("euroc", tmp_path, imu=IMU | {"mounting_deg": [0.0, 90.0, 0.0]}, **options)
    assert np.abs(turned.log.imu.accel - plain.log.imu.accel).max() < 1e-12
    assert np.abs(attitude_errors(turned.reference.q_nb, plain.reference.q_nb)).max() < 1e-9
    other = import_log("euroc", tmp_path, imu=IMU | {"mounting_deg": [0.0, 0.0, 90.0]}, **options)
    assert np.abs(other.log.imu.accel - plain.log.imu.accel).max() > 5.0


REAL_EUROC = "1403636579758555392,-0.099134701513277898,0.14730578886832138,0.02722713633111154,8.1476917083333333,-0.37592158333333331,-2.4026292499999999"
"""The first row of MH_01_easy/imu0/data.csv, as MRPT's reader of the data set quotes it (CEuroc dataset source, BSD 3-Clause)."""


def test_a_row_of_euroc(tmp_path: Path) -> None:
    """Most of gravity lies along the sensor's x: up; the rest says that the vehicle is nose-down by some 16°."""
    from testbed.formats.config import RecordingConfig
    from testbed.formats.euroc import read

    (tmp_path / "imu0").mkdir()
    rows = [REAL_EUROC.replace("1403636579758555392", str(1403636579758555392 + 5_000_000 * k)) for k in range(5)]
    (tmp_path / "imu0" / "data.csv").write_text("\r\n".join([writers.EUROC_IMU, *rows]) + "\r\n")
    raw = read(RecordingConfig(format="euroc"), tmp_path)
    assert raw.imu.accel[0] == pytest.approx([-2.40262925, -0.37592158, -8.14769171])
    assert raw.imu.t == pytest.approx(0.758555392 + 0.005 * np.arange(1, 5), abs=1e-9)
    assert np.degrees(np.arctan2(raw.imu.accel[0, 0], -raw.imu.accel[0, 2])) == pytest.approx(-16.4, abs=0.1)


def test_kitti(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    writers.write_kitti(tmp_path, trajectory, log)
    read = import_log("kitti", tmp_path, imu=IMU, initial={"attitude": "reference"}, sampling="interval")
    same_imu(read, log)
    same_reference(read, trajectory, 0.0, 1e-6, 1e-9, 1e-9)


def test_an_even_turn_is_no_rest(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """Without fixes only the reference shows it: 0.12 rad/s would be the gyros' bias."""
    writers.write_kitti(tmp_path, trajectory, log)
    read = import_log("kitti", tmp_path, imu=IMU, initial={"attitude": "reference"})
    assert not any("at rest" in note for note in read.notes)
    assert np.abs(read.log.initial.gyro_bias).max() == 0.0


@pytest.mark.parametrize(
    ("format", "package", "extra"),
    [
        ("ardupilot", "pymavlink", "ardupilot"),
        ("rosbag", "rosbags", "rosbag"),
        ("mcap", "rosbags", "rosbag"),
        ("nmea", "pynmeagps", "nmea"),
        ("ubx", "pyubx2", "ubx"),
    ],
)
def test_a_package_that_is_absent_is_named(
    format: str, package: str, extra: str, log, tmp_path: Path, monkeypatch
) -> None:
    suffix = {"ardupilot": "bin", "rosbag": "bag", "mcap": "mcap"}.get(format, format)
    writers.table_of_imu(log, tmp_path, 0.0)
    (tmp_path / f"x.{suffix}").write_bytes(b"anything")
    monkeypatch.setitem(sys.modules, package, None)
    for name in list(sys.modules):
        if name.startswith(package + "."):
            monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=rf"{package}: pip install 'navigation-testbed\[{extra}\]'"):
        import_log(format, tmp_path, imu=IMU)


def test_no_reader_is_imported_before_it_is_asked_for() -> None:
    code = "import sys, testbed.formats.importers, testbed.cli; print([m for m in %r if m in sys.modules])"
    packages = ["pymavlink", "rosbags", "pynmeagps", "pyubx2", "pyulog"]
    said = subprocess.run([sys.executable, "-c", code % packages], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "[]"


REFUSED = {
    "ardupilot": [("x.bin", b"", "x.bin"), ("x.bin", b"PK\x03\x04" * 40, "0 IMU messages")],
    "rosbag": [("x.bag", b"", "not a readable bag"), ("x.bag", b"#ROSBAG V2.0\n", "not a readable bag")],
    "mcap": [("x.mcap", b"\x89MCAP0\r\n", "not a readable bag")],
    "nmea": [("x.nmea", b"hello\n", "no GGA sentence")],
    "ubx": [("x.ubx", b"hello\n", "no message NAV-PVT")],
}


@pytest.mark.parametrize("case", [(f, *rest) for f, cases in REFUSED.items() for rest in cases])
def test_files_that_are_none(case: tuple[str, str, bytes, str], log: SensorLog, tmp_path: Path) -> None:
    format, name, content, words = case
    writers.table_of_imu(log, tmp_path, 0.0)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        import_log(format, tmp_path, imu=IMU)
    assert name in str(caught.value) and words in str(caught.value), str(caught.value)
