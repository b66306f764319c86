"""The odometer: speed of a wheel along the vehicle's forward axis, counted in pulses of the turning wheel.

Model after Groves, 2nd ed., section 6.2 (scale error from the tyre's radius, quantisation by the encoder). A sample is the
mean speed over a counting interval and describes its middle; it is stamped ``latency_s`` later. SI units; b is
forward-right-down; the wheel rolls without slip unless the truth says how much (column ``wheel_slip``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from testbed.base.errors import InputError
from testbed.data.records import Array, Samples, Trajectory
from testbed.data.specs import Vector
from testbed.sensors.config import SensorTable, Triple
from testbed.sensors.draws import Draws
from testbed.sensors.sensor import Column, Sensor


@dataclass(frozen=True)
class OdometerSpec:
    """Wheel-speed sensor."""

    name: str = "ideal"
    rate_hz: float = 10.0
    scale_factor: float = 0.0
    """Relative scale error (tyre radius, pressure, load), 1 sigma over vehicles."""
    misalignment: float = 0.0
    """Of the rolling direction against the IMU's forward axis, up and sideways, rad, 1 sigma per axis."""
    noise_sigma: float = 0.0
    """White noise per sample, m/s."""
    pulse_length: float = 0.0
    """Way per pulse of the encoder, m; 0: not counted in pulses."""
    lever_arm_b: Vector = (0.0, 0.0, 0.0)
    """From the IMU to where the wheel touches the ground, m, in b."""
    latency_s: float = 0.0
    """A sample is stamped this long after the moment that it describes, the middle of its counting interval."""

    def measurement_std(self) -> float:
        """1 sigma of a sample, m/s: noise, and a rounding error of variance pulse²/12 at each end of the interval.

        That is the mean over speeds: at a steady one the count alternates, with a variance up to half as much again.
        """
        return math.hypot(self.noise_sigma, self.pulse_length * self.rate_hz / math.sqrt(6.0))


class OdometerConfig(SensorTable):
    """``[sensors.odometer]``"""

    kind: ClassVar[str] = "odometer"
    rate_hz: float | None = Field(
        default=None, gt=0, le=1000, description="Samples per second; default: the catalogue's, Hz"
    )
    lever_arm_m: Triple = Field(
        default=(0.0, 0.0, 0.0), description="From the IMU to the wheel's contact point, forward, right, down, m"
    )

    def spec(self) -> OdometerSpec:
        """The specification."""
        return replace(self._figures(), lever_arm_b=self.lever_arm_m)


@dataclass(frozen=True, repr=False)
class OdometerSamples(Samples):
    """``t`` (M,), ``speed`` (M,) m/s along the rolling direction, negative backwards."""

    speed: Array
    spec: OdometerSpec
    kind: ClassVar[str] = "odometer"
    shapes: ClassVar[Mapping[str, tuple[int | None, ...]]] = {"speed": ()}


def sense_odometer(
    config: OdometerConfig, trajectory: Trajectory, draws: Draws, arm_b: Vector
) -> tuple[OdometerSamples, dict[str, Any]]:
    """Samples, and the drawn scale error and mounting angles (up, sideways; rad)."""
    from testbed.physics.interpolate import sample_times

    spec = config.spec()
    ends = sample_times(trajectory, spec.rate_hz)
    stamps = ends - 0.5 / spec.rate_hz + spec.latency_s
    seen = stamps <= trajectory.t[-1]
    if not seen.any():
        raise InputError(f"[sensors.odometer] rate_hz: the motion is too short for a sample at {spec.rate_hz:g} Hz")
    mount = spec.misalignment * draws.turn_on("odometer.misalignment").standard_normal(2)
    scale = spec.scale_factor * float(draws.turn_on("odometer.scale_factor").standard_normal())
    edges = np.concatenate([trajectory.t[:1], ends])
    way = (1.0 + scale) * _way(trajectory, edges, np.array(arm_b) + np.array(spec.lever_arm_b), mount)
    if spec.pulse_length:
        phase = draws.turn_on("odometer.phase").uniform()
        way = spec.pulse_length * np.floor(way / spec.pulse_length + phase)
    speed = np.diff(way) * spec.rate_hz
    speed += spec.noise_sigma * draws.noise("odometer.white").standard_normal(len(speed))
    drawn = {"odometer_scale_factor": scale, "odometer_misalignment": mount}
    return OdometerSamples(stamps[seen], speed[seen], spec), drawn


def _way(trajectory: Trajectory, t: Array, arm_b: Array, mount: Array) -> Array:
    """Way (m) that the wheel has rolled at the times ``t``: integral of its speed along the rolling direction."""
    from scipy.interpolate import CubicSpline

    from testbed.physics.interpolate import point_state
    from testbed.physics.rotations import quat_to_matrix, quats_to_matrices, rotvec_to_quat

    _, _, _, v_n = point_state(trajectory, trajectory.t, arm_b)
    direction_b = np.array(quat_to_matrix(rotvec_to_quat(np.array([0.0, mount[0], mount[1]]))))[:, 0]
    forward = np.einsum("ki,ki->k", quats_to_matrices(trajectory.q_nb) @ direction_b, v_n)
    if (slip := trajectory.extra.get("wheel_slip")) is not None:
        forward = forward * (1.0 + slip)
    return np.asarray(CubicSpline(trajectory.t, forward).antiderivative()(t))


SENSOR = Sensor(
    kind="odometer",
    title="Odometer",
    spec=OdometerSpec,
    config=OdometerConfig,
    samples=OdometerSamples,
    sense=sense_odometer,
    columns=(Column("speed", "speed_mps", "speed"),),
    rows={
        "scale_factor": ("Scale factor, 1σ", 100.0, "%"),
        "misalignment": ("Mounting angles, 1σ", math.degrees(1.0), "°"),
        "noise_sigma": ("Noise, 1σ", 1.0, "m/s"),
        "pulse_length": ("Way per pulse", 1e3, "mm"),
        "lever_arm_b": ("Lever arm, body axes", 1.0, "m"),
        "latency_s": ("Latency", 1.0, "s"),
    },
    figures={
        "scale_factor_pct": ("scale_factor", 1e-2),
        "misalignment_deg": ("misalignment", math.radians(1.0)),
        "noise_mps": ("noise_sigma", 1.0),
        "pulse_mm": ("pulse_length", 1e-3),
        "latency_s": ("latency_s", 1.0),
    },
    catalogue={
        "car": {
            "source": "assumed: 96 pulses to a turn of a wheel of 2 m, its radius known to 1 % (pressure, load, wear)",
            "rate_hz": 10.0,
            "pulse_mm": 20.8,
            "scale_factor_pct": 1.0,
            "misalignment_deg": 0.5,
            "noise_mps": 0.02,
            "latency_s": 0.05,
            "assumed": ["pulse_mm", "scale_factor_pct", "misalignment_deg", "noise_mps", "latency_s", "rate_hz"],
        }
    },
)
