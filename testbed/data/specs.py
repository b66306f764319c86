"""Sensor specifications in SI units: what a data sheet promises and a filter may know.

A catalogue entry or scenario table (data-sheet units) becomes one of these; a `SensorLog` carries them. Every figure
defaults to zero (or no limit), which is the ideal sensor. ``sigma`` figures are one standard deviation over units.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any

Vector = tuple[float, float, float]

GAUSS_MARKOV_PEAK = 0.61736
"""Peak of the Allan deviation of a first-order Gauss-Markov process, over its sigma; it lies at 1.893 correlation times."""


@dataclass(frozen=True)
class TriadSpec:
    """Three gyros (unit u = rad/s) or three accelerometers (u = m/s²)."""

    turn_on_bias: float = 0.0
    """Constant bias drawn at switch-on, u, 1 sigma."""
    true_bias: Vector | None = None
    """Known constant bias instead of a drawn one, u (never told to a filter)."""
    bias_instability: float = 0.0
    """In-run bias stability: the flat of the Allan deviation, u."""
    correlation_time_s: float = 200.0
    """Of the first-order Gauss-Markov process that makes the bias instability."""
    white_noise: float = 0.0
    """Noise density: angle or velocity random walk, u/√Hz."""
    rate_random_walk: float = 0.0
    """u/√s."""
    scale_factor: float = 0.0
    """Relative scale error, 1 sigma per axis."""
    misalignment: float = 0.0
    """Rotation of the triad against the frame, rad, 1 sigma per axis."""
    nonorthogonality: float = 0.0
    """Axis to axis, rad, 1 sigma per pair."""
    nonlinearity: float = 0.0
    """Largest departure from a straight line over the range, relative to the range."""
    g_sensitivity: float = 0.0
    """Gyro output per acceleration, (rad/s)/(m/s²), 1 sigma per axis."""
    bias_temperature: float = 0.0
    """u/K, 1 sigma per axis."""
    scale_temperature: float = 0.0
    """1/K, 1 sigma per axis."""
    bandwidth_hz: float = math.inf
    """-3 dB frequency."""
    range: float = math.inf
    """Output saturates at ± this, u."""
    resolution: float = 0.0
    """One least significant bit, u."""

    def gauss_markov_sigma(self) -> float:
        """Steady-state sigma (u) of the Gauss-Markov bias whose Allan deviation peaks at ``bias_instability``.

        IEEE Std 952-1997, eq. C.16, maximised numerically: see `GAUSS_MARKOV_PEAK`.
        """
        return self.bias_instability / GAUSS_MARKOV_PEAK


@dataclass(frozen=True)
class ImuSpec:
    """Inertial measurement unit."""

    name: str = "ideal"
    rate_hz: float = 100.0
    gyro: TriadSpec = field(default_factory=TriadSpec)
    accel: TriadSpec = field(default_factory=TriadSpec)
    lever_arm_b: Vector = (0.0, 0.0, 0.0)
    """From the reference point of the trajectory to the IMU, m, in b."""


@dataclass(frozen=True)
class SignalSpec:
    """What a receiver makes of satellite signals; C/N0 in dB-Hz. Sigmas of zero are the ideal receiver."""

    cn0_zenith: float = 47.0
    """C/N0 of an open signal along the antenna's axis."""
    pattern_drop: float = 15.0
    """By which the antenna's gain has fallen at 90 degrees from its axis, dB."""
    mask: float = math.radians(5.0)
    """Satellites below this elevation are not used, rad."""
    dll_bandwidth_hz: float = 0.0
    """Of the code loop, one-sided; 0: no code noise."""
    correlator_chips: float = 0.5
    """Early to late."""
    rate_sigma: float = 0.0
    """White noise of a range rate at 45 dB-Hz, m/s; it grows as the square root of the noise."""
    multipath_zenith: float = 0.0
    """Gauss-Markov code multipath far above the horizon, m."""
    multipath_horizon: float = 0.0
    """What is added at the horizon, m; it falls by e every ``multipath_angle``."""
    multipath_angle: float = math.radians(10.0)
    """rad"""
    multipath_time_s: float = 25.0
    clock_h0_s: float = 0.0
    """White frequency noise of the oscillator, the h0 of its Allan variance, s."""
    clock_hm2_ps: float = 0.0
    """Random walk of its frequency, h-2, 1/s."""

    def clock_densities(self) -> tuple[float, float]:
        """Spectral densities of clock noise (m²/s) and of its drift's (m²/s³): Brown and Hwang, 4th ed., section 9.3."""
        c = 299792458.0
        return c * c * self.clock_h0_s / 2.0, c * c * 2.0 * math.pi**2 * self.clock_hm2_ps


