"""UBX messages of u-blox receivers as the fixes of a recording, beside the IMU as a table (`testbed.formats.beside`).

Read by pyubx2. NAV-PVT has place, velocity, time (UTC) and the receiver's own sigmas (u-blox F9 HPG 1.32 interface
description, 3.15.13): hAcc counts for north and east, sAcc for each axis of the velocity, as other loggers take them. Other
messages are passed over; messages whose checksum is wrong are left out, and told.
"""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import GnssFixes
from testbed.data.specs import GnssSpec
from testbed.formats import beside
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import check_place, check_time, library, rate_of

SUFFIXES = (".ubx",)
NAV_PVT = 0x0107
FIX_TYPES = (3, 4)
"""Three-dimensional, and with dead reckoning beside GNSS; 5 is time alone, 1 dead reckoning alone."""
LEAST_STD = (0.01, 0.01, 0.01, 0.01, 0.01, 0.01)
"""m and m/s: the messages count millimetres, of which a receiver may state none."""


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The tables of a folder with the fixes of a file of UBX messages (part ``ubx``)."""
    return beside.read(config, folder, "ubx", SUFFIXES, read_fixes)


def read_fixes(path: Path, base: float = 0.0) -> beside.ReceiverFile:
    """Fixes of the NAV-PVT messages, times from ``base`` (Unix, s) on. Raises InputError that names the file."""
    found, wrong = _messages(path)
    if not found:
        hint = f" ({len(wrong)} messages could not be read: {wrong[0]})" if wrong else ""
        raise InputError(f"{path}: has no message NAV-PVT{hint}; let the receiver write it")
    notes = [f"{path}: {len(wrong)} messages could not be read ({wrong[0]})"] if wrong else []
    good = [m for m in found if m.fixType in FIX_TYPES and m.gnssFixOk and m.validDate and m.validTime]
    if not good:
        raise InputError(f"{path}: none of its {len(found)} messages NAV-PVT has a three-dimensional fix and a time")
    if len(good) < len(found):
        notes.append(f"{path}: {len(found) - len(good)} messages without a three-dimensional fix are left out")
    if carrier := sum(m.carrSoln == 2 for m in good):
        notes.append(f"{path}: {carrier} of {len(good)} fixes have fixed ambiguities")
    t = check_time(np.array([_seconds(m, path) - base for m in good]), f"{path}: time")
    lat, lon = (np.radians([getattr(m, key) for m in good]) for key in ("lat", "lon"))
    check_place(lat, lon, str(path))
    h, north, east, down = (
        1e-3 * np.array([getattr(m, key) for m in good]) for key in ("height", "velN", "velE", "velD")
    )
    level, high, speed = (1e-3 * np.array([getattr(m, key) for m in good]) for key in ("hAcc", "vAcc", "sAcc"))
    std = np.maximum(np.column_stack([level, level, high, speed, speed, speed]), LEAST_STD)
    typical = np.median(std, axis=0)
    spec = GnssSpec("UBX NAV-PVT", rate_of(t), float(typical[0]), float(typical[2]), velocity_sigma=float(typical[3]))
    fixes = GnssFixes(t, lat, lon, h, np.column_stack([north, east, down]), spec, (), std)
    return beside.ReceiverFile(fixes, notes=notes)


def _messages(path: Path) -> tuple[list[Any], list[str]]:
    """The NAV-PVT messages, and what the reader said of messages that it could not take."""
    pyubx2 = library("pyubx2", "pyubx2", "ubx", "UBX files")
    wrong: list[str] = []
    try:
        with path.open("rb") as stream:
            reader = pyubx2.UBXReader(
                stream,
                protfilter=pyubx2.UBX_PROTOCOL,
                quitonerror=pyubx2.ERR_LOG,
                errorhandler=lambda error: wrong.append(str(error)),
                msgfilter=NAV_PVT,
            )
            return [message for _, message in reader if message is not None and message.identity == "NAV-PVT"], wrong
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    except Exception as error:  # pyubx2 raises its own errors and struct's on damaged files
        raise InputError(f"{path}: not a readable file of UBX messages ({type(error).__name__}: {error})") from None


def _seconds(message: Any, path: Path) -> float:
    """Unix time of a fix, s; ``nano`` is what the second is off, up to half of one either way."""
    try:
        whole = datetime.datetime(
            message.year,
            message.month,
            message.day,
            message.hour,
            message.min,
            min(message.second, 59),
            tzinfo=datetime.UTC,
        )
    except ValueError as error:
        raise InputError(f"{path}: a NAV-PVT message has no time ({error})") from None
    return whole.timestamp() + max(message.second - 59, 0) + 1e-9 * message.nano
