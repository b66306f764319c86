"""Units at the end of a column's name (``gyro_x_dps``), and their factors to the bench's own units.

The bench's units are SI and radians, with two exceptions that DESIGN names: µT for magnetic fields. Factors are exact
by definition (international foot and knot, standard gravity).
"""

from __future__ import annotations

import math

from testbed.base.errors import InputError, nearest
from testbed.physics.earth import G0

_DEG = math.pi / 180.0

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "angle": {"rad": 1.0, "deg": _DEG, "mrad": 1e-3, "dege7": 1e-7 * _DEG},
    "angular rate": {"radps": 1.0, "dps": _DEG, "degps": _DEG, "mradps": 1e-3, "dph": _DEG / 3600.0},
    "acceleration": {"mps2": 1.0, "g": G0, "mg": 1e-3 * G0, "ftps2": 0.3048},
    "length": {"m": 1.0, "ft": 0.3048, "km": 1e3, "cm": 1e-2, "mm": 1e-3},
    "speed": {
        "mps": 1.0,
        "kmph": 1.0 / 3.6,
        "kt": 1852.0 / 3600.0,
        "kn": 1852.0 / 3600.0,
        "ftps": 0.3048,
        "cmps": 1e-2,
    },
    "magnetic field": {"ut": 1.0, "nt": 1e-3, "mgauss": 0.1, "gauss": 100.0, "t": 1e6},
    "pressure": {"pa": 1.0, "hpa": 100.0, "mbar": 100.0, "kpa": 1e3, "bar": 1e5},
    "number": {"": 1.0},
}
"""Quantity -> unit suffix -> factor to SI (µT for magnetic fields)."""


def split(column: str, quantity: str) -> tuple[str, float]:
    """Stem of a column's name and the factor of its unit. Raises InputError on a unit that ``quantity`` does not have."""
    if quantity == "number":
        return column, 1.0
    stem, _, unit = column.rpartition("_")
    units = UNITS[quantity]
    if unit.lower() not in units:
        raise InputError(f"column '{column}': '{unit}' is no unit of {quantity}; {nearest(unit.lower(), units)}")
    return stem, units[unit.lower()]
