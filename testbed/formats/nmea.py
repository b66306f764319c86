"""NMEA 0183 sentences as the fixes of a recording, beside the IMU as a table (`testbed.formats.beside`); read by pynmeagps.

GGA gives the place (its height above mean sea level plus the geoid's separation is the ellipsoid's), RMC speed, course and
date, GST the sigmas, ZDA the date where RMC has none; sentences of one time of day make one fix. Any talker. Sentences
whose checksum is wrong are left out, and told.

No sentence states a vertical velocity: it is the difference of the heights (`testbed.formats.first_motion`). Sigmas come
from GST or from ``[recording.gnss]``; an HDOP alone is none.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, GnssFixes
from testbed.data.specs import GnssSpec
from testbed.formats import beside
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import check_finite, check_place, check_time, library, rate_of

SUFFIXES = (".nmea", ".nma", ".log", ".txt")
QUALITIES = {1: "single", 2: "differential", 3: "PPS", 4: "RTK fixed", 5: "RTK float", 7: "manual", 8: "simulated"}
"""GGA's quality of fixes; 0 is none and 6 dead reckoning."""
VELOCITY_STD = 0.1
"""m/s, as no sentence states it: data sheets of single-frequency receivers have 0.05 m/s (half of the readings), and a speed in
tenths of a knot or a course in degrees at 5 m/s rounds off as much."""
NO_COURSE = 0.5
"""Knots: at rest receivers leave the course empty, and its direction does not matter."""
DAY = 86400.0
SENT_WITH_ALL = 0.5
"""Share of the fixes: a receiver that sends speed or sigmas less often than places sends them with every second one at most;
above it single sentences were lost."""


