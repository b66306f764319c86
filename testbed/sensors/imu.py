"""The IMU: what gyros and accelerometers of a specification make of the true angular rate and specific force.

A chain of steps in the order of `config.ImuStep`, each built by one small function here and each with random streams of
its own; models after Groves, 2nd ed., section 4.4, and IEEE Std 952-1997. Frame b, SI units; measured = true + bias.

The log is worked through in blocks of rows that stay in the processor's cache, all steps on a block before the next.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, ImuSamples, Trajectory
from testbed.data.specs import ImuSpec, TriadSpec
from testbed.physics.earth import G0
from testbed.sensors import kernels, slow_bias, vibration
from testbed.sensors.config import ImuConfig
from testbed.sensors.draws import Draws

BLOCK = 4096
"""Rows that are worked on at a time."""
_FULLY_DITHERED = 1.0 / 3.0
"""Noise variance (in LSB², quantisation included) from which the quantisation error is white: 0.5 LSB drawn, and 1/12."""
TRIADS = ("gyro", "accel")


@dataclass(frozen=True)
class Motion:
    """True motion of the reference point: means over the intervals that end at ``t`` (n,); the first begins at ``start``."""

    start: float
    t: Array
    w_ib_b: Array
    f_b: Array
    engine_rpm: Array | None = None


@dataclass(frozen=True)
class Block:
    """Consecutive rows of the log in the making."""

    rows: slice
    t: Array
    gyro: Array
    accel: Array

    def triad(self, name: str) -> Array:
        """``gyro`` or ``accel``."""
        return self.gyro if name == "gyro" else self.accel


Step = Callable[[Block], None]


@dataclass(frozen=True)
class Setup:
    """What the builders of the steps need; ``constants`` collects what they drew, ``bias`` the slow bias per triad."""

    spec: ImuSpec
    config: ImuConfig
    motion: Motion
    draws: Draws
    bias: dict[str, Array]
    constants: dict[str, Any] = field(default_factory=dict)

    def on(self, step: str) -> bool:
        """Whether the scenario leaves a step switched on."""
        return step not in self.config.disable

    def triads(self) -> list[tuple[str, TriadSpec]]:
        """Names and specifications of the two triads."""
        return [(name, getattr(self.spec, name)) for name in TRIADS]


def sense_imu(config: ImuConfig, motion: Motion, draws: Draws) -> tuple[ImuSamples, dict[str, Array], dict[str, Any]]:
    """Samples, the true slow bias (n,3) of each triad at the sample times, and the constants that were drawn."""
    n = len(motion.t)
    rate = float(n / (motion.t[-1] - motion.start))
    setup = Setup(config.spec(rate), config, motion, draws, {name: np.empty((n, 3)) for name in TRIADS})
    steps = [step for build in CHAIN for step in build(setup)]
    gyro, accel = np.empty((n, 3)), np.empty((n, 3))
    for first in range(0, n, BLOCK):
        rows = slice(first, min(first + BLOCK, n))
        block = Block(rows, motion.t[rows], gyro[rows], accel[rows])
        block.gyro[:], block.accel[:] = motion.w_ib_b[rows], motion.f_b[rows]
        for step in steps:
            step(block)
    return ImuSamples(motion.t, gyro, accel, setup.spec), setup.bias, setup.constants


def _lever_arm(setup: Setup) -> list[Step]:
    arm = np.array(setup.spec.lever_arm_b)
    if not setup.on("lever_arm") or not arm.any():
        return []
    w, dt = setup.motion.w_ib_b, 1.0 / setup.spec.rate_hz
    alpha = np.gradient(w, dt, axis=0)
    return [lambda block: kernels.add_lever_arm(block.accel, w[block.rows], alpha[block.rows], arm)]


def _scale_and_misalignment(setup: Setup) -> list[Step]:
    steps: list[Step] = []
    for name, spec in setup.triads():
        matrix = np.eye(3)
        if setup.on("scale_factor") and spec.scale_factor:
            scale = spec.scale_factor * setup.draws.turn_on(f"imu.{name}.scale_factor").standard_normal(3)
            setup.constants[f"{name}_scale_factor"] = scale
            matrix = np.diag(1.0 + scale)
        if setup.on("misalignment") and (spec.misalignment or spec.nonorthogonality):
            turn = _misalignment_matrix(spec, setup.draws.turn_on(f"imu.{name}.misalignment"))
            setup.constants[f"{name}_misalignment"] = turn
            matrix = matrix @ turn
        if not np.array_equal(matrix, np.eye(3)):
            steps.append(_on_triad(name, kernels.apply_matrix, matrix))
    return steps


def _misalignment_matrix(spec: TriadSpec, rng: np.random.Generator) -> Array:
    """True vector in b to the components along the sensing axes: a small rotation, then axes that are not square.

    x of the triad is the reference; y leans to x, z to x and y, each pair by an angle of its own.
    """
    from testbed.physics.rotations import quat_to_matrix, rotvec_to_quat

    turn, lean = spec.misalignment * rng.standard_normal(3), spec.nonorthogonality * rng.standard_normal(3)
    axes = np.array([[1.0, 0.0, 0.0], [lean[0], 1.0, 0.0], [lean[1], lean[2], 1.0]])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return axes @ np.array(quat_to_matrix(rotvec_to_quat(turn))).T


def _nonlinearity(setup: Setup) -> list[Step]:
    steps: list[Step] = []
    for name, spec in setup.triads():
        if setup.on("nonlinearity") and spec.nonlinearity:
            sign = setup.draws.turn_on(f"imu.{name}.nonlinearity").choice([-1.0, 1.0], 3)
            amplitude = spec.nonlinearity * spec.range * sign
            setup.constants[f"{name}_nonlinearity"] = amplitude
            steps.append(_on_triad(name, kernels.add_chebyshev, amplitude, spec.range))
    return steps


def _g_sensitivity(setup: Setup) -> list[Step]:
    """Acts on the specific force as the accelerometers' scale and misalignment have left it: a second-order liberty."""
    sigma = setup.spec.gyro.g_sensitivity
    if not setup.on("g_sensitivity") or not sigma:
        return []
    matrix = sigma * setup.draws.turn_on("imu.gyro.g_sensitivity").standard_normal((3, 3))
    setup.constants["gyro_g_sensitivity"] = matrix
    return [lambda block: kernels.add_product(block.gyro, matrix, block.accel)]


