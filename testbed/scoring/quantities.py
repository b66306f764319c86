"""What the bench measures, one registry: each quantity with its label, unit, group, and how it follows from the errors.

Metrics, tables, plots, sweeps and headlines take their names, words and units from here. A metric is a statistic and a
quantity: ``rmse_north_m``. Errors are estimate minus truth; SI units, angles in degrees as the names say.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


@dataclass(frozen=True)
class Quantity:
    """An error over time. ``of`` takes the axes' errors (N,9) and the rotation vector (N,3, rad) and gives (N,).

    ``states`` are the error states (`testbed.data.records.STATE_NAMES`) that it is about: who does not estimate them all is not
    scored on it. ``short`` heads a column.
    """

    name: str
    label: str
    short: str
    unit: str
    group: str
    states: tuple[str, ...]
    of: Callable[[Array, Array], Array]


def _axis(name: str, label: str, short: str, unit: str, group: str, states: tuple[str, ...], column: int) -> Quantity:
    return Quantity(name, label, short, unit, group, states, lambda values, phi: values[:, column])


def _norm(values: Array) -> Array:
    import numpy as np

    return np.sqrt(np.einsum("ij,ij->i", values, values))


def _heading_and_inclination(phi: Array) -> tuple[Array, Array]:
    """Sizes (N,), degrees, of the two turns, about down and about a horizontal axis, that make up a rotation vector (N,3)."""
    import numpy as np

    angle = _norm(phi)
    half = 0.5 * np.sinc(0.5 * angle / np.pi)  # sin(angle / 2) / angle
    w, z = np.cos(0.5 * angle), half * phi[:, 2]
    level = half * np.hypot(phi[:, 0], phi[:, 1])
    return np.degrees(2.0 * np.arctan2(np.abs(z), np.abs(w))), np.degrees(2.0 * np.arctan2(level, np.hypot(w, z)))


def _magnitude(
    name: str, label: str, short: str, unit: str, group: str, states: tuple[str, ...], part: slice
) -> Quantity:
    return Quantity(name, label, short, unit, group, states, lambda values, phi: _norm(values[:, part]))


_NED = ("north", "east", "down")
_POSITION = tuple(f"position_{axis}_m" for axis in _NED)
_VELOCITY = tuple(f"velocity_{axis}_mps" for axis in _NED)
_ATTITUDE = tuple(f"attitude_{axis}_rad" for axis in _NED)
_GROUPS = {"position": _POSITION, "velocity": _VELOCITY, "attitude": _ATTITUDE}
"""What a truth may know: `testbed.data.records.KNOWN`."""

QUANTITIES: dict[str, Quantity] = {
    q.name: q
    for q in (
        *(_axis(f"{a}_m", a.title(), a.title(), "m", "Position", (_POSITION[k],), k) for k, a in enumerate(_NED)),
        _magnitude("position_2d_m", "2-D position", "2-D pos.", "m", "Position", _POSITION[:2], slice(0, 2)),
        _magnitude("position_3d_m", "3-D position", "3-D pos.", "m", "Position", _POSITION, slice(0, 3)),
        *(
            _axis(f"v_{a}_mps", f"{a.title()} velocity", f"{a.title()} vel.", "m/s", "Velocity", (_VELOCITY[k],), 3 + k)
            for k, a in enumerate(_NED)
        ),
        _magnitude("velocity_3d_mps", "3-D velocity", "3-D vel.", "m/s", "Velocity", _VELOCITY, slice(3, 6)),
        # An Euler angle mixes the components of the rotation vector.
        *(
            _axis(f"{a}_deg", a.title(), a.title(), "°", "Attitude", _ATTITUDE, 6 + k)
            for k, a in enumerate(("roll", "pitch", "yaw"))
        ),
        Quantity(
            *("attitude_deg", "Attitude", "Attitude", "°", "Attitude", _ATTITUDE),
            lambda values, phi: _norm(phi) * (180.0 / math.pi),
        ),
        # The error's turn about down that leaves the least, and what it leaves (Laidig et al. 2021, doi:10.3390/data6070072).
        Quantity(
            *("heading_deg", "Heading", "Heading", "°", "Attitude", _ATTITUDE),
            lambda values, phi: _heading_and_inclination(phi)[0],
        ),
        Quantity(
            *("inclination_deg", "Inclination", "Incl.", "°", "Attitude", _ATTITUDE),
            lambda values, phi: _heading_and_inclination(phi)[1],
        ),
    )
}
AXES = tuple(f"{a}_m" for a in _NED) + tuple(f"v_{a}_mps" for a in _NED) + ("roll_deg", "pitch_deg", "yaw_deg")
"""The signed errors: columns of `metrics.ErrorSeries.values`."""
GROUPS: dict[str, list[str]] = {
    group: [name for name in AXES if QUANTITIES[name].group == group] for group in ("Position", "Velocity", "Attitude")
}
"""Axes that share a plot."""
AGAINST_FIXES = tuple(name for name, q in QUANTITIES.items() if q.group in ("Position", "Velocity"))
"""What can be compared with a GNSS fix, too (``rmse_gnss_``, ``mean_gnss_``)."""

STATISTICS: dict[str, tuple[str, str]] = {
    "rmse": ("{} RMSE", "{}"),
    "max": ("largest {} error", "Max {}"),
    "final": ("{} error at the end", "End {}"),
    "mean": ("mean {} error", "Mean {}"),
}
"""Statistic of an error over a window: in words, and as the head of a column."""
FIX_STATISTICS = ("rmse", "mean")
TIME_METRIC = "us_per_sample"
"""Computation time of an estimator per IMU sample."""
DIVERGED = "diverged"
"""Share of runs that were lost."""


@dataclass(frozen=True)
class StateTest:
    """A consistency test of the states whose names begin with one of ``prefixes``."""

    label: str
    prefixes: tuple[str, ...]


NEES: dict[str, StateTest] = {
    "nees_position": StateTest("NEES position", ("position_",)),
    "nees_velocity": StateTest("NEES velocity", ("velocity_",)),
    "nees_attitude": StateTest("NEES attitude", ("attitude_",)),
    "nees_bias": StateTest("NEES bias", ("accel_bias_", "gyro_bias_")),
}
NIS = "nis"
"""Of all aidings together; ``nis_`` and the aiding's name of each, where a filter has several."""
_OTHER = {NIS: ("NIS", ""), TIME_METRIC: ("Computation time per sample", "µs"), DIVERGED: ("Runs lost", "")}

