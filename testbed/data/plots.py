"""What the records draw of themselves: a look at a flight, a log or a solution before anything is scored.

Figures of matplotlib, which a notebook shows and ``figure.savefig`` writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.figure_style import COLOURS, STYLE, new_figure
from testbed.physics import earth, rotations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Place = tuple[Array, Array, Array]
"""``lat``, ``lon`` (rad) and ``h`` (m), each (N,)."""
MOST_POINTS = 3000
"""Of a line: more than a screen has pixels across."""


def motion(t: Array, place: Place, v_n: Array, q_nb: Array) -> Figure:
    """Ground track; height, speed and attitude over time: ``v_n`` (N,3) m/s, ``q_nb`` (N,4)."""
    import matplotlib

    rows = _rows(t)
    t, v_n, q_nb, h = t[rows], v_n[rows], q_nb[rows], place[2][rows]
    north, east, _ = _local([column[rows] for column in place])
    euler = np.degrees(rotations.quats_to_eulers(q_nb))
    euler[np.abs(np.diff(euler, axis=0, prepend=euler[:1])) > 180.0] = np.nan  # no line where an angle wraps
    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.2)
        grid = figure.add_gridspec(
            3, 2, width_ratios=(1.2, 1.0), left=0.13, right=0.985, bottom=0.11, top=0.97, wspace=0.3
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
        panels[0].plot(t, h, color=COLOURS[0][0])
        panels[1].plot(t, np.linalg.norm(v_n, axis=1), color=COLOURS[0][0])
        _lines(panels[2], t, euler, ("roll", "pitch", "yaw"))
        _name(panels, ("Height, m", "Speed, m/s", "Attitude, °"))
    return figure


def log(t: Array, gyro: Array, accel: Array, fixes: tuple[Array, Place] | None) -> Figure:
    """Angular rate (N,3) rad/s, specific force (N,3) m/s² and, where there are fixes, their place from the first one on."""
    import matplotlib

    rows = _rows(t)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.2)
        axes = np.atleast_1d(figure.subplots(2 if fixes is None else 3, 1, sharex=True))
        figure.subplots_adjust(left=0.11, right=0.985, bottom=0.1, top=0.96, hspace=0.14)
        _lines(axes[0], t[rows], np.degrees(gyro[rows]), "xyz")
        _lines(axes[1], t[rows], accel[rows], "xyz")
        if fixes is not None:
            _lines(axes[2], fixes[0], np.column_stack(_local(fixes[1])), ("north", "east", "down"), ".", ms=2)
        _name(axes, ("Angular rate, °/s", "Specific force, m/s²", "Fixes, m"))
    return figure


def _rows(t: Array) -> slice:
    return slice(None, None, max(1, len(t) // MOST_POINTS))


def _local(place: Sequence[Array]) -> tuple[Array, Array, Array]:
    """North, east, down (m) from the first row."""
    north, east, down = earth.position_difference(*place, *(np.full_like(column, column[0]) for column in place))
    return north, east, down


def _lines(ax: Axes, t: Array, values: Array, names: Any, *style: Any, **look: Any) -> None:
    for k, name in enumerate(names):
        ax.plot(t, values[:, k], *style, color=COLOURS[k][0], label=name, lw=0.8, **look)
    ax.legend(loc="upper right", ncols=len(names))


def _name(axes: Any, names: tuple[str, ...]) -> None:
    for ax, name in zip(axes, names, strict=False):
        ax.set_ylabel(name)
    axes[-1].set_xlabel("Time, s")
