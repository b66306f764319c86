"""Errors of accelerometers and gyros: bias, scale factor, misalignment, and the gyros' sensitivity to acceleration.

Measured = (1 + M) true + bias (+ G times specific force for gyros), M with scale factors on its diagonal and axis
misalignments off it: Groves, 2nd ed., eq. 4.16 and 4.17. Couplings are of first order in the errors.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from estimators.blocks import Block, Process, add_block, constant, per_axis
from testbed.data.records import SensorLog
from testbed.data.specs import TriadSpec

MEMORY = 0.3
"""How far back a bias estimate looks, in correlation times of the bias: tens of seconds for the units of the catalogue."""
RANDOM_WALK_SHARE = 3.0 * (0.5 * MEMORY**2 - 1.0 + (1.0 + MEMORY) * np.exp(-MEMORY)) / MEMORY**3
"""Least-squares slope of 1 - exp(-x) over 0 < x < MEMORY, relative to its slope at 0."""
CUBIC_SLOPE = 3.0
"""Of T3(u) = 4 u³ - 3 u at the origin, in size."""
OFF_DIAGONAL = ("xy", "xz", "yx", "yz", "zx", "zy")


def bias_process(triad: str, log: SensorLog) -> Process:
    """The bias of a triad ("accel" or "gyro") as one state per axis, see `triad_process`."""
    spec: TriadSpec = getattr(log.imu.spec, triad)
    first = 9 if triad == "accel" else 12
    std = np.asarray(log.initial.std, dtype=float)[first : first + 3]
    start = np.asarray(getattr(log.initial, f"{triad}_bias"), dtype=float)
    drive, decay, share = triad_process(spec, std)
    return Process(start, np.diag(std**2), np.full(3, drive), np.full(3, decay), share * start)


def triad_process(spec: TriadSpec, bias_std: np.ndarray) -> tuple[float, float, float]:
    """Driving density², inverse correlation time and share of the constant part of a triad's bias.

    One state per axis stands for the sum of a constant c (turn-on bias) and a Gauss-Markov process g. Its best guess far
    ahead is ``share`` times the initial estimate, ``share`` = var c / (var c + var g). Taken as Gauss-Markov about that
    value it is g itself without c, and a random walk where c dominates; there the driving density is the one whose growth
    follows the structure function 2 var g (1 - exp(-t/tau)) of g best over the filter's `MEMORY`, as the growth at t = 0
    would make the filter too cautious.
    """
    markov = spec.gauss_markov_sigma() ** 2
    steady = spec.turn_on_bias**2 + markov
    share = spec.turn_on_bias**2 / steady if steady > 0.0 else 1.0
    drive = 2.0 * markov / spec.correlation_time_s * (1.0 - share * (1.0 - RANDOM_WALK_SHARE))
    final = steady * (1.0 - share**2) + share**2 * float(np.mean(bias_std**2))
    decay = drive / (2.0 * final) if final > 0.0 else 0.0
    return drive + spec.rate_random_walk**2, decay, share


def white_density(spec: TriadSpec, dt: float) -> float:
    """White noise density² of a triad sampled every ``dt`` (s).

    A data sheet's random walk holds at the output, rounding to one bit included, unless the bit is coarser than the noise.
    """
    return max(spec.white_noise**2, spec.resolution**2 / 12.0 * dt)


class NoiseModel(NamedTuple):
    """What a log's specifications imply for a filter with three accelerometer and three gyro biases."""

    q: np.ndarray
    """(12,) spectral densities of accelerometer and gyro noise, then of what drives their biases."""
    decay: np.ndarray
    """(2,) inverse correlation time of accelerometer and gyro bias, 1/s."""
    bias_mean: np.ndarray
    """(6,) what the biases return to."""
    covariance: np.ndarray
    """(15,15) P0."""


def noise_model(log: SensorLog) -> NoiseModel:
    """For filters that are no composition of blocks."""
    spec, dt = log.imu.spec, (log.imu.t[-1] - log.initial.t) / len(log.imu.t)
    accel, gyro = bias_process("accel", log), bias_process("gyro", log)
    white = np.repeat([white_density(spec.accel, dt), white_density(spec.gyro, dt)], 3)
    return NoiseModel(
        np.concatenate([white, accel.drive, gyro.drive]),
        np.array([accel.decay[0], gyro.decay[0]]),
        np.concatenate([accel.centre, gyro.centre]),
        np.diag(np.asarray(log.initial.std, dtype=float) ** 2),
    )


def scale_process(triad: str, log: SensorLog) -> Process:
    """Scale factors: the specification's sigma per axis, and the slope that a curved characteristic has near zero.

    The lowest odd curve whose largest departure from the best straight line over the range is e times the range, the cubic
    T3, has a slope of 3 e there; below a fifth of the range the slope changes by less than an eighth of that.
    """
    spec: TriadSpec = getattr(log.imu.spec, triad)
    return constant(np.full(3, np.hypot(spec.scale_factor, CUBIC_SLOPE * spec.nonlinearity)))


