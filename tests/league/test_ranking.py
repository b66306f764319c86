"""Places and marks against a second implementation (scipy) and by hand, on made errors."""

import math

import numpy as np
import pytest
from scipy import stats

from testbed.league import ranking
from testbed.league.suite import load_track

TRACK = load_track("agile-outages")
RNG = np.random.default_rng(7)


def runs(errors, nees=1.0):
    """Runs as cells hold them; an error that is no number is a lost run."""
    return [
        {"error": None, "reason": "lost"} if math.isnan(e) else {"error": e, "reason": "", "nees": {"position": nees}}
        for e in errors
    ]


def scattered(centre, spread, n=12):
    return centre * np.exp(spread * RNG.standard_normal(n))


def by_name(standings):
    return {standing.entry: standing for standing in standings}


def test_mean_interval_and_pairs_are_those_of_scipy():
    """Student's interval and paired t test of the logarithms; Holm by hand for three pairs."""
    common = scattered(1.0, 0.3)
    errors = {
        "a": 2.0 * common * scattered(1.0, 0.1),
        "b": 2.3 * common * scattered(1.0, 0.1),
        "c": 2.35 * common * scattered(1.0, 0.1),
    }
    errors["c"] *= 1.01 * stats.gmean(errors["b"]) / stats.gmean(errors["c"])
    found = by_name(ranking.table(TRACK, {name: runs(e) for name, e in errors.items()}))
    for name, e in errors.items():
        logs = np.log(e)
        low, high = stats.t.interval(0.95, len(e) - 1, logs.mean(), stats.sem(logs))
        assert found[name].error == pytest.approx(stats.gmean(e))
        assert (found[name].low, found[name].high) == pytest.approx((math.exp(low), math.exp(high)))
    pairs = [("a", "b"), ("a", "c"), ("b", "c")]
    p = sorted((stats.ttest_rel(np.log(errors[x]), np.log(errors[y])).pvalue, (x, y)) for x, y in pairs)
    apart = []
    for k, (value, pair) in enumerate(p):
        if value * (3 - k) >= 0.05:
            break
        apart.append(pair)
    assert apart and len(apart) < 3, "made so that both happen"
    for x, y in pairs:
        assert (y in found[x].tied) == ((x, y) not in apart)
    assert [found[name].rank for name in "abc"] == [1, 2, 2]


def test_a_row_of_fewer_runs_is_set_off_against_the_reference():
    """The first two draws are easy. By hand: on them the row errs by 2 and 3 times the reference's 1 m, by sqrt(6) in the mean, and the
    reference's mean over all four is 2 m."""
    errors = {"indirect-kf": [1.0, 1.0, 4.0, 4.0], "slow": [2.0, 3.0], "other": [1.9, 3.1, 8.0, 9.0]}
    found = by_name(ranking.table(TRACK, {name: runs(e) for name, e in errors.items()}))
    assert found["indirect-kf"].error == pytest.approx(2.0)
    assert found["slow"].error == pytest.approx(2.0 * math.sqrt(6.0))
    assert found["other"].error == pytest.approx(stats.gmean(errors["other"]))
    halves = [stats.t.ppf(0.975, n - 1) * stats.sem(np.log(e)) for n, e in ((2, [2.0, 3.0]), (4, [1.0, 1.0, 4.0, 4.0]))]
    assert math.log(found["slow"].high / found["slow"].error) == pytest.approx(math.hypot(*halves))
    alone = ranking.table(TRACK, {"slow": runs([2.0, 3.0]), "lost": runs([math.nan] * 2)})
    assert by_name(alone)["slow"].error == pytest.approx(math.sqrt(6.0)), "without the reference as it is"
    lost = by_name(ranking.table(TRACK, {"indirect-kf": runs([1.0, 1.0, 4.0, 4.0]), "lost": runs([math.nan] * 2)}))
    assert lost["lost"].error == pytest.approx(ranking.limit_of(TRACK)), "a row that loses all stands at the limit"


