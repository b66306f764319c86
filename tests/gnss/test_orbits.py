"""Satellites and delays against the figures of sidereon and RTKLIB (golden/), and against those programs where installed."""

import csv
import datetime
from pathlib import Path

import numpy as np
import pytest

from testbed.base.errors import InputError
from testbed.gnss import atmosphere, orbits, rinex
from testbed.gnss.constellation import GALILEO_EPOCH_OF_SLOTS, GPS_EPOCH_OF_SLOTS, nominal_sky, sidereal_angle
from testbed.gnss.receiver import dilution
from testbed.physics import ecef, ranging
from testbed.physics.ranging import C

GOLDEN = Path(__file__).parent / "golden"
DATA = Path(__file__).parents[3] / "shared" / "data" / "rinex"
NAVIGATION = DATA / "SEPT2650.21P"
with_data = pytest.mark.skipif(not NAVIGATION.is_file(), reason="needs the shared navigation file")


def rows(name):
    with open(GOLDEN / name, encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def records():
    if not NAVIGATION.is_file():
        pytest.skip("needs the shared navigation file")
    return rinex.read_navigation(NAVIGATION).records


def test_orbits_and_clocks_are_those_of_both_programs(records):
    """1e-6 m and 1e-9 m of clock: double precision leaves 1e-8 m of 3e7 m, and 1e-12 m of a clock of 1e5 m."""
    for row in rows("orbits.csv"):
        record = records[int(row["record"])]
        start = record.epoch() + datetime.timedelta(seconds=float(row["dt_s"]))
        eph = record.row(start)
        place, _, ea = orbits.orbit(eph, 0.0)
        for theirs in ("{}_m", "{}_rtklib_m"):
            assert np.allclose(place, [float(row[theirs.format(axis)]) for axis in "xyz"], rtol=0.0, atol=1e-6), row
        eph[orbits.TGD] = 0.0
        offset, _ = orbits.clock(eph, 0.0, ea)
        # the polynomial alone has to be right to its last digits, 1e-16 of 1e-3 s
        expected = C * (float(row["polynomial_s"]) + float(row["relativity_s"]))
        assert offset == pytest.approx(expected, rel=1e-14, abs=1e-9), row
        if row["satellite"][0] == "G":
            assert record.row(start)[orbits.TGD] == float(row["group_delay_s"])


def test_velocity_and_clock_rate_are_derivatives(records):
    """Central differences over 0.5 s leave a sixth of the jerk, 1e-4 m/s³ times h²: 4e-6 m/s."""
    worst = 0.0
    for record in records[::7]:
        eph = record.row(record.epoch())
        _, velocity, ea = orbits.orbit(eph, 1000.0)
        (before, _, ea0), (after, _, ea1) = orbits.orbit(eph, 999.5), orbits.orbit(eph, 1000.5)
        worst = max(worst, np.abs(np.array(after) - before - velocity).max())
        rate = orbits.clock(eph, 1000.0, ea)[1]
        assert orbits.clock(eph, 1000.5, ea1)[0] - orbits.clock(eph, 999.5, ea0)[0] == pytest.approx(rate, abs=1e-9)
    assert worst < 1e-5


def test_ranges_and_their_rates(records):
    """The range's fixed point by brute force, and its rate by differences, from a moving antenna."""
    start, moving = np.array([-3962108.7, 3381309.5, 3668678.6]), np.array([150.0, -80.0, 60.0])
    for record in records[::11]:
        eph = record.row(record.epoch())

        def at(t, eph=eph):
            return orbits.received(eph, t, tuple(start + moving * t))

        place, velocity, distance, _ = at(100.0)
        tau, r = 0.07, start + moving * 100.0
        for _ in range(12):
            x = np.array(orbits.turned(orbits.orbit(eph, 100.0 - tau)[0], ranging.OMEGA * tau))
            tau = np.linalg.norm(x - r) / C
        assert distance == pytest.approx(C * tau, abs=1e-6) and np.allclose(place, x, rtol=0.0, atol=1e-6)
        _, u = ranging.sight(place, r)
        rate = ranging.range_rate(u, place, velocity, moving)
        assert at(100.5)[2] - at(99.5)[2] == pytest.approx(rate, abs=1e-5)


def test_delays_are_those_of_both_programs():
    for row in (dict(zip(r, map(float, r.values()), strict=True)) for r in rows("models.csv")):
        lat, lon = np.radians(row["lat_deg"]), np.radians(row["lon_deg"])
        sky = np.radians(row["el_deg"]), np.radians(row["az_deg"])
        coefficients = np.array([8.3819e-9, 1.4901e-8, -5.9605e-8, -5.9605e-8, 83968.0, 16384.0, -131072.0, -65536.0])
        mine = atmosphere.klobuchar(coefficients, (lat, lon), sky, row["t_s"])
        assert mine == pytest.approx(row["iono_m"], abs=1e-9) and mine == pytest.approx(row["iono_rtklib_m"], abs=1e-9)
        dry, wet = atmosphere.saastamoinen(lat, row["h_m"])
        assert dry + wet == pytest.approx(row["tropo_rtklib_m"], abs=1e-9)
    dry, wet = atmosphere.saastamoinen(np.radians(45.0), 3000.0)
    assert dry == pytest.approx(1.597, abs=1e-3) and wet == pytest.approx(0.033, abs=1e-3)


def test_dilution_is_that_of_both_programs():
    """Twenty random skies, 1e-9: inverses of four by four matrices of a condition below 1e4."""
    for row in rows("dop.csv"):
        azimuth, elevation = np.array([[float(x) for x in sight.split(":")] for sight in row["sky"].split()]).T
        level = np.cos(elevation)
        lines = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(elevation)])
        hdop, vdop, tdop, pdop = dilution(lines, np.ones(len(lines), dtype=np.int64))
        for name, mine in (("hdop", hdop), ("vdop", vdop), ("tdop", tdop), ("pdop", pdop)):
            theirs = [row[name], *([row[f"{name}_rtklib"]] if name != "tdop" else [])]
            assert [float(x) for x in theirs] == pytest.approx([mine] * len(theirs), rel=1e-9), (name, row)


