"""Verdicts that are right as often as they say, on tables whose truth is known; runs that are no samples; named runaways.

``TESTBED_FULL_COUNTS=1`` repeats the simulations with the full counts of the acceptance (minutes).
"""

from __future__ import annotations

import math
import os
import tomllib
import warnings

import monte_carlo as mc
import numpy as np
import pytest
from scipy import stats
from scipy.special import stdtrit

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.cli import commands
from testbed.montecarlo import runner
from testbed.montecarlo.compare import compare_all, compare_results
from testbed.report import tables
from testbed.report.headline import headline
from testbed.report.index import entry_of
from testbed.report.results import load_result
from testbed.report.text import markdown
from testbed.scenario import Scenario
from testbed.scoring import effects
from testbed.scoring.claims import ClaimConfig
from testbed.scoring.effects import Effect, distinct_rows, effect
from testbed.scoring.statistics import difference_p, holm
from testbed.scoring.verdicts import check_claims, few_runs_notes, judge

FULL = bool(os.environ.get("TESTBED_FULL_COUNTS"))
MARGIN = 10.0
DIRECTION = ClaimConfig(better="a", than="b", metric="rmse_north_m")
EQUAL = ClaimConfig(better="a", than="b", metric="rmse_north_m", kind="equal", margin_pct=MARGIN)


@pytest.fixture(autouse=True)
def real_pipeline():
    """The plug-in of these tests replaces two functions of the pipeline; put them back."""
    before = pipeline.fly, pipeline.sense
    yield
    pipeline.fly, pipeline.sense = before


@pytest.fixture
def without_bootstrap(monkeypatch):
    """Simulations of thousands of tests take Student's interval of the same ratio in place of the bootstrap's."""

    def student(a, b, seed=0):
        x, y, n = a, b, len(a)
        ratio = x.mean() / y.mean()
        error = 100.0 * (x - ratio * y).std(ddof=1) / (math.sqrt(n) * y.mean())
        half = stdtrit(n - 1, 0.975) * error
        percent = 100.0 * (1.0 - ratio)
        return Effect(percent, percent - half, percent + half, error, n, percent, percent - half, percent + half)

    monkeypatch.setattr(effects, "_effect", student)


def table(rng, runs, improvement=0.0, scatter=0.15, common=0.3):
    """Paired errors of two methods, means in the ratio 1 - improvement; log-normal, as RMSEs are; the sensors are shared."""
    luck = np.exp(common * rng.standard_normal(runs))
    own = np.exp(scatter * rng.standard_normal((2, runs)) - 0.5 * scatter**2)
    return (1.0 - improvement) * luck * own[0], luck * own[1]


def word(claim, measured):
    return judge([claim], [measured])[0][0]


@pytest.mark.parametrize(
    ("low", "high", "paper", "expected"),
    [
        (10.0, 20.0, 15.0, "reproduced"),
        (10.0, 20.0, 5.0, "reproduced"),
        (10.0, 20.0, 20.0, "reproduced"),
        (10.0, 20.0, 34.0, "direction reproduced"),
        (10.0, 20.0, None, "reproduced"),
        (-5.0, 20.0, 15.0, "not reproduced"),
        (-20.0, -5.0, 15.0, "reversed"),
        (-0.04, -0.01, None, "not reproduced"),
        (0.01, 0.04, None, "not reproduced"),
        (math.nan, math.nan, 15.0, "not tested"),
    ],
)
def test_verdicts_on_a_direction(low, high, paper, expected):
    middle = 0.5 * (low + high)
    measured = Effect(middle, low, high, (high - low) / 4.2, 20, middle, low, high)
    assert word(DIRECTION.model_copy(update={"paper_improvement_pct": paper}), measured) == expected


