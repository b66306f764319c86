"""Solutions of other programs: a table with units in the column names, TUM's text, or RTKLIB's .pos.

- CSV or Parquet: ``time_s, lat_deg, lon_deg, alt_m`` and, as options, ``v_north_mps, v_east_mps, v_down_mps`` and
  ``roll_deg, pitch_deg, yaw_deg`` or ``q_nb_0 .. q_nb_3``, in any unit that `testbed.data.column_units` lists.
- TUM (.tum, .txt): ``time x y z qx qy qz qw`` in metres of a local frame, east-north-up about the first row of the truth
  where nothing aligns it; quaternions turn the body (forward-left-up) to that frame, as in ROS. Another frame is what
  alignment is for.
- .pos: `testbed.formats.rtklib`.

All become north-east-down metres about the first row of the truth, and forward-right-down attitudes. `read_solution` makes a
`NavSolution` of the first kind, with ``std_position_north_m`` .. ``std_attitude_down_rad`` as further options.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import NAVIGATION_STATES, Array, NavSolution, Trajectory
from testbed.formats.kinematics import multiply
from testbed.formats.recording import check_finite, check_time
from testbed.formats.rtklib import read_pos
from testbed.formats.table import EULER, QUATERNION, SOLUTION_STD, VELOCITY, Tables

TUM = (".tum", ".txt")
_ENU_TO_NED = np.array([[0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0]])
_FRD_TO_FLU = np.array([[0.0, 1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Track:
    """A solution about an origin: ``t`` (N,), ``ned`` (N,3) m, ``v_n`` (N,3) and ``q_nb`` (N,4) or None where it has none."""

    name: str
    t: Array
    ned: Array
    v_n: Array | None = None
    q_nb: Array | None = None
    notes: tuple[str, ...] = ()
    """What its file leaves in doubt."""
    place: str = ""
    """How a message names it: its file."""


Origin = tuple[float, float, float]
"""Latitude, longitude (rad) and height (m)."""


def origin_of(truth: Trajectory) -> Origin:
    """The first row of the truth."""
    return float(truth.lat[0]), float(truth.lon[0]), float(truth.h[0])


def local(lat: Array, lon: Array, h: Array, origin: Origin) -> Array:
    """(N,3) m north, east, down of the tangent plane at ``origin``, Earth's curvature and all."""
    import pymap3d

    e, n, u = pymap3d.geodetic2enu(lat, lon, h, *origin, deg=False)
    return np.column_stack([n, e, -u])


def read(path: Path, origin: Origin) -> Track:
    """A solution file, by its ending. Raises InputError that names what is wrong with it."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.suffix == ".pos":
        fixes, position_only, _ = read_pos(path)
        ned = local(fixes.lat, fixes.lon, fixes.h, origin)
        return Track(path.stem, fixes.t, ned, None if position_only else fixes.v_n, place=str(path))
    if path.suffix in TUM:
        return _tum(path)
    tables, velocity, attitude = _tables(path)
    table = tables.parts["solution"]
    _check_angles(path, table["lat"], table["lon"], origin)
    return Track(
        path.stem,
        table["time"] + tables.base,
        local(table["lat"], table["lon"], table["alt"], origin),
        tables.block("solution", list(VELOCITY)) if velocity else None,
        tables.quaternions("solution") if attitude else None,
        tuple(tables.notes),
        str(path),
    )


NEAR = 0.02
"""rad, 1.1°: a flight of a hundred kilometres; places in another unit lie further apart, but near latitude and longitude 0."""


def _check_angles(path: Path, lat: Array, lon: Array, origin: Origin) -> None:
    """Raises InputError where the places are the truth's once their unit or order is another one."""
    own, true = np.array([np.median(lat), np.median(lon)]), np.array(origin[:2])
    if _near(own, true):
        return
    found = f"{path}: lies at {np.degrees(own[0]):.6g}°, {np.degrees(own[1]):.6g}°, the truth at {np.degrees(true[0]):.6g}°, {np.degrees(true[1]):.6g}°"
    named = "Such columns are called lat_rad, lon_rad"
    if _near(np.degrees(own), true):
        raise InputError(f"{found}: are lat and lon in radians? {named}")
    if _near(own, np.degrees(true)):
        raise InputError(f"{found}: are lat and lon of the truth in radians? {named}")
    if _near(own[::-1], true):
        raise InputError(f"{found}: are lat and lon exchanged?")


