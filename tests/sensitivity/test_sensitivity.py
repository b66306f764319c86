"""Sensitivity studies: indices that are known in closed form, resuming, what a lost run or bad input does."""

from __future__ import annotations

import math
from pathlib import Path

import monte_carlo as mc
import numpy as np
import pandas as pd
import pytest
from command_line import SHORT, call

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.sensitivity.design import make_design
from testbed.sensitivity.factors import Factor, parse_factor
from testbed.sensitivity.indices import indices, noise_share
from testbed.sensitivity.question import Question
from testbed.sensitivity.study import Stopped, sensitivity

pytest.importorskip("SALib", reason="needs the extra 'sensitivity'")

PLUGIN = Path(__file__).parents[1] / "plugins" / "known_indices.py"
METRIC = "rmse_north_m"
TABLES = ("sensitivity.csv", "outcomes.csv", "sensitivity.md")


@pytest.fixture(autouse=True)
def real_pipeline():
    """The plug-in of these tests replaces two functions of the pipeline; put them back."""
    before = pipeline.fly, pipeline.sense
    yield
    pipeline.fly, pipeline.sense = before


def figures(low, high):
    return tuple(Factor(f"estimators.known.params.x{k}", low, high) for k in (1, 2, 3))


def ask(out, params=None, factors=None, **changes):
    """Run a small study of the plug-in's function and return its table by figure."""
    options = {key: changes.pop(key) for key in ("jobs", "resume", "time_limit_s", "progress") if key in changes}
    scenario = mc.scenario([{"name": "known", "params": params or {}}])
    question = Question(
        factors or figures(0.0, 1.0), (METRIC,), **{"samples": 64, "trajectories": 8, "runs": 2} | changes
    )
    sensitivity(scenario, question, out, plugins=[PLUGIN], **{"jobs": 1} | options)
    return pd.read_csv(out / "sensitivity.csv").set_index("key")


def inside(table, name, wanted):
    return ((table[f"{name}_low"] <= wanted) & (wanted <= table[f"{name}_high"])).tolist()


def test_a_linear_function_has_the_indices_of_its_coefficients(tmp_path):
    """x uniform over a unit range: S1 = ST = c² / sum c², and every elementary effect is c."""
    c = np.array([4.0, 2.0, 1.0])
    table = ask(tmp_path / "out", {"noise_m": 0.5}, samples=64)
    for name in ("S1", "ST"):
        assert inside(table, name, c**2 / (c**2).sum()) == [True] * 3
        assert (table[f"{name}_high"] - table[f"{name}_low"] < 0.9).all()  # 2 * 1.96 * sqrt(2 / 64) is 0.69
    assert table["mu_star"].to_numpy() == pytest.approx(c, rel=1e-4)  # the RMSE of 600 rows on an ellipsoid
    assert table["sigma"].to_numpy() == pytest.approx(0.0, abs=1e-3)
    assert "`estimators.known.params.x1` decides most" in (tmp_path / "out/sensitivity.md").read_text()


def test_the_ishigami_function_has_the_indices_of_its_integral(tmp_path):
    """Ishigami & Homma (1990) with a = 7, b = 0.1 over (-pi, pi): x3 acts through its interplay with x1 alone."""
    a, b, pi = 7.0, 0.1, math.pi
    v1, v2, v13 = 0.5 * (1 + b * pi**4 / 5) ** 2, a**2 / 8, 8 * b**2 * pi**8 / 225
    total = v1 + v2 + v13
    table = ask(tmp_path / "out", {"kind": "ishigami"}, figures(-pi, pi), methods=("sobol",), samples=128, runs=1)
    assert inside(table, "S1", np.array([v1, v2, 0.0]) / total) == [True] * 3
    assert inside(table, "ST", np.array([v1 + v13, v2, v13]) / total) == [True] * 3
    assert "mu_star" not in table


