"""The Earth's magnetic field as a vector in b, and as a heading.

Groves, 2nd ed., section 6.1.1: measured = (1 + D) C_bn m_n + hard iron, m_n the local field of a map. Heading uses the
horizontal direction alone, so that iron in the vertical and the map's strength do not matter. Fields in µT.
"""

from __future__ import annotations

import numpy as np

from estimators.aiding import ABSENT, Aiding, Columns, Measurements, add_aiding
from estimators.blocks.sensors import samples_of
from estimators.core.model import attitude, triple
from testbed.base.errors import InputError
from testbed.data.records import MagSamples, SensorLog
from testbed.physics.rotations import cross, matrix_rotate, quat_to_matrix

HARD_IRON, DISTORTION = 3, 4
"""Places in the parameters of the columns of blocks, behind the local field."""
DECLINATION = 0
SMALLEST_STD = 1e-3
"""µT: R of an ideal sensor is zero, which no filter can use."""


def _variance(mag: MagSamples) -> float:
    """Noise and rounding to one bit, µT²."""
    return float(max(mag.spec.noise_sigma**2 + mag.spec.resolution**2 / 12.0, SMALLEST_STD**2))


def fields(log: SensorLog, columns: Columns) -> Measurements:
    """The field of each sample. Raises InputError where the specification's local field contradicts its declination."""
    mag = samples_of(log, "mag", "the aiding 'mag'")
    north, east, _ = mag.spec.field_n
    if abs(np.arctan2(east, north) - mag.spec.declination) > 1e-6:
        raise InputError(
            f"the aiding 'mag' needs the local field, but that of the log '{log.name}' points {np.degrees(np.arctan2(east, north)):.3g}°"
            f" east and its declination is {np.degrees(mag.spec.declination):.3g}°; give field_n, or use the aiding 'heading'"
        )
    places = [columns.get(name, ABSENT) for name in ("mag-bias", "mag-distortion")]
    parameters = np.array([*mag.spec.field_n, *places], dtype=float)
    return Measurements(mag.t, mag.field, np.full(mag.field.shape, _variance(mag)), parameters)


def measure_field(state, imu, parameters, z, residual, h):
    """Magnetic field (3,), µT, in b: that of place and date, with the magnetometer's hard iron and distortion."""
    m, field = quat_to_matrix(attitude(state)), triple(parameters, 0)
    iron, distortion = int(parameters[HARD_IRON]), int(parameters[DISTORTION])
    zero = 0.0 * state[0]
    in_b = (
        m[0][0] * field[0] + m[1][0] * field[1] + m[2][0] * field[2],
        m[0][1] * field[0] + m[1][1] * field[1] + m[2][1] * field[2],
        m[0][2] * field[0] + m[1][2] * field[1] + m[2][2] * field[2],
    )
    for i in range(3):
        axis = (zero + (1.0 if i == 0 else 0.0), zero + (1.0 if i == 1 else 0.0), zero + (1.0 if i == 2 else 0.0))
        predicted = zero
        if distortion >= 0:
            first = distortion + 3 * i
            axis = (
                axis[0] + state[1 + first],
                axis[1] + state[2 + first],
                axis[2] + state[3 + first],
            )
            for j in range(3):
                h[i, first + j] = in_b[j]
        if iron >= 0:
            predicted = predicted + state[1 + iron + i]
            h[i, iron + i] = 1.0
        by_attitude = cross(matrix_rotate(m, axis), field)
        for j in range(3):
            h[i, 6 + j] = by_attitude[j]
        predicted = predicted + axis[0] * in_b[0] + axis[1] * in_b[1] + axis[2] * in_b[2]
        residual[i] = z[i] - predicted


def headings(log: SensorLog, columns: Columns) -> Measurements:
    """Noise across the horizontal field of the map is the heading's."""
    mag = samples_of(log, "mag", "the aiding 'heading'")
    level = np.hypot(*mag.spec.field_n[:2])
    if level < SMALLEST_STD:
        raise InputError(f"the aiding 'heading' needs a horizontal field, but that of the log '{log.name}' is vertical")
    parameters = np.array([mag.spec.declination, columns.get("mag-bias", ABSENT)], dtype=float)
    return Measurements(mag.t, mag.field, np.full((len(mag.t), 1), _variance(mag) / level**2), parameters)


def measure_heading(state, imu, parameters, z, residual, h):
    """Heading (1,), rad, of the horizontal part of the measured field."""
    m, iron = quat_to_matrix(attitude(state)), int(parameters[1])
    zero = 0.0 * state[0]
    field = (zero + z[0], zero + z[1], zero + z[2])
    if iron >= 0:
        field = (
            field[0] - state[1 + iron],
            field[1] - state[2 + iron],
            field[2] - state[3 + iron],
        )
    north, east, down = matrix_rotate(m, field)
    level = north * north + east * east
    sine, cosine = np.sin(parameters[DECLINATION]), np.cos(parameters[DECLINATION])
    # From magnetic north of the map to where the sample has it, less than half a turn.
    residual[0] = -np.arctan2(east * cosine - north * sine, north * cosine + east * sine)
    h[0, 6] = -(north * down / level)
    h[0, 7] = -(east * down / level)
    h[0, 8] = 1.0 + zero
    if iron >= 0:
        for j in range(3):
            h[0, iron + j] = (east * m[0][j] - north * m[1][j]) / level


FIELD = ("x, µT", "y, µT", "z, µT")
add_aiding(Aiding("mag", "mag", FIELD, measure_field, fields, summary="magnetic field as a vector", in_lanes=True))
add_aiding(
    Aiding(
        "heading",
        "mag",
        ("heading, rad",),
        measure_heading,
        headings,
        summary="direction of magnetic north",
        in_lanes=True,
    )
)
