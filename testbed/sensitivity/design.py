"""The plans of points: Morris's trajectories and Saltelli's cross-sampled Sobol sequence, as SALib draws them.

M. D. Morris, Technometrics 33 (1991) 161-174; A. Saltelli et al., Comput. Phys. Commun. 181 (2010) 259-270. Points lie in the
unit cube. A longer plan begins with the points of a shorter one, so a study can be made longer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from testbed.base.errors import InputError, MissingExtra, nearest
from testbed.base.resources import has_package
from testbed.base.streams import stream
from testbed.data.records import Array

MORRIS, SOBOL = "morris", "sobol"
METHODS = (MORRIS, SOBOL)
LEVELS = 4
"""Of Morris's grid: an even number lets every level be drawn equally often, and with 4 a step is two thirds of the range."""


@dataclass(frozen=True)
class Design:
    """Points (groups * size, d) of a method; each group of ``size`` consecutive points is drawn independently of the others."""

    method: str
    points: Array
    size: int

    @property
    def groups(self) -> int:
        """Trajectories of Morris, base samples of Sobol."""
        return len(self.points) // self.size


def make_design(method: str, dimensions: int, groups: int, seed: int) -> Design:
    """``groups`` trajectories (d + 1 points each) or base samples (d + 2 points each). Raises InputError, MissingExtra."""
    if method not in METHODS:
        raise InputError(f"--method {method}: no such method; {nearest(method, METHODS)}")
    if not has_package("SALib"):
        raise MissingExtra("sensitivity needs the extra 'sensitivity': pip install 'navigation-testbed[sensitivity]'")
    problem = {
        "num_vars": dimensions,
        "names": [f"x{k}" for k in range(dimensions)],
        "bounds": [[0.0, 1.0]] * dimensions,
    }
    own_seed = int(stream(seed, 0, f"sensitivity.{method}").integers(2**31))
    if method == MORRIS:
        from SALib.sample import morris

        if groups < 2:
            raise InputError(f"--trajectories {groups}: at least 2, or there is no interval")
        points = morris.sample(problem, groups, num_levels=LEVELS, seed=own_seed)
        return Design(MORRIS, points, dimensions + 1)
    from SALib.sample import sobol

    if groups < 2 or groups & (groups - 1):
        raise InputError(
            f"--samples {groups}: expected a power of 2, as Sobol's sequence is even only then (128, 256, 512)"
        )
    points = sobol.sample(problem, groups, calc_second_order=False, seed=own_seed)
    return Design(SOBOL, np.asarray(points), dimensions + 2)