@pytest.mark.parametrize(
    ("percent", "error", "expected"),
    [
        (0.0, 1.0, "reproduced"),
        (3.0, 1.0, "reproduced"),
        (0.0, 8.0, "undecided"),
        (10.0, 1.0, "undecided"),
        (20.0, 1.0, "not reproduced"),
        (-20.0, 1.0, "not reproduced"),
        (0.0, math.nan, "not tested"),
    ],
)
def test_verdicts_on_equality(percent, error, expected):
    half = 2.0 * error
    measured = Effect(percent, percent - half, percent + half, error, 1 if math.isnan(error) else 30)
    assert word(EQUAL, measured) == expected


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"kind": "equal"}, "needs margin_pct"),
        ({"margin_pct": 5.0}, "belongs to an equality claim"),
        ({"than": "a"}, "both name 'a'"),
        ({"paper_improvement_pct": 0.0}, "kind = 'equal' and margin_pct"),
    ],
)
def test_a_claim_says_what_it_is(change, told):
    with pytest.raises(InputError, match=told):
        validate(ClaimConfig, {"better": "a", "than": "b", "metric": "rmse_north_m"} | change, "s.toml")


@pytest.mark.usefixtures("without_bootstrap")
def test_equality_at_the_margin_is_found_in_five_percent():
    """Level of the two one-sided tests: at the margin itself, on either side, "reproduced" comes in 5 % of all tables."""
    rng, tables = np.random.default_rng(20), 20_000 if FULL else 1000
    for improvement in (0.01 * MARGIN, -0.01 * MARGIN):
        found = [word(EQUAL, effect(*table(rng, 60, improvement))) for _ in range(tables)]
        share = found.count("reproduced") / tables
        print(f"true effect {100 * improvement:+.0f} %, margin {MARGIN:.0f} %: reproduced in {100 * share:.2f} %")
        # sampling: four standard deviations; and 0.7 points for the skewness of the tables, of order 1 / sqrt(60) times 5 %
        assert abs(share - 0.05) < 4 * math.sqrt(0.05 * 0.95 / tables) + 0.007


@pytest.mark.usefixtures("without_bootstrap")
def test_equality_is_found_with_the_power_of_the_two_one_sided_tests():
    """Power for equal means: 2 Φ(margin / error - 1.645) - 1 (Chow, Shao & Wang, *Sample Size Calculations*, 3.2)."""
    rng, tables, runs = np.random.default_rng(21), 5000 if FULL else 500, 200
    scatter = 0.32  # so that the margin is three standard errors, where the power is neither 0 nor 1
    pairs = [effect(*table(rng, runs, 0.0, scatter)) for _ in range(tables)]
    error = np.median([e.error for e in pairs])
    expected = 2.0 * stats.norm.cdf(MARGIN / error - stats.norm.ppf(0.95)) - 1.0
    power = [word(EQUAL, e) for e in pairs].count("reproduced") / tables
    print(f"power {100 * power:.1f} %, stated {100 * expected:.1f} %")
    # the error itself varies by 1 / sqrt(2 * 200) = 5 % (more with long tails): 2 points of power at its slope here
    assert 0.6 < expected < 0.95
    assert abs(power - expected) < 4 * math.sqrt(expected * (1 - expected) / tables) + 0.02


@pytest.mark.usefixtures("without_bootstrap")
def test_holm_keeps_the_family_wise_error_over_simulated_pages():
    """Pages of 12 true nulls (9 of direction, 3 at the margin): any verdict that says something, in 5 % of the pages at most."""
    rng, pages, decided = (
        np.random.default_rng(22),
        1000 if FULL else 150,
        {"reproduced", "direction reproduced", "reversed"},
    )
    claims = [DIRECTION] * 9 + [EQUAL] * 3
    wrong = alone = 0
    for _ in range(pages):
        found = [effect(*table(rng, 40, 0.0 if claim is DIRECTION else 0.01 * MARGIN)) for claim in claims]
        wrong += any(verdict in decided for verdict, _, _ in judge(claims, found))
        alone += any(word(claim, e) in decided for claim, e in zip(claims, found, strict=True))
    print(f"pages with a wrong verdict: {wrong} of {pages}; uncorrected {alone}")
    assert wrong / pages <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / pages)  # three standard deviations of the count
    assert alone / pages > 0.3  # 1 - 0.95^12 = 46 %: the correction is needed


