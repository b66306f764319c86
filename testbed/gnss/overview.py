"""What a receiver had of the sky on one flight, epoch by epoch, as a table for plots: seconds, degrees, dB-Hz, metres."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from testbed.data.observations import GnssObservations
from testbed.data.satellites import name_of
from testbed.gnss.receiver import EXCLUDED, USED, dilution

if TYPE_CHECKING:
    import pandas as pd

MOST_EPOCHS = 600
"""About one per pixel of a printed figure."""


def satellites_frame(observations: GnssObservations) -> pd.DataFrame:
    """A row per satellite and epoch, of at most `MOST_EPOCHS` epochs and all in which one was excluded.

    Columns ``time_s``, ``satellite``, ``azimuth_deg``, ``elevation_deg``, ``cn0_dbhz``, ``residual_m`` (of the receiver's own
    fix, not a number without one), ``used`` (0 no fix, 1 used, 2 excluded), and of the epoch ``hdop`` and ``vdop``.
    """
    import pandas as pd

    o, first = observations, observations.first_rows()
    epoch = np.repeat(np.arange(len(first) - 1), np.diff(first))
    step = max(1, -(-(len(first) - 1) // MOST_EPOCHS))
    kept = (epoch % step == 0) | np.isin(epoch, epoch[o.used == EXCLUDED])
    dop = np.full((len(o.t), 2), np.nan)
    for k in np.unique(epoch[kept]):
        rows = slice(first[k], first[k + 1])
        dop[rows] = _dilution(observations, rows)
    return pd.DataFrame(
        {
            "time_s": o.t[kept],
            "satellite": [name_of(code) for code in o.sv[kept]],
            "azimuth_deg": np.degrees(o.azimuth[kept]),
            "elevation_deg": np.degrees(o.elevation[kept]),
            "cn0_dbhz": o.cn0[kept],
            "residual_m": np.where(o.used[kept] == 0, np.nan, o.residual[kept]),
            "used": o.used[kept].astype(int),
            "hdop": dop[kept, 0],
            "vdop": dop[kept, 1],
        }
    )


def _dilution(o: GnssObservations, rows: slice) -> tuple[float, float]:
    """Horizontal and vertical dilution of the satellites that an epoch's fix used."""
    used = o.used[rows] == USED
    if not used.any():
        return np.nan, np.nan
    azimuth, elevation = o.azimuth[rows][used], o.elevation[rows][used]
    level = np.cos(elevation)
    lines = np.column_stack([np.cos(azimuth) * level, np.sin(azimuth) * level, -np.sin(elevation)])
    return dilution(lines, o.systems()[rows][used])[:2]
