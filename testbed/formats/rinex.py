"""RINEX 3 observations with the navigation file of their day as the GNSS of a recording, beside the IMU as a table.

The log has both: the satellites, for tightly coupled filters, and the fixes that the bench's own receiver model makes of them
(`testbed.gnss.recorded`). Format: RINEX 3.04; GPS and Galileo on L1 and E1. The IMU is `testbed.formats.table`'s.

Times become UTC: GPST minus the leap seconds, as other loggers' clocks run. An IMU that is stamped in GPST needs
``[recording.imu] clock_s = -18``.
"""

from __future__ import annotations

import datetime
from dataclasses import replace
from pathlib import Path

import numpy as np

from testbed.base.errors import InputError
from testbed.formats.config import RecordingConfig
from testbed.formats.raw import Raw
from testbed.formats.recording import existing
from testbed.formats.rtklib import LEAP_SECONDS
from testbed.formats.table import Tables, read_mapping
from testbed.formats.table_samples import samples_of
from testbed.gnss.recorded import read_rinex
from testbed.gnss.sense import fixes_of

UNIX = datetime.datetime(1970, 1, 1)
ENDINGS = {"obs": ("*.obs", "*.??[oO]", "*_?O.rnx", "*O.rnx"), "nav": ("*.nav", "*.??[pPnN]", "*N.rnx")}
"""How the files of a part end: RINEX's short names (yyO, yyP, yyN), its long ones (O.rnx, N.rnx), and plain ones."""


def read(config: RecordingConfig, folder: Path) -> Raw:
    """The tables of a folder with the observations of a RINEX file (parts ``obs`` and ``nav``; default: the only ones there)."""
    root = folder / config.dir
    columns = read_mapping(folder / config.mapping) if config.mapping else {}
    files = {part: name for part, name in config.files.items() if part not in ENDINGS}
    tables = Tables(root, files, columns | config.columns, ("imu", "mag", "baro", "reference"))
    raw = samples_of(tables, config.sampling)
    observed, broadcast = (_file(root, config.files, part) for part in ENDINGS)
    observations, start = read_rinex(observed, broadcast)
    first = (start - UNIX).total_seconds() - LEAP_SECONDS - float(tables.base)
    fixes, observations, _ = fixes_of(replace(observations, t=observations.t + first))
    if not len(fixes.t):
        raise InputError(f"{observed}: no epoch of it gives a fix; does {broadcast.name} belong to its day?")
    raw.gnss, raw.others["gnss_raw"] = fixes, observations
    raw.stated.add("gnss")
    raw.places |= {"gnss": str(observed), "gnss_raw": str(observed)}
    epochs = len(np.unique(observations.t))
    raw.notes += [
        f"{observed}: GPST is read as UTC + {LEAP_SECONDS:.0f} s",
        f"{observed}: {len(observations.satellites())} satellites, {epochs} epochs, {len(fixes.t)} fixes by the bench's own"
        " receiver model",
    ]
    return raw


def _file(root: Path, files: dict[str, str], part: str) -> Path:
    if part in files:
        return existing(root / files[part], part)
    found = sorted({path for pattern in ENDINGS[part] for path in root.glob(pattern)})
    if len(found) != 1:
        raise InputError(
            f"{root}: holds {len(found)} files of the part '{part}'; name the one to use under files.{part}"
        )
    return found[0]
