"""A trajectory from a file: it becomes the truth that the file describes, closes, and is refused where no vehicle moves so."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from closure import strapdown_errors

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.base.notes import notes_of
from testbed.base.schema import validate
from testbed.flight.own import TrajectoryConfig
from testbed.flight.track import fly_track, notes_of_track
from testbed.physics import earth
from testbed.physics.ecef import to_ecef, to_geodetic
from testbed.physics.rotations import attitude_errors, quats_to_eulers, quats_to_matrices
from testbed.scenario import load_scenario

NESC = Path(__file__).resolve().parents[3] / "shared" / "data" / "nesc"
NAVEGO = Path(__file__).resolve().parents[3] / "shared" / "data" / "navego" / "ref.mat"


def made(path, **keys):
    return fly_track(validate(TrajectoryConfig, {"trajectory": str(path)} | keys, "flight"))


def write(path: Path, names: str, *columns, fmt: str = "%.17g") -> Path:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=names, comments="", fmt=fmt)
    return path


def closure(truth):
    """Largest distance (m) of the strapdown over the true increments."""
    return np.linalg.norm(strapdown_errors(truth), axis=0).max()


def circle(tmp_path, rate=1.0, seconds=120.0, radius=400.0, period=60.0):
    """A level circle: the analytic motion of which speed, acceleration and bank are known."""
    t = np.arange(round(seconds * rate) + 1) / rate
    angle = 2.0 * np.pi * t / period
    north, east = radius * np.sin(angle), radius * (1.0 - np.cos(angle))
    return write(tmp_path / "circle.csv", "time_s,north_m,east_m,down_m", t, north, east, 0.0 * t)


ORIGIN = {"lat_deg": 47.0, "lon_deg": 11.0, "alt_m": 500.0}


def test_geodetic_and_back():
    """Places all over the Earth, the poles among them, come back to 1 nm along the ellipsoid and in height."""
    rng = np.random.default_rng(3)
    lat = np.concatenate([np.arcsin(rng.uniform(-1, 1, 50)), [np.pi / 2, -np.pi / 2, 0.0]])
    lon, h = rng.uniform(-np.pi, np.pi, 53), rng.uniform(-500, 50_000, 53)
    back = to_geodetic(to_ecef(lat, lon, h))
    assert np.abs(back[0] - lat).max() < 1e-14 and np.abs(back[2] - h).max() < 1e-8
    np.testing.assert_allclose(to_ecef(*back), to_ecef(lat, lon, h), atol=5e-9)
    # the equator's radius and the pole's, by the definition of WGS-84
    np.testing.assert_allclose(np.linalg.norm(to_ecef(np.array([0.0, np.pi / 2]), np.zeros(2), np.zeros(2)), axis=1), [
        6378137.0, 6356752.314245], atol=1e-5)  # fmt: skip


def test_a_circle_of_one_row_per_second_is_banked_as_it_must_be(tmp_path):
    """v = 2 pi r / T, and tan(bank) = v² / (g r). The spline of fifth degree through 60 rows per turn leaves
    (2 pi / 60)^5 of the speed, 1e-5, and the rows' ends a little more."""
    truth = made(circle(tmp_path), origin=ORIGIN, attitude="coordinated")
    speed = 2.0 * np.pi * 400.0 / 60.0
    inner = (truth.t > 10.0) & (truth.t < 110.0)
    np.testing.assert_allclose(np.linalg.norm(truth.v_n[inner], axis=1), speed, rtol=1e-4)
    roll, pitch, _ = np.degrees(quats_to_eulers(truth.q_nb[inner])).T
    g = earth.gravity(np.radians(47.0), 500.0)
    # Coriolis adds 2 Omega v sin(lat) = 4e-3 m/s² to 4.4 m/s²; the plane is flat, the Earth is not: 0.4 km / 6400 km
    np.testing.assert_allclose(roll, np.degrees(np.arctan(speed**2 / 400.0 / g)), atol=0.05)
    assert np.abs(pitch).max() < 0.02 and np.abs(truth.f_b[inner, 1]).max() < 1e-3
    assert closure(truth) < 1e-3
    level = made(tmp_path / "circle.csv", origin=ORIGIN)
    assert np.abs(quats_to_eulers(level.q_nb)[:, 0]).max() < 1e-12
    np.testing.assert_allclose(level.f_b[1000:-1000, 1], speed**2 / 400.0, rtol=2e-3)


