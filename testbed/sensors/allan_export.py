"""Fitted noise figures in the words of others: a catalogue entry of this bench, and the parameters of well-known tools.

Sources of the units: kalibr's IMU noise model page; GTSAM's PreintegrationCombinedParams (continuous covariances); KF-GINS's
example configuration; NaveGo's imu_si_errors; PX4's parameter reference and EKF2 (a step of dt adds (dt noise)² to the
covariance, so its figures are per sample at the filter's rate); MATLAB's gyroparams and accelparams. SI inside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.schema import dump_toml
from testbed.data.specs import GAUSS_MARKOV_PEAK
from testbed.physics.earth import G0
from testbed.sensors.allan import Pooled

if TYPE_CHECKING:
    from testbed.data.records import SensorLog

PX4_RATE_HZ = 100.0
"""EKF2_PREDICT_US is 10 ms."""
_DEG = 180.0 / math.pi


@dataclass(frozen=True)
class Words:
    """One tool: (parameter, value, unit) for gyro and accelerometer."""

    tool: str
    rows: list[tuple[str, float, str]]


def entry(name: str, log: SensorLog, pooled: Pooled) -> str:
    """TOML text of a catalogue ``[imu.NAME]``, to be named by ``file`` and ``model`` in a scenario."""
    table: dict[str, Any] = {
        "source": f"Allan analysis of {log.name or 'a record'}, {log.imu.t[-1] - log.initial.t:.0f} s at rest",
        "rate_hz": float(np.round(log.imu.spec.rate_hz, 3)),
    }
    offset = float(np.sqrt(np.mean(log.imu.gyro.mean(axis=0) ** 2)))
    table |= {
        "gyro_turn_on_bias_dps": _digits(offset * _DEG),
        "gyro_arw_dpsqrth": _digits(60.0 * _DEG * pooled.gyro.white_noise),
    }
    table |= _slow("gyro", pooled.gyro, "dph", 3600.0 * _DEG, "dpsqrth3", 3600.0**1.5 * _DEG)
    excess = abs(float(np.linalg.norm(log.imu.accel.mean(axis=0))) - G0)
    table |= {
        "accel_turn_on_bias_mg": _digits(1e3 * excess / G0),
        "accel_vrw_mpspsqrth": _digits(60.0 * pooled.accel.white_noise),
    }
    table |= _slow("accel", pooled.accel, "mg", 1e3 / G0, "mpspsqrth3", 3600.0**1.5)
    remark = (
        "# turn-on biases are what this one record shows of them: the mean rate (Earth's 15 deg/h in it), and the size of\n"
        "# gravity; several starts tell more. Figures that the record does not tell apart from zero are left out.\n"
    )
    return remark + dump_toml({"imu": {name: table}})


def _slow(triad: str, figures: Any, unit: str, factor: float, walk_unit: str, walk_factor: float) -> dict[str, float]:
    out = {}
    if figures.bias_instability:
        out[f"{triad}_bias_instability_{unit}"] = _digits(factor * figures.bias_instability)
        out[f"{triad}_correlation_time_s"] = _digits(figures.correlation_time_s)
    if figures.rate_random_walk:
        out[f"{triad}_rrw_{walk_unit}"] = _digits(walk_factor * figures.rate_random_walk)
    return out


def _digits(value: float) -> float:
    """Four digits: the figures of an hour's record are good to a percent."""
    return float(f"{value:.4g}")


def driving(figures: Any) -> float:
    """u/√s: the random walk of the bias for tools that know no other: its own, or what a Gauss-Markov process is driven by."""
    if figures.rate_random_walk:
        return float(figures.rate_random_walk)
    sigma = figures.bias_instability / GAUSS_MARKOV_PEAK
    return float(sigma * math.sqrt(2.0 / figures.correlation_time_s)) if figures.correlation_time_s else 0.0


