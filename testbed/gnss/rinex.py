"""RINEX 3 files: broadcast ephemerides of GPS and Galileo.

RINEX 3.04, tables A5, A6 and A8. A record is read by its columns: 19 characters a number, exponents with D or E.
Satellites of other systems are passed over; SI units and radians, as the files have them.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.satellites import GALILEO, GPS, name_of
from testbed.gnss import orbits
from testbed.gnss.constellation import GPS_EPOCH, KLOBUCHAR, SYSTEMS, Sky

Array = NDArray[np.float64]

WIDTH = 19
LINES_BEHIND = {"G": 7, "E": 7, "C": 7, "J": 7, "I": 7, "R": 3, "S": 3}
"""Lines of a record after its first."""
LONGEST_AGE_S = {GPS: 7200.0, GALILEO: 10800.0}
"""An ephemeris is used this long before and after its time: half a fit interval of GPS, and what Galileo's allows."""
INAV = 0b101
"""Bits of a Galileo record's data source: I/NAV received on E1 or E5b, whose clock is that of E1 with E5b."""

# Places of the numbers of a record, the three of the clock first.
_PLACES = {
    orbits.AF0: 0,
    orbits.AF1: 1,
    orbits.AF2: 2,
    orbits.CRS: 4,
    orbits.DELTA_N: 5,
    orbits.M0: 6,
    orbits.CUC: 7,
    orbits.ECC: 8,
    orbits.CUS: 9,
    orbits.SQRT_A: 10,
    orbits.CIC: 12,
    orbits.OMEGA0: 13,
    orbits.CIS: 14,
    orbits.I0: 15,
    orbits.CRC: 16,
    orbits.ARGP: 17,
    orbits.OMEGA_DOT: 18,
    orbits.I_DOT: 19,
}
_TOE, _SOURCE, _WEEK, _ACCURACY, _HEALTH, _TGD, _BGD_E5B = 11, 20, 21, 23, 24, 25, 26


class Record(NamedTuple):
    """One ephemeris of a file."""

    code: int
    week: int
    toe: float
    """Second of the week."""
    toc: datetime.datetime
    numbers: Array
    """As in the file, the clock's three first; blanks are 0."""

    @property
    def healthy(self) -> bool:
        """Whether the satellite calls itself so; of a Galileo satellite the bits of E1."""
        health = int(self.numbers[_HEALTH])
        return health == 0 if self.code // 100 == GPS else health & 0b111 == 0

    @property
    def accuracy(self) -> float:
        """Accuracy of the signal in space as broadcast (m)."""
        return float(self.numbers[_ACCURACY])

    def epoch(self) -> datetime.datetime:
        """Time that the orbit refers to, GPS time."""
        return GPS_EPOCH + datetime.timedelta(weeks=self.week, seconds=self.toe)

    def row(self, start: datetime.datetime) -> Array:
        """The ephemeris for a flight that starts at ``start``."""
        out = np.zeros(len(orbits.FIELDS))
        for column, place in _PLACES.items():
            out[column] = self.numbers[place]
        gps = self.code // 100 == GPS
        out[orbits.TOE] = (self.epoch() - start).total_seconds()
        out[orbits.TOE_OF_WEEK] = self.toe
        out[orbits.TOC] = (self.toc - start).total_seconds()
        out[orbits.TGD] = self.numbers[_TGD if gps else _BGD_E5B]
        out[orbits.MU] = orbits.MU_GPS if gps else orbits.MU_GALILEO
        return out


@dataclass(frozen=True)
class Navigation:
    """What a navigation file holds: records in the order of the file, the ionosphere's coefficients, system offsets."""

    path: str
    records: tuple[Record, ...]
    klobuchar: Array
    galileo_offset: float
    """GPS time minus Galileo time as broadcast (GAGP), m; 0 where the file has none."""

    def sky(self, start: datetime.datetime, systems: Sequence[str]) -> Sky:
        """The satellites that are healthy at ``start``, each with the ephemeris nearest to it.

        Raises InputError when no satellite has one that is young enough.
        """
        wanted = {SYSTEMS[system] for system in systems}
        best: dict[int, Record] = {}
        for record in self.records:
            age = abs((record.epoch() - start).total_seconds())
            if record.code // 100 not in wanted or not usable(record) or age > LONGEST_AGE_S[record.code // 100]:
                continue
            known = best.get(record.code)
            if known is None or age < abs((known.epoch() - start).total_seconds()):
                best[record.code] = record
        if not best:
            first, last = min(r.epoch() for r in self.records), max(r.epoch() for r in self.records)
            raise InputError(
                f"{self.path}: no ephemeris of {' or '.join(systems)} within two hours of {start:%Y-%m-%d %H:%M:%S};"
                f" the file's are of {first:%Y-%m-%d %H:%M} to {last:%Y-%m-%d %H:%M}"
            )
        codes = sorted(best)
        rows = np.array([best[code].row(start) for code in codes])
        return Sky(start, np.array(codes, dtype=np.int64), rows, self.klobuchar, Path(self.path).name)


