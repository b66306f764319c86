"""Attitude filters of others on a body that swings and turns round: a peer that is fed a wrong axis, sign or declination fails here."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from ahrs_simulation import FIELD_N, RATE_HZ, simulate

from testbed.data.registry import make_estimator
from testbed.physics.rotations import attitude_errors

SETTLED = round(20.0 * RATE_HZ)
"""VQF finds its attitude by itself, with time constants of 3 and 9 s."""
PACKAGES = {"madgwick": "ahrs", "mahony": "ahrs", "ahrs-ekf": "ahrs", "vqf": "vqf", "riann": "riann"}


@pytest.mark.parametrize("name", PACKAGES)
def test_an_attitude_filter_follows_perfect_sensors(name) -> None:
    """Nothing accelerates or disturbs, so that gravity and field are exact: within 2 degrees, RIANN's published tilt error on
    data of all kinds (Weber et al. 2021, table 3). The declination is 4.2 degrees: its wrong sign would be 8.4."""
    if find_spec(PACKAGES[name]) is None:
        pytest.skip(f"needs the package {PACKAGES[name]}")
    assert np.degrees(np.arctan2(FIELD_N[1], FIELD_N[0])) > 4.0
    made = simulate(0, 60.0, noise=0.0)
    solution = make_estimator(name).run(made.log)
    turn = np.degrees(attitude_errors(np.ascontiguousarray(solution.q_nb), made.q_nb))[SETTLED:]
    assert np.sqrt(np.mean(turn**2, axis=0)).max() < 2.0