def in_words_of_others(rate_hz: float, pooled: Pooled) -> list[Words]:
    """The figures for each tool, first those of a sample at ``rate_hz``."""
    g, a = pooled.gyro, pooled.accel
    kg, ka, root = driving(g), driving(a), math.sqrt(rate_hz)
    g_sigma, a_sigma = g.bias_instability / GAUSS_MARKOV_PEAK, a.bias_instability / GAUSS_MARKOV_PEAK
    px4 = math.sqrt(PX4_RATE_HZ)
    return [
        Words(
            f"one sample at {rate_hz:g} Hz (discrete)",
            [
                ("gyro noise", g.white_noise * root, "rad/s"),
                ("gyro bias step", kg / root, "rad/s"),
                ("accel noise", a.white_noise * root, "m/s^2"),
                ("accel bias step", ka / root, "m/s^2"),
            ],
        ),
        Words(
            "kalibr (continuous)",
            [
                ("gyroscope_noise_density", g.white_noise, "rad/s/sqrt(Hz)"),
                ("gyroscope_random_walk", kg, "rad/s^2/sqrt(Hz)"),
                ("accelerometer_noise_density", a.white_noise, "m/s^2/sqrt(Hz)"),
                ("accelerometer_random_walk", ka, "m/s^3/sqrt(Hz)"),
                ("update_rate", rate_hz, "Hz"),
            ],
        ),
        Words(
            "GTSAM (continuous)",
            [
                ("gyroscopeCovariance", g.white_noise**2, "(rad/s)^2/Hz"),
                ("accelerometerCovariance", a.white_noise**2, "(m/s^2)^2/Hz"),
                ("biasOmegaCovariance", kg**2, "(rad/s^2)^2/Hz"),
                ("biasAccCovariance", ka**2, "(m/s^3)^2/Hz"),
            ],
        ),
        Words(
            "KF-GINS",
            [
                ("arw", 60.0 * _DEG * g.white_noise, "deg/sqrt(h)"),
                ("vrw", 60.0 * a.white_noise, "m/s/sqrt(h)"),
                ("gbstd", 3600.0 * _DEG * g_sigma, "deg/h"),
                ("abstd", 1e5 * a_sigma, "mGal"),
                ("corrtime", (g.correlation_time_s or a.correlation_time_s) / 3600.0, "h"),
            ],
        ),
        Words(
            "NaveGo",
            [
                ("arw", g.white_noise, "rad/s/sqrt(Hz)"),
                ("vrw", a.white_noise, "m/s^2/sqrt(Hz)"),
                ("gb_dyn", g_sigma, "rad/s"),
                ("ab_dyn", a_sigma, "m/s^2"),
                ("gb_corr", g.correlation_time_s, "s"),
                ("ab_corr", a.correlation_time_s, "s"),
                ("arrw", g.rate_random_walk, "rad/s^2/sqrt(Hz)"),
                ("vrrw", a.rate_random_walk, "m/s^3/sqrt(Hz)"),
            ],
        ),
        Words(
            "PX4 (discrete, 100 Hz)",
            [
                ("EKF2_GYR_NOISE", g.white_noise * px4, "rad/s"),
                ("EKF2_ACC_NOISE", a.white_noise * px4, "m/s^2"),
                ("EKF2_GYR_B_NOISE", kg * px4, "rad/s^2"),
                ("EKF2_ACC_B_NOISE", ka * px4, "m/s^3"),
            ],
        ),
        Words(
            "MATLAB (continuous)",
            [
                ("gyroparams NoiseDensity", g.white_noise, "rad/s/sqrt(Hz)"),
                ("gyroparams BiasInstability", g.bias_instability, "rad/s"),
                ("gyroparams RandomWalk", g.rate_random_walk, "rad/s*sqrt(Hz)"),
                ("accelparams NoiseDensity", a.white_noise, "m/s^2/sqrt(Hz)"),
                ("accelparams BiasInstability", a.bias_instability, "m/s^2"),
                ("accelparams RandomWalk", a.rate_random_walk, "m/s^2*sqrt(Hz)"),
            ],
        ),
    ]


def text(words: list[Words]) -> str:
    """The figures as lines under each tool's name."""
    lines = []
    for tool in words:
        lines.append(tool.tool)
        lines += [
            f"  {name:28s} {f'{value:.4g}' if value else 'not seen':>12s}  {unit}" for name, value, unit in tool.rows
        ]
    return "\n".join(lines) + "\n"
