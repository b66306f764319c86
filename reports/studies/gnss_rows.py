"""RINEX observations of a receiver at rest: fixes of sidereon, of RTKLIB and of the bench's own receiver as rows of one table.

``python reports/studies/gnss_rows.py OBS NAV X Y Z FOLDER`` (the place of the antenna, m in e) writes a table of fixes per program and
one of the truth into FOLDER, and scores them with ``testbed score``. Needs the extra ``oracles``. GPS on L1, broadcast
ionosphere, Saastamoinen, 5 degrees: RTKLIB by `pntpos`, sidereon by `solve_spp_from_rinex_obs`.
"""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from testbed.data.observations import GnssObservations
from testbed.data.records import Array
from testbed.gnss.recorded import read_rinex
from testbed.gnss.sense import fixes_of
from testbed.physics.ecef import ecef_to_geodetic

MASK_DEG = 5.0


def of_sidereon(observations: Path, navigation: Path, start: Sequence[float]) -> Iterable[tuple[float, Array]]:
    """Seconds from the first epoch, and place in e, of each epoch with a solution; ``start``: a guess of the place."""
    import sidereon

    nav = sidereon.parse_rinex_nav(navigation.read_text())
    obs = sidereon.parse_rinex_obs(observations.read_text())
    satellites = [f"G{k:02d}" for k in range(1, 33)]
    corrections = sidereon.SppCorrections(ionosphere=True, troposphere=True)
    options = sidereon.RinexSppOptions(obs, corrections=corrections, initial_guess=[*start, 0.0], satellites=satellites)
    first = None
    for epoch in sidereon.solve_spp_from_rinex_obs(nav, obs, options):
        moment = np.datetime64(str(epoch.epoch).removeprefix("ObsEpochTime(").removesuffix(")"))
        first = moment if first is None else first
        if epoch.solved:
            s = epoch.solution
            yield (moment - first) / np.timedelta64(1, "s"), np.array([s.x_m, s.y_m, s.z_m])


def of_rtklib(observations: Path, navigation: Path) -> Iterable[tuple[float, Array]]:
    """The same by RTKLIB."""
    import pyrtklib as rtk

    obs, nav, sta = rtk.obs_t(), rtk.nav_t(), rtk.sta_t()
    for path in (observations, navigation):
        rtk.readrnx(str(path), 1, "", obs, nav, sta)
    rtk.uniqnav(nav)
    rtk.sortobs(obs)
    options = rtk.prcopt_default
    options.mode, options.navsys, options.nf = rtk.PMODE_SINGLE, rtk.SYS_GPS, 1
    options.ionoopt, options.tropopt, options.elmin = rtk.IONOOPT_BRDC, rtk.TROPOPT_SAAS, np.radians(MASK_DEG)
    first, i = obs.data[0].time, 0
    while i < obs.n:
        now, j = obs.data[i].time, i
        while j < obs.n and abs(rtk.timediff(obs.data[j].time, now)) < 1e-3:
            j += 1
        epoch = rtk.Arr1Dobsd_t(j - i)
        for k in range(i, j):
            epoch[k - i] = obs.data[k]
        solution, sky = rtk.sol_t(), rtk.Arr1Ddouble(2 * (j - i))
        if rtk.pntpos(
            epoch.ptr, j - i, nav, options, solution, sky, rtk.Arr1Dssat_t(rtk.MAXSAT).ptr, rtk.Arr1Dchar(256)
        ):
            yield rtk.timediff(now, first), np.array([solution.rr[k] for k in range(3)])
        i = j


def of_the_bench(observations: Path, navigation: Path) -> Iterable[tuple[float, tuple[float, float, float]]]:
    """The same by `testbed.gnss`, latitude, longitude and height."""
    raw, _ = read_rinex(observations, navigation, MASK_DEG)
    gps = GnssObservations(**{key: v[raw.sv < 200] if isinstance(v, np.ndarray) else v for key, v in vars(raw).items()})
    fixes = fixes_of(gps)[0]
    return zip(fixes.t, zip(fixes.lat, fixes.lon, fixes.h, strict=True), strict=True)


AT_REST = {f"v_{axis}_mps": 0.0 for axis in ("north", "east", "down")} | {
    f"{a}_deg": 0.0 for a in ("roll", "pitch", "yaw")
}


def write(
    path: Path,
    rows: Iterable[tuple[float, tuple[float, float, float]]],
    more: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """A table that ``testbed score`` reads; ``more``: columns of one value."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(["time_s", "lat_deg", "lon_deg", "alt_m", *more])
        for t, (lat, lon, h) in rows:
            out.writerow([repr(float(x)) for x in (t, np.degrees(lat), np.degrees(lon), h, *more.values())])


def make(observations: Path, navigation: Path, place: Sequence[float], folder: Path) -> list[Path]:
    """The tables of all three programs, and truth.csv beside them."""
    folder.mkdir(parents=True, exist_ok=True)
    made = [folder / f"{name}.csv" for name in ("sidereon", "rtklib", "testbed")]
    for path, rows in zip(
        made, (of_sidereon(observations, navigation, place), of_rtklib(observations, navigation)), strict=False
    ):
        write(path, ((t, ecef_to_geodetic(*map(float, r))) for t, r in rows))
    own = list(of_the_bench(observations, navigation))
    write(made[-1], own)
    truth = ecef_to_geodetic(*map(float, place))
    write(folder / "truth.csv", ((t, truth) for t in np.arange(-1.0, own[-1][0] + 2.0)), AT_REST)
    return made


if __name__ == "__main__":
    if len(sys.argv) != 7:
        sys.exit(__doc__)
    at, where = [float(x) for x in sys.argv[3:6]], Path(sys.argv[6])
    tables = make(Path(sys.argv[1]), Path(sys.argv[2]), at, where)
    command = [
        str(Path(sys.executable).with_name("testbed")),
        "score",
        *map(str, tables),
        "--truth",
        str(where / "truth.csv"),
    ]
    sys.exit(subprocess.run(command, check=False).returncode)
