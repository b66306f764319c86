"""Allan deviation of inertial sensors, and the random-walk and bias figures that it holds.

Overlapping Allan deviation after Riley, NIST SP 1065, eq. 11; model curve of white noise, first-order
Gauss-Markov bias and rate random walk after IEEE Std 952-1997, annex C. Samples in rad/s or m/s², cluster times in s.
The fit and its intervals: `testbed.sensors.allan_fit`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from testbed.base.errors import InputError
from testbed.base.files import write_with
from testbed.data.records import Array, SensorLog
from testbed.data.specs import GAUSS_MARKOV_PEAK, TriadSpec
from testbed.sensors.allan_fit import Curve, Figures, fit_allan, markov_shape

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

POINTS_PER_OCTAVE = 3
FEWEST_CLUSTERS = 5
"""Cluster times reach to this part of the record."""
APART = 4.0
"""Sigmas between an axis and the value of all: among the 18 of a unit, of equal axes, once in 900 units."""
COLUMNS = ["triad", "axis", "figure", "unit", "fitted", "std", "data_sheet", "difference_pct", "note"]


def allan_deviation(samples: Array, rate_hz: float) -> Curve:
    """Overlapping Allan deviation of one axis (n,); NIST SP 1065, eq. 11, by the integral (n+1,) of the samples."""
    n = len(samples)
    sizes = np.unique(
        np.round(2.0 ** np.arange(0.0, math.log2(n / FEWEST_CLUSTERS), 1.0 / POINTS_PER_OCTAVE)).astype(int)
    )
    # Without its mean the integrated phase keeps its digits.
    centred = np.asarray(samples, dtype=np.float64) - np.mean(samples)
    integral = np.concatenate([[0.0], np.cumsum(centred)])
    deviation = [
        np.sqrt(np.mean((integral[2 * m :] - 2.0 * integral[m:-m] + integral[: -2 * m]) ** 2) / 2.0) / m for m in sizes
    ]
    return Curve(sizes / rate_hz, np.array(deviation))


def pooled(curves: list[Curve]) -> Curve:
    """The curve of several axes of one kind: the root of their mean Allan variance."""
    return Curve(curves[0].tau, np.sqrt(np.mean([curve.deviation**2 for curve in curves], axis=0)))


def model_deviation(tau: Array, white_noise: float, markov_sigma: float, correlation_time: float, rrw: float) -> Array:
    """Allan deviation of white noise + Gauss-Markov + rate random walk. IEEE Std 952-1997 eq. C.7, C.16 and C.11."""
    return np.sqrt(white_noise**2 / tau + markov_sigma**2 * markov_shape(tau / correlation_time) + rrw**2 * tau / 3.0)


@dataclass(frozen=True)
class _Unit:
    """How a figure is printed: its name, its unit and the factor from SI."""

    name: str
    unit: str
    factor: float


def _units(triad: str) -> dict[str, _Unit]:
    from testbed.physics.earth import G0

    deg = 180.0 / math.pi
    if triad == "gyro":
        return {
            "white_noise": _Unit("ARW", "deg/sqrt(h)", 60.0 * deg),
            "bias_instability": _Unit("bias instability", "deg/h", 3600.0 * deg),
            "correlation_time_s": _Unit("correlation time", "s", 1.0),
            "rate_random_walk": _Unit("RRW", "deg/sqrt(h3)", 3600.0**1.5 * deg),
        }
    return {
        "white_noise": _Unit("VRW", "m/s/sqrt(h)", 60.0),
        "bias_instability": _Unit("bias instability", "mg", 1e3 / G0),
        "correlation_time_s": _Unit("correlation time", "s", 1.0),
        "rate_random_walk": _Unit("RRW", "m/s/sqrt(h3)", 3600.0**1.5),
    }


def analyse(log: SensorLog) -> pd.DataFrame:
    """Fitted figures beside the specification: one row per triad, axis (``x``, ``y``, ``z``, ``all``) and figure.

    Columns: triad, axis, figure, unit, fitted, std (1 sigma), data_sheet, difference_pct, note. A figure that is not told
    apart from zero is NaN, and the note gives its upper limit. ``all`` is the fit to the mean Allan variance of the three
    axes, where one value fits them: where an axis lies more than `APART` sigmas from it, it is NaN and the note says so.
    A process that the log's specification denies is not fitted; without a specification (a recording) all are. A log that
    moves shows its motion: the figures are those of a sensor only at rest.
    """
    import pandas as pd

    rows = []
    for triad, samples, spec in _triads(log):
        curves = [allan_deviation(samples[:, i], _rate(log)) for i in range(3)]
        each = [_fit(curve, log, spec, 1) for curve in curves]
        together = _fit(pooled(curves), log, spec, 3)
        for axis, figures in zip(("x", "y", "z", "all"), [*each, together], strict=True):
            for key, unit in _units(triad).items():
                note = _strangers(key, together, each) if axis == "all" else ""
                known = key != "correlation_time_s" or spec.bias_instability > 0.0  # else it is a default
                row = _row(figures, key, getattr(spec, key) if known else 0.0, unit, note)
                if row is not None:
                    rows.append({"triad": triad, "axis": axis} | row)
    return pd.DataFrame(rows, columns=COLUMNS)


class Pooled(NamedTuple):
    """Fits to the mean Allan variance of the three axes."""

    gyro: Figures
    accel: Figures


def pooled_figures(log: SensorLog) -> Pooled:
    """One set of figures for each triad: what a specification holds, even where the axes differ."""
    fits = []
    for _, samples, spec in _triads(log):
        curve = pooled([allan_deviation(samples[:, i], _rate(log)) for i in range(3)])
        fits.append(_fit(curve, log, spec, 3))
    return Pooled(*fits)


def _row(figures: Figures, key: str, promised: float, unit: _Unit, note: str) -> dict[str, Any] | None:
    """A figure in its unit; None where neither the fit nor the data sheet knows it."""
    fitted, limit = getattr(figures, key), figures.limits.get(key)
    if not fitted and not promised:
        return None
    if not fitted or note:
        told = note or ("not told apart from zero" + (f": below {limit * unit.factor:.3g}" if limit else ""))
        value = std = math.nan
    else:
        value, std, told = fitted * unit.factor, getattr(figures, f"{key}_std", math.nan) * unit.factor, ""
    sheet = promised * unit.factor if promised else math.nan
    difference = 100.0 * (value / sheet - 1.0)
    row = {"figure": unit.name, "unit": unit.unit, "fitted": value, "std": std}
    return row | {"data_sheet": sheet, "difference_pct": difference, "note": told}


def _strangers(key: str, together: Figures, each: list[Figures]) -> str:
    """Why one value does not fit all axes; empty where it does."""
    value = getattr(together, key)
    for axis, figures in zip("xyz", each, strict=True):
        own, std = getattr(figures, key), getattr(figures, f"{key}_std", math.nan)
        if own and value and abs(own - value) > APART * math.hypot(std, getattr(together, f"{key}_std", math.nan)):
            return f"the axes differ: {axis} does not fit a common value"
        if not own and value and value > 2.0 * figures.limits.get(key, math.inf):
            return f"the axes differ: {axis} has less than a common value"
    return ""


def plot(log: SensorLog, path: str | Path) -> None:
    """Write `figure` as PNG."""
    write_with(Path(path), partial(figure(log).savefig, format="png", dpi=80))


def figure(log: SensorLog, width: float = 11.0, height: float = 4.6) -> Figure:
    """Log-log plot of the Allan deviation of both triads, with the fitted curve and its -1/2, 0 and +1/2 slopes; inches."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(width, height), layout="constrained")
    for axes, (triad, samples, spec) in zip(drawn.subplots(1, 2), _triads(log), strict=True):
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
    return drawn


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