def test_holm_is_the_textbook_example():
    # Holm (1979): ordered p-values times n, n-1, ..., kept monotone
    adjusted = holm(np.array([0.01, 0.04, 0.03, 0.005, math.nan]))
    assert np.allclose(adjusted, [0.03, 0.06, 0.06, 0.02, math.nan], equal_nan=True)


def test_claims_on_time_do_not_move_the_verdicts_of_the_others():
    rng = np.random.default_rng(23)
    a, b = table(rng, 30, 0.05)
    for cost in (np.full(30, 1.0), np.linspace(1.0, 3.0, 30)):
        values = {("a", "us_per_sample"): cost, ("b", "us_per_sample"): cost[::-1]}
        values |= {("a", "rmse_north_m"): a, ("b", "rmse_north_m"): b}
        timed = DIRECTION.model_copy(update={"metric": "us_per_sample"})
        rows = check_claims([DIRECTION, timed, timed], lambda row, _, metric, v=values: v[row, metric], 1)
        assert rows[0]["p_holm"] == rows[0]["p_value"]


def test_one_runaway_cannot_turn_a_verdict_without_being_named():
    """One run of a fixed table of 200 made 10,000 times worse, of either method: the verdict stays, or says why it does not."""
    rng, turned = np.random.default_rng(24), 0
    for improvement, paper in ((0.2, 15.0), (0.2, 34.0), (0.0, None), (-0.2, 10.0), (0.0, "equal"), (0.3, "equal")):
        claim = EQUAL if paper == "equal" else DIRECTION.model_copy(update={"paper_improvement_pct": paper})
        pair = table(rng, 200, improvement)
        before = word(claim, effect(*pair))
        for side in (0, 1):
            for run in range(0, 200, 10) if FULL else (57,):
                spoilt = [values.copy() for values in pair]
                spoilt[side][run] *= 1e4
                values = dict(zip("ab", spoilt, strict=True))
                row = check_claims([claim], lambda method, *_, v=values: v[method], 1, range(1000, 1200))[0]
                assert row["verdict"] in (before, "depends on runaways")
                assert row["runaways"] == str(1000 + run)
                turned += row["verdict"] != before
    assert turned  # else the table would be too tame to show anything


def test_lost_runs_count_as_the_worst():
    """A method that loses most runs and shines in the rest does not win: the median of the ratios says no."""
    rng = np.random.default_rng(25)
    a, b = table(rng, 60, 0.3)
    a[:45] = np.nan
    row = check_claims([DIRECTION], lambda method, *_: {"a": a, "b": b}[method], 1)[0]
    assert (row["lost_better"], row["lost_than"], row["n"]) == (45, 0, 15)
    assert row["verdict"] == "depends on runaways" and row["median_pct"] == -math.inf


def test_the_median_has_its_binomial_interval():
    """Ranks 5 and 16 of 20 (1-based 6 and 15) hold a median with 95.9 % (tables of the sign test)."""
    measured = effect(np.arange(1.0, 21.0), np.full(20, 100.0))
    assert (measured.median_high, measured.median, measured.median_low) == pytest.approx((94.0, 89.5, 85.0))
    assert math.isnan(effect(np.arange(1.0, 6.0), np.full(5, 100.0)).median_low)


