"""Every estimator answers as it did when `record` wrote ``recorded/``: a change of the code is no change of the filters."""

from __future__ import annotations

import json
from typing import Any

import pytest
from parity_cases import (
    AHRS,
    AHRS_0_1,
    NO_BIASES,
    PLANS,
    SEARCHED,
    TOLERANCE,
    Case,
    answer,
    cases,
    difference,
    figures,
    reference,
    scores,
    sensor_log,
)
from parity_logs import digest, recording, truth
from record import FOLDER


@pytest.fixture(scope="module", params=PLANS, ids=lambda plan: plan.name)
def recorded(request):
    """A recording as a log, and what was answered to it."""
    plan = request.param
    tables = recording(plan)
    stored = json.loads((FOLDER / f"{plan.name}.json").read_text())
    assert digest(tables) == stored["hash"], "the recording itself has changed, not the filters"
    return plan, sensor_log(plan, tables), stored


def worst(stored: dict[str, Any], now: dict[str, Any]) -> tuple[float, str]:
    """The largest difference and where it is; tables and columns that are new do not count, missing ones do."""
    found = (0.0, "")
    for table, columns in stored.items():
        for key, column in columns.items():
            if (table, key) == ("innovation", "t"):
                continue  # was the time at which the fix was stamped, is the time that it describes
            there = key in now.get(table, {})
            found = max(
                found, (difference(table, key, column, now[table][key]) if there else float("inf"), f"{table}: {key}")
            )
    return found


def test_answers(recorded):
    plan, log, stored = recorded
    for case in cases(plan):
        expected = {
            key: columns for key, columns in stored[case.label].items() if key != "innovation" or case.innovations
        }
        apart, where = worst(expected, figures(case, answer(case, log)))
        told = f"{plan.name}, {case.label}, {where}: {apart:.2g} of its scale, allowed {case.tolerance:g}"
        assert apart <= case.tolerance, told


def test_scores_of_candidates(recorded):
    plan, log, stored = recorded
    if plan.name not in SEARCHED:
        assert "searcher" not in stored
        return
    apart, where = worst(stored["searcher"], scores(log, reference(truth(plan))))
    assert apart <= TOLERANCE, f"{plan.name}, {where}: {apart:.2g} of its scale"


NEARLY = 1.0 + 1e-6
CHANGED = (
    Case("indirect-kf", "indirect-kf", {"gyro_bias_scale": NEARLY}),
    Case("update-ins", "update-ins", {"velocity_std_scale": NEARLY}, states=()),
    Case("lkf9", "lkf9", {"gyro_noise_scale": NEARLY}, NO_BIASES),
    Case("direct-ekf", "direct-ekf", {"accel_noise_scale": NEARLY}),
    Case("direct-ukf", "direct-ukf", {"alpha": NEARLY}),
    Case("stekf", "stekf", {"forgetting": 0.95 * NEARLY}),
    Case("rstekf", "rstekf", {"position_std_scale": NEARLY}),
    Case("imm-ekf", "imm-ekf", {"stay_probability": 0.96 * NEARLY}),
    Case("imm-rstekf", "imm-rstekf", {"velocity_std_scale": NEARLY}),
    Case("ahrs-kf", "ahrs-kf", AHRS_0_1 | {"mag_noise_scale": 9.06 * NEARLY}, **AHRS),
)


def test_a_millionth_is_seen():
    """A parameter that is off by 1e-6 moves more than rounding may: what is recorded binds, and the tolerance is not wide."""
    plan = PLANS[0]
    log = sensor_log(plan, recording(plan))
    stored = json.loads((FOLDER / f"{plan.name}.json").read_text())
    for case in CHANGED:
        apart, _ = worst(stored[case.label], figures(case, answer(case, log)))
        assert apart > 10.0 * TOLERANCE, f"{case.label} with {case.params}: {apart:.2g}"
