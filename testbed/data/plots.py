"""What the records draw of themselves: a look at a flight, a log or a solution before anything is scored.

Figures of matplotlib, which a notebook shows and ``figure.savefig`` writes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.figure_style import COLOURS, STYLE, new_figure
from testbed.physics import earth, rotations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from testbed.data.records import Array, GnssFixes, SensorLog, Trajectory
    from testbed.data.solution import NavSolution

MOST_POINTS = 3000
"""Of a line: more than a screen has pixels across."""


def motion(record: Trajectory | NavSolution) -> Figure:
    """Ground track; height, speed and attitude over time, of the truth or of an estimate."""
    import matplotlib

    rows = slice(None, None, max(1, len(record.t) // MOST_POINTS))
    t, v = record.t[rows], record.v_n[rows]
    north, east, _ = _local(record, rows)
    euler = np.degrees(rotations.quats_to_eulers(record.q_nb[rows]))
    euler[np.abs(np.diff(euler, axis=0, prepend=euler[:1])) > 180.0] = np.nan  # no line where an angle wraps
    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.2)
        grid = figure.add_gridspec(
            3, 2, width_ratios=(1.2, 1.0), left=0.1, right=0.985, bottom=0.1, top=0.95, wspace=0.3
        )
        track = figure.add_subplot(grid[:, 0])
        track.plot(east, north, color=COLOURS[0][0])
        track.plot(east[:1], north[:1], "o", color="black", ms=4)
        track.set(xlabel="East, m", ylabel="North, m")
        track.set_aspect("equal", adjustable="datalim")
        last = figure.add_subplot(grid[2, 1])
        panels = [figure.add_subplot(grid[0, 1], sharex=last), figure.add_subplot(grid[1, 1], sharex=last), last]
        for ax in panels[:2]:
            ax.tick_params(labelbottom=False)
        panels[0].plot(t, record.h[rows], color=COLOURS[0][0])
        panels[1].plot(t, np.linalg.norm(v, axis=1), color=COLOURS[0][0])
        _lines(panels[2], t, euler, ("roll", "pitch", "yaw"))
        _name(panels, ("Height, m", "Speed, m/s", "Attitude, °"))
    return figure


def log(record: SensorLog) -> Figure:
    """Angular rate, specific force and, where there are fixes, their place from the first one on."""
    import matplotlib

    imu, gnss = record.imu, record.gnss
    rows = slice(None, None, max(1, len(imu.t) // MOST_POINTS))
    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.2)
        axes = np.atleast_1d(figure.subplots(2 if gnss is None else 3, 1, sharex=True))
        figure.subplots_adjust(left=0.11, right=0.985, bottom=0.1, top=0.96, hspace=0.14)
        _lines(axes[0], imu.t[rows], np.degrees(imu.gyro[rows]), "xyz")
        _lines(axes[1], imu.t[rows], imu.accel[rows], "xyz")
        if gnss is not None:
            _lines(axes[2], gnss.t, np.column_stack(_local(gnss)), ("north", "east", "down"), ".", ms=2)
        _name(axes, ("Angular rate, °/s", "Specific force, m/s²", "Fixes, m"))
    return figure


def _local(record: Trajectory | NavSolution | GnssFixes, rows: slice = slice(None)) -> tuple[Array, Array, Array]:
    """North, east, down (m) from the first row."""
    lat, lon, h = record.lat[rows], record.lon[rows], record.h[rows]
    first = np.full_like(lat, lat[0]), np.full_like(lon, lon[0]), np.full_like(h, h[0])
    north, east, down = earth.position_difference(lat, lon, h, *first)
    return north, east, down


def _lines(ax: Axes, t: Array, values: Array, names: Any, *style: Any, **look: Any) -> None:
    for k, name in enumerate(names):
        ax.plot(t, values[:, k], *style, color=COLOURS[k][0], label=name, lw=0.8, **look)
    ax.legend(loc="upper right", ncols=len(names))


def _name(axes: Any, names: tuple[str, ...]) -> None:
    for ax, name in zip(axes, names, strict=False):
        ax.set_ylabel(name)
    axes[-1].set_xlabel("Time, s")