@pytest.mark.parametrize("runs", [1, 2, 3, 30])
def test_tables_of_any_kind_are_judged_without_a_warning(runs):
    """Equal, proportional, lost, zero and infinite-looking tables: a verdict each, and no warning of a library."""
    rng = np.random.default_rng(26)
    b = np.exp(rng.standard_normal(runs))
    shapes = [
        b,
        0.5 * b,
        b + 1e-13,
        np.full(runs, np.nan),
        np.zeros(runs),
        b * np.where(np.arange(runs) % 2, 1e200, 1.0),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for a in shapes:
            for other in (b, np.zeros(runs)):
                found = effect(a, other)
                assert word(DIRECTION, found) in WORDS and word(EQUAL, found) in WORDS
            if runs > 1 and np.isfinite(a).all() and a.max() < 1e100:
                assert all(0.0 <= difference_p(a, b, paired) <= 1.0 for paired in (True, False))


WORDS = (
    *("reproduced", "direction reproduced", "not reproduced", "reversed"),
    *("undecided", "depends on runaways", "not tested"),
)


def test_tables_say_what_their_intervals_cover(tmp_path):
    settings = {"runs": 8, "seed": 1, "vary": ["noise", "manoeuvres"]}
    drawn = {"monte_carlo": settings | {"disperse": {"initial.speed_mps": {"factor": [0.9, 1.1]}}}}
    for name, more, words in (("one", {}, "seeds of one flight"), ("many", drawn, "flights and seeds")):
        scenario = mc.scenario([mc.GOOD, mc.BAD], claims=[mc.CLAIM], runs=8).model_dump(mode="json", exclude_none=True)
        result = runner.run(Scenario.model_validate(scenario | more), tmp_path / name, jobs=1, plugins=[mc.PLUGIN])
        assert f"intervals cover {words}" in tables.claims(load_result(result.out))[0].note


def test_copies_of_a_pair_are_one_pair():
    assert distinct_rows(np.array([[1.0, np.nan], [2.0, 3.0], [1.0, np.nan], [2.0, 3.0]])).tolist() == [0, 1]
    measured = effect(np.full(20, 1.0), np.full(20, 2.0))
    assert measured.n == 1 and math.isnan(measured.low) and math.isnan(measured.p_value)
    assert word(DIRECTION, measured) == word(EQUAL, measured) == "not tested"


def still(label, north_m, **params):
    """An estimator with the same error in every run."""
    return {"name": "still", "label": label, "params": {"north_m": north_m} | params}


def test_few_runs_say_that_they_do_not_settle_a_claim():
    """Half of the error in both of two runs: the interval leaves 0 out, Student's t of one degree of freedom does not."""
    columns = {"a": np.array([1.0, 1.3]), "b": np.array([2.2, 2.4])}
    timed = DIRECTION.model_copy(update={"metric": "us_per_sample"})
    rows = check_claims([DIRECTION, timed], lambda row, *_: columns[row], 0)
    for row in rows:
        assert row["ci_low"] > 0.0 and row["p_holm"] > 0.05 and row["verdict"] == "not reproduced"
    assert few_runs_notes(rows[1:]) == []
    (note,) = few_runs_notes(rows)
    assert "(1)" in note and "more runs settle it" in note
    columns["a"][1] = 9.0  # the interval holds 0
    assert few_runs_notes(check_claims([DIRECTION], lambda row, *_: columns[row], 0)) == []


def test_a_batch_of_few_runs_has_the_note(tmp_path):
    claim = mc.CLAIM | {"better": "a", "than": "b"}
    rows = [
        {"name": "noisy", "label": row, "params": {"sigma_m": 0.1, "common_m": common}}
        for row, common in (("a", 1.0), ("b", 2.0))
    ]
    result = runner.run(mc.scenario(rows, runs=2, claims=[claim]), tmp_path / "out", jobs=1, plugins=[mc.PLUGIN])
    assert "says little of so few runs" in result.notes[0]
    assert list(result.notes) == few_runs_notes(result.claims.to_dict("records"))
    assert list(load_result(result.out).manifest["notes"]) == list(result.notes)


def test_identical_runs_are_one_run_everywhere(tmp_path, capsys):
    rows, claims = [still("a", 1.0), still("b", 2.0)], [{"better": "a", "than": "b", "metric": "rmse_north_m"}]
    claims += [claims[0] | {"kind": "equal", "margin_pct": 60.0}, claims[0] | {"metric": "us_per_sample"}]
    made = [
        runner.run(mc.scenario(rows, runs=5, claims=claims), tmp_path / name, jobs=1, plugins=[mc.PLUGIN])
        for name in ("one", "two")
    ]
    result = made[0]
    assert result.claims["verdict"].tolist() == ["not tested"] * 3
    assert result.claims[["ci_low", "ci_high", "p_value", "p_holm"]].isna().all(axis=None)
    assert set(result.summary["n"]) == {1} and result.summary["ci_low"].isna().all()
    assert set(result.improvements["n"]) == {1} and result.improvements["p_value"].isna().all()
    loaded = load_result(result.out)
    assert "one run" in headline(loaded).sentences[0]
    assert not {"reproduced", "reproduced."} & set(markdown(loaded, {}).replace("*", "").split())
    worse = [still("a", 1.5), still("b", 2.0)]
    other = runner.run(mc.scenario(worse, runs=5), tmp_path / "worse", jobs=1, plugins=[mc.PLUGIN]).out
    assert set(compare_all(made[0].out, made[1].out)["verdict"]) == {"same"}
    assert set(compare_results(result.out, other)["verdict"]) == {"not tested"}
    assert commands.compare(result.out, other) == 0 and "no statistical error" in capsys.readouterr().out


def test_copies_among_real_runs_count_once(tmp_path):
    """Runs 5 to 9 repeat run 4: six samples, not ten."""
    rows = [{"name": "repeats", "label": "a"}, {"name": "repeats", "label": "b", "params": {"sigma_m": 2.0}}]
    claim = {"better": "a", "than": "b", "metric": "rmse_north_m"}
    result = runner.run(mc.scenario(rows, runs=10, claims=[claim]), tmp_path / "out", jobs=1, plugins=[mc.PLUGIN])
    assert result.claims["n"].tolist() == [5] and set(result.summary["n"]) == {5}


def test_auto_stops_where_runs_are_copies(tmp_path):
    rows, claims = [still("a", 1.0), still("b", 2.0)], [{"better": "a", "than": "b", "metric": "rmse_north_m"}]
    auto = runner.Auto(width_pct=1.0, cap=200)
    result = runner.run(mc.scenario(rows, claims=claims), tmp_path / "out", runs=auto, jobs=1, plugins=[mc.PLUGIN])
    assert result.runs["run"].nunique() == auto.first


def test_own_claims_are_counted_apart(tmp_path):
    claims = [mc.CLAIM, mc.CLAIM | {"id": "2", "origin": "own"}, mc.CLAIM | {"id": "3", "origin": "own"}]
    result = runner.run(
        mc.scenario([mc.GOOD, mc.BAD], runs=30, claims=claims), tmp_path / "out", jobs=1, plugins=[mc.PLUGIN]
    )
    loaded = load_result(result.out)
    told = entry_of(loaded)
    assert (len(told["verdicts"]), len(told["own_verdicts"])) == (1, 2)
    assert [(t.title, len(t.rows)) for t in tables.claims(loaded)] == [("Claims", 1), ("Our own claims", 2)]


def test_shipped_claims_say_whose_they_are():
    from testbed.scenario import list_scenarios, load_scenario, overlays_of

    for name, path in list_scenarios().items():
        for variant in [None, *overlays_of(path)[1]]:
            for claim in load_scenario(name, variant=variant).claims:
                assert (claim.origin == "own") == (name in OWN_SCENARIOS or claim.id in OWN)
        assert "paper_improvement_pct = 0.0" not in path.read_text()
        assert tomllib.loads(path.read_text())["scenario"]["name"] == name


OWN = (
    *("4-bias-states", "4-kfann-coasting", "4-t2-kfann-coasting", "4-t3-kfann-coasting"),
    *("4-nnckf", "4-nnakf", "own-network", "own-attitude"),
)
OWN_SCENARIOS = (
    "quickstart",
    "car-drive",
    "city-partial",
    "bank-and-lose",
    "jamming",
    "spoofing",
    "whole-flight",
    "multirotor",
    "field-mission",
)
