"""A new sensor in one file: a range finder that looks down along the body and reads the distance to level ground.

Copied into the folder of the sensors, this is all that it takes; see test_sensor_registry.py. Metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from testbed.data.records import Array, Samples, Trajectory
from testbed.data.specs import Vector
from testbed.sensors.config import SensorTable
from testbed.sensors.draws import Draws
from testbed.sensors.sensor import Column, Sensor


@dataclass(frozen=True)
class RangefinderSpec:
    """Range finder."""

    name: str = "ideal"
    rate_hz: float = 20.0
    noise_sigma: float = 0.0
    """White noise per sample, m."""


class RangefinderConfig(SensorTable):
    """``[sensors.rangefinder]``"""

    kind: ClassVar[str] = "rangefinder"
    rate_hz: float | None = Field(default=None, gt=0, le=1000, description="Samples per second, Hz")
    ground_m: float = Field(default=0.0, ge=-500, le=9000, description="Height of the ground above the ellipsoid, m")


@dataclass(frozen=True)
class RangefinderSamples(Samples):
    """``t`` (M,), ``range`` (M,) m."""

    range: Array
    spec: RangefinderSpec
    kind: ClassVar[str] = "rangefinder"
    shapes: ClassVar[Mapping[str, tuple[int | None, ...]]] = {"range": ()}


def sense(
    config: RangefinderConfig, trajectory: Trajectory, draws: Draws, arm_b: Vector
) -> tuple[RangefinderSamples, dict[str, Any]]:
    from testbed.physics.interpolate import sample_times, state_at
    from testbed.physics.rotations import quats_to_matrices

    spec = config._figures()
    t = sample_times(trajectory, spec.rate_hz)
    _, _, h, _, q_nb = state_at(trajectory, t)
    distance = (h - config.ground_m) / np.maximum(quats_to_matrices(q_nb)[:, 2, 2], 0.1)
    distance += spec.noise_sigma * draws.noise("rangefinder.white").standard_normal(len(t))
    return RangefinderSamples(t, distance, spec), {}


SENSOR = Sensor(
    kind="rangefinder",
    title="Range finder",
    spec=RangefinderSpec,
    config=RangefinderConfig,
    samples=RangefinderSamples,
    sense=sense,
    columns=(Column("range", "range_m", "length"),),
    rows={"noise_sigma": ("Noise, 1σ", 1.0, "m")},
    figures={"noise_m": ("noise_sigma", 1.0)},
    catalogue={"small": {"source": "assumed", "noise_m": 0.1, "assumed": ["noise_m"]}},
)
