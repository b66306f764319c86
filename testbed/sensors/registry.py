"""The sensors that there are: every module of this folder that defines ``SENSOR``, found by looking.

From here come the ``[sensors]`` section of a scenario, the kinds of samples in a log, and the catalogue's kinds. Adding a
sensor changes no line of this or any other file.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, create_model

from testbed.base.schema import Table
from testbed.sensors import catalog
from testbed.sensors.config import BaroConfig, GnssConfig, ImuConfig, MagConfig
from testbed.sensors.sensor import Sensor

_DEFINED = re.compile(rb"^SENSOR\b", re.MULTILINE)


def _found() -> dict[str, Sensor]:
    """By kind, in the order of their ranks. A module is read before it is imported: most others load compiled code."""
    sensors: list[Sensor] = []
    for folder in sys.modules[__package__].__path__:
        for module in pkgutil.iter_modules([folder]):
            if _DEFINED.search((Path(folder) / f"{module.name}.py").read_bytes()):
                sensors.append(importlib.import_module(f"testbed.sensors.{module.name}").SENSOR)
    return {sensor.kind: sensor for sensor in sorted(sensors, key=lambda sensor: (sensor.rank, sensor.kind))}


SAMPLES = _found()
"""All kinds of samples that a log may have."""
SENSORS = {kind: sensor for kind, sensor in SAMPLES.items() if sensor.config is not None}
"""Those that have a section of the scenario."""
for _sensor in SENSORS.values():
    catalog.declare(_sensor.kind, _sensor.spec, _sensor.figures, _sensor.catalogue)


def list_sensors() -> dict[str, dict[str, str]]:
    """The shipped catalogue: kind (``imu``, ``gnss``, ``odometer`` ...) to name to source."""
    return {
        kind: {name: str(entry["source"]) for name, entry in catalog.shipped(kind).items()} for kind in catalog.SPECS
    }


if TYPE_CHECKING:

    class SensorsConfig(Table):
        """``[sensors]``: what records the flight; one table for each sensor that is aboard."""

        imu: ImuConfig
        gnss: GnssConfig | None
        mag: MagConfig | None
        baro: BaroConfig | None
else:
    SensorsConfig = create_model(
        "SensorsConfig",
        __base__=Table,
        __module__=__name__,
        __doc__="``[sensors]``: what records the flight; one table for each sensor that is aboard.",
        imu=(ImuConfig, Field(default_factory=ImuConfig, description="Inertial measurement unit")),
        **{kind: (s.config | None, Field(default=None, description=s.title)) for kind, s in SENSORS.items()},
    )
