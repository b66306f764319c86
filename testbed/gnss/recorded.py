"""Recorded observations: a RINEX 3 observation file and the navigation file of its day, as `GnssObservations`.

RINEX 3.04, tables A2 and A3; the algorithm of IS-GPS-200, section 20.3.3.4.3: a signal that is received at t left at
t - P / c minus the satellite's clock error. GPS and Galileo on L1 and E1 are read, other signals passed over. SI units.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.observations import GnssObservations
from testbed.data.satellites import GALILEO, GPS, LETTERS
from testbed.data.specs import GnssSpec, SignalSpec
from testbed.gnss import orbits, signals
from testbed.gnss.atmosphere import klobuchar, saastamoinen
from testbed.gnss.config import SatellitesConfig
from testbed.gnss.constellation import DAY_S, week_seconds
from testbed.gnss.receiver import Received, solve
from testbed.gnss.rinex import LONGEST_AGE_S, Navigation, Record, read_header, read_navigation, usable
from testbed.gnss.sense import space_of
from testbed.physics.delays import tropo_mapping
from testbed.physics.ecef import geodetic_to_ecef, north_east_down
from testbed.physics.ranging import L1, OMEGA, C, sight

Array = NDArray[np.float64]

CODES = ("C1C", "C1X", "C1W")
"""Pseudoranges on L1 and E1, the first of which a file has is taken."""
WAVELENGTH = C / L1
SURVEY = SignalSpec(dll_bandwidth_hz=0.25, correlator_chips=0.1, multipath_zenith=0.13, multipath_horizon=0.53)
"""What weights of a geodetic receiver follow from; its own figures are in no file."""
TROPO_SIGMA, IONO_SHARE = 0.12, 0.5
"""m at zenith (DO-229), and the share of the modelled ionosphere that the model leaves (half of it, by its design)."""
SMALLEST_CN0, UNKNOWN_CN0 = 20.0, 40.0
UNKNOWN_RATE_SIGMA = 0.05
LONGEST_INTERVAL_S = 1.0
"""Between epochs whose carriers make a rate."""


class Measured(NamedTuple):
    """Columns of an observation file, a row per satellite and epoch; not a number where the file has none."""

    t: Array
    """s from the first epoch"""
    sv: Array
    pseudorange: Array
    carrier: Array
    """cycles"""
    doppler: Array
    """Hz"""
    cn0: Array
    """dB-Hz"""


def read_rinex(
    observations: str | Path, navigation: str | Path, mask_deg: float = 5.0
) -> tuple[GnssObservations, datetime.datetime]:
    """The observations of L1 and E1, and the GPS time that their times count from.

    Without Doppler in the file range rates are central differences of the carrier over two epochs. Satellites below ``mask_deg``,
    without a healthy ephemeris of their time, or without a range rate are left out. Raises InputError that names the file.
    """
    start, measured = read_measured(observations)
    nav = read_navigation(navigation)
    rate, rate_sigma = _rates(measured)
    records = _Records(nav)
    found = [records.nearest(int(sv), start, t) for sv, t in zip(measured.sv, measured.t, strict=True)]
    kept = np.array([r is not None for r in found]) & np.isfinite(measured.pseudorange) & np.isfinite(rate)
    if not kept.any():
        raise InputError(f"{observations}: no pseudorange of a satellite with an ephemeris in {navigation}")
    table = {"t": measured.t[kept], "sv": measured.sv[kept], "pseudorange": measured.pseudorange[kept]}
    table |= {"range_rate": rate[kept], "rate_sigma": rate_sigma[kept]}
    table["cn0"] = np.where(np.isfinite(measured.cn0[kept]), measured.cn0[kept], UNKNOWN_CN0)
    rows = [records.row(r, start) for r, keep in zip(found, kept, strict=True) if keep and r is not None]
    accuracy = np.array([r.accuracy for r, keep in zip(found, kept, strict=True) if keep and r is not None])
    return _located(table, rows, accuracy, (nav, start, np.radians(mask_deg))), start


class _Records:
    """Ephemerides by satellite."""

    def __init__(self, nav: Navigation) -> None:
        self._of: dict[int, list[Record]] = {}
        for record in filter(usable, nav.records):
            self._of.setdefault(record.code, []).append(record)
        self._rows: dict[int, Array] = {}

    def nearest(self, code: int, start: datetime.datetime, t: float) -> Record | None:
        """The one nearest in time, if it is young enough."""
        moment = start + datetime.timedelta(seconds=float(t))
        known = self._of.get(code, [])
        ages = [abs((record.epoch() - moment).total_seconds()) for record in known]
        if not ages or min(ages) > LONGEST_AGE_S[code // 100]:
            return None
        return known[int(np.argmin(ages))]

    def row(self, record: Record, start: datetime.datetime) -> Array:
        """Its ephemeris, made once."""
        if id(record) not in self._rows:
            self._rows[id(record)] = record.row(start)
        return self._rows[id(record)]


def _rates(measured: Measured) -> tuple[Array, Array]:
    """Range rates (m/s) from Doppler, else from the carrier between the epochs before and behind; and their sigma.

    A difference over one interval would be the rate in its middle: half a second late, that is 7 cm/s of velocity.
    """
    rate = -WAVELENGTH * measured.doppler
    for sv in np.unique(measured.sv):
        own = np.flatnonzero(measured.sv == sv)
        t, carrier = measured.t[own], WAVELENGTH * measured.carrier[own]
        central = np.full(len(own), np.nan)
        if len(own) > 2:
            before, behind = t[1:-1] - t[:-2], t[2:] - t[1:-1]
            even = (np.abs(before - behind) < 1e-3) & (behind <= LONGEST_INTERVAL_S)
            central[1:-1] = np.where(even, (carrier[2:] - carrier[:-2]) / (before + behind), np.nan)
        rate[own] = np.where(np.isfinite(rate[own]), rate[own], central)
    return rate, np.full(len(rate), UNKNOWN_RATE_SIGMA)


def _located(
    table: dict[str, Array], rows: list[Array], accuracy: Array, sky: tuple[Navigation, datetime.datetime, float]
) -> GnssObservations:
    """Satellites and delays for the place where the receiver was; found in two rounds, the first from the Earth's centre."""
    nav, start, mask = sky
    n = len(rows)
    x0, v0, clock, rate = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n)
    for k, eph in enumerate(rows):
        left = table["t"][k] - table["pseudorange"][k] / C
        clock[k], _ = orbits.clock(eph, left, orbits.orbit(eph, left)[2])
        x0[k], v0[k], ea = orbits.orbit(eph, left - clock[k] / C)
        clock[k], rate[k] = orbits.clock(eph, left - clock[k] / C, ea)
    table = table | {"clock": clock, "clock_rate": rate}
    place = np.zeros((n, 3))
    for _ in range(3):
        table |= _seen_from(place, x0, v0, table, (nav, start))
        table["sigma"] = np.sqrt(_variance(table, accuracy))
        kept = (table["elevation"] >= mask) | ~place.any(axis=1)
        place = _places(table, kept, place)
    kept = table["elevation"] >= mask
    table["noise"] = signals.code_noise(SURVEY, np.maximum(table["cn0"], SMALLEST_CN0))
    nothing = np.zeros(n)
    table |= {"residual": nothing, "used": nothing, "lock_time": nothing}
    # what broadcast orbits and models leave is in no file either: figures of a quiet day, as simulated
    space = space_of(SatellitesConfig())
    spec = GnssSpec("RINEX", 1.0 / float(np.median(np.diff(np.unique(table["t"])))), space=space, signals=SURVEY)
    return GnssObservations(**{key: values[kept] for key, values in table.items()}, spec=spec)