@pytest.mark.parametrize(
    ("every", "place_m", "velocity_mps", "attitude_deg"),
    [
        # every row: what rounding and two ways to spline leave
        (1, 1e-4, 0.01, 1e-9),
        # 10 Hz: between rows the gusts change the velocity by 0.1 m/s, for 0.05 s, and the roll rate by 40 deg/s: T² / 8 of
        # 400 deg/s² is 0.5 deg
        (10, 5e-3, 0.1, 0.5),
        # 1 Hz: a roll of 60 deg/s may begin and end between two rows (a quarter of it unseen, 15 deg); its 2.5 m/s² for a
        # quarter of a second are 0.6 m/s, doubled for the spline's overshoot; that for a quarter of a second 0.3 m
        (100, 0.3, 1.2, 15.0),
    ],
)
@pytest.mark.parametrize(
    ("name", "sink_mps"),
    [
        ("quickstart", 0.0),
        # a touch-down takes the rate of descent away between two rows, 1 m/s at most of this flight: that in velocity, and in
        # place its quarter over the rows' distance
        ("whole-flight", 1.0),
    ],
)
def test_a_shipped_flight_thinned_comes_back(tmp_path, name, sink_mps, every, place_m, velocity_mps, attitude_deg):
    flown = pipeline.fly(load_scenario(name))
    whole = len(flown.t) - (len(flown.t) - 1) % every  # as far as the thinned rows reach
    parts = ("t", "lat", "lon", "h", "v_n", "q_nb", "f_b", "w_ib_b")
    flown = type(flown)(**{part: getattr(flown, part)[:whole] for part in parts})
    if every > 1:
        place_m, velocity_mps = place_m + 0.25 * sink_mps * every * flown.dt, velocity_mps + sink_mps
    else:  # two samples of 26 instead of 10 m/s², of which T / 8 may go another way
        velocity_mps += 0.02 * sink_mps
    rows = slice(0, len(flown.t), every)
    euler = np.degrees(quats_to_eulers(flown.q_nb))
    columns = flown.t, np.degrees(flown.lat), np.degrees(flown.lon), flown.h, *euler.T
    names = "time_s,lat_deg,lon_deg,alt_m,roll_deg,pitch_deg,yaw_deg"
    truth = made(write(tmp_path / "thin.csv", names, *(c[rows] for c in columns)))
    assert len(truth.t) == len(flown.t)
    miss = earth.position_difference(truth.lat, truth.lon, truth.h, flown.lat, flown.lon, flown.h)
    # within three rows of the ends a spline is known from one side alone: twice as far
    share = np.where((flown.t < 0.03 * every) | (flown.t > flown.t[-1] - 0.03 * every), 0.5, 1.0)
    assert (share * np.linalg.norm(miss, axis=0)).max() < place_m
    assert (share * np.linalg.norm(truth.v_n - flown.v_n, axis=1)).max() < velocity_mps
    assert np.degrees(np.linalg.norm(attitude_errors(truth.q_nb, flown.q_nb), axis=1)).max() < attitude_deg
    assert closure(truth) < 0.01


