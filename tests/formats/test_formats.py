"""Data in and out: every round trip gives back what was written, and damaged files are refused with a clear message."""

from __future__ import annotations

import json
from pathlib import Path

import formats_flight
import numpy as np
import pandas as pd
import pytest

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.data.records import SensorLog, Trajectory
from testbed.formats import export_log, export_trajectory, import_log, load_recording
from testbed.formats.config import RecordingConfig

EXACT = 0.0
DEGREES = 2e-15
"""rad: radians to degrees and back costs at most two roundings of a value below 4."""


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return formats_flight.make_trajectory()


@pytest.fixture(scope="module")
def log(trajectory: Trajectory) -> SensorLog:
    return formats_flight.make_log(trajectory)


def differences(a: object, b: object) -> dict[str, float]:
    """Largest difference of each array attribute of two records."""
    arrays = {k: (v, getattr(b, k)) for k, v in vars(a).items() if isinstance(v, np.ndarray)}
    return {k: float(np.abs(v - w).max()) for k, (v, w) in arrays.items()}


@pytest.mark.parametrize(("kind", "angle"), [("navego", EXACT), ("csv", DEGREES), ("parquet", DEGREES)])
def test_log_round_trip_is_exact(
    kind: str, angle: float, trajectory: Trajectory, log: SensorLog, tmp_path: Path
) -> None:
    export_log(log, tmp_path, kind, reference=trajectory)
    read = import_log(kind, tmp_path)
    for part in ("imu", "gnss", "mag", "baro", "initial"):
        for name, value in differences(getattr(log, part), getattr(read.log, part)).items():
            assert value <= (angle if name in ("lat", "lon") else EXACT), (part, name)
        if part != "initial":
            assert getattr(read.log, part).spec == getattr(log, part).spec
    assert (read.log.initial.lat, read.log.initial.t) == (log.initial.lat, log.initial.t)
    assert read.log.gnss.outages == log.gnss.outages
    for name, value in differences(trajectory, read.reference).items():
        # Means implied by rows dt apart know a vector that turns by w dt to (w dt)^2 / 12 = 1.2e-7: of 10 m/s2, of 7.3e-5 rad/s.
        implied = {"f_b": 1.2e-6, "w_ib_b": 9e-12}
        rounding = {"lat": angle, "lon": angle} | {k: v + angle * 100.0 for k, v in implied.items()}
        assert value <= rounding.get(name, EXACT), name