def _near(one: Array, other: Array) -> bool:
    apart = one - other
    apart[1] = (apart[1] + np.pi) % (2.0 * np.pi) - np.pi
    return bool(np.abs(apart).max() < NEAR)


def _tables(path: Path) -> tuple[Tables, bool, bool]:
    """A table of a solution, and whether it has velocities and an attitude."""
    tables = Tables(path.parent, {"solution": path.name}, {}, ("solution",))
    table = tables.parts["solution"]
    velocity = [key for key in VELOCITY if key in table]
    if velocity and len(velocity) < 3:
        raise InputError(f"{path}: has {', '.join(velocity)}, but not all three velocities")
    return tables, bool(velocity), any(key in table for key in (*EULER, *QUATERNION))


def read_solution(path: Path) -> NavSolution:
    """A table of a solution as an estimator's answer; what it has no columns for is not scored. Raises InputError."""
    tables, velocity, attitude = _tables(path)
    table = tables.parts["solution"]
    n = len(table["time"])
    answered = {"position": True, "velocity": velocity, "attitude": attitude}
    states = tuple(state for state in NAVIGATION_STATES if answered[state.split("_")[0]])
    names = [f"std_{state.rpartition('_')[0]}" for state in states]
    if (given := [name for name in SOLUTION_STD if name in table]) and given != names:
        missing = [name for name in names if name not in given]
        raise InputError(
            f"{path}: has {', '.join(given)}"
            + (f", but not {', '.join(missing)}" if missing else ", beside no columns of what they are sigmas of")
        )
    return NavSolution(
        table["time"] + tables.base,
        table["lat"],
        table["lon"],
        table["alt"],
        tables.block("solution", list(VELOCITY)) if velocity else np.zeros((n, 3)),
        tables.quaternions("solution") if attitude else np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        std=tables.block("solution", names) if given else None,
        states=states,
    )


def _tum(path: Path) -> Track:
    try:
        rows = np.loadtxt(path, ndmin=2, comments="#")
    except ValueError as error:
        raise InputError(f"{path}: not a TUM file of numbers, time x y z qx qy qz qw ({error})") from None
    if rows.shape[1] != 8 or len(rows) < 2:
        raise InputError(f"{path}: has {len(rows)} rows of {rows.shape[1]} numbers, TUM's have time x y z qx qy qz qw")
    check_finite(rows, str(path))
    t = check_time(rows[:, 0], f"{path}: time")
    norm = np.linalg.norm(rows[:, 4:], axis=1, keepdims=True)
    if (np.abs(norm - 1.0) > 1e-2).any():
        raise InputError(f"{path}: the quaternion of row {int(np.argmax(np.abs(norm - 1.0)))} has not length 1")
    q = rows[:, [7, 4, 5, 6]] / norm
    n = len(t)
    q_nb = multiply(multiply(np.repeat(_ENU_TO_NED, n, axis=0), q), np.repeat(_FRD_TO_FLU, n, axis=0))
    return Track(path.stem, t, rows[:, [2, 1, 3]] * [1.0, 1.0, -1.0], None, q_nb, place=str(path))


def read_truth(path: Path, notes: list[str] | None = None) -> Trajectory:
    """A truth from a file: a stored trajectory, or a table as the part ``reference`` of a recording; seconds of its own clock.

    What the table leaves in doubt is added to ``notes``.
    """
    import pyarrow.parquet as pq

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.suffix == ".parquet" and b"testbed" in (pq.read_schema(path).metadata or {}):
        return Trajectory.load(path)
    tables = Tables(path.parent, {"reference": path.name}, {}, ("reference",))
    r = tables.parts["reference"]
    known = ["position", "velocity"]
    n = len(r["time"])
    if n < 2:
        raise InputError(f"{path}: has {n} rows, at least 2 are needed")
    q_nb = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    if any(key in r for key in ("roll", "q_nb_0")):
        q_nb, known = tables.quaternions(), [*known, "attitude"]
    v_n = tables.block("reference", ["v_north", "v_east", "v_down"])
    t = r["time"] + tables.base
    nothing = np.zeros((n, 3))
    if notes is not None:
        notes += tables.notes
    return Trajectory(t, r["lat"], r["lon"], r["alt"], v_n, q_nb, nothing, nothing, name=path.stem, known=tuple(known))