def test_a_car_that_stops_keeps_its_heading(tmp_path):
    """North at 10 m/s, a stop of 20 s, on to the east: the heading is held, then turns; the truth closes."""
    t = np.arange(0.0, 81.0)
    speed = np.interp(t, [0, 20, 30, 50, 60, 80], [10, 10, 0, 0, 10, 10])
    heading = np.where(t < 40, 0.0, np.radians(90.0))
    north, east = np.cumsum(speed * np.cos(heading)), np.cumsum(speed * np.sin(heading))
    truth = made(write(tmp_path / "stop.csv", "t,north,east,up", t, north, east, 0.0 * t), origin=ORIGIN)
    yaw = np.degrees(quats_to_eulers(truth.q_nb)[:, 2])
    assert abs(yaw[1500]) < 0.1 and abs(yaw[-500] - 90.0) < 0.1
    assert np.abs(truth.w_ib_b).max() < np.radians(200.0)
    v_b = np.einsum("kji,kj->ki", quats_to_matrices(truth.q_nb), truth.v_n)
    assert np.abs(v_b[np.linalg.norm(truth.v_n, axis=1) > 2.0, 1:]).max() < 0.02
    assert closure(truth) < 0.01


def test_a_noisy_track_is_smoothed_when_asked(tmp_path):
    """Places at 10 Hz rounded to 1e-6 degrees, 0.1 m: splined through, 0.03 m of noise at 10 Hz are 10 m/s² and more; a knot
    every 3 s averages 30 rows, so that the noise of the place falls below 0.02 m."""
    path = circle(tmp_path, rate=10.0)
    t, north, east, _ = np.loadtxt(path, delimiter=",", skiprows=1).T
    per = np.array(earth.metres_per_radian(np.radians(47.0), 500.0))
    lat, lon = 47.0 + np.degrees(north / per[0]), 11.0 + np.degrees(east / per[1])
    rough = write(tmp_path / "rough.csv", "t,lat,lon,alt", t, lat.round(6), lon.round(6), 500.0 + 0.0 * t)
    clean = write(tmp_path / "clean.csv", "t,lat,lon,alt", t, lat, lon, 500.0 + 0.0 * t)
    with pytest.raises(InputError, match=r"acceleration of .* m/s².*smooth_s fits"):
        made(rough, max_acceleration_mps2=10.0)
    smooth, exact = made(rough, smooth_s=3.0, max_acceleration_mps2=10.0), made(clean)
    miss = earth.position_difference(smooth.lat, smooth.lon, smooth.h, exact.lat, exact.lon, exact.h)
    assert np.sqrt(np.mean(np.square(miss))) < 0.02
    with pytest.raises(InputError, match=r"smooth_s = 0.02.*no row"):
        made(rough, smooth_s=0.02)


GPX = """<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
{}</trkseg></trk></gpx>"""
KML = """<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Placemark><gx:Track>{}</gx:Track></Placemark></kml>"""


