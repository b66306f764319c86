"""Coefficients of white noise, Gauss-Markov bias and rate random walk from an Allan curve, with intervals.

The Allan variance is linear in the three variances N², sigma², K² for a given correlation time: IEEE Std 952-1997, eq. C.7,
C.16, C.11. They are fitted to the measured variances by non-negative least squares, weighted with the variance that the
overlapping estimator has under the fitted model (iterated); the correlation time minimises the gamma deviance.

An overlapping Allan variance is a weighted sum over the periodogram, whose lines (1/T apart) are independent with standard
deviation equal to the density S: Percival and Walden, *Spectral Analysis for Physical Applications* (1993), ch. 6. Hence

    cov(V_i, V_j) = (1 / T_ij) integral G_i G_j S² df,    G_i = 2 sin⁴(pi f tau_i) / (m_i sin(pi f dt))²,

T_ij being the longer of the two spans that are averaged over. It counts the degrees of freedom of each point and knows that
neighbouring points share data. A term stays only where its variance lies `SIGNIFICANT` sigmas above
zero, sigma being that of a world without it, and `LIMIT` of its own sigmas; else its upper limit is told. Units u, u·√s, u/√s for samples of unit u; SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from testbed.data.records import Array
from testbed.data.specs import GAUSS_MARKOV_PEAK

SIGNIFICANT = 4.0
"""Sigmas above zero. The estimate of a variance that rests on four degrees of freedom (what the longest cluster times have)
exceeds 4 sigma by chance in 0.4 % of cases, one of a normal distribution never: at most one invention in 250."""
LIMIT = 2.0
"""Sigmas of a two-sided 95 % interval, and of the upper limit of a term that is not told apart from zero."""
MARKOV_PEAK_AT = 1.893
"""Correlation times at which the Allan deviation of a Gauss-Markov process peaks."""
MODEL_ERROR = 0.01
"""Relative error of the model's variance: a sensor's bandwidth and rounding shape the shortest cluster times by so much."""
ROUNDS = 4
"""Of weights: their change falls by more than ten with each."""
FREQUENCIES_PER_DECADE = 200
TERMS = ("white_noise", "bias_instability", "rate_random_walk")


@dataclass(frozen=True)
class Curve:
    """Overlapping Allan deviation: cluster times ``tau`` (m,), the first of one sample, and ``deviation`` (m,)."""

    tau: Array
    deviation: Array


@dataclass(frozen=True)
class Figures:
    """Fitted coefficients, each with a 1-sigma uncertainty; zero is a term that is not told apart from zero."""

    white_noise: float = 0.0
    bias_instability: float = 0.0
    correlation_time_s: float = 0.0
    rate_random_walk: float = 0.0
    white_noise_std: float = 0.0
    bias_instability_std: float = 0.0
    rate_random_walk_std: float = 0.0
    limits: dict[str, float] = field(default_factory=dict)
    """Upper limit of each term that was looked for and not told apart from zero."""


def markov_shape(x: Array) -> Array:
    """Allan variance of a first-order Gauss-Markov process of sigma 1 at ``x`` correlation times; a series near zero."""
    x = np.asarray(x, dtype=np.float64)
    small = x < 0.02
    safe = np.where(small, 1.0, x)
    exact = 2.0 / safe - (3.0 - 4.0 * np.exp(-safe) + np.exp(-2.0 * safe)) / safe**2
    return np.where(small, x * (2.0 / 3.0 - 0.5 * x + 7.0 / 30.0 * x * x), exact)


def fit_allan(curve: Curve, duration_s: float, axes: int = 1, markov: bool = True, walk: bool = True) -> Figures:
    """Coefficients of the model from the curve of ``axes`` axes, each recorded for ``duration_s``.

    ``markov=False`` and ``walk=False`` leave out a process that the sensor is known not to have. Bias instability is the
    peak of the fitted Gauss-Markov part: the flat that white noise and random walk leave. A peak that is not an
    octave within the longest cluster time is not seen as one; what rises towards it is a random walk.
    """
    if not (curve.deviation > 0.0).all():
        return Figures()
    fit = _Fit(curve, duration_s, axes)
    kept = tuple(name for name, wanted in zip(TERMS, (True, markov, walk), strict=True) if wanted)
    limits: dict[str, float] = {}
    everything = fit.solve(kept)[0]
    while True:
        variances, time = fit.solve(kept)
        doubtful = {}
        own = fit.sigmas(kept, time, variances)
        for k, name in enumerate(TERMS):
            if name not in kept:
                continue
            others = tuple(n for n in kept if n != name)
            chance = fit.sigmas(kept, time, fit.solve(others)[0] if others else np.zeros(3))[k]
            if variances[k] < max(SIGNIFICANT * chance, LIMIT * own[k]) or variances[k] == 0.0:
                doubtful[name] = variances[k] / max(chance, own[k], 1e-300), math.sqrt(variances[k] + LIMIT * chance)
        if not doubtful:
            break
        weakest = min(doubtful, key=lambda name: doubtful[name][0])
        limits[weakest] = doubtful[weakest][1] * (GAUSS_MARKOV_PEAK if weakest == "bias_instability" else 1.0)
        kept = tuple(name for name in kept if name != weakest)
        if not kept:
            return Figures(limits=limits)
    # What leaving out a doubtful term has moved is an error of the others that sampling alone does not tell.
    sigmas = np.hypot(fit.sigmas(kept, time, variances), variances - everything)
    return _figures(variances, sigmas, time, limits)


def _figures(variances: Array, sigmas: Array, time: float, limits: dict[str, float]) -> Figures:
    """Roots of variances, and their sigmas by the derivative of the root."""
    values = np.sqrt(variances)
    stds = np.where(values > 0.0, sigmas / (2.0 * np.where(values > 0.0, values, 1.0)), 0.0)
    scale = np.array([1.0, GAUSS_MARKOV_PEAK, 1.0])
    n, b, k = (float(v) for v in values * scale)
    n_std, b_std, k_std = (float(v) for v in stds * scale)
    return Figures(n, b, float(time) if b > 0.0 else 0.0, k, n_std, b_std, k_std, limits)


class _Fit:
    """One curve with what its fits share."""

    def __init__(self, curve: Curve, duration_s: float, axes: int) -> None:
        self.tau, self.variance, self.axes = curve.tau, curve.deviation**2, axes
        dt = float(self.tau[0])
        spans = np.maximum(duration_s - 2.0 * self.tau + dt, dt)
        self._span = np.maximum.outer(spans, spans)
        decades = math.log10(0.5 / dt * 100.0 * duration_s)
        self._f = np.geomspace(0.01 / duration_s, 0.5 / dt, max(200, round(FREQUENCIES_PER_DECADE * decades)))
        self._df = np.gradient(self._f)
        gain = np.sin(np.pi * np.outer(self.tau, self._f)) ** 2 * dt / self.tau[:, None]
        self._gain = 2.0 * (gain / np.sin(np.pi * self._f * dt)) ** 2
        self._line_power = self._gain**2 * self._df / np.diag(self._span)[:, None] / axes
        self._times = np.geomspace(4.0 * dt, max(8.0 * dt, self.tau[-1] / (2.0 * MARKOV_PEAK_AT)), 32)

    def design(self, kept: tuple[str, ...], time: float) -> Array:
        """(m,3) Allan variances of unit variances; a column of a term that is left out is zero."""
        columns = [1.0 / self.tau, markov_shape(self.tau / time), self.tau / 3.0]
        return np.column_stack([c * (name in kept) for c, name in zip(columns, TERMS, strict=True)])

    def _density(self, variances: Array, time: float) -> Array:
        w2 = (2.0 * np.pi * self._f) ** 2
        white, markov, walk = variances
        return 2.0 * white + 4.0 * markov * time / (1.0 + w2 * time**2) + 2.0 * walk / w2

    def covariance(self, variances: Array, time: float) -> Array:
        """(m,m) of the measured Allan variances under a model; the mean over axes has so much less."""
        weighted = self._gain * (self._density(variances, time) ** 2 * self._df)
        return weighted @ self._gain.T / self._span / self.axes

    def _errors(self, variances: Array, time: float) -> Array:
        """(m,) variances of the points: sampling, and the model's own error."""
        return (
            self._line_power @ self._density(variances, time) ** 2
            + (MODEL_ERROR * (self.design(TERMS, time) @ variances)) ** 2
        )

    def solve(self, kept: tuple[str, ...]) -> tuple[Array, float]:
        """Variances (3,) and the correlation time."""
        if "bias_instability" not in kept:
            return self._linear(kept, float(self._times[0]))[0], float(self._times[0])
        from scipy.optimize import minimize_scalar

        costs = [self._linear(kept, time)[1] for time in self._times]
        k = int(np.argmin(costs))
        low, high = self._times[max(k - 1, 0)], self._times[min(k + 1, len(costs) - 1)]
        best = minimize_scalar(
            lambda x: self._linear(kept, math.exp(x))[1], bounds=(math.log(low), math.log(high)), method="bounded"
        )
        time = math.exp(best.x)
        return self._linear(kept, time)[0], time

    def _linear(self, kept: tuple[str, ...], time: float) -> tuple[Array, float]:
        """Variances (3,) for a correlation time, and their deviance."""
        from scipy.optimize import nnls

        design, model = self.design(kept, time), self.variance
        # First weights: relative errors as of white noise, from the measured curve.
        errors = self.variance**2 * self.tau / self.tau[0]
        variances = np.zeros(3)
        for _ in range(ROUNDS):
            scale = 1.0 / np.sqrt(errors)
            norm = np.maximum(np.linalg.norm(design * scale[:, None], axis=0), 1e-300)
            variances = nnls(design * scale[:, None] / norm, self.variance * scale)[0] / norm
            model = np.maximum(design @ variances, 1e-12 * self.variance)
            errors = np.maximum(self._errors(variances, time), (1e-3 * model) ** 2)
        freedom = 2.0 * model**2 / errors
        ratio = self.variance / model
        return variances, float((freedom * (ratio - 1.0 - np.log(ratio))).sum())

    def sigmas(self, kept: tuple[str, ...], time: float, world: Array) -> Array:
        """(3,) standard deviations of the variances fitted with the terms ``kept`` to curves of a ``world`` of variances.

        Weights are those of that world; the fitted correlation time counts as a fourth unknown where the world has the
        Gauss-Markov process.
        """
        design = self.design(kept, time)
        columns = [k for k, name in enumerate(TERMS) if name in kept]
        x = design[:, columns]
        if world[1] > 0.0 and "bias_instability" in kept:
            slope = markov_shape(self.tau / (1.01 * time)) - markov_shape(self.tau / (0.99 * time))
            x = np.column_stack([x, world[1] * slope / 0.02])
        weights = 1.0 / np.maximum(self._errors(world, time), (1e-6 * self.variance) ** 2)
        norm = np.sqrt((x**2 * weights[:, None]).sum(axis=0))
        x = x / norm
        estimator = np.linalg.pinv((x * weights[:, None]).T @ x, rcond=1e-10) @ (x * weights[:, None]).T / norm[:, None]
        covariance = estimator @ self.covariance(world, time) @ estimator.T
        out = np.zeros(3)
        out[columns] = np.sqrt(np.maximum(np.diag(covariance)[: len(columns)], 0.0))
        return out