def _seen_from(
    place: Array, x0: Array, v0: Array, table: Mapping[str, Array], sky: tuple[Navigation, datetime.datetime]
) -> dict[str, Array]:
    """Satellites in the e of reception at ``place`` (n,3: lat, lon, h; zeros: unknown), their directions and delays."""
    nav, second = sky[0], week_seconds(sky[1]) % DAY_S
    n = len(x0)
    out = {key: np.zeros(n) for key in ("elevation", "azimuth", "iono", "tropo")} | {
        "x_e": np.empty((n, 3)),
        "v_e": np.empty((n, 3)),
    }
    for k in range(n):
        known = place[k].any()
        r = geodetic_to_ecef(*place[k]) if known else (0.0, 0.0, 0.0)
        tau = sight(x0[k], r)[0] / C if known else orbits.LIGHT_TIME
        x = orbits.turned(x0[k], OMEGA * tau)
        out["x_e"][k], out["v_e"][k] = x, orbits.turned(v0[k], OMEGA * tau)
        if not known:
            out["elevation"][k] = 0.5 * np.pi
            continue
        u = np.array(north_east_down(place[k, 0], place[k, 1])) @ sight(x, r)[1]
        out["elevation"][k], out["azimuth"][k] = np.arcsin(-u[2]), np.arctan2(u[1], u[0]) % (2.0 * np.pi)
        if out["elevation"][k] > 0.0:
            direction = out["elevation"][k], out["azimuth"][k]
            out["iono"][k] = klobuchar(nav.klobuchar, (place[k, 0], place[k, 1]), direction, second + table["t"][k])
            out["tropo"][k] = sum(saastamoinen(place[k, 0], place[k, 2])) * tropo_mapping(direction[0])
    return out


