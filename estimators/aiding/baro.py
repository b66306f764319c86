"""Height by a barometer: the standard atmosphere's height of each pressure sample, with the bias of the block ``baro-bias``."""

from __future__ import annotations

import numpy as np

from estimators.aiding import ABSENT, Aiding, Columns, Measurements, add_aiding
from estimators.blocks.sensors import samples_of
from testbed.data.records import SensorLog
from testbed.physics.atmosphere import isa_gradient, isa_height

SMALLEST_VARIANCE = 1e-6
"""m²: R of an ideal sensor is zero, which no filter can use."""


def heights(log: SensorLog, columns: Columns) -> Measurements:
    """Height (m) of each sample; its noise is the sensor's and the rounding to one bit, through the gradient at that height.

    ``z`` also holds what a metre of bias at the start's height, an error of pressure, is as height at the sample's.
    """
    baro = samples_of(log, "baro", "the aiding 'baro'")
    height = isa_height(baro.pressure)
    gradient = isa_gradient(height)
    variance = (baro.spec.noise_sigma**2 + baro.spec.resolution**2 / 12.0) / gradient**2
    return Measurements(
        baro.t,
        np.column_stack([height, isa_gradient(np.array(log.initial.h)) / gradient]),
        np.maximum(variance, SMALLEST_VARIANCE)[:, None],
        np.array([columns.get("baro-bias", ABSENT)], dtype=float),
    )


def measure_height(state, imu, parameters, z, residual, h):
    """Height of the standard atmosphere (1,), m, against the state's height and the barometer's bias."""
    column = int(parameters[0])
    predicted = state[2]
    h[0, 2] = -1.0
    if column >= 0:
        predicted = predicted + state[1 + column] * z[1]
        h[0, column] = z[1]
    residual[0] = z[0] - predicted


add_aiding(
    Aiding(
        "baro",
        "baro",
        ("height, m",),
        measure_height,
        heights,
        summary="height of the standard atmosphere",
        in_lanes=True,
    )
)