def test_the_indices_are_those_of_another_implementation():
    """SALib's own analysis of the same points; the function is neither linear nor centred."""
    from SALib.analyze import morris, sobol

    problem = {"num_vars": 4, "names": list("abcd"), "bounds": [[0.0, 1.0]] * 4}
    for method, groups in (("morris", 10), ("sobol", 64)):
        design = make_design(method, 4, groups, seed=5)
        x = design.points
        y = 1e3 + x[:, 0] ** 2 + np.exp(x[:, 1]) * x[:, 2]
        found, reach = indices(design, y.reshape(groups, design.size, 1), seed=5)
        if method == "sobol":
            theirs = sobol.analyze(problem, y, calc_second_order=False, num_resamples=1000, seed=1)
        else:
            theirs = morris.analyze(problem, x, y, num_levels=4, num_resamples=1000, seed=1)
        for name, values in found.items():
            assert values == pytest.approx(np.array(theirs[name], dtype=float), rel=1e-9, abs=1e-12)
            if f"{name}_conf" in theirs:  # both are estimates of one spread from 1000 resamples, each to 2 %
                assert reach[name] == pytest.approx(np.array(theirs[f"{name}_conf"], dtype=float), rel=0.15, abs=1e-9)
        assert found["mu_star" if method == "morris" else "ST"][3] == 0.0


def test_the_share_of_the_seeds_is_told_and_lies_in_the_intervals():
    """Noise of 3 in each value: a mean over 9 seeds has a variance of 1, beside one of 3 between the points."""
    rng = np.random.default_rng(1)
    common = rng.normal(size=(1, 1, 9)) * 50.0  # the same for every point: moves no index
    y = np.sqrt(3.0) * rng.normal(size=(300, 5, 1)) + common + 3.0 * rng.normal(size=(300, 5, 9))
    assert noise_share(y) == pytest.approx(0.25, rel=0.1)  # 1500 points: 4 % of either variance
    assert math.isnan(noise_share(y[:, :, :1]))
    design = make_design("sobol", 2, 64, seed=1)
    # What the first figure is worth differs between two seeds: resampled, the slope is 3, 1.5 or 0 with 1/4, 1/2, 1/4, and its ST
    # (slope² / (slope² + 1)) 0.90, 0.69 or 0, with a deviation of 0.34 beside that of the points.
    x = design.points.reshape(64, 4, 2)
    y = x[:, :, :1] * np.array([3.0, 0.0]) + x[:, :, 1:]
    of_seeds, of_points = (indices(design, each, seed=1)[1]["ST"][0] for each in (y, y.mean(axis=2, keepdims=True)))
    assert of_seeds == pytest.approx(math.hypot(1.96 * 0.34, of_points), rel=0.15)


@pytest.mark.parametrize("jobs", [1, 2])
def test_stopped_resumed_and_longer_studies_are_the_undisturbed_one(tmp_path, jobs):
    def interrupt(method, done, total):
        if method == "sobol" and done >= total // 2:
            raise KeyboardInterrupt

    small = {"samples": 8, "trajectories": 2, "params": {"noise_m": 0.5, "lost_above": 0.9}}
    ask(tmp_path / "whole", **small)
    out = tmp_path / "parts"
    with pytest.raises(Stopped, match="--resume"):
        ask(out, **small | {"samples": 4}, progress=interrupt, jobs=jobs)
    assert not (out / "sensitivity.csv").exists()
    with pytest.raises(InputError, match="--resume"):
        ask(out, **small)
    seen = []
    ask(out, **small, resume=True, jobs=jobs, progress=lambda *now: seen.append(now))
    assert [now for now in seen if now[0] == "morris"] == [("morris", 8, 8)]  # all of it was stored
    assert next(done for method, done, _ in seen if method == "sobol") >= 8
    for name in TABLES:
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    with pytest.raises(InputError, match="another scenario or question"):
        ask(out, **small | {"runs": 3}, resume=True)


def test_a_lost_run_costs_its_group_and_is_told(tmp_path):
    """x1 above 0.9 is lost: the rest is uniform up to 0.9."""
    table = ask(tmp_path / "out", {"lost_above": 0.9}, methods=("sobol",), samples=64, runs=1)
    variance = np.array([4.0 * 0.9, 2.0, 1.0]) ** 2
    assert inside(table, "ST", variance / variance.sum()) == [True] * 3
    outcomes = pd.read_csv(tmp_path / "out/outcomes.csv")
    assert 5 <= outcomes["groups_lost"][0] <= 20  # 1 - 0.9² of 64 groups: 12 with a deviation of 3
    text = (tmp_path / "out/sensitivity.md").read_text()
    assert "groups of points hold a run that was lost" in text and "ArithmeticError: too far out" in text


