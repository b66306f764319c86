"""Makes the golden figures of this folder from sidereon 3.0.4 and pyrtklib 0.2.7, two implementations of other people.

    .venv/bin/python tests/gnss/golden/make.py SEPT2650.21P

orbits.csv: ephemerides of the file (by number among its GPS and Galileo records) evaluated around their time; models.csv:
delays and dilution at random places. Nothing in here imports the testbed.
"""

import csv
import sys
from pathlib import Path

import numpy as np
import pyrtklib as rtk
import sidereon

HERE = Path(__file__).parent
ALPHA = [8.3819e-9, 1.4901e-8, -5.9605e-8, -5.9605e-8]
BETA = [83968.0, 16384.0, -131072.0, -65536.0]


def doubles(values):
    out = rtk.Arr1Ddouble(len(values))
    for k, value in enumerate(values):
        out[k] = float(value)
    return out


def orbits(path):
    records = [r for r in sidereon.parse_rinex_nav_records(Path(path).read_text()) if str(r.satellite)[0] in "GE"]
    rng = np.random.default_rng(1)
    for k in sorted(rng.choice(len(records), 40, replace=False)):
        record = records[k]
        for dt in (-7200.0, -1234.5, 0.0, 3600.0):
            e = record.evaluate(record.toe_tow_s + dt)
            row = k, record.satellite, record.toe_tow_s, dt, *e.position_m
            yield *row, e.clock_polynomial_s, e.relativistic_clock_s, e.group_delay_s


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
        "record satellite toe_s dt_s x_m y_m z_m polynomial_s relativity_s group_delay_s".split(),
        orbits(sys.argv[1]),
    )
    write("models.csv", "lat_deg lon_deg h_m az_deg el_deg t_s iono_m iono_rtklib_m tropo_rtklib_m".split(), models())