def test_all_formats_say_the_same(tmp_path):
    """One walk as CSV with dates, with semicolons and other names, without times, as Parquet, GPX, KML."""
    import pandas as pd

    n = np.arange(8)
    lat, lon, alt = 50.0 + 2e-5 * n, 8.0 + 1e-5 * n, 100.0 + 0.1 * n
    when = [f"2024-05-01T10:00:{k:02d}Z" for k in n]
    rows = list(zip(when, lat, lon, alt, strict=True))
    files = {
        "dates.csv": "time,lat,lon,alt\n" + "".join(f"{w},{a:.9f},{o:.9f},{h:.3f}\n" for w, a, o, h in rows),
        "other.csv": "Zeit;Breite;Laenge;Hoehe\n" + "".join(f"{1714557600000 + 1000 * k};{a:.9f};{o:.9f};{h:.3f}\n" for k, (_, a, o, h) in enumerate(rows)),
        "bare.csv": "Latitude,Longitude,Altitude,sats\n" + "".join(f"{a:.9f},{o:.9f},{h:.3f},9\n" for _, a, o, h in rows),
        "walk.gpx": GPX.format("".join(f'<trkpt lat="{a:.9f}" lon="{o:.9f}"><ele>{h:.3f}</ele><time>{w}</time></trkpt>' for w, a, o, h in rows)),
        "walk.kml": KML.format("".join(f"<when>{w}</when>" for w in when) + "".join(f"<gx:coord>{o:.9f} {a:.9f} {h:.3f}</gx:coord>" for _, a, o, h in rows)),
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    pd.DataFrame({"time_s": n + 0.0, "lat_rad": np.radians(lat), "lon_deg": lon, "alt_cm": 100 * alt}).to_parquet(
        tmp_path / "walk.parquet"
    )
    columns = {"Zeit": "time_ms", "Breite": "lat_deg", "Laenge": "lon_deg", "Hoehe": "alt_m"}
    keys = {"other.csv": {"columns": columns}, "bare.csv": {"row_rate_hz": 1.0}}
    truths = {name: made(tmp_path / name, **keys.get(name, {})) for name in [*files, "walk.parquet"]}
    for name, truth in truths.items():
        assert truth.t[-1] == pytest.approx(7.0), name
        np.testing.assert_allclose(truth.lat[::100], np.radians(lat), atol=1e-11, err_msg=name)
        np.testing.assert_allclose(truth.h[::100], alt, atol=1e-4, err_msg=name)
    bare = validate(TrajectoryConfig, {"trajectory": str(tmp_path / "bare.csv"), "row_rate_hz": 1.0}, "flight")
    notes = " ".join(notes_of_track(bare))
    assert "Latitude as lat_deg" in notes and "does not use sats" in notes


@pytest.mark.skipif(not NAVEGO.exists(), reason="needs NaveGo's example")
def test_navego_reference():
    """NaveGo's own reference, 437 s of a car at 200 Hz: the truth meets its places to 0.1 mm, and its attitude is the file's."""
    from scipy.io import loadmat

    ref = loadmat(NAVEGO)["ref"][0, 0]
    t, lat = ref["t"].ravel(), ref["lat"].ravel()
    truth = made(NAVEGO, rate_hz=200.0)
    np.testing.assert_allclose(truth.t, t - t[0], atol=1e-9)
    np.testing.assert_allclose(truth.lat, lat, atol=1e-4 / 6.4e6)
    np.testing.assert_allclose(quats_to_eulers(truth.q_nb)[:, 1], ref["pitch"].ravel(), atol=1e-9)


@pytest.mark.skipif(not NESC.is_dir(), reason="needs the published histories")
@pytest.mark.parametrize(
    ("case", "rate", "most"),
    [
        # across equator and date line
        ("16", 100.0, 1e-2),
        # 5.5 km from the pole n turns by 0.03 rad/s, and the strapdown's error is of first order in that turn: 6 m after
        # 180 s at 100 Hz, 1.3 m at 400 Hz; the truth itself returns (below)
        ("15", 1000.0, 1.0),
    ],
)
def test_published_circles_round_the_pole_and_across_the_date_line(tmp_path, case, rate, most):
    """F-16 of NASA/TM-2015-218675, simulator 04: through the file's last place within a micrometre, and back by strapdown."""
    with (NESC / f"Atmos_{case}_sim_04.csv").open() as text:
        rows = list(csv.DictReader(text))
    keys = ["time", "latitude_deg", "longitude_deg", "altitudeMsl_ft"] + [
        f"eulerAngle_deg_{a}" for a in ("Roll", "Pitch", "Yaw")
    ]
    columns = np.array([[float(row[key]) for key in keys] for row in rows])
    path = write(tmp_path / "f16.csv", "time_s,lat_deg,lon_deg,alt_ft,roll_deg,pitch_deg,yaw_deg", columns)
    truth = made(path, rate_hz=rate)
    last = to_ecef(*np.array([[*np.radians(columns[-1, 1:3]), 0.3048 * columns[-1, 3]]]).T)
    assert np.linalg.norm(to_ecef(truth.lat[-1:], truth.lon[-1:], truth.h[-1:]) - last) < 1e-6
    assert closure(truth) < most


def track(**changes):
    """A straight walk of 1 m/s, 40 rows a second apart, and what is changed in it."""
    columns = {"time_s": np.arange(40.0), "lat_deg": 50.0 + np.arange(40) / 111_000.0, "lon_deg": np.full(40, 8.0), "alt_m": np.full(40, 100.0)}  # fmt: skip
    for name, change in changes.items():
        columns[name] = change(columns[name].copy()) if callable(change) else change
    return columns


def put(k, value):
    return lambda column: np.where(np.arange(len(column)) == k, value, column)


def jump(column):
    return column + np.where(np.arange(len(column)) >= 20, 0.002, 0.0)


@pytest.mark.parametrize(
    ("columns", "keys", "message"),
    [
        (track(lat_deg=jump), {}, r"near row (20|21) \(t = (19|20) s, line (21|22) of the file\) the places need .* m/s"),
        (track(lat_deg=put(10, 51.0)), {}, r"near row (9|10|11|12) .*need"),
        (track(time_s=lambda t: t + 9.0 * (t > 11)), {}, r"a gap of 10 s after row 12 \(t = 11 s"),
        (track(time_s=put(7, 6.0)), {}, r"row 8 .*is not later than the row before it"),
        (track(alt_m=put(5, np.nan)), {}, r"row 6 .*empty or no finite number"),
        (track(lat_deg=put(5, 100.0)), {}, r"row 6 .*no place on the Earth"),
        (track(yaw_deg=np.zeros(40)), {}, r"an attitude of yaw alone; it lacks roll_deg, pitch_deg"),
        (track(roll_deg=np.zeros(40), pitch_deg=np.zeros(40), yaw_deg=put(9, 170.0)(np.zeros(40))), {"max_rate_dps": 100.0}, r"near row (9|10|11) .*turns at"),
        (track(q_nb_0=np.ones(40), q_nb_1=np.ones(40), q_nb_2=np.zeros(40), q_nb_3=np.zeros(40)), {}, r"row 1 .*length 1.414"),
        (track(), {"attitude": "file"}, "the file has none"),
        (track(), {"origin": ORIGIN}, r"remove \[flight.origin\]"),
        (track(), {"columns": {"latitude": "lat_deg"}}, "'columns' names 'latitude'; did you mean 'lat_deg'"),
        (track(), {"row_rate_hz": 5.0}, "remove row_rate_hz"),
        ({("lat_m" if k == "lat_deg" else k): v for k, v in track().items()}, {}, "'m' is no unit of angle"),
        ({k: v[:3] for k, v in track().items()}, {}, "3 rows; a trajectory needs at least 4"),
        ({k: v for k, v in track().items() if k != "alt_m"}, {}, "no column for alt_m"),
        ({k: v for k, v in track().items() if k != "time_s"}, {}, "say row_rate_hz"),
        ({"time_s": np.arange(9.0), "north_m": np.arange(9.0), "east_m": np.arange(9.0), "down_m": np.arange(9.0)}, {}, r"need \[flight.origin\]"),
    ],
)  # fmt: skip
def test_what_no_vehicle_does_is_refused_with_the_row(tmp_path, columns, keys, message):
    path = write(tmp_path / "track.csv", ",".join(columns), *columns.values())
    with pytest.raises(InputError, match=rf"{path}.*{message}"):
        made(path, **keys)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "time_s,lat_deg,lon_deg,alt_m\n1,50,8,x\n2,50,8,1\n", r"row 1, column 'alt_m': 'x' is no number"),
        ("a.csv", "", "not a readable table"),
        ("a.xlsx", "", "no format has this ending"),
        ("a.gpx", GPX.format('<trkpt lat="50" lon="8"><ele>1</ele></trkpt>'), "row 1: the track point has no <time>"),
        ("a.gpx", "<gpx>", "not valid XML"),
        ("a.kml", KML.format("<gx:coord>8 50 1</gx:coord>"), "0 times .*says nothing of the motion"),
        ("a.mat", "nonsense", "not a readable .mat file"),
    ],
)
def test_files_that_cannot_be_read_are_named(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=rf"{tmp_path / name}: .*{message}"):
        made(tmp_path / name)