@dataclass(frozen=True)
class SpaceSpec:
    """What is known of the errors that signals arrive with, 1 sigma: for filters that use them."""

    gps_sigma: float = 0.0
    """Orbit and clock of a GPS satellite, m."""
    gps_time_s: float = 36000.0
    galileo_sigma: float = 0.0
    """m"""
    galileo_time_s: float = 5400.0
    iono_sigma: float = 0.0
    """At zenith, what the broadcast model leaves, m."""
    iono_time_s: float = 1800.0
    tropo_sigma: float = 0.0
    """At zenith, m."""
    tropo_time_s: float = 1800.0


@dataclass(frozen=True)
class GnssSpec:
    """GNSS receiver that gives position and velocity in n; sigmas are per axis."""

    name: str = "ideal"
    rate_hz: float = 5.0
    horizontal_sigma: float = 0.0
    """White position noise north and east, m."""
    vertical_sigma: float = 0.0
    """White height noise, m."""
    horizontal_markov_sigma: float = 0.0
    """Gauss-Markov position error north and east, m."""
    vertical_markov_sigma: float = 0.0
    """m."""
    markov_time_s: float = 60.0
    velocity_sigma: float = 0.0
    """White velocity noise north, east and down, m/s."""
    lever_arm_b: Vector = (0.0, 0.0, 0.0)
    """From the IMU to the antenna, m, in b."""
    latency_s: float = 0.0
    """A fix is stamped this long after the moment that it describes."""
    signals: SignalSpec = field(default_factory=SignalSpec)
    """Of a receiver that is simulated down to the satellites."""
    space: SpaceSpec = field(default_factory=SpaceSpec)


@dataclass(frozen=True)
class MagSpec:
    """Three-axis magnetometer; fields in µT."""

    name: str = "ideal"
    rate_hz: float = 50.0
    noise_sigma: float = 0.0
    """White noise per sample, µT."""
    turn_on_bias: float = 0.0
    """Hard iron left after calibration, µT, 1 sigma per axis."""
    soft_iron: float = 0.0
    """Elements of the soft-iron matrix, relative, 1 sigma."""
    misalignment: float = 0.0
    """rad, 1 sigma per axis."""
    range: float = math.inf
    """µT."""
    resolution: float = 0.0
    """µT."""
    declination: float = 0.0
    """Of the local field, rad east: what a map gives to the filter."""
    field_n: Vector = (20.0, 0.0, 45.0)
    """Local field in n at the start, µT."""


@dataclass(frozen=True)
class BaroSpec:
    """Barometer; pressures in Pa."""

    name: str = "ideal"
    rate_hz: float = 10.0
    noise_sigma: float = 0.0
    """White noise per sample, Pa."""
    turn_on_bias: float = 0.0
    """Pa, 1 sigma."""
    drift: float = 0.0
    """Random walk, Pa/√s."""
    minimum: float = 0.0
    """Pa."""
    maximum: float = math.inf
    """Pa."""
    resolution: float = 0.0
    """Pa."""


def to_dict(spec: Any) -> dict[str, Any]:
    """A specification as plain data that JSON can hold; infinite limits are left out."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: clean(v) for k, v in value.items() if not (isinstance(v, float) and math.isinf(v))}
        return list(value) if isinstance(value, tuple) else value

    return clean(asdict(spec))


def from_dict(kind: type, data: dict[str, Any]) -> Any:
    """Inverse of `to_dict` for a specification class. Raises TypeError on an unknown key or a wrong type."""
    defaults = kind()
    values: dict[str, Any] = {}
    for key, value in data.items():
        current = getattr(defaults, key, None)
        if is_dataclass(current):
            values[key] = from_dict(type(current), value)
        else:
            values[key] = tuple(value) if isinstance(value, list) else value
            _check_kind(f"{kind.__name__}.{key}", current, values[key])
    unknown = set(values) - {f.name for f in fields(kind)}
    if unknown:
        raise TypeError(f"{kind.__name__} has no field {', '.join(sorted(unknown))}")
    return kind(**values)


def _check_kind(name: str, usual: Any, value: Any) -> None:
    """Raises TypeError where ``value`` is not of the kind of the default ``usual`` (None: three numbers, or nothing)."""

    def number(v: Any) -> bool:
        return isinstance(v, int | float) and not isinstance(v, bool) and not math.isnan(v)

    if isinstance(usual, str):
        right, wanted = isinstance(value, str), "a text"
    elif isinstance(usual, tuple) or usual is None:
        three = isinstance(value, tuple) and len(value) == 3 and all(number(v) for v in value)
        right, wanted = three or (usual is None and value is None), "three numbers"
    else:
        right, wanted = number(value), "a number"
    if not right:
        raise TypeError(f"{name} should be {wanted}, is {value!r:.60}")