def test_an_error_that_is_switched_off_has_no_effect_and_the_noise_is_common(tmp_path):
    """The real sensors: equal random numbers at each point leave a figure without effect an index of exactly 0."""
    out = tmp_path / "out"
    over = ["sensors.imu.gyro_nonlinearity_pctfs=0.05..0.2", "sensors.imu.gyro_turn_on_bias_dps=0.01..1:log"]
    options = ["--method", "morris", "--trajectories", "3", "--runs", "2", "--jobs", "1", "--estimators", "ins"]
    words = [part for text in over for part in ("--over", text)]
    code, told = call(
        "sensitivity", "quickstart", *SHORT, *words, *options, "--metric", "rmse_yaw_deg", "--out", str(out)
    )
    assert code == 0, told
    table = pd.read_csv(out / "sensitivity.csv").set_index("key")
    assert table["mu_star"].iloc[0] == 0.0 and table["mu_star"].iloc[1] > 0.1
    assert "gyro_nonlinearity_pctfs: no effect at all" in (out / "sensitivity.md").read_text()
    assert (out / "sensitivity-rmse_yaw_deg-all.png").stat().st_size > 5000


def test_a_range():
    assert parse_factor("a.b=0.1..3") == Factor("a.b", 0.1, 3.0)
    assert parse_factor("a.b = 1e-3..2:log").value(0.5) == pytest.approx(math.sqrt(2e-3))
    assert parse_factor("a=-2..-1").value(0.25) == -1.75


BAD = {
    "--over": ["--over"],
    "--over a.b": ["KEY=LOW..HIGH"],
    "--over sensors.imu.rate_hz=3..1": ["3 must be below 1"],
    "--over sensors.imu.rate_hz=0..1:log": ["above 0"],
    "--over sensors.imu.rate_hz=1..2:cubic": ["'cubic' is no axis", "linear, log"],
    "--over sensors.imu.gyro_arw=1..2": ["gyro_arw", "did you mean 'gyro_arw_"],
    "--over sensors.imu.gyro_arw_dpsqrth=-1..2": ["--over sensors.imu.gyro_arw_dpsqrth=-1..2", "gyro_arw_dpsqrth"],
    "--over estimators.nobody.params.x=1..2": ["no such row", "ins"],
    "--over flight.wind.north_mps=1..2": ["the flight is flown once", "--sweep"],
    "--over sensors.imu.gyro_arw_dpsqrth=1..2 --over sensors.imu.gyro_arw_dpsqrth=1..3": ["has a range already"],
    "--over sensors.imu.gyro_arw_dpsqrth=1..2 --metric rmse_nort_m": ["--metric rmse_nort_m", "did you mean"],
    "--over sensors.imu.gyro_arw_dpsqrth=1..2 --window outage": ["--window outage", "valid: all"],
    "--over sensors.imu.gyro_arw_dpsqrth=1..2 --method fast": ["--method fast", "morris, sobol"],
    "--over sensors.imu.gyro_arw_dpsqrth=1..2 --samples 100": ["a power of 2"],
    "--over sensors.imu.gyro_arw_dpsqrth=1..2 --estimators kalman": ["no estimator 'kalman'"],
    "--over initial.yaw_deg=1..2 --metric nees_bias --estimators ins": ["ins is not scored on nees_bias"],
}


@pytest.mark.parametrize("words", BAD)
def test_bad_input_gives_one_message_and_leaves_nothing(words, tmp_path):
    out = tmp_path / "out"
    given = [] if words == "--over" else words.split()
    code, told = call("sensitivity", "quickstart", *SHORT, *given, "--out", str(out))
    assert code == 2 and len(told.strip().splitlines()) == 1 and not out.exists(), told
    for part in BAD[words]:
        assert part in told