SCENARIO = """
[scenario]
name = "own"
[flight]
trajectory = "walk.csv"
[sensors.imu]
model = "ADIS16448"
[sensors.gnss]
model = "Garmin16x"
[[estimators]]
name = "indirect-kf"
"""


def test_a_scenario_on_a_file(tmp_path):
    write(tmp_path / "walk.csv", ",".join(track()), *track().values())
    (tmp_path / "own.toml").write_text(SCENARIO)
    scenario = load_scenario(tmp_path / "own.toml")
    truth = pipeline.fly(scenario)
    log, _ = pipeline.sense(scenario, truth)
    assert truth.name == "walk" and len(log.gnss.t) > 20 and notes_of(scenario) == []
    again = tmp_path / "again.toml"
    again.write_text(scenario.to_toml())
    digest = scenario.digest()
    assert load_scenario(again).digest() == digest
    # the content counts, not the name
    write(tmp_path / "walk.csv", ",".join(track()), *track(alt_m=np.full(40, 101.0)).values())
    assert load_scenario(tmp_path / "own.toml").digest() != digest
    # in place of what a shipped scenario flies
    taken = load_scenario("quickstart", overrides={"flight.trajectory": str(tmp_path / "walk.csv")})
    assert taken.flight == load_scenario(tmp_path / "own.toml").flight
    for wrong, message in (
        ({"flight.trajektory": "x"}, "'flight.trajektory' is not a known key"),
        ({"flight.rate_hz": 5.0}, "'flight.rate_hz': input should be greater than or equal to 10"),
        ({"monte_carlo.vary": ["turbulence"]}, "recorded motion is the same in every run"),
    ):
        with pytest.raises(InputError, match=message):
            load_scenario(tmp_path / "own.toml", overrides=wrong)
    (tmp_path / "walk.csv").unlink()
    with pytest.raises(InputError, match=r"own.toml: .*walk.csv: no such file"):
        pipeline.fly(scenario)


