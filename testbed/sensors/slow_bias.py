"""The slowly changing bias of a triad: turn-on bias, bias instability, rate random walk, temperature.

Drawn at knots of 10 Hz (finer for short correlation times) with exact discretisation and linear in between: the bias
changes so slowly that the samples cannot tell. Groves, 2nd ed., section 4.4.1; IEEE Std 952-1997, annex C. SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from testbed.data.records import Array
from testbed.data.specs import TriadSpec
from testbed.sensors import kernels
from testbed.sensors.config import ImuConfig, Temperature
from testbed.sensors.draws import Draws

KNOT_INTERVAL_S = 0.1
KNOTS_PER_CORRELATION_TIME = 100


@dataclass(frozen=True)
class SlowBias:
    """A piecewise linear process: ``knots`` (m,3) from ``start`` every ``step`` seconds."""

    start: float
    step: float
    knots: Array
    constants: dict[str, Any] = field(default_factory=dict)


def draw(name: str, spec: TriadSpec, config: ImuConfig, start: float, end: float, draws: Draws) -> SlowBias:
    """The bias of triad ``name`` (``gyro`` or ``accel``) from ``start`` to ``end``, s."""
    step = min(KNOT_INTERVAL_S, spec.correlation_time_s / KNOTS_PER_CORRELATION_TIME)
    knots = np.zeros((math.ceil((end - start) / step) + 2, 3))
    constants: dict[str, Any] = {}
    off = config.disable
    if "turn_on_bias" not in off:
        constants[f"{name}_turn_on_bias"] = turn_on_bias(spec, draws.turn_on(f"imu.{name}.turn_on_bias"))
        knots += constants[f"{name}_turn_on_bias"]
    if "bias_instability" not in off and spec.bias_instability:
        rng = draws.noise(f"imu.{name}.bias_instability")
        knots += gauss_markov(len(knots), spec.gauss_markov_sigma(), spec.correlation_time_s, step, rng)
    if "rate_random_walk" not in off and spec.rate_random_walk:
        rng = draws.noise(f"imu.{name}.rate_random_walk")
        knots[1:] += np.cumsum(
            spec.rate_random_walk * math.sqrt(step) * rng.standard_normal((len(knots) - 1, 3)), axis=0
        )
    if "temperature" not in off and config.temperature is not None and spec.bias_temperature:
        per_kelvin = spec.bias_temperature * draws.turn_on(f"imu.{name}.bias_temperature").standard_normal(3)
        constants[f"{name}_bias_temperature"] = per_kelvin
        knots += np.outer(
            kelvin(config.temperature, start + step * np.arange(len(knots), dtype=np.float64)), per_kelvin
        )
    return SlowBias(start, step, knots, constants)


def turn_on_bias(spec: TriadSpec, rng: np.random.Generator) -> Array:
    """The constant bias (3,): drawn, unless the specification knows it."""
    drawn = spec.turn_on_bias * rng.standard_normal(3)
    return drawn if spec.true_bias is None else np.array(spec.true_bias)


def gauss_markov(n: int, sigma: float, correlation_time: float, step: float, rng: np.random.Generator) -> Array:
    """(n,3) first-order Gauss-Markov process in its steady state, sampled every ``step`` seconds."""
    process = rng.standard_normal((n, 3))
    decay = math.exp(-step / correlation_time)
    kernels.markov(process, decay, math.sqrt(1.0 - decay * decay))
    process *= sigma
    return process


def kelvin(profile: Temperature, t: Array) -> Array:
    """Temperature above the reference at times ``t``, K."""
    return np.interp(t, profile.time_s, profile.celsius) - profile.reference_celsius