def _slow_bias(setup: Setup) -> list[Step]:
    """Turn-on bias, bias instability, rate random walk and the bias of temperature: summed, then added in one pass."""
    steps: list[Step] = []
    for name, spec in setup.triads():
        process = slow_bias.draw(name, spec, setup.config, setup.motion.start, setup.motion.t[-1], setup.draws)
        setup.constants.update(process.constants)

        def step(block: Block, name: str = name, p: slow_bias.SlowBias = process) -> None:
            kernels.add_interpolated(block.triad(name), setup.bias[name][block.rows], block.t, p.start, p.step, p.knots)

        steps.append(step)
    return steps


def _white_noise(setup: Setup) -> list[Step]:
    steps: list[Step] = []
    for name, spec in setup.triads():
        if setup.on("white_noise") and spec.white_noise:
            rng, buffer = setup.draws.noise(f"imu.{name}.white_noise"), np.empty((BLOCK, 3))
            sigma = drawn_noise_sigma(spec, setup.spec.rate_hz, setup.on("quantisation"))

            def step(
                block: Block, name: str = name, sigma: float = sigma, rng: Any = rng, buffer: Array = buffer
            ) -> None:
                noise = buffer[: len(block.t)]
                rng.standard_normal(out=noise)
                kernels.add_scaled(block.triad(name), sigma, noise)

            steps.append(step)
    return steps


def drawn_noise_sigma(spec: TriadSpec, rate_hz: float, quantised: bool) -> float:
    """Standard deviation of the white noise that is drawn per sample.

    A data sheet's random walk is measured at the output, so it holds the quantisation error, LSB²/12 where the noise
    dithers it fully; only the rest is drawn.
    """
    variance = spec.white_noise**2 * rate_hz
    if quantised and variance > _FULLY_DITHERED * spec.resolution**2:
        variance -= spec.resolution**2 / 12.0
    return math.sqrt(variance)


def _scale_of_temperature(setup: Setup) -> list[Step]:
    steps: list[Step] = []
    profile = setup.config.temperature
    for name, spec in setup.triads():
        if setup.on("temperature") and profile is not None and spec.scale_temperature:
            drawn = spec.scale_temperature * setup.draws.turn_on(f"imu.{name}.scale_temperature").standard_normal(3)
            setup.constants[f"{name}_scale_temperature"] = drawn

            def step(block: Block, name: str = name, drawn: Array = drawn) -> None:
                kernels.scale_by_temperature(block.triad(name), drawn, slow_bias.kelvin(profile, block.t))

            steps.append(step)
    return steps