def _variance(table: Mapping[str, Array], accuracy: Array) -> Array:
    """Variance (m²) of a corrected pseudorange: broadcast accuracy, delays, multipath, noise."""
    elevation = np.maximum(table["elevation"], np.radians(3.0))
    noise = signals.code_noise(SURVEY, np.maximum(table["cn0"], SMALLEST_CN0))
    multipath = signals.multipath_sigma(SURVEY, elevation)
    tropo = TROPO_SIGMA * tropo_mapping(elevation)
    return accuracy**2 + (IONO_SHARE * table["iono"]) ** 2 + tropo**2 + multipath**2 + noise**2


def _places(table: Mapping[str, Array], kept: NDArray[np.bool_], before: Array) -> Array:
    """(n,3) where the receiver was at each row's epoch; as ``before`` where that cannot be told."""
    t, rows = table["t"][kept], np.flatnonzero(kept)
    first = np.concatenate([[0], np.flatnonzero(np.diff(t) > 0.0) + 1, [len(t)]]).astype(np.int64)
    received = Received(
        first,
        (table["sv"][rows] // 100).astype(np.int64),
        np.ascontiguousarray(table["x_e"][rows]),
        np.ascontiguousarray(table["v_e"][rows]),
        (table["pseudorange"] + table["clock"] - table["iono"] - table["tropo"])[rows],
        (table["range_rate"] + table["clock_rate"])[rows],
        table["sigma"][rows],
        table["rate_sigma"][rows],
    )
    found = solve(received).place
    out = before.copy()
    epoch = np.searchsorted(t[first[:-1]], table["t"], side="right") - 1
    known = (epoch >= 0) & np.isfinite(found[np.maximum(epoch, 0), 0])
    out[known] = found[epoch[known]]
    return out


def read_measured(path: str | Path) -> tuple[datetime.datetime, Measured]:
    """GPS time of the first epoch, and the columns. Raises InputError that names file and line."""
    try:
        lines = Path(path).read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a RINEX file: {error}") from None
    header, k = read_header(path, lines, "O")
    places = _places_of_types(path, header.get("SYS / # / OBS TYPES", ""))
    start: datetime.datetime | None = None
    rows: list[tuple[float, ...]] = []
    while k < len(lines):
        moment, flag, count = _epoch(path, k, lines[k])
        start = start or moment
        if k + count > len(lines) - 1:
            raise InputError(f"{path}: line {k + 1}: the epoch names {count} satellites, but the file ends before")
        if flag <= 1:
            seconds = (moment - start).total_seconds()
            rows += [
                _row(path, j, lines[j], places, seconds) for j in range(k + 1, k + 1 + count) if lines[j][:1] in places
            ]
        k += 1 + count
    if start is None or not rows:
        raise InputError(f"{path}: no observation of GPS or Galileo in it")
    rows.sort(key=lambda row: row[:2])
    return start, Measured(*np.array(rows).T)


def _places_of_types(path: str | Path, text: str) -> dict[str, tuple[int, ...]]:
    """For each system the places of pseudorange, carrier, Doppler and C/N0 in a line; -1 where it has none."""
    types: dict[str, list[str]] = {}
    system = ""
    for line in text.split("\n"):
        system = line[:1].strip() or system
        types.setdefault(system, []).extend(line[6:].split())
    out = {}
    for letter in LETTERS.values():
        names = types.get(letter, [])
        code = next((name for name in CODES if name in names), None)
        if code is not None:
            wanted = (code, *(kind + code[1:] for kind in "LDS"))
            out[letter] = tuple(names.index(name) if name in names else -1 for name in wanted)
    if not out:
        raise InputError(f"{path}: no pseudorange on L1 or E1 ({', '.join(CODES)}) of GPS or Galileo in its header")
    return out


def _epoch(path: str | Path, k: int, line: str) -> tuple[datetime.datetime, int, int]:
    try:
        if line[:1] != ">":
            raise ValueError
        year, month, day, hour, minute = (int(part) for part in line[1:18].split())
        second = float(line[18:29])
        moment = datetime.datetime(year, month, day, hour, minute) + datetime.timedelta(seconds=second)
        return moment, int(line[29:32]), int(line[32:35])
    except ValueError:
        raise InputError(f"{path}: line {k + 1}: expected an epoch ('> 2021 03 19 ...'), got '{line[:35]}'") from None


def _row(path: str | Path, k: int, line: str, places: Mapping[str, tuple[int, ...]], t: float) -> tuple[float, ...]:
    system = GPS if line[0] == LETTERS[GPS] else GALILEO
    values = []
    try:
        code = 100 * system + int(line[1:3])
        for place in places[line[0]]:
            text = line[3 + 16 * place : 17 + 16 * place].strip() if place >= 0 else ""
            values.append(float(text) if text else np.nan)
    except ValueError:
        raise InputError(f"{path}: line {k + 1}: a number is damaged in '{line[:40]}'") from None
    return (t, float(code), *values)
