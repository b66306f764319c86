"""Errors of the aiding sensors as states: barometer bias."""

from __future__ import annotations

import numpy as np

from estimators.blocks import Block, Process, add_block, constant
from testbed.errors import InputError
from testbed.records import SensorLog


def baro_bias(log: SensorLog) -> Process:
    """Height error of a barometer, m: its turn-on bias and drift in Pa through the pressure gradient at the start's height.

    dp/dh = -g p / (R T) of the standard atmosphere, 12 Pa/m at sea level. What the air's own temperature adds is not in a
    data sheet and not in here.
    """
    if log.baro is None:
        raise InputError(f"the block 'baro-bias' needs a barometer, but the log '{log.name}' has none")
    spec, per_metre = log.baro.spec, pressure_per_metre(log.initial.h)
    made = constant(np.array([max(spec.turn_on_bias / per_metre, 1e-3)]))
    return made._replace(drive=np.array([(spec.drift / per_metre) ** 2]))


def pressure_per_metre(h: float) -> float:
    """Fall of pressure with height in the standard atmosphere (ISO 2533), Pa/m, at height ``h`` (m) below the tropopause."""
    temperature = 288.15 - 0.0065 * h
    return float(101325.0 * (temperature / 288.15) ** 5.25588 * 9.80665 / (287.05287 * temperature))


add_block(Block("baro-bias", ("baro_bias_m",), baro_bias, summary="turn-on bias and drift of the barometer, as height"))