@with_data
def test_ranges_are_those_of_sidereon():
    """0.1 mm: sidereon rounds the time of transmission to a microsecond, 3e-5 m at its speed along the line of sight."""
    sky = rinex.read_navigation(NAVIGATION).sky(datetime.datetime(2021, 9, 22, 2, 30), ["gps"])
    theirs = {row["satellite"]: float(row["range_m"]) for row in rows("ranges.csv")}
    r = np.array([-3962108.6617, 3381309.5232, 3668678.6410])
    shared = [(theirs[n], eph) for n, eph in zip(sky.names, sky.ephemerides, strict=True) if n in theirs]
    assert len(shared) > 10
    for distance, eph in shared:
        assert orbits.received(eph, 0.0, r)[2] == pytest.approx(distance, abs=1e-4)


def test_places_go_back_and_forth():
    """A nanometre, everywhere to 500 km, the poles and the equator included."""
    rng = np.random.default_rng(1)
    for lat, lon, h in [
        *rng.uniform([-1.57, -3.1, -500.0], [1.57, 3.1, 5e5], (200, 3)),
        (np.pi / 2, 0.0, 10.0),
        (0.0, 1.0, 0.0),
    ]:
        x = ecef.geodetic_to_ecef(lat, lon, h)
        back = ecef.ecef_to_geodetic(*x)
        assert np.allclose(ecef.geodetic_to_ecef(*back), x, rtol=0.0, atol=5e-9)
        assert back[2] == pytest.approx(h, abs=1e-8)


def test_sidereal_time_is_that_of_the_performance_standard():
    """1993-07-01 00:00: 18h36m14.4s, which the standard gives to a tenth of a second, 0.0004 degrees; UT1 adds 0.004."""
    angle = np.degrees(sidereal_angle(GPS_EPOCH_OF_SLOTS)) % 360.0
    assert angle == pytest.approx(15.0 * (18 + 36 / 60 + 14.4 / 3600), abs=6e-3)


