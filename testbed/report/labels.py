"""Words, colours and number formats, one definition for tables, figures and pages; quantities: `testbed.scoring.quantities`.

Colours: `testbed.base.figure_style`. Line styles repeat the distinction for print in grey.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

DASHES = ["solid", "dash", "dot", "dashdot", "longdash", "longdashdot"]
MISSING = "–"


def short_name(name: str, longest: int) -> str:
    """A name with its middle left out where a figure has no room for more than ``longest`` characters."""
    return name if len(name) <= longest else f"{name[: longest // 2]}…{name[-(longest - longest // 2 - 1) :]}"


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