def test_a_row_of_great_scatter_does_not_tie_the_field():
    """It leads by chance and nothing tells it from the last; the second, which is sharp, does."""
    errors = {
        "wild": scattered(1.0, 4.0),
        "sharp": scattered(3.0, 0.01),
        "worse": scattered(6.0, 0.01),
        "twin": scattered(6.0, 0.01),
    }
    errors["wild"] *= 2.5 / stats.gmean(errors["wild"])
    errors["twin"] *= 1.0001 * stats.gmean(errors["worse"]) / stats.gmean(errors["twin"])
    found = by_name(ranking.table(TRACK, {name: runs(e) for name, e in errors.items()}))
    assert [found[name].rank for name in ("wild", "sharp", "worse", "twin")] == [1, 1, 3, 3]
    assert "worse" in found["wild"].tied


def test_the_runs_that_both_have_are_paired():
    """Ten runs of a slow row against the first ten of a hundred: the other ninety say nothing of the pair."""
    fast = np.concatenate([scattered(1.0, 0.02, 10), scattered(50.0, 0.02, 90)])
    slow = 2.0 * fast[:10]
    found = by_name(ranking.table(TRACK, {"fast": runs(fast), "slow": runs(slow * scattered(1.0, 0.01, 10))}))
    assert found["slow"].tied == [] and found["fast"].runs == 100
    # The mean of all its runs puts it behind, and the pair says that it is not worse: it shares the place.
    assert (found["slow"].rank, found["fast"].rank) == (1, 1)


def test_lost_runs_and_marks():
    n = 12
    rows = {
        "honest": runs(scattered(3.0, 0.01), 1.1),
        "boaster": runs(scattered(2.0, 0.01), 9.0),
        "timid": runs(scattered(2.5, 0.01), 0.1),
        "silent": [{"error": e, "reason": "", "nees": {}} for e in scattered(2.2, 0.01)],
        "gone": runs([math.nan] * n),
        "half": runs([3.0, math.nan] * (n // 2)),
    }
    found = by_name(ranking.table(TRACK, rows))
    assert {name: found[name].mark for name in rows} == {
        "honest": "", "boaster": "over-confident", "timid": "over-cautious", "silent": "no sigmas", "gone": "no run finished", "half": "",
    }  # fmt: skip
    assert [name for name in rows if found[name].wins] == ["honest"]
    assert found["boaster"].rank == 1 and found["honest"].rank == 4
    assert found["gone"].error == pytest.approx(10000.0) and found["gone"].lost == n
    assert found["half"].error == pytest.approx(math.sqrt(3.0 * 10000.0)) and found["half"].lost == n // 2


def test_a_mark_needs_proof():
    """NEES of 0.9 to 3.0 scatters about 1.4: nothing is shown; its copy of a hundred runs is over-confident."""
    few = [{"error": 1.0, "reason": "", "nees": {"position": x}} for x in (0.9, 1.2, 3.0)]
    assert ranking.honesty(few)[1] == "" and ranking.honesty(few * 34)[1] == "over-confident"
    wild = [{"error": 1.0, "nees": {"position": value}} for value in (30.0, 80.0, 240.0)]
    assert ranking.honesty(wild)[1] == "over-confident", "three runs are enough where no chance makes such a mean"
    assert ranking.honesty([{"error": 1.0, "nees": {"position": value}} for value in (0.3, 1.0, 5.0)])[1] == ""
    assert ranking.honesty([{"error": 1.0, "nees": {"position": 0.0001}}])[1] == ""
    assert (
        ranking.honesty([{"error": 1.0, "nees": {"position": value}} for value in (0.01, 0.02, 0.0)])[1]
        == "over-cautious"
    )
    for n in (1, 3, 10):
        least, most = ranking.chance(n)
        assert stats.chi2.cdf([n * least, n * most], n) == pytest.approx([0.005, 0.995])
    assert ranking.honesty([{"error": 1.0, "nees": {"position": None}}] * 3)[1] == "over-confident", "sigmas of zero"
    assert ranking.honesty([{"error": 1.0, "nees": {"position": 1.0, "attitude": 8.0}}] * 3)[1] == "over-confident"


def test_one_run_is_told_and_separates_nothing():
    found = ranking.table(TRACK, {"a": runs([1.0]), "b": runs([5.0])})
    assert [(s.entry, s.rank, s.low) for s in found] == [("a", 1, None), ("b", 1, None)]
