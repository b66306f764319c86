"""Allan deviation of inertial sensors, and the random-walk and bias figures that it holds.

Overlapping Allan deviation by the package allantools (Riley, NIST SP 1065); model curve of white noise, first-order
Gauss-Markov bias and rate random walk after IEEE Std 952-1997, annex C. Samples in rad/s or m/s², cluster times in s.

The fit is a weighted nonlinear least squares of the model's Allan variance to the measured one, both in logarithms, with
weights from the number of independent clusters. Neighbouring cluster times are correlated, which the least squares does
not know; so the stated uncertainties come from the sampling theory of each process, not from the residuals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.errors import InputError
from testbed.files import write_with
from testbed.records import Array, SensorLog
from testbed.specs import GAUSS_MARKOV_PEAK, TriadSpec

if TYPE_CHECKING:
    import pandas as pd

POINTS_PER_OCTAVE = 3
FEWEST_CLUSTERS = 5
"""Cluster times reach to this part of the record."""


@dataclass(frozen=True)
class Curve:
    """Overlapping Allan deviation: cluster times ``tau`` (m,), ``deviation`` (m,), and the clusters that fit (m,)."""

    tau: Array
    deviation: Array
    clusters: Array


@dataclass(frozen=True)
class Figures:
    """Fitted coefficients, each with a 1-sigma uncertainty. Units u, u·√s, u/√s for samples of unit u."""

    white_noise: float
    bias_instability: float
    correlation_time_s: float
    rate_random_walk: float
    white_noise_std: float
    bias_instability_std: float
    rate_random_walk_std: float


def allan_deviation(samples: Array, rate_hz: float) -> Curve:
    """Overlapping Allan deviation of one axis (n,)."""
    import allantools

    n = len(samples)
    sizes = np.unique(
        np.round(2.0 ** np.arange(0.0, math.log2(n / FEWEST_CLUSTERS), 1.0 / POINTS_PER_OCTAVE)).astype(int)
    )
    # Without its mean the integrated phase keeps its digits.
    centred = np.asarray(samples, dtype=np.float64) - np.mean(samples)
    tau, deviation, _, _ = allantools.oadev(centred, rate=rate_hz, data_type="freq", taus=sizes / rate_hz)
    return Curve(tau, deviation, n / sizes - 1.0)


def pooled(curves: list[Curve]) -> Curve:
    """The curve of several axes of one kind: the root of their mean Allan variance."""
    variance = np.mean([curve.deviation**2 for curve in curves], axis=0)
    return Curve(curves[0].tau, np.sqrt(variance), np.sum([curve.clusters for curve in curves], axis=0))


def model_deviation(tau: Array, white_noise: float, markov_sigma: float, correlation_time: float, rrw: float) -> Array:
    """Allan deviation of white noise + Gauss-Markov + rate random walk. IEEE Std 952-1997 eq. C.7, C.16 and C.11."""
    return np.sqrt(white_noise**2 / tau + markov_sigma**2 * _markov_shape(tau / correlation_time) + rrw**2 * tau / 3.0)


def _markov_shape(x: Array) -> Array:
    """Allan variance of a first-order Gauss-Markov process of sigma 1 at ``x`` correlation times; a series near zero."""
    x = np.asarray(x, dtype=np.float64)
    small = x < 0.02
    safe = np.where(small, 1.0, x)
    exact = 2.0 / safe - (3.0 - 4.0 * np.exp(-safe) + np.exp(-2.0 * safe)) / safe**2
    return np.where(small, x * (2.0 / 3.0 - 0.5 * x + 7.0 / 30.0 * x * x), exact)


def fit_allan(curve: Curve, duration_s: float, axes: int = 1, markov: bool = True, walk: bool = True) -> Figures:
    """Coefficients of the model from the curve of ``axes`` axes, each recorded for ``duration_s``.

    ``markov=False`` and ``walk=False`` leave out a process that the sensor is known not to have. Bias instability is the
    peak of the fitted Gauss-Markov part: the flat that white noise and random walk leave.
    """
    from scipy.optimize import least_squares

    tau = curve.tau
    if not (curve.deviation > 0.0).all():
        return Figures(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    target, weight = 2.0 * np.log(curve.deviation), np.sqrt(0.5 * curve.clusters)
    white, floor = float(curve.deviation[0] * math.sqrt(tau[0])), float(curve.deviation.min())
    slope = floor / math.sqrt(tau[-1])
    # Rows: white noise, Gauss-Markov sigma, correlation time, rate random walk; columns: lower bound, upper bound.
    bounds = np.array(
        [[1e-3 * white, 1e3 * white], [1e-4 * floor, 1e2 * floor], [2.0 * tau[0], tau[-1]], [1e-5 * slope, 1e3 * slope]]
    )
    free = np.array([True, markov, markov, walk])

    def coefficients(p: Array) -> Array:
        full = np.array([0.0, 0.0, 1.0, 0.0])
        full[free] = np.exp(p)
        return full

    def residuals(p: Array) -> Array:
        return weight * (2.0 * np.log(model_deviation(tau, *coefficients(p))) - target)

    guesses = [t for t in (10.0, 50.0, 200.0, 1000.0) if bounds[2, 0] < t < bounds[2, 1]] if markov else [1.0]
    starts = [np.array([white, floor, guess, slope]) for guess in guesses or [float(np.sqrt(bounds[2].prod()))]]
    log_bounds = np.log(bounds[free]).T
    fits = [least_squares(residuals, np.log(start[free]), bounds=log_bounds, x_scale=0.1) for start in starts]
    n, sigma, time, rrw = coefficients(min(fits, key=lambda fit: fit.cost).x)
    total = axes * duration_s
    return Figures(
        float(n),
        float(GAUSS_MARKOV_PEAK * sigma),
        float(time) if markov else 0.0,
        float(rrw),
        white_noise_std=float(n * math.sqrt(tau[0] / (2.0 * total))),
        bias_instability_std=float(GAUSS_MARKOV_PEAK * sigma * math.sqrt(time / (2.0 * total))),
        rate_random_walk_std=_walk_std(n, sigma, time, rrw, duration_s, axes),
    )


def _walk_std(white: float, sigma: float, time: float, rrw: float, duration_s: float, axes: int) -> float:
    """Periodogram lines at which the walk rules the spectrum decide: each gives its variance to 100 %."""
    if rrw == 0.0:
        return 0.0
    rest = white**2 + 2.0 * sigma**2 * time
    lines = max(1.0, axes * duration_s * rrw / (2.0 * math.pi * math.sqrt(rest)))
    return rrw / (2.0 * math.sqrt(lines))


@dataclass(frozen=True)
class _Unit:
    """How a figure is printed: its name, its unit and the factor from SI."""

    name: str
    unit: str
    factor: float


def _units(triad: str) -> dict[str, _Unit]:
    from testbed.earth import G0

    deg = 180.0 / math.pi
    if triad == "gyro":
        return {
            "white_noise": _Unit("ARW", "deg/sqrt(h)", 60.0 * deg),
            "bias_instability": _Unit("bias instability", "deg/h", 3600.0 * deg),
            "rate_random_walk": _Unit("RRW", "deg/sqrt(h3)", 3600.0**1.5 * deg),
        }
    return {
        "white_noise": _Unit("VRW", "m/s/sqrt(h)", 60.0),
        "bias_instability": _Unit("bias instability", "mg", 1e3 / G0),
        "rate_random_walk": _Unit("RRW", "m/s/sqrt(h3)", 3600.0**1.5),
    }


def analyse(log: SensorLog) -> pd.DataFrame:
    """Fitted figures beside the specification: one row per triad, axis (``x``, ``y``, ``z``, ``all``) and figure.

    Columns: triad, axis, figure, unit, fitted, std (1 sigma), data_sheet, difference_pct. ``all`` is the fit to the mean
    Allan variance of the three axes. A process that the log's specification denies is not fitted; without a specification
    (a recording) all are. A log that moves shows its motion: the figures are those of a sensor only at rest.
    """
    import pandas as pd

    rows = []
    for triad, samples, spec in _triads(log):
        curves = [allan_deviation(samples[:, i], _rate(log)) for i in range(3)]
        for axis, curve in zip(("x", "y", "z", "all"), [*curves, pooled(curves)], strict=True):
            figures = _fit(curve, log, spec, 3 if axis == "all" else 1)
            for key, unit in _units(triad).items():
                fitted, promised = getattr(figures, key), getattr(spec, key)
                if not fitted and not promised:
                    continue
                rows.append(
                    {
                        "triad": triad,
                        "axis": axis,
                        "figure": unit.name,
                        "unit": unit.unit,
                        "fitted": fitted * unit.factor,
                        "std": getattr(figures, f"{key}_std") * unit.factor,
                        "data_sheet": promised * unit.factor if promised else math.nan,
                        "difference_pct": 100.0 * (fitted / promised - 1.0) if promised else math.nan,
                    }
                )
    columns = ["triad", "axis", "figure", "unit", "fitted", "std", "data_sheet", "difference_pct"]
    return pd.DataFrame(rows, columns=columns)


def plot(log: SensorLog, path: str | Path) -> None:
    """Log-log plot of the Allan deviation of both triads, with the fitted curve and its -1/2, 0 and +1/2 slopes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    for axes, (triad, samples, spec) in zip(figure.subplots(1, 2), _triads(log), strict=True):
        unit = "deg/h" if triad == "gyro" else "mg"
        factor = _units(triad)["bias_instability"].factor
        curves = [allan_deviation(samples[:, i], _rate(log)) for i in range(3)]
        for curve, name in zip(curves, "xyz", strict=True):
            axes.loglog(curve.tau, curve.deviation * factor, lw=0.9, alpha=0.7, label=f"{name} axis")
        curve = pooled(curves)
        _draw_fit(axes, curve.tau, _fit(curve, log, spec, 3), factor)
        if (curve.deviation > 0.0).all():
            axes.set_ylim(0.5 * factor * curve.deviation.min(), 2.0 * factor * curve.deviation.max())
        axes.set(
            title=f"{log.name or log.imu.spec.name}: {triad}",
            xlabel="cluster time, s",
            ylabel=f"Allan deviation, {unit}",
        )
        axes.grid(True, which="both", lw=0.3)
        axes.legend(fontsize=7)
    write_with(Path(path), partial(figure.savefig, format="png", dpi=80))


