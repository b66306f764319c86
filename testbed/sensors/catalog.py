"""The catalogue of sensors: data-sheet figures with the unit in the key, turned into the SI specifications.

Figures and their sources stand in ``catalog.toml`` (or a user's file of the same form). Keys end in their unit, where
``p`` reads "per": ``gyro_arw_dpsqrth`` is °/√h. Results are `testbed.specs` in SI units and radians.
"""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from testbed.earth_units import G0
from testbed.errors import InputError, nearest
from testbed.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec

SHIPPED = Path(__file__).with_name("catalog.toml")
SPECS = {"imu": ImuSpec, "gnss": GnssSpec, "mag": MagSpec, "baro": BaroSpec}
DEG = math.pi / 180.0
HOUR = 3600.0
REMARKS = ("source", "assumed")
"""Keys of an entry that are no figures."""
