"""Errors of the aiding sensors as states: barometer, magnetometer, odometer.

Magnetometer: measured = (1 + D) true + b, soft iron and misalignment in D, hard iron b (Groves, 2nd ed., section 6.1.1).
Odometer: scale error and the two angles between the rolling direction and the b-frame's x (Groves, section 6.2).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from estimators.blocks import Block, Process, add_block, constant, per_axis
from testbed.base.errors import InputError
from testbed.data.records import SensorLog
from testbed.physics.atmosphere import isa_gradient

SMALLEST_STD = 1e-9
"""Of a figure that a data sheet does not give: the state stays where it is, and P stays regular."""


def samples_of(log: SensorLog, kind: str, part: str) -> Any:
    """The samples of a sensor that ``part`` needs. Raises InputError where the log has none."""
    samples = getattr(log, kind)
    if samples is None or len(samples.t) == 0:
        raise InputError(f"{part} needs [sensors.{kind}], but the log '{log.name}' has no such samples")
    return samples


def baro_bias(log: SensorLog) -> Process:
    """Height error of a barometer at the start's height, m: its turn-on bias and drift in Pa through the pressure gradient.

    What the air's own temperature adds is not in a data sheet and not in here.
    """
    spec = samples_of(log, "baro", "the block 'baro-bias'").spec
    gradient = float(isa_gradient(np.array(log.initial.h)))
    made = constant(np.array([max(spec.turn_on_bias / gradient, SMALLEST_STD)]))
    return made._replace(drive=np.array([(spec.drift / gradient) ** 2]))


def hard_iron(log: SensorLog) -> Process:
    """Constant field of the vehicle, µT in b: what calibration left, by the data sheet."""
    spec = samples_of(log, "mag", "the block 'mag-bias'").spec
    return constant(np.full(3, max(spec.turn_on_bias, SMALLEST_STD)))


def distortion(log: SensorLog) -> Process:
    """D row by row: nine elements of soft iron, and a common rotation t of the axes, D = -[t x]."""
    spec = samples_of(log, "mag", "the block 'mag-distortion'").spec
    turn = np.zeros((9, 3))
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        turn[3 * i + j, axis], turn[3 * j + i, axis] = 1.0, -1.0
    made = constant(np.full(9, max(spec.soft_iron, SMALLEST_STD)))
    return made._replace(covariance=made.covariance + spec.misalignment**2 * turn @ turn.T)


def odometer_scale(log: SensorLog) -> Process:
    """Relative error of the wheel's radius, by the data sheet."""
    spec = samples_of(log, "odometer", "the block 'odometer-scale'").spec
    return constant(np.array([max(spec.scale_factor, SMALLEST_STD)]))


def odometer_mounting(log: SensorLog) -> Process:
    """Turn of the rolling direction against the x axis of b: about y (up), then about z (to the right), rad."""
    spec = samples_of(log, "odometer", "the block 'odometer-mounting'").spec
    return constant(np.full(2, max(spec.misalignment, SMALLEST_STD)))


PAIRS = tuple(a + b for a in "xyz" for b in "xyz")
for _name, _states, _process, _summary in (
    ("baro-bias", ("baro_bias_m",), baro_bias, "turn-on bias and drift of the barometer, as height"),
    ("mag-bias", per_axis("mag_bias_{}_ut"), hard_iron, "hard iron, three constants"),
    ("mag-distortion", per_axis("mag_distortion_{}", PAIRS), distortion, "soft iron and misalignment, nine constants"),
    ("odometer-scale", ("odometer_scale",), odometer_scale, "scale error of the wheel, a constant"),
    (
        "odometer-mounting",
        ("odometer_mount_y_rad", "odometer_mount_z_rad"),
        odometer_mounting,
        "direction in which the wheel rolls, two constants",
    ),
):
    add_block(Block(_name, _states, _process, summary=_summary))