def read_navigation(path: str | Path) -> Navigation:
    """Read a RINEX 3 navigation file. Raises InputError that names file and line for one that is none or is damaged."""
    try:
        lines = Path(path).read_text(encoding="ascii", errors="strict").splitlines()
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a RINEX file: {error}") from None
    header, first = read_header(path, lines, "N")
    klobuchar = np.concatenate(
        [_coefficients(path, header, key) for key in ("GPSA", "GPSB")] if "GPSA" in header else [KLOBUCHAR]
    )
    offset = 0.0
    if "GAGP" in header:
        offset = 299792458.0 * _number(path, 0, header["GAGP"][5:22])
    records, k = [], first
    while k < len(lines):
        line = lines[k]
        if not line.strip():
            k += 1
            continue
        if line[0] not in LINES_BEHIND:
            raise InputError(f"{path}: line {k + 1}: '{line[:3]}' is no satellite")
        last = k + LINES_BEHIND[line[0]]
        if line[0] in "GE":
            if last >= len(lines):
                raise InputError(f"{path}: line {k + 1}: the record of {line[:3]} is cut off")
            records.append(_record(path, k, lines[k : last + 1]))
        k = last + 1
    if not records:
        raise InputError(f"{path}: no ephemeris of GPS or Galileo in it")
    return Navigation(str(path), tuple(records), klobuchar, offset)


def read_header(path: str | Path, lines: Sequence[str], kind: str) -> tuple[Mapping[str, str], int]:
    """Header lines by their labels (ionosphere and time offsets by their first four letters), and the line behind it.

    Raises InputError when the file is not RINEX 3 of the kind "N" (navigation) or "O" (observations).
    """
    if not lines or "RINEX VERSION / TYPE" not in lines[0]:
        raise InputError(f"{path}: line 1: no RINEX file, which begins with its version")
    version, found = lines[0][:9].strip(), lines[0][20:21]
    what = {"N": "navigation", "O": "observation"}[kind]
    if not version.startswith("3.") or found != kind:
        raise InputError(f"{path}: line 1: version {version} of type '{found}'; a RINEX 3 {what} file is needed")
    header: dict[str, str] = {}
    for k, line in enumerate(lines):
        label = line[60:].strip()
        if label == "END OF HEADER":
            return header, k + 1
        key = line[:4].strip() if label in ("IONOSPHERIC CORR", "TIME SYSTEM CORR") else label
        header[key] = header[key] + "\n" + line[:60] if key in header else line[:60]
    raise InputError(f"{path}: the header has no end (END OF HEADER)")


def _coefficients(path: str | Path, header: Mapping[str, str], key: str) -> Array:
    text = header[key]
    return np.array([_number(path, 0, text[5 + 12 * k : 17 + 12 * k]) for k in range(4)])


def _record(path: str | Path, k: int, lines: Sequence[str]) -> Record:
    head = lines[0]
    try:
        code = 100 * (GPS if head[0] == "G" else GALILEO) + int(head[1:3])
        year, month, day, hour, minute, second = (int(part) for part in head[3:23].split())
        toc = datetime.datetime(year, month, day, hour, minute, second)
    except ValueError:
        raise InputError(f"{path}: line {k + 1}: '{head[:23]}' is no satellite and time") from None
    texts = [(k, head[23 + WIDTH * i : 42 + WIDTH * i]) for i in range(3)]
    for j, line in enumerate(lines[1:]):
        texts += [(k + 1 + j, line[4 + WIDTH * i : 23 + WIDTH * i]) for i in range(4)]
    numbers = np.array([_number(path, at, text) for at, text in texts])
    if not 1000.0 < numbers[10] < 10000.0 or not 0.0 <= numbers[8] < 0.5:
        raise InputError(f"{path}: line {k + 1}: the orbit of {name_of(code)} is none of a satellite (sqrt A, e)")
    return Record(code, int(numbers[_WEEK]), float(numbers[_TOE]), toc, numbers)


def _number(path: str | Path, k: int, text: str) -> float:
    text = text.strip()
    if not text:
        return 0.0
    try:
        return float(text.replace("D", "E").replace("d", "E"))
    except ValueError:
        raise InputError(f"{path}: line {k + 1}: '{text}' is no number") from None


def usable(record: Record) -> bool:
    """Whether a receiver of L1 or E1 uses it: healthy, and of Galileo the I/NAV message, whose clock belongs to E1."""
    return record.healthy and (record.code // 100 == GPS or bool(int(record.numbers[_SOURCE]) & INAV))