@pytest.mark.parametrize(
    ("systems", "mask", "count", "hdop", "vdop"),
    [
        (["gps"], 5.0, 7.6, 1.08, 1.55),
        (["gps"], 10.0, 6.7, 1.21, 1.87),
        (["galileo"], 5.0, 7.9, 1.04, 1.61),
        (["gps", "galileo"], 5.0, 15.5, 0.69, 1.00),
        (["gps", "galileo"], 10.0, 13.7, 0.78, 1.20),
    ],
)
def test_nominal_constellations_have_the_dilution_of_an_independent_propagation(systems, mask, count, hdop, vdop):
    """Satellites within 0.1 and dilution within 0.02 of another program's at 45 N over ten days, every 15 minutes.

    That program took the angles of the tables for the start, with a Greenwich angle of zero: each constellation begins at
    the epoch of its table here, seen from where the sidereal angle is zero then. It left out the turn of the nodes.
    """
    skies = []
    for system in systems:
        epoch = {"gps": GPS_EPOCH_OF_SLOTS, "galileo": GALILEO_EPOCH_OF_SLOTS}[system]
        place = np.radians(45.0), -sidereal_angle(epoch)
        axes = np.array(ecef.north_east_down(*place))
        skies.append((nominal_sky(epoch, [system]), ecef.geodetic_to_ecef(*place, 0.0), axes))
    seen, dops = [], []
    for t in np.arange(0.0, 10 * 86400.0, 900.0):
        lines, system_of = [], []
        for sky, r, axes in skies:
            for code, eph in zip(sky.codes, sky.ephemerides, strict=True):
                u = axes @ ranging.sight(orbits.orbit(eph, t)[0], r)[1]
                if np.degrees(np.arcsin(-u[2])) > mask:
                    lines.append(u)
                    system_of.append(code // 100)
        seen.append(len(lines))
        dops.append(dilution(np.array(lines), np.array(system_of))[:2])
    assert np.mean(seen) == pytest.approx(count, abs=0.1)
    assert np.mean(dops, axis=0) == pytest.approx([hdop, vdop], abs=0.02)


def test_damaged_files_are_named(tmp_path):
    path = tmp_path / "brdc.rnx"
    path.write_text("what\n")
    with pytest.raises(InputError, match=r"brdc\.rnx: line 1: no RINEX file"):
        rinex.read_navigation(path)
    if NAVIGATION.is_file():
        lines = NAVIGATION.read_text().splitlines()
        path.write_text("\n".join(lines[:14]))
        with pytest.raises(InputError, match="line 11: the record of G06 is cut off"):
            rinex.read_navigation(path)
        path.write_text("\n".join([*lines[:12], lines[12].replace("E", "x"), *lines[13:]]))
        with pytest.raises(InputError, match=r"line 13: '.*' is no number"):
            rinex.read_navigation(path)
        with pytest.raises(InputError, match="no ephemeris of gps within two hours of 2021-01-01"):
            rinex.read_navigation(NAVIGATION).sky(datetime.datetime(2021, 1, 1), ["gps"])
        path.write_text("\n".join(lines).replace("     3.04", "     2.11", 1))
        with pytest.raises(InputError, match=r"version 2\.11 of type 'N'; a RINEX 3 navigation file is needed"):
            rinex.read_navigation(path)


@with_data
def test_range_agrees_with_sidereon_where_it_is_installed(records):
    """0.1 mm: sidereon rounds the time of transmission to a microsecond, 3e-5 m at its speed along the line of sight."""
    sidereon = pytest.importorskip("sidereon")
    text, moment = NAVIGATION.read_text(), datetime.datetime(2021, 9, 22, 2, 30)
    sky, nav = rinex.read_navigation(NAVIGATION).sky(moment, ["gps"]), sidereon.parse_rinex_nav(text)
    seconds, checked = (moment - datetime.datetime(2000, 1, 1, 12)).total_seconds(), 0
    r = np.array([-3962108.6617, 3381309.5232, 3668678.6410])
    for name, eph in zip(sky.names, sky.ephemerides, strict=True):
        theirs = sidereon.observe_broadcast(nav, name, r, seconds, 1575.42e6, light_time=True, sagnac=True)
        assert orbits.received(eph, 0.0, r)[2] == pytest.approx(theirs.geometric_range_m, abs=1e-4)
        checked += 1
    assert checked > 10
