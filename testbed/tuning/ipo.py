"""Inclined planes system optimisation (IPO, Mozaffari, Abdy & Zahiri 2016) and its modified form (MIPO, 2017).

Agents roll down the planes between them and better agents: a_i = sum over better j of sin(atan((f_j - f_i)/(x_i - x_j))),
x_i += k1 U a_i + k2 U (x_best - x_i). All move together. The two differ in how k1 and k2 change with the iteration t.

Both can be read otherwise as printed in 2022: its eq. 7 has no x_i on the right (``keeps_place = false``), and its unit step of
f_j - f_i is one for the worse agents j (``planes = "worse"``), from which an agent is then pushed away.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array
from testbed.tuning.search import Best, Bounds, Steps

BETTER, WORSE = "better", "worse"
"""The agents that make the planes on which an agent rolls."""


def ipo(
    bounds: Bounds,
    population: int,
    iterations: int,
    rng: np.random.Generator,
    c1: float = 0.2,
    c2: float = 1.7,
    shift1: float = 1.0,
    shift2: float = 80.0,
    scale1: float = 0.2,
    scale2: float = 0.73,
    keeps_place: bool = True,
    planes: str = BETTER,
) -> Steps:
    """k1 = c1/(1 + exp((t - shift1) scale1)), k2 = c2/(1 + exp(-(t - shift2) scale2)): the shifts are iterations."""

    def gains(t: int) -> tuple[float, float]:
        return c1 * logistic(-(t - shift1) * scale1), c2 * logistic((t - shift2) * scale2)

    return _inclined_planes(bounds, population, iterations, rng, gains, keeps_place, planes)


def mipo(
    bounds: Bounds,
    population: int,
    iterations: int,
    rng: np.random.Generator,
    k1damp: float = 0.5,
    k2damp: float = 1.5,
    keeps_place: bool = True,
    planes: str = BETTER,
) -> Steps:
    """k1 = k1damp (T - t)/T, k2 = k2damp t/T. Published ranges: k1damp 0.01 to 1, k2damp 0.9 to 2."""

    def gains(t: int) -> tuple[float, float]:
        return k1damp * (iterations - t) / iterations, k2damp * t / iterations

    return _inclined_planes(bounds, population, iterations, rng, gains, keeps_place, planes)


def _inclined_planes(
    bounds: Bounds,
    population: int,
    iterations: int,
    rng: np.random.Generator,
    gains: Callable[[int], tuple[float, float]],
    keeps_place: bool,
    planes: str,
) -> Steps:
    if planes not in (BETTER, WORSE):
        raise InputError(f"planes = {planes!r}: of '{BETTER}' or of '{WORSE}' agents")
    x = bounds.draw(rng, population)
    best = Best()
    for t in range(1, iterations + 1):
        f = yield x
        best.update(x, f)
        k1, k2 = gains(t)
        pull = k1 * rng.random(x.shape) * acceleration(x, f, planes) + k2 * rng.random(x.shape) * (best.x - x)
        x = bounds.clip(x + pull if keeps_place else pull)


def acceleration(x: Array, f: Array, planes: str = BETTER) -> Array:
    """(N,d): sum over better (worse) agents of the sine of the slope angle; agents at the same place have no slope."""
    run = x[:, None, :] - x[None, :, :]
    rise = (f[None, :] - f[:, None])[:, :, None]
    length = np.hypot(rise, run)
    sine = np.divide(rise * np.sign(run), length, out=np.zeros_like(run), where=length > 0.0)
    out: Array = np.where(rise < 0.0 if planes == BETTER else rise > 0.0, sine, 0.0).sum(axis=1)
    return out


def logistic(u: float) -> float:
    """1/(1 + exp(-u)) without overflow."""
    return float(0.5 * (1.0 + np.tanh(0.5 * u)))