def test_rows_of_less_than_a_hertz_are_told_and_far_ones_refused(tmp_path):
    """1 Hz is what the documents ask for: a row each 2 s is told, each 10 s refused unless max_gap_s allows it, and then told."""

    def notes(rate, **keys):
        path = circle(tmp_path, rate, 240.0, 4000.0, 600.0)
        keys = {"origin": ORIGIN} | keys
        made(path, **keys)
        return notes_of_track(validate(TrajectoryConfig, {"trajectory": str(path)} | keys, "flight"))

    assert notes(1.0) == ()
    assert any("its rows are 2 s apart (0.5 Hz)" in note for note in notes(0.5))
    with pytest.raises(InputError, match=r"a gap of 10 s after row 1 .*at most 5 s are bridged \(the key max_gap_s\)"):
        notes(0.1)
    assert any("its rows are 10 s apart (0.1 Hz)" in note for note in notes(0.1, max_gap_s=10.0))


def test_a_receiver_that_saves_a_place_each_seven_seconds_is_followed(tmp_path):
    """GPX has dates, so its times are in no doubt."""
    import pandas as pd

    n = np.arange(30)
    when = pd.Timestamp("2024-05-01T10:00:00Z") + pd.to_timedelta(7 * n, unit="s")
    points = "".join(
        f'<trkpt lat="{50.0 + 1e-4 * k:.9f}" lon="8.0"><ele>100</ele><time>{w:%Y-%m-%dT%H:%M:%SZ}</time></trkpt>'
        for k, w in zip(n, when, strict=True)
    )
    (tmp_path / "walk.gpx").write_text(GPX.format(points))
    assert made(tmp_path / "walk.gpx").t[-1] == pytest.approx(7.0 * 29)
    config = validate(TrajectoryConfig, {"trajectory": str(tmp_path / "walk.gpx")}, "flight")
    assert any("its rows are 7 s apart" in note for note in notes_of_track(config))
