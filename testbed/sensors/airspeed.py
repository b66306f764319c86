"""The airspeed sensor: true airspeed from a pitot tube, with scale error, noise, resolution and a lower limit.

The air is that of the flight: its column ``airspeed_mps`` holds steady wind and the turbulence, which is correlated from
sample to sample. A filter that takes airspeed for ground speed meets that error as it is; nothing is added for it here. m/s.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from testbed.base.errors import InputError
from testbed.data.records import Array, Samples, Trajectory
from testbed.data.specs import Vector
from testbed.sensors.config import SensorTable
from testbed.sensors.draws import Draws
from testbed.sensors.sensor import Column, Sensor

COLUMN = "airspeed_mps"


@dataclass(frozen=True)
class AirspeedSpec:
    """Pitot tube that reports true airspeed."""

    name: str = "ideal"
    rate_hz: float = 10.0
    scale_factor: float = 0.0
    """Relative scale error (tube's place, density taken for the air's), 1 sigma over units."""
    noise_sigma: float = 0.0
    """White noise per sample, m/s."""
    minimum: float = 0.0
    """Below this it reads zero, m/s: dynamic pressure drowns in the transducer's offset."""
    resolution: float = 0.0
    """m/s."""


class AirspeedConfig(SensorTable):
    """``[sensors.airspeed]``"""

    kind: ClassVar[str] = "airspeed"
    rate_hz: float | None = Field(
        default=None, gt=0, le=1000, description="Samples per second; default: the catalogue's, Hz"
    )

    def spec(self) -> AirspeedSpec:
        """The specification."""
        found: AirspeedSpec = self._figures()
        return found


@dataclass(frozen=True, repr=False)
class AirspeedSamples(Samples):
    """``t`` (M,), ``speed`` (M,) true airspeed, m/s."""

    speed: Array
    spec: AirspeedSpec
    kind: ClassVar[str] = "airspeed"
    shapes: ClassVar[Mapping[str, tuple[int | None, ...]]] = {"speed": ()}


def sense_airspeed(
    config: AirspeedConfig, trajectory: Trajectory, draws: Draws, arm_b: Vector
) -> tuple[AirspeedSamples, dict[str, Any]]:
    """Samples, and the drawn scale error. Raises InputError for a motion without air data."""
    from testbed.physics.interpolate import sample_times

    if COLUMN not in trajectory.extra:
        raise InputError(
            f"[sensors.airspeed] '{trajectory.name}' has no air data (column {COLUMN}); aeroplanes that JSBSim flies have them, multirotors "
            "and what rolls or walks carry no pitot tube"
        )
    spec = config.spec()
    t = sample_times(trajectory, spec.rate_hz)
    scale = spec.scale_factor * float(draws.turn_on("airspeed.scale_factor").standard_normal())
    speed = (1.0 + scale) * np.interp(t, trajectory.t, trajectory.extra[COLUMN])
    speed += spec.noise_sigma * draws.noise("airspeed.white").standard_normal(len(t))
    if spec.resolution:
        speed = np.rint(speed / spec.resolution) * spec.resolution
    return AirspeedSamples(t, np.where(speed < spec.minimum, 0.0, speed), spec), {"airspeed_scale_factor": scale}


SENSOR = Sensor(
    kind="airspeed",
    title="Airspeed sensor",
    spec=AirspeedSpec,
    config=AirspeedConfig,
    samples=AirspeedSamples,
    sense=sense_airspeed,
    columns=(Column("speed", "airspeed_mps", "speed"),),
    rows={
        "scale_factor": ("Scale factor, 1σ", 100.0, "%"),
        "noise_sigma": ("Noise, 1σ", 1.0, "m/s"),
        "minimum": ("Lowest reading", 1.0, "m/s"),
        "resolution": ("Resolution", 1.0, "m/s"),
    },
    figures={
        "scale_factor_pct": ("scale_factor", 1e-2),
        "noise_mps": ("noise_sigma", 1.0),
        "minimum_mps": ("minimum", 1.0),
        "resolution_mps": ("resolution", 1.0),
    },
    catalogue={
        "pitot": {
            "source": "assumed: a small unmanned aircraft's pitot tube, its place and the air's density known to 2 %",
            "rate_hz": 10.0,
            "scale_factor_pct": 2.0,
            "noise_mps": 0.3,
            "minimum_mps": 5.0,
            "assumed": ["scale_factor_pct", "noise_mps", "minimum_mps", "rate_hz"],
        }
    },
)