MAIN = ("position_3d_m", "velocity_3d_mps", "attitude_deg")
"""One quantity for each group, where there is room for no more."""
COMPARED = (
    *("rmse_north_m", "rmse_east_m", "rmse_down_m", "rmse_position_3d_m", "max_position_3d_m", "final_position_3d_m"),
    *("rmse_velocity_3d_mps", "rmse_roll_deg", "rmse_pitch_deg", "rmse_yaw_deg", "rmse_attitude_deg"),
)
"""Metrics of the report's tables."""
IMPROVED = ("rmse_position_2d_m", "rmse_position_3d_m", "rmse_velocity_3d_mps", "rmse_attitude_deg", "rmse_yaw_deg")
"""Metrics in which every estimator is set against the first one of the scenario."""
RANKED = ("rmse_position_3d_m", "rmse_attitude_deg", "rmse_roll_deg", "rmse_velocity_3d_mps")
"""Metrics that a headline is about, in order of preference, where no claim says which."""


def metric_names() -> list[str]:
    """Every metric that a table may hold, but for ``nis_`` of single aidings."""
    against = [f"{s}_gnss_{q}" for s in FIX_STATISTICS for q in AGAINST_FIXES]
    return [*(f"{s}_{q}" for s in STATISTICS for q in QUANTITIES), *NEES, NIS, *against, DIVERGED]


def is_consistency(name: str) -> bool:
    """Whether a metric is a NEES or NIS."""
    return name in NEES or name == NIS or name.startswith(f"{NIS}_")


def scored_quantities(states: Sequence[str], known: Sequence[str] = tuple(_GROUPS)) -> tuple[Quantity, ...]:
    """Those that an estimator of these states answers for: all where it names none of position, velocity and attitude.

    ``known`` are the groups of them that the truth knows.
    """
    named = {*_POSITION, *_VELOCITY, *_ATTITUDE} & set(states) or {*_POSITION, *_VELOCITY, *_ATTITUDE}
    told = named & {state for group in known for state in _GROUPS[group]}
    return tuple(q for q in QUANTITIES.values() if told.issuperset(q.states))


def split_metric(metric: str) -> tuple[str, str]:
    """``rmse_north_m`` -> (``rmse``, ``north_m``); a metric without a statistic gives an empty first part."""
    head, _, rest = metric.partition("_")
    return (head, rest) if head in STATISTICS and rest else ("", metric)


def metric_label(metric: str) -> str:
    """``rmse_position_3d_m`` -> ``3-D position RMSE``."""
    statistic, quantity = split_metric(metric)
    name = quantity_label(quantity)
    if not statistic:
        return name
    words = STATISTICS[statistic][0].format(name[0].lower() + name[1:])
    return words[0].upper() + words[1:]


def short_label(metric: str) -> str:
    """``max_north_m`` -> ``Max North``: the head of a narrow column."""
    statistic, quantity = split_metric(metric)
    short = QUANTITIES[quantity].short if quantity in QUANTITIES else quantity_label(quantity)
    return STATISTICS[statistic][1].format(short) if statistic else short


def quantity_label(quantity: str) -> str:
    """A quantity in words; one that is not known (a filter's own) by its name."""
    plain = quantity.removeprefix("gnss_")
    if plain in QUANTITIES:
        return QUANTITIES[plain].label + (" against GNSS" if plain != quantity else "")
    if quantity in NEES:
        return NEES[quantity].label
    if quantity in _OTHER:
        return _OTHER[quantity][0]
    return (
        quantity.replace("nis_", "NIS ", 1).replace("_", " ")
        if is_consistency(quantity)
        else quantity.replace("_", " ")
    )


def unit(metric: str) -> str:
    """Unit as printed; empty for a dimensionless metric."""
    quantity = split_metric(metric)[1].removeprefix("gnss_")
    return QUANTITIES[quantity].unit if quantity in QUANTITIES else _OTHER.get(quantity, ("", ""))[1]


def axis_title(metric: str) -> str:
    """``North, m`` or ``North RMSE, m``: label and unit of a plot's axis."""
    return ", ".join(filter(None, (metric_label(metric), unit(metric))))
