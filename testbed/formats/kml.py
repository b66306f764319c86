"""KML for Google Earth, through simplekml: the flown track, the estimated track coloured by its error, the outages.

Altitudes are absolute. KML's are above mean sea level, the bench's above the ellipsoid; the difference, the geoid's
undulation, is up to 100 m and is not removed. Position errors in metres (three-dimensional).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import MissingExtra
from testbed.data.records import Array, NavSolution, Trajectory
from testbed.formats.recording import interpolate_motion
from testbed.physics import earth

LIMITS = (1.0, 3.0, 10.0, 30.0)
"""m: error classes."""
COLOURS = ("ff2ca02c", "ff22bdbc", "ff0e7fff", "ff2827d6", "ff8c1a4a")
"""One more than `LIMITS`, aabbggrr: green, olive, orange, red, purple."""
MOST_POINTS = 3000


def save_track(
    path: Path, trajectory: Trajectory, solution: NavSolution | None = None, outages: Sequence[tuple[float, float]] = ()
) -> None:
    """Write the track; with a ``solution`` its error colours the estimated track. Raises InputError without simplekml."""
    try:
        import simplekml
    except ImportError:
        raise MissingExtra("KML needs the package simplekml: pip install 'navigation-testbed[formats]'") from None
    kml = simplekml.Kml(name=trajectory.name or "flight")
    rows = _thin(len(trajectory.t))
    truth = _coordinates(trajectory, rows)
    _line(
        kml, "truth" if solution is not None else "flight", truth, "ffffffff" if solution is not None else "ffb4771f", 2
    )
    if solution is not None:
        _coloured(kml.newfolder(name="estimate"), trajectory, solution)
    for number, (start, end) in enumerate(outages, 1):
        inside = np.flatnonzero((trajectory.t >= start) & (trajectory.t <= end))
        if len(inside) > 1:
            folder = kml.newfolder(name=f"outage {number}: {start:g} to {end:g} s")
            _line(folder, f"outage {number}", _coordinates(trajectory, inside[_thin(len(inside))]), "ff000000", 6)
            for row, label in ((inside[0], "begins"), (inside[-1], "ends")):
                point = folder.newpoint(
                    name=f"outage {number} {label}", coords=_coordinates(trajectory, np.array([row]))
                )
                point.altitudemode = "absolute"
    for phase in trajectory.phases:
        row = np.array([min(int(np.searchsorted(trajectory.t, phase.start)), len(trajectory.t) - 1)])
        kml.newpoint(name=phase.name, coords=_coordinates(trajectory, row)).altitudemode = "absolute"
    kml.save(str(path))


def position_error(trajectory: Trajectory, solution: NavSolution) -> tuple[NDArray[np.int64], Array]:
    """Rows of the solution within the trajectory, and their position errors (m)."""
    r, s = trajectory, solution
    rows = np.flatnonzero((s.t >= r.t[0] - 1e-9) & (s.t <= r.t[-1] + 1e-9) & np.isfinite(s.lat + s.lon + s.h))
    lat, lon, h, _, _ = interpolate_motion(s.t[rows], r.t, r.lat, r.lon, r.h, r.v_n, r.q_nb)
    difference = earth.position_difference(s.lat[rows], s.lon[rows], s.h[rows], lat, lon, h)
    return rows, np.sqrt(np.sum(np.array(difference) ** 2, axis=0))


def _coloured(folder: Any, trajectory: Trajectory, solution: NavSolution) -> None:
    rows, error = position_error(trajectory, solution)
    thin = _thin(len(rows))
    rows, error = rows[thin], error[thin]
    kind = np.searchsorted(LIMITS, error, side="right")
    edges = np.concatenate([[0], np.flatnonzero(np.diff(kind)) + 1, [len(kind)]])
    names = [
        f"below {LIMITS[0]:g} m",
        *(f"{a:g} to {b:g} m" for a, b in zip(LIMITS, LIMITS[1:], strict=False)),
        f"above {LIMITS[-1]:g} m",
    ]
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        part = rows[begin : min(end + 1, len(rows))]
        if len(part) > 1:
            _line(folder, f"error {names[kind[begin]]}", _coordinates(solution, part), COLOURS[kind[begin]], 3)


def _line(folder: Any, name: str, coordinates: list[tuple[float, float, float]], colour: str, width: int) -> None:
    line = folder.newlinestring(name=name, coords=coordinates)
    line.altitudemode = "absolute"
    line.style.linestyle.color, line.style.linestyle.width = colour, width


def _coordinates(record: Trajectory | NavSolution, rows: NDArray[np.int64]) -> list[tuple[float, float, float]]:
    lon, lat, h = np.degrees(record.lon[rows]), np.degrees(record.lat[rows]), record.h[rows]
    return [
        (round(x, 9), round(y, 9), round(z, 3)) for x, y, z in zip(lon.tolist(), lat.tolist(), h.tolist(), strict=True)
    ]


def _thin(count: int) -> NDArray[np.int64]:
    """At most `MOST_POINTS` row numbers, first and last among them."""
    return (
        np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int)) if count else np.empty(0, int)
    )
