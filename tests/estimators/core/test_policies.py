"""Adaptive policies where nothing needs adapting, and parts that a plug-in brings without an estimator."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import sensor_log, weaving_flight

from estimators import policies
from estimators.methods.eskf import Eskf
from testbed.base.errors import InputError
from testbed.data.registry import load_plugin

POLICY = """
from estimators.policies import Policy, add_policy
import numpy as np

add_policy(Policy("takes-all", lambda memory, residual, s, r, h, p: 1.0, lambda rows: np.zeros(0)))
"""


def test_sage_husa_believes_an_honest_receiver():
    """With white fixes as good as stated, R is known to 20 % (50 samples); off by that, a filter loses some per cent of accuracy.

    Half as much again is allowed over the plain filter: eight flights of 120 fixes, of which the first take R as stated.
    """
    truth = weaving_flight(60.0, rate=50.0)
    squares = {"plain": [], "sage-husa": []}
    for seed in range(8):
        log = sensor_log(truth, seed, position_sigma=3.0, velocity_sigma=0.2, std=(10.0, 1.0, 0.01))
        for policy, found in squares.items():
            solution = Eskf(policy=policy).run(log)
            found.append(np.mean((solution.v_n - truth.v_n[1:]) ** 2))
    plain, adaptive = (np.sqrt(np.mean(squares[policy])) for policy in ("plain", "sage-husa"))
    assert adaptive < 1.5 * plain


def test_a_plugin_may_hold_a_policy_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(policies, "POLICIES", dict(policies.POLICIES))
    (tmp_path / "mine.py").write_text(POLICY)
    assert load_plugin(tmp_path / "mine.py") == []
    assert "takes-all" in policies.POLICIES
    (tmp_path / "empty.py").write_text("import estimators.policies\n")
    with pytest.raises(InputError, match=r"no estimator in it; .*add_policy"):
        load_plugin(tmp_path / "empty.py")
