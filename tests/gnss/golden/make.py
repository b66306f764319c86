"""Makes the golden figures of this folder from sidereon 3.0.4 and pyrtklib 0.2.7, two implementations of other people.

    .venv/bin/python tests/gnss/golden/make.py SEPT2650.21P

orbits.csv: ephemerides of the file (by number among its GPS and Galileo records) evaluated around their time, by both where
RTKLIB has the same record; models.csv: delays at random places; ranges.csv: light time and the turn of the Earth to a fixed
antenna, by sidereon; dop.csv: dilution of random skies, by both. Nothing in here imports the testbed.
"""

import csv
import sys
from pathlib import Path

import numpy as np
import pyrtklib as rtk
import sidereon

HERE = Path(__file__).parent
ALPHA = [8.3819e-9, 1.4901e-8, -5.9605e-8, -5.9605e-8]
RECEIVER = np.array([-3962108.6617, 3381309.5232, 3668678.6410])
BETA = [83968.0, 16384.0, -131072.0, -65536.0]


def doubles(values):
    out = rtk.Arr1Ddouble(len(values))
    for k, value in enumerate(values):
        out[k] = float(value)
    return out


def of_rtklib(path):
    """Ephemerides of RTKLIB by satellite and time."""
    obs, nav, sta = rtk.obs_t(), rtk.nav_t(), rtk.sta_t()
    rtk.readrnx(str(path), 1, "", obs, nav, sta)
    return {(satellite_name(nav.eph[k].sat), round(nav.eph[k].toes)): nav.eph[k] for k in range(nav.n)}


def satellite_name(number):
    """RTKLIB numbers GPS 1 to 32 and, behind GLONASS's 27, Galileo from 60 on."""
    return f"G{number:02d}" if number <= 32 else f"E{number - 59:02d}"


def position_of_rtklib(e, dt):
    place, clock, variance = rtk.Arr1Ddouble(6), rtk.Arr1Ddouble(2), rtk.Arr1Ddouble(1)
    rtk.eph2pos(rtk.timeadd(e.toe, dt), e, place, clock, variance)
    return [place[k] for k in range(3)]


def ranges(path):
    nav = sidereon.parse_rinex_nav(Path(path).read_text())
    start = (np.datetime64("2021-09-22T02:30") - np.datetime64("2000-01-01T12:00")) / np.timedelta64(1, "s")
    for name in [f"G{k:02d}" for k in range(1, 33)]:
        try:
            seen = sidereon.observe_broadcast(nav, name, RECEIVER, start, 1575.42e6, light_time=True, sagnac=True)
        except Exception:  # a satellite without an ephemeris of this time
            continue
        yield name, seen.geometric_range_m


def dilutions():
    rng = np.random.default_rng(3)
    for _ in range(20):
        count, lat, lon = int(rng.integers(5, 12)), rng.uniform(-1.2, 1.2), rng.uniform(-3.0, 3.0)
        az, el = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.1, 1.5, count)
        east, north, up = np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)
        axes = np.array(
            [
                [-np.sin(lon), np.cos(lon), 0.0],
                [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
                [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
            ]
        )
        lines = np.column_stack([east, north, up]) @ axes
        theirs = sidereon.gnss_dop(lines, np.ones(count), sidereon.Wgs84Geodetic(lat, lon, 0.0))
        out = rtk.Arr1Ddouble(4)
        rtk.dops(count, doubles(np.column_stack([az, el]).ravel()), 0.0, out)
        sky = " ".join(f"{a:.17g}:{e:.17g}" for a, e in zip(az, el, strict=True))
        yield sky, theirs.hdop, theirs.vdop, theirs.tdop, theirs.pdop, out[2], out[3], out[1]


def orbits(path):
    other = of_rtklib(path)
    records = [r for r in sidereon.parse_rinex_nav_records(Path(path).read_text()) if str(r.satellite)[0] in "GE"]
    rng = np.random.default_rng(1)
    for k in sorted(rng.choice(len(records), 40, replace=False)):
        record = records[k]
        for dt in (-7200.0, -1234.5, 0.0, 3600.0):
            e = record.evaluate(record.toe_tow_s + dt)
            row = k, record.satellite, record.toe_tow_s, dt, *e.position_m
            same = other.get((str(record.satellite), round(record.toe_tow_s)))
            theirs = ["", "", ""] if same is None else position_of_rtklib(same, dt)
            yield *row, e.clock_polynomial_s, e.relativistic_clock_s, e.group_delay_s, *theirs


def models():
    rng = np.random.default_rng(2)
    for _ in range(30):
        lat, lon = np.degrees(np.arcsin(rng.uniform(-0.95, 0.95))), rng.uniform(-180.0, 180.0)
        h, az, el, t = (
            rng.uniform(0.0, 9000.0),
            rng.uniform(0.0, 360.0),
            rng.uniform(5.0, 90.0),
            rng.uniform(0.0, 86400.0),
        )
        iono = sidereon.klobuchar_native(ALPHA, BETA, lat, lon, az, el, t, 1575.42e6)
        pos = doubles([np.radians(lat), np.radians(lon), h])
        when = rtk.gpst2time(2176, 259200.0 + t)
        iono_rtk = rtk.ionmodel(when, doubles(ALPHA + BETA), pos, doubles([np.radians(az), np.radians(el)]))
        tropo_rtk = rtk.tropmodel(when, pos, doubles([0.0, np.pi / 2]), 0.7)
        yield lat, lon, h, az, el, t, iono, iono_rtk, tropo_rtk


def write(name, head, rows):
    with open(HERE / name, "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(head)
        out.writerows([[f"{float(v):.17g}" if isinstance(v, float | np.floating) else v for v in row] for row in rows])


if __name__ == "__main__":
    write(
        "orbits.csv",
        "record satellite toe_s dt_s x_m y_m z_m polynomial_s relativity_s group_delay_s x_rtklib_m y_rtklib_m z_rtklib_m".split(),
        orbits(sys.argv[1]),
    )
    write("models.csv", "lat_deg lon_deg h_m az_deg el_deg t_s iono_m iono_rtklib_m tropo_rtklib_m".split(), models())
    write("ranges.csv", ["satellite", "range_m"], ranges(sys.argv[1]))
    write("dop.csv", "sky hdop vdop tdop pdop hdop_rtklib vdop_rtklib pdop_rtklib".split(), dilutions())