def test_trajectory_round_trips_through_navego_ref(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """MATLAB's fields are there too: DCMnb_m maps n to b, so applied to v_n it gives the body velocity."""
    from scipy.io import loadmat

    export_log(log, tmp_path, "navego")
    export_trajectory(trajectory, tmp_path / "ref.mat")
    ref = loadmat(tmp_path / "ref.mat")["ref"][0, 0]
    nav_to_body = ref["DCMnb_m"].reshape(-1, 3, 3).transpose(0, 2, 1)
    body = np.einsum("kij,kj->ki", nav_to_body, ref["vel"])
    assert np.abs(np.hypot(body[:, 0], body[:, 2]) - np.hypot(30.0, 1.0)).max() < 1e-9 + np.abs(body[:, 1]).max()
    assert differences(trajectory, import_log("navego", tmp_path).reference)["q_nb"] == 0.0


def test_other_units_and_names_are_converted(log: SensorLog, tmp_path: Path) -> None:
    """°/s, g, ns from an epoch, feet and knots; one gyro axis with the other sign."""
    export_log(log, tmp_path, "csv")
    epoch = 1_700_000_000_000_000_000
    imu = pd.DataFrame({"stamp": epoch + np.round(log.imu.t * 1e9).astype("i8")})
    for i, axis in enumerate("xyz"):
        imu[f"w{axis}"] = np.degrees(log.imu.gyro[:, i]) * (-1.0 if axis == "y" else 1.0)
        imu[f"a{axis}"] = log.imu.accel[:, i] / 9.80665
    imu.to_csv(tmp_path / "imu.csv", index=False)
    gnss = pd.read_csv(tmp_path / "gnss.csv")
    gnss["time_us"] = epoch // 1000 + np.round(gnss.pop("time_s") * 1e6).astype("i8")
    gnss["alt_ft"] = gnss.pop("alt_m") / 0.3048
    gnss["v_north_kt"] = gnss.pop("v_north_mps") * 3600.0 / 1852.0
    gnss.to_csv(tmp_path / "gnss.csv", index=False)
    for name in ("mag.csv", "baro.csv"):
        (tmp_path / name).unlink()
    stored = json.loads((tmp_path / "log.json").read_text())
    del stored["initial"]
    (tmp_path / "log.json").write_text(json.dumps(stored))
    columns = {"stamp": "time_ns", "wx": "gyro_x_dps", "wy": "-gyro_y_dps", "wz": "gyro_z_dps"} | {
        f"a{a}": f"accel_{a}_g" for a in "xyz"
    }
    read = import_log("table", tmp_path, columns=columns).log
    n = len(read.imu.t)
    assert np.abs(read.imu.t - log.imu.t[-n:]).max() < 1e-9
    assert np.abs(read.imu.gyro - log.imu.gyro[-n:]).max() < 1e-15
    assert np.abs(read.imu.accel - log.imu.accel[-n:]).max() < 1e-13
    m = len(read.gnss.t)
    assert m == len(log.gnss.t) - 1  # the first fix has become the initial position
    assert np.abs(read.gnss.h - log.gnss.h[-m:]).max() < 1e-10
    assert np.abs(read.gnss.v_n - log.gnss.v_n[-m:]).max() < 1e-12


def _csv(log: SensorLog, folder: Path) -> None:
    export_log(log, folder, "csv")


def _edit(path: Path, line: int, old: str, new: str) -> None:
    lines = path.read_text().splitlines()
    cells = lines[line].split(",")
    header = lines[0].split(",")
    cells[header.index(old)] = new
    lines[line] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


def _header(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda d: _edit(d / "imu.csv", 9, "gyro_y_radps", "nan"), ["imu.csv", "gyro_y_radps", "sample 8", "finite"]),
        (
            lambda d: _edit(d / "imu.csv", 9, "gyro_y_radps", "fast"),
            ["imu.csv", "gyro_y_radps", "sample 8", "'fast'", "number"],
        ),
        (lambda d: _edit(d / "gnss.csv", 5, "time_s", "0.01"), ["gnss.csv", "sample 4", "increase"]),
        (lambda d: _edit(d / "gnss.csv", 5, "lat_deg", "120"), ["gnss.csv", "latitude", "±90°"]),
        (
            lambda d: _header(d / "imu.csv", "gyro_x_radps", "gyro_x_dpss"),
            ["imu.csv", "dpss", "angular rate", "did you mean 'dps'"],
        ),
        (lambda d: _header(d / "imu.csv", "accel_z_mps2", "azz"), ["imu.csv", "no column for accel_z"]),
        (lambda d: (d / "imu.csv").write_bytes(b"\x00\xff\xfe,,\n" * 4), ["imu.csv"]),
        (lambda d: (d / "imu.csv").write_text(""), ["imu.csv", "not a readable table"]),
        (lambda d: (d / "imu.csv").unlink(), ["imu.csv", "no such file", "gnss.csv"]),
        (lambda d: (d / "log.json").write_text("{"), ["log.json", "cannot be read"]),
        (lambda d: (d / "log.json").write_text('{"imu": {"nmae": 1}}'), ["log.json", "imu"]),
        (lambda d: (d / "log.json").unlink(), ["nothing states how good the imu is", "[recording.imu]"]),
    ],
)
def test_damaged_tables_are_refused(damage, words: list[str], log: SensorLog, tmp_path: Path) -> None:
    _csv(log, tmp_path)
    damage(tmp_path)
    with pytest.raises(InputError) as caught:
        import_log("table", tmp_path)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_unknown_names_are_refused_with_the_nearest(log: SensorLog, tmp_path: Path) -> None:
    _csv(log, tmp_path)
    cases = [
        (lambda: import_log("navgo", tmp_path), "did you mean 'navego'"),
        (lambda: import_log("table", tmp_path, columns={"wx": "giro_x_dps"}), "did you mean 'gyro_x_dps'"),
        (lambda: import_log("table", tmp_path, mappping="x"), "did you mean 'mapping'"),
        (lambda: import_log("table", tmp_path, columns={"imo": {"x": "y"}}), "did you mean 'imu'"),
        (lambda: import_log("ulog", tmp_path, columns={"a": "b"}), "columns and mapping are for the formats table"),
        (lambda: export_log(log, tmp_path, "kml"), "cannot be exported here"),
    ]
    for call, words in cases:
        with pytest.raises(InputError) as caught:
            call()
        assert words in str(caught.value)


