"""Words, units, colours and number formats, one definition for tables, figures and pages.

Colours: Okabe and Ito (2008), a palette that stays distinct under the common colour-vision deficiencies; yellow is left out
(unreadable on white). Line styles repeat the distinction for print in grey.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

QUANTITIES: dict[str, tuple[str, str]] = {
    "north_m": ("North", "m"),
    "east_m": ("East", "m"),
    "down_m": ("Down", "m"),
    "position_2d_m": ("2-D position", "m"),
    "position_3d_m": ("3-D position", "m"),
    "v_north_mps": ("North velocity", "m/s"),
    "v_east_mps": ("East velocity", "m/s"),
    "v_down_mps": ("Down velocity", "m/s"),
    "velocity_3d_mps": ("3-D velocity", "m/s"),
    "roll_deg": ("Roll", "°"),
    "pitch_deg": ("Pitch", "°"),
    "yaw_deg": ("Yaw", "°"),
    "attitude_deg": ("Attitude", "°"),
    "nees_position": ("NEES position", ""),
    "nees_velocity": ("NEES velocity", ""),
    "nees_attitude": ("NEES attitude", ""),
    "nees_bias": ("NEES bias", ""),
    "nis": ("NIS", ""),
}
STATISTICS = {"rmse": "{} RMSE", "max": "largest {} error", "final": "{} error at the end", "mean": "mean {} error"}
GROUPS: dict[str, list[str]] = {
    "Position": ["north_m", "east_m", "down_m"],
    "Velocity": ["v_north_mps", "v_east_mps", "v_down_mps"],
    "Attitude": ["roll_deg", "pitch_deg", "yaw_deg"],
}
# (on white, on dark)
COLOURS = [
    ("#0072B2", "#4FA8DE"),
    ("#D55E00", "#F0803C"),
    ("#009E73", "#2CC79B"),
    ("#CC79A7", "#E29AC2"),
    ("#B07A00", "#E6B23C"),
    ("#3A9BDC", "#8CCBF2"),
    ("#7A4FA3", "#B493D6"),
    ("#5B5B5B", "#B5B5B5"),
]
DASHES = ["solid", "dash", "dot", "dashdot", "longdash", "longdashdot"]
MISSING = "–"


def split_metric(metric: str) -> tuple[str, str]:
    """``rmse_north_m`` -> (``rmse``, ``north_m``); a metric without a statistic gives an empty first part."""
    head, _, rest = metric.partition("_")
    return (head, rest) if head in STATISTICS and rest else ("", metric)


def metric_label(metric: str) -> str:
    """``rmse_position_3d_m`` -> ``3-D position RMSE``."""
    statistic, quantity = split_metric(metric)
    name = quantity_label(quantity)
    if not statistic or name.startswith(("NEES", "NIS")):
        return name
    words = STATISTICS[statistic].format(name[0].lower() + name[1:])
    return words[0].upper() + words[1:]


def quantity_label(quantity: str) -> str:
    return QUANTITIES.get(quantity, (quantity.replace("_", " "), ""))[0]


def unit(metric: str) -> str:
    """Unit as printed; empty for a dimensionless metric."""
    return QUANTITIES.get(split_metric(metric)[1], ("", ""))[1]


def window_label(window: str) -> str:
    """``all`` -> ``whole flight``; ``phase_3_turn`` -> ``phase 3, turn``."""
    if window == "all":
        return "whole flight"
    if window == "outages":
        return "all GNSS outages"
    kind, _, rest = window.partition("_")
    if kind == "phase" and rest:
        number, _, name = rest.partition("_")
        return f"phase {number}, {name.replace('_', ' ')}" if name else f"phase {number}"
    return window.replace("_", " ")


def number(value: object, digits: int = 3) -> str:
    """Three significant figures without exponent between 1e-4 and 1e6: ``0.0422``, ``12.3``, ``712``."""
    if value is None or isinstance(value, str):
        return str(value) if value else MISSING
    x = float(value)  # type: ignore[arg-type]
    if not math.isfinite(x):
        return MISSING
    if x == 0.0:
        return "0"
    if not 1e-4 <= abs(x) < 1e6:
        return f"{x:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(float(f"{abs(x):.{digits - 1}e}"))))
    return f"{x:.{decimals}f}".replace("-", "−")


def percent(value: object) -> str:
    """One decimal below 100 %, none above; a real minus sign."""
    x = float("nan") if value is None else float(value)  # type: ignore[arg-type]
    if not math.isfinite(x):
        return MISSING
    if 99.95 <= x < 100.0:
        return "> 99.9"
    text = f"{x:.1f}" if abs(x) < 100 else f"{x:.0f}"
    return "0.0" if text == "-0.0" else text.replace("-", "−")


def component_label(component: object, position: int, names: Sequence[str]) -> str:
    """The component's name where names are given; else its number, counted from 1."""
    if position < len(names):
        return str(names[position])
    return component if isinstance(component, str) else str(position + 1)


def verdict_kind(verdict: object) -> str:
    """``good``, ``part``, ``bad`` or ``open``: how a verdict is coloured. The word itself always stands beside it."""
    text = str(verdict).lower()
    if any(word in text for word in ("not tested", "undecided", "inconclusive", "nan")):
        return "open"
    if text.startswith(("not ", "reversed", "contradict", "fails")):
        return "bad"
    if any(word in text for word in ("part", "direction", "depends", "inconsistent")):
        return "part"
    if text.startswith(("reproduced", "holds")):
        return "good"
    return "open"
