"""Height by a barometer: the standard atmosphere's height of each pressure sample, with the bias of the block ``baro-bias``."""

from __future__ import annotations

import numpy as np

from estimators.aiding import ABSENT, Aiding, Columns, Measurements, add_aiding
from estimators.blocks.sensors import pressure_per_metre
from estimators.core.lanes import get, put, set_entry
from testbed.errors import InputError
from testbed.records import SensorLog


def heights(log: SensorLog, columns: Columns) -> Measurements:
    """Height (m) of each sample; its noise is the sensor's and the rounding to one bit, through the gradient at that height."""
    from testbed.sensors.barometer import isa_height

    if log.baro is None or len(log.baro.t) == 0:
        raise InputError(f"the aiding 'baro' needs a barometer, but the log '{log.name}' has none; add [sensors.baro]")
    baro, spec = log.baro, log.baro.spec
    height = isa_height(baro.pressure)
    gradient = np.array([pressure_per_metre(h) for h in height])
    variance = (spec.noise_sigma**2 + spec.resolution**2 / 12.0) / gradient**2
    return Measurements(
        baro.t,
        height[:, None],
        np.maximum(variance, 1e-6)[:, None],
        np.array([columns.get("baro-bias", ABSENT)], dtype=float),
    )


def measure_height(state, imu, parameters, z, residual, h):
    column = int(parameters[0])
    predicted = get(state, 2)
    set_entry(h, 0, 2, -1.0)
    if column >= 0:
        predicted = predicted + get(state, 1 + column)
        set_entry(h, 0, column, 1.0)
    put(residual, 0, get(z, 0) - predicted)


add_aiding(Aiding("baro", "baro", ("height, m",), measure_height, heights, summary="height of the standard atmosphere"))