def test_scenario_gives_sensors_times_and_alignment(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """A catalogue model replaces the file's; the cut log starts and ends where it should, with an attitude of its own."""
    export_log(log, tmp_path, "csv", reference=trajectory)
    data = {"format": "table", "dir": tmp_path.name, "start_s": 10.0, "end_s": 30.0, "imu": {"model": "ADIS16448"}}
    config = validate(RecordingConfig, data, "test")
    read = load_recording(config, tmp_path.parent)
    assert read.log.imu.spec.name == "ADIS16448"
    assert read.log.initial.t == pytest.approx(10.0, abs=0.2)
    assert read.log.initial.t == read.reference.t[0]
    assert read.log.imu.t[-1] == read.reference.t[-1] == pytest.approx(30.0, abs=1e-6)
    assert read.log.gnss.t[0] > read.log.initial.t
    assert load_recording(config, tmp_path.parent) is read  # one reading for the flight and for the log


def test_alignment_agrees_with_truth_within_its_sigma(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    """Without noise, levelling in a 20° banked climbing turn is exact to the mean acceleration's model: 1 sigma."""
    from testbed.formats.alignment import align
    from testbed.formats.config import AlignmentConfig
    from testbed.physics.rotations import attitude_errors

    for heading in ("course", "mag"):
        config = AlignmentConfig(heading=heading)
        aligned = align(config, log.imu, log.gnss, log.mag, None, log.initial.t, "test")
        truth = trajectory.q_nb[round(aligned.initial.t * 100.0)]
        error = attitude_errors(aligned.initial.q_nb[None], truth[None])[0]
        assert (np.abs(error) < 3.0 * aligned.initial.std[6:9]).all(), heading
        assert np.abs(error[:2]).max() < np.radians(1.5)
        assert abs(error[2]) < np.radians(1.5)


def test_kml_marks_errors_and_outages(trajectory: Trajectory, tmp_path: Path) -> None:
    """An estimate 5 m too far north is drawn in the colour of its class, and truth at absolute altitudes."""
    pytest.importorskip("simplekml")
    import xml.etree.ElementTree as ET

    from testbed.data.records import NavSolution
    from testbed.formats import kml

    r = trajectory
    solution = NavSolution(r.t, r.lat + 5.0 / 6.37e6, r.lon, r.h, r.v_n, r.q_nb)
    _, error = kml.position_error(r, solution)
    assert np.abs(error - 5.0).max() < 0.02  # the meridian radius at 47° is 0.1 % from 6370 km
    path = tmp_path / "flight.kml"
    export_trajectory(r, path, solution=solution, outages=[(12.0, 14.0)])
    root = ET.parse(path).getroot()
    text = path.read_text()
    space = {"k": "http://www.opengis.net/kml/2.2"}
    lines = {
        p.find("k:name", space).text
        for p in root.iterfind(".//k:Placemark", space)
        if p.find("k:LineString", space) is not None
    }
    assert lines == {"truth", "error 3 to 10 m", "outage 1"}
    assert kml.COLOURS[2] in text
    assert text.count("absolute") == text.count("<Placemark")


def edited(folder: Path, part: str, change) -> None:
    lines = (folder / f"{part}.csv").read_text().splitlines()
    (folder / f"{part}.csv").write_text("\n".join(change(lines)) + "\n")


@pytest.mark.parametrize("part", ["imu", "gnss", "mag", "baro", "reference"])
def test_empty_reversed_and_doubled_tables_are_refused(
    part: str, trajectory: Trajectory, log: SensorLog, tmp_path: Path
) -> None:
    changes = {
        "no rows": lambda lines: lines[:1],
        "time must increase": lambda lines: lines[:1] + lines[:0:-1],
        "is there 2 times": lambda lines: [line + "," + line.split(",")[1] for line in lines],
    }
    for said, change in changes.items():
        export_log(log, tmp_path, "csv", reference=trajectory)
        edited(tmp_path, part, change)
        with pytest.raises(InputError, match=said) as refusal:
            import_log("csv", tmp_path)
        assert f"{part}.csv" in str(refusal.value)


def test_a_reference_of_two_rows_is_refused(trajectory: Trajectory, log: SensorLog, tmp_path: Path) -> None:
    export_log(log, tmp_path, "csv", reference=trajectory)
    edited(tmp_path, "reference", lambda lines: lines[:3])
    with pytest.raises(InputError, match="reference has 2 rows"):
        import_log("csv", tmp_path)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("outages",), "x"),
        (("outages",), [1, 2]),
        (("outages",), [[3.0, 1.0]]),
        (("initial", "t"), [1, 2]),
        (("imu", "gyro", "white_noise"), "much"),
        (("imu", "rate_hz"), None),
        (("gnss", "lever_arm_b"), 3.0),
        (("mag", "name"), 7),
    ],
)
def test_wrong_types_in_a_stored_log_are_refused(log: SensorLog, tmp_path: Path, place: tuple, value: object) -> None:
    export_log(log, tmp_path, "csv")
    stored = json.loads((tmp_path / "log.json").read_text())
    table = stored
    for key in place[:-1]:
        table = table[key]
    table[place[-1]] = value
    (tmp_path / "log.json").write_text(json.dumps(stored))
    with pytest.raises(InputError, match=rf"log\.json.*{place[0]}"):
        import_log("csv", tmp_path)