@dataclass
class _Sentences:
    """Rows by the time of day, s, as they come: a later day's are later rows."""

    place: list[tuple[float, ...]] = field(default_factory=list)
    """Day, time of day, latitude, longitude (deg), height above mean sea level, quality, geoid separation or NaN."""
    motion: dict[tuple[int, float], tuple[float, float]] = field(default_factory=dict)
    """(day, time of day) -> speed (knots), course (deg)."""
    sigma: dict[tuple[int, float], tuple[float, float, float]] = field(default_factory=dict)
    dates: dict[int, datetime.date] = field(default_factory=dict)
    """Day of the file -> date."""
    wrong: list[str] = field(default_factory=list)
    """What the reader said of sentences that it could not take."""


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The tables of a folder with the fixes of a file of sentences (part ``nmea``)."""
    return beside.read(config, folder, "nmea", SUFFIXES, read_fixes)


def read_fixes(path: Path, base: float = 0.0) -> beside.ReceiverFile:
    """Fixes of a file of sentences, times from ``base`` (Unix, s) on. Raises InputError that names the file."""
    said = _read_sentences(path)
    if not said.place:
        hint = f" ({len(said.wrong)} sentences could not be read: {said.wrong[0]})" if said.wrong else ""
        raise InputError(f"{path}: has no GGA sentence{hint}; is this NMEA 0183?")
    rows = np.array(said.place, dtype=np.float64)
    notes = [f"{path}: {len(said.wrong)} sentences could not be read ({said.wrong[0]})"] if said.wrong else []
    good = np.isin(rows[:, 5], list(QUALITIES)) & np.isfinite(rows[:, 2:5]).all(axis=1)
    if not good.any():
        raise InputError(f"{path}: none of its {len(rows)} GGA sentences has a fix (quality 1 to 5)")
    if not good.all():
        notes.append(f"{path}: {int((~good).sum())} sentences without a fix (quality 0 or 6) are left out")
    shares = ", ".join(f"{int((rows[:, 5] == q).sum())} {QUALITIES[int(q)]}" for q in np.unique(rows[good, 5]))
    notes.append(f"{path}: {shares}")
    rows = rows[good]
    rows = rows[np.concatenate([[True], np.any(np.diff(rows[:, :2], axis=0) != 0.0, axis=1)])]
    rows = _whole(said, rows, notes, path)
    t, dated = _times(path, said, rows, base)
    if not dated:
        notes.append(f"{path}: tells no date; times are seconds of the day")
    lat, lon = np.radians(rows[:, 2]), np.radians(rows[:, 3])
    check_place(lat, lon, str(path))
    h = rows[:, 4] + _separation(rows[:, 6], notes, path)
    v_n, std, level = _motion_and_sigmas(said, rows, notes, path)
    spec = GnssSpec("NMEA", rate_of(t))
    if std is not None:
        typical = np.median(std, axis=0)
        spec = replace(spec, horizontal_sigma=float(typical[:2].max()), vertical_sigma=float(typical[2]))
        spec = replace(spec, velocity_sigma=VELOCITY_STD if level else 0.0)
    fixes = GnssFixes(t, lat, lon, h, v_n, spec, (), std)
    return beside.ReceiverFile(fixes, not level, level, notes)


def _read_sentences(path: Path) -> _Sentences:
    pynmeagps = library("pynmeagps", "pynmeagps", "nmea", "NMEA files")
    said = _Sentences()
    day, last = 0, -1.0
    try:
        with path.open("rb") as stream:
            reader = pynmeagps.NMEAReader(
                stream, quitonerror=pynmeagps.ERR_LOG, errorhandler=lambda error: said.wrong.append(str(error))
            )
            for _, message in reader:
                clock = getattr(message, "time", None)
                if not isinstance(clock, datetime.time):
                    continue
                seconds = clock.hour * 3600.0 + clock.minute * 60.0 + clock.second + clock.microsecond * 1e-6
                day += int(seconds < last - 0.5 * DAY)
                last = seconds
                _take(said, message, day, seconds)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    except (ValueError, TypeError, AttributeError, IndexError) as error:
        raise InputError(f"{path}: not a readable file of NMEA sentences ({type(error).__name__}: {error})") from None
    return said


def _take(said: _Sentences, message: Any, day: int, seconds: float) -> None:
    kind, when = message.msgID, (day, seconds)
    if kind == "GGA" and _numbers(message.lat, message.lon, message.alt):
        separation = message.sep if _numbers(message.sep) else np.nan
        said.place.append(
            (float(day), seconds, message.lat, message.lon, message.alt, float(message.quality), separation)
        )
    elif kind == "RMC":
        if isinstance(message.date, datetime.date):
            said.dates.setdefault(day, message.date)
        if message.status == "A" and _numbers(message.spd):
            if _numbers(message.cog):
                said.motion[when] = (message.spd, message.cog)
            elif message.spd < NO_COURSE:
                said.motion[when] = (message.spd, 0.0)
    elif kind == "GST" and _numbers(message.stdLat, message.stdLong, message.stdAlt):
        said.sigma[when] = (message.stdLat, message.stdLong, message.stdAlt)
    elif kind == "ZDA" and _numbers(message.year, message.month, message.day):
        said.dates.setdefault(day, datetime.date(int(message.year), int(message.month), int(message.day)))


def _numbers(*values: Any) -> bool:
    return all(isinstance(value, int | float) for value in values)


def _times(path: Path, said: _Sentences, rows: Array, base: float) -> tuple[Array, bool]:
    """Seconds from ``base`` on, and whether the file tells the date."""
    t = DAY * rows[:, 0] + rows[:, 1]
    if said.dates:
        day, date = next(iter(said.dates.items()))
        start = datetime.datetime.combine(date, datetime.time(), datetime.UTC).timestamp()
        t = t + (start - DAY * day - base)
    return check_time(t, f"{path}: time"), bool(said.dates)


def _separation(stated: Array, notes: list[str], path: Path) -> Array | float:
    """Of the geoid from the ellipsoid, m; sentences without one get that of the others."""
    known = np.isfinite(stated)
    if not known.any():
        notes.append(f"{path}: states no geoid separation; heights are above mean sea level")
        return 0.0
    return np.where(known, stated, np.median(stated[known]))


def _whole(said: _Sentences, rows: Array, notes: list[str], path: Path) -> Array:
    """Fixes but for those whose RMC or GST was lost, where the others have theirs."""
    when = [(int(day), seconds) for day, seconds in rows[:, :2]]
    keep = np.ones(len(rows), dtype=bool)
    for kind, what, table in (("RMC", "speed and course", said.motion), ("GST", "sigmas", said.sigma)):
        has = np.array([key in table for key in when])
        if not has.all() and has.mean() > SENT_WITH_ALL:
            lost = int((~has).sum())
            notes.append(
                f"{path}: {lost} of {len(rows)} fixes {'has' if lost == 1 else 'have'} no {what} (a damaged or missing {kind}),"
                f" the first {rows[np.argmin(has), 1]:.2f} s into its day, and {'is' if lost == 1 else 'are'} left out"
            )
            keep &= has
    return rows[keep]


def _motion_and_sigmas(said: _Sentences, rows: Array, notes: list[str], path: Path) -> tuple[Array, Array | None, bool]:
    """v_n (M,3), sigmas (M,6) or None, and whether speed and course are there, in every fix or not at all."""
    when = [(int(day), seconds) for day, seconds in rows[:, :2]]
    level, stated = (sum(key in table for key in when) for table in (said.motion, said.sigma))
    v_n = np.zeros((len(rows), 3))
    if level == len(rows):
        knots, course = check_finite(np.array([said.motion[key] for key in when]), str(path)).T
        v_n[:, 0], v_n[:, 1] = (knots * 1852.0 / 3600.0 * f(np.radians(course)) for f in (np.cos, np.sin))
    elif level:
        notes.append(f"{path}: {level} of {len(rows)} fixes have speed and course (RMC); velocities are left aside")
    std = None
    if stated == len(rows):
        metres = check_finite(np.array([said.sigma[key] for key in when]), str(path))
        std = np.hstack([metres, np.full((len(rows), 3), VELOCITY_STD if level == len(rows) else np.inf)])
    elif stated:
        notes.append(f"{path}: {stated} of {len(rows)} fixes have sigmas (GST); they are left aside")
    return v_n, std, level == len(rows)
