"""Claims of KFANN that a study judges: innovations run by run, and rows that no filter can have."""

from __future__ import annotations

from math import comb

import numpy as np
import pandas as pd
import pytest
from report_studies import study

from testbed.scoring.claims import ClaimConfig, ReadingConfig

fed, innovations, verdict_rows = study("kfann_fed"), study("kfann_innovations"), study("study_verdicts").verdict_rows


def objections(draw, runs=400, n=799):
    """Share of runs in which each test objects to innovations that ``draw`` makes of white normal ones."""
    rng = np.random.default_rng(1)
    found = [innovations.figures_of(draw(rng.standard_normal(n))) for _ in range(runs)]
    return {test: np.mean([row[test] for row in found]) for test in innovations.TESTS}


def test_five_percent_of_the_runs_object_to_what_is_true():
    """Of 400: 1.9 to 8.1 % are three binomial deviations. The share of 799 moves in steps, which takes 1 % at most."""
    for test, share in objections(lambda x: x).items():
        assert 0.019 - 0.01 < share < 0.081 + 0.01, test


@pytest.mark.parametrize(
    ("draw", "test", "others"),
    [
        (lambda x: x + 0.2, "mean", ("normal",)),  # 0.2 of a sigma is 5.7 errors of a mean of 799
        (lambda x: 1.2 * x, "inside", ("mean", "normal")),  # 90.4 % are inside, 95.4 have an error of 0.74 %
        (lambda x: x * (1.0 + 0.3 * np.sin(np.arange(799) / 7.0)), "normal", ("mean",)),  # kurtosis 3.4, error 0.17
    ],
)
def test_a_run_tells_what_is_wrong_and_nothing_else(draw, test, others):
    shares = objections(draw)
    assert shares[test] > 0.5
    assert all(shares[other] < 0.09 for other in others)


def test_verdicts_over_runs_are_exact():
    """Counts of 100 runs against 10 %: probabilities by the sum of the binomial itself, and Holm's factor of two."""
    few, many = innovations.judge([3, 25], 100)
    below = sum(comb(100, k) * 0.1**k * 0.9 ** (100 - k) for k in range(4))
    above = sum(comb(100, k) * 0.1**k * 0.9 ** (100 - k) for k in range(25, 101))
    assert few["p_holm"] == pytest.approx(2.0 * below) and many["p_holm"] == pytest.approx(2.0 * above)
    assert (few["verdict"], many["verdict"]) == ("reproduced", "not reproduced")
    assert innovations.judge([10], 100)[0]["verdict"] == "undecided"
    # Clopper and Pearson's: the ends at which so few, and so many, come in 2.5 % of the cases
    low, high = few["ci_low"] / 100.0, few["ci_high"] / 100.0
    assert sum(comb(100, k) * high**k * (1 - high) ** (100 - k) for k in range(4)) == pytest.approx(0.025)
    assert sum(comb(100, k) * low**k * (1 - low) ** (100 - k) for k in range(3, 101)) == pytest.approx(0.025)


def test_a_claim_that_fails_with_a_bias_depends_on_it():
    rows = pd.DataFrame(
        [
            {"imu": imu, "trajectory": "trajectory 1", "channel": channel, "run": run}
            | dict.fromkeys(innovations.TESTS, float(imu != "white noise" and run % 2 == 0))
            for imu in ("white noise", "gyro bias 0.55 deg/s")
            for channel in innovations.CHANNELS
            for run in range(100)
        ]
    )
    table = innovations.verdicts(rows)
    assert len(table) == 2 * 2 * 3 and table["class"].str.startswith("depends on IMU").all()
    assert set(table.loc[table["verdict"] == "not reproduced", "effect_pct"]) == {50.0}


def test_rows_of_a_study_are_judged_like_a_scenario_s():
    """Half the error in ten runs with a little scatter, equal with a bias: holds in one reading and fails in the other."""
    claims = [ClaimConfig(id="c", better="a", than="b", metric="rmse_position_3d_m", window="outages", text="words")]
    readings = [ReadingConfig(name=name, leaves_open="x", conditions={"bias": name}) for name in ("no", "yes")]
    b = np.linspace(9.0, 11.0, 10)
    tables = {
        "no": pd.DataFrame({"a": 0.5 * b + 0.01 * (-1.0) ** np.arange(10), "b": b}),
        "yes": pd.DataFrame({"a": b + (-1.0) ** np.arange(10), "b": b}),
    }
    table = verdict_rows(claims, readings, tables)
    assert table["verdict"].tolist() == ["reproduced", "not reproduced"] and (table["text"] == "words").all()
    assert table["class"].str.startswith("depends on bias").all() and table["runs"].tolist() == [10, 10]
    assert table["effect_pct"][0] == pytest.approx(50.0, abs=0.1)


def test_claims_with_the_networks_true_errors_name_every_trajectory():
    rows = pd.DataFrame(
        [
            (trajectory, reading, run, name, scale * (10.0 + run), 1.0)
            for trajectory in ("trajectory 1", "trajectory 2", "trajectory 3")
            for reading in ("as stated", "matched")
            for run in range(6)
            for name, scale in ((fed.TRUE_R, 1.0 + 0.001 * run), (fed.ANN, 4.0), (fed.UPDATE, 0.5), (fed.COASTING, 1.0))
        ],
        columns=["trajectory", "reading", "run", "fed", "outage_m", "first_m"],
    )
    table = fed.verdicts(rows)
    assert len(table) == 3 * 3 * 2
    words = table.groupby("claim")["class"].unique().map(list)
    assert all(words[f"true-R-{t}-1"] == ["holds"] and words[f"true-R-{t}-2"] == ["fails"] for t in "123")
    assert (table.loc[table["claim"].str.endswith("3"), "origin"] == "own").all()