def _vibration(setup: Setup) -> list[Step]:
    if not setup.on("vibration") or setup.config.vibration is None:
        return []
    motion = setup.motion
    accel, gyro = vibration.generate(setup.config.vibration, motion.start, motion.t, motion.engine_rpm, setup.draws)

    def step(block: Block) -> None:
        kernels.add_scaled(block.accel, G0, accel[block.rows])
        kernels.add_scaled(block.gyro, math.radians(1.0), gyro[block.rows])

    return [step]


def _bandwidth(setup: Setup) -> list[Step]:
    """Second-order Butterworth. A bandwidth beyond half the sample rate has no effect on the samples of that rate."""
    steps: list[Step] = []
    for name, spec in setup.triads():
        if setup.on("bandwidth") and spec.bandwidth_hz < 0.5 * setup.spec.rate_hz:
            b, a = butterworth(spec.bandwidth_hz, setup.spec.rate_hz)
            state = np.full((3, 2), np.nan)

            def step(block: Block, name: str = name, b: Array = b, a: Array = a, state: Array = state) -> None:
                x = block.triad(name)
                if np.isnan(state[0, 0]):  # start settled on the first sample
                    state[:, 0], state[:, 1] = (1.0 - b[0]) * x[0], (b[2] - a[2]) * x[0]
                kernels.second_order_filter(x, b, a, state)

            steps.append(step)
    return steps


def butterworth(bandwidth_hz: float, rate_hz: float) -> tuple[Array, Array]:
    """Coefficients b, a of a second-order Butterworth low-pass, bilinear with the -3 dB frequency kept.

    Its gain at f is 1/sqrt(1 + (tan(pi f/rate) / tan(pi bandwidth/rate))⁴).
    """
    k = math.tan(math.pi * bandwidth_hz / rate_hz)
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    b0 = k * k * norm
    return np.array([b0, 2.0 * b0, b0]), np.array(
        [1.0, 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm]
    )


def _saturation(setup: Setup) -> list[Step]:
    limited = [(name, spec.range) for name, spec in setup.triads() if math.isfinite(spec.range)]
    return [_on_triad(name, kernels.saturate, limit) for name, limit in limited if setup.on("saturation")]


def _quantisation(setup: Setup) -> list[Step]:
    coarse = [(name, spec.resolution) for name, spec in setup.triads() if spec.resolution]
    return [_on_triad(name, kernels.quantise, lsb) for name, lsb in coarse if setup.on("quantisation")]


def _on_triad(name: str, kernel: Callable[..., None], *parameters: Any) -> Step:
    """A step that is one kernel on one triad."""
    return lambda block: kernel(block.triad(name), *parameters)


CHAIN: tuple[Callable[[Setup], list[Step]], ...] = (
    _lever_arm,
    _scale_and_misalignment,
    _nonlinearity,
    _g_sensitivity,
    _slow_bias,
    _white_noise,
    _scale_of_temperature,
    _vibration,
    _bandwidth,
    _saturation,
    _quantisation,
)
"""Builders of the steps, in the order in which the steps act."""


def motion_of(trajectory: Trajectory, rate_hz: float | None) -> Motion:
    """The true motion of a flight at the IMU's rate, of which the trajectory's must be a whole multiple.

    The mean over a long interval is the mean of the means over its parts, so nothing is lost. Raises InputError for a rate
    that the trajectory cannot give.
    """
    rate = 1.0 / trajectory.dt
    ratio = rate / rate_hz if rate_hz is not None else 1.0
    parts = round(ratio)
    if parts < 1 or abs(ratio / parts - 1.0) > 1e-6:
        raise InputError(
            f"[sensors.imu] rate_hz: {rate_hz:g} Hz cannot be had from a trajectory of {rate:g} Hz;"
            f" set flight.rate_hz to a whole multiple of {rate_hz:g}"
        )
    n = (len(trajectory.t) - 1) // parts
    if n < 2:
        raise InputError(f"[sensors.imu] rate_hz: the flight is too short for two samples at {rate_hz:g} Hz")
    rpm = trajectory.extra.get("engine_rpm")

    def means(values: Array) -> Array:
        inside = values[1 : n * parts + 1]
        return inside if parts == 1 else inside.reshape(n, parts, -1).mean(axis=1).reshape(n, *values.shape[1:])

    return Motion(
        float(trajectory.t[0]),
        trajectory.t[parts : n * parts + 1 : parts],
        means(trajectory.w_ib_b),
        means(trajectory.f_b),
        None if rpm is None else means(rpm),
    )