def misalignment_process(triad: str, log: SensorLog) -> Process:
    """Off-diagonal elements, in the order of `OFF_DIAGONAL`: a common small rotation of the triad, and axes not square.

    A rotation t makes M = -[t x]; where x is the reference axis, lean of y to x and of z to x and y adds below the diagonal.
    """
    spec: TriadSpec = getattr(log.imu.spec, triad)
    effect = np.zeros((6, 6))
    for row, (i, j) in enumerate(("xyz".index(p[0]), "xyz".index(p[1])) for p in OFF_DIAGONAL):
        axis = 3 - i - j
        effect[row, axis] = 1.0 if (i, j) in ((0, 1), (1, 2), (2, 0)) else -1.0
        if i > j:
            effect[row, 3 + i + j - 1] = 1.0
    std = np.repeat([spec.misalignment, spec.nonorthogonality], 3)
    made = constant(np.ones(6))
    return made._replace(covariance=effect @ np.diag(std**2) @ effect.T)


def g_sensitivity_process(log: SensorLog) -> Process:
    """Nine elements of G, row by row: the specification's sigma each."""
    return constant(np.full(9, log.imu.spec.gyro.g_sensitivity))


def bias_of_accel(aux, imu, accel, gyro):
    """Three biases, m/s²: each adds itself to its axis."""
    for i in range(3):
        accel[i, i] = 1.0


def bias_of_gyro(aux, imu, accel, gyro):
    """Three biases, rad/s: each adds itself to its axis."""
    for i in range(3):
        gyro[i, i] = 1.0


def scale_of_accel(aux, imu, accel, gyro):
    """Three scale factor errors: each adds its share of the specific force on its axis."""
    for i in range(3):
        accel[i, i] = imu[3 + i]


def scale_of_gyro(aux, imu, accel, gyro):
    """Three scale factor errors: each adds its share of the rate on its axis."""
    for i in range(3):
        gyro[i, i] = imu[i]


def misalignment_of_accel(aux, imu, accel, gyro):
    """Six off-diagonal terms, two of an axis: each adds its share of the specific force on another axis."""
    for i in range(3):
        accel[2 * i, i] = imu[3 + (1 if i == 0 else 0)]
        accel[2 * i + 1, i] = imu[3 + (1 if i == 2 else 2)]


def misalignment_of_gyro(aux, imu, accel, gyro):
    """Six off-diagonal terms, two of an axis: each adds its share of the rate on another axis."""
    for i in range(3):
        gyro[2 * i, i] = imu[1 if i == 0 else 0]
        gyro[2 * i + 1, i] = imu[1 if i == 2 else 2]


def g_of_gyro(aux, imu, accel, gyro):
    """Nine terms of g-sensitivity, (rad/s)/(m/s²): each adds its share of a specific force to a rate."""
    for i in range(3):
        for j in range(3):
            gyro[3 * i + j, i] = imu[3 + j]


for _triad, _bias, _unit, _scale, _misalignment in (
    ("accel", bias_of_accel, "mps2", scale_of_accel, misalignment_of_accel),
    ("gyro", bias_of_gyro, "radps", scale_of_gyro, misalignment_of_gyro),
):
    add_block(
        Block(
            f"{_triad}-bias",
            per_axis(f"{_triad}_bias_{{}}_{_unit}"),
            partial(bias_process, _triad),
            _triad,  # type: ignore[arg-type]
            _bias,
            summary="turn-on bias and bias instability, one state per axis",
        )
    )
    add_block(
        Block(
            f"{_triad}-scale",
            per_axis(f"{_triad}_scale_{{}}"),
            partial(scale_process, _triad),
            _triad,  # type: ignore[arg-type]
            _scale,
            follows_imu=True,
            in_lanes=True,
            summary="scale factor error, one constant per axis",
        )
    )
    add_block(
        Block(
            f"{_triad}-misalignment",
            per_axis(f"{_triad}_misalignment_{{}}_rad", OFF_DIAGONAL),
            partial(misalignment_process, _triad),
            _triad,  # type: ignore[arg-type]
            _misalignment,
            follows_imu=True,
            in_lanes=True,
            summary="rotation of the triad and axes that are not square, six constants",
        )
    )
add_block(
    Block(
        "g-sensitivity",
        per_axis("gyro_g_sensitivity_{}", [a + b for a in "xyz" for b in "xyz"]),
        g_sensitivity_process,
        "gyro",
        g_of_gyro,
        follows_imu=True,
        in_lanes=True,
        summary="gyro output per specific force, nine constants, (rad/s)/(m/s²)",
    )
)
