"""What every record checks of its arrays when it is made: shapes, increasing time, finite values; and gaps in times."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError

GAP = 5.0
"""Sampling intervals without a sample that count as a gap: a logger's jitter is one or two, a lost packet more."""
LEAST_GAP_S = 0.05
"""A shorter gap turns into less than a filter's own noise: 1 m/s² for 0.05 s is 1 mm."""


def check_arrays(
    record: Any,
    what: str,
    shapes: dict[str, tuple[int | None, ...]],
    minimum: int = 2,
    finite: bool = True,
    repeats: bool = False,
) -> None:
    """Shapes, finite values and increasing time; None in a shape means any length. Arrays become float64.

    ``repeats``: several rows may be of one time.
    """
    t = _numbers(record.t, what, "t")
    object.__setattr__(record, "t", t)
    if t.ndim != 1 or len(t) < minimum:
        raise InputError(f"{what}: needs at least {minimum} samples, has shape {t.shape}")
    if not np.isfinite(t).all():
        raise InputError(f"{what}: time is not finite at sample {int(np.argmin(np.isfinite(t)))}")
    rising = np.diff(t) >= 0 if repeats else np.diff(t) > 0
    if not rising.all():
        k = int(np.argmin(rising)) + 1
        raise InputError(f"{what}: time must increase, but sample {k} is at {t[k]:.6g} s after {t[k - 1]:.6g} s")
    for name, shape in shapes.items():
        values = _numbers(getattr(record, name), what, name)
        object.__setattr__(record, name, values)
        wanted = (len(t), *shape)
        fits = values.ndim == len(wanted) and all(w in (None, v) for w, v in zip(wanted, values.shape, strict=True))
        if not fits:
            length = " as 't' has it" if values.shape[1:] == wanted[1:] else ""
            raise InputError(f"{what}: '{name}' has shape {values.shape}, expected {wanted}{length}")
        if finite and not np.isfinite(values).all():
            k = int(np.argmin(np.isfinite(values).reshape(len(t), -1).all(axis=1)))
            raise InputError(f"{what}: '{name}' is not finite at sample {k} (t = {t[k]:.6g} s)")


def _numbers(given: Any, what: str, name: str) -> NDArray[np.float64]:
    """An array as float64. Raises InputError for anything but real numbers."""
    check_real(given, what, name)
    try:
        return np.ascontiguousarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: '{name}' is no array of numbers ({error})") from None


def check_real(given: Any, what: str, name: str) -> None:
    """Raise InputError for complex numbers, whose imaginary part would be lost."""
    if np.iscomplexobj(given):
        raise InputError(f"{what}: '{name}' is complex; it must be of real numbers")


MOST_STEPS = 20_000
"""Of which the usual one is taken: the median of so many is that of all to a percent of their scatter."""


def gaps_of(t: NDArray[np.float64]) -> list[tuple[float, float]]:
    """(last time before, first time after) of each gap in some sampling times."""
    if len(t) < 3:
        return []
    steps = np.diff(t)
    usual = float(np.median(steps[:: max(1, len(steps) // MOST_STEPS)]))
    wide = np.flatnonzero(steps > max(GAP * usual, LEAST_GAP_S))
    return [(float(t[k]), float(t[k + 1])) for k in wide]