def _draw_fit(axes: Any, tau: Array, fit: Figures, factor: float) -> None:
    sigma = fit.bias_instability / GAUSS_MARKOV_PEAK
    if fit.white_noise:
        total = model_deviation(tau, fit.white_noise, sigma, fit.correlation_time_s or 1.0, fit.rate_random_walk)
        axes.loglog(tau, total * factor, "k", lw=1.4, label="fit")
        axes.loglog(tau, fit.white_noise / np.sqrt(tau) * factor, "k--", lw=0.7, label="white noise, slope -1/2")
    if fit.bias_instability:
        axes.axhline(fit.bias_instability * factor, color="k", ls=":", lw=0.9, label="bias instability, slope 0")
    if fit.rate_random_walk:
        axes.loglog(
            tau, fit.rate_random_walk * np.sqrt(tau / 3.0) * factor, "k-.", lw=0.7, label="rate random walk, slope +1/2"
        )


def _triads(log: SensorLog) -> list[tuple[str, Array, TriadSpec]]:
    return [("gyro", log.imu.gyro, log.imu.spec.gyro), ("accel", log.imu.accel, log.imu.spec.accel)]


def _rate(log: SensorLog) -> float:
    """Of the samples, Hz. Raises InputError for a record that is too short or has gaps."""
    steps = np.diff(log.imu.t)
    if len(steps) < 100:
        raise InputError(f"Allan deviation: the log has {len(steps) + 1} IMU samples, too few")
    if steps.max() > 1.5 * np.median(steps):
        k = int(np.argmax(steps))
        raise InputError(
            f"Allan deviation: the samples must be evenly spaced; there is a gap after t = {log.imu.t[k]:.6g} s"
        )
    return float(1.0 / steps.mean())


def _fit(curve: Curve, log: SensorLog, spec: TriadSpec, axes: int) -> Figures:
    silent = spec.white_noise == 0.0
    markov, walk = silent or spec.bias_instability > 0.0, silent or spec.rate_random_walk > 0.0
    return fit_allan(curve, float(log.imu.t[-1] - log.initial.t), axes, markov, walk)
