"""A flight on a local plane, for drawing: east, north and height from degrees, and axis limits that keep the flight in view.

Source: radii of curvature of `testbed.physics.earth` at the first point; good to centimetres per kilometre. Metres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from testbed.physics.earth import principal_radii

Array = NDArray[np.float64]


def local(frame: pd.DataFrame, origin: pd.DataFrame) -> tuple[Array, Array, Array]:
    """East and north (m) from the first row of ``origin``, and height (m), of every row of ``frame``."""
    lat0, lon0, alt0 = (float(origin[c].iloc[0]) for c in ("lat_deg", "lon_deg", "alt_m"))
    meridian, normal = principal_radii(np.radians(lat0))
    turn = (frame["lon_deg"].to_numpy() - lon0 + 180.0) % 360.0 - 180.0
    north = np.radians(frame["lat_deg"].to_numpy() - lat0) * (meridian + alt0)
    east = np.radians(turn) * (normal + alt0) * np.cos(np.radians(lat0))
    return east, north, frame["alt_m"].to_numpy()


def map_limits(east: Array, north: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of the true track with a margin, so that a diverged estimate cannot shrink the map."""
    margin = 0.08 * max(np.ptp(east), np.ptp(north), 10.0)
    return (east.min() - margin, east.max() + margin), (north.min() - margin, north.max() + margin)


def first_view(sizes: Sequence[float]) -> float | None:
    """The limit of an axis of errors, by the largest of each estimator: twice the largest of those within ten times the best,
    where the worst is more than 30 times larger; None: all fit."""
    sizes = sorted(sizes)
    if len(sizes) < 2 or sizes[-1] <= 30.0 * sizes[0]:
        return None
    return 2.0 * max(size for size in sizes if size <= 10.0 * sizes[0])


def height_limits(up: Array) -> tuple[float, float]:
    margin = max(0.3 * float(np.ptp(up)), 20.0)
    return float(up.min()) - margin, float(up.max()) + margin
