"""Ranks of algorithms: by hand, ties, and intervals that are as wide as the seeds leave them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from testbed.base.errors import InputError
from testbed.tuning.ranks import rank_table, ranks

MEAN = {"fitness": [("fitness", "mean")]}


def lines(**values):
    return pd.DataFrame([{"algorithm": name, "fitness": v} for name, found in values.items() for v in found])


def test_ranks_and_ties():
    np.testing.assert_array_equal(
        ranks(np.array([[3.0, 1.0, 2.0], [5.0, 5.0, 1.0]])), [[3.0, 1.0, 2.0], [2.5, 2.5, 1.0]]
    )


def test_sums_by_hand():
    """a: min 1, max 9, mean 5, variance 32; b: 2, 4, 3, 2: a is first in the minimum alone, so 1 + 2 + 2 + 2 and 2 + 1 + 1 + 1."""
    parts = {"all": [("fitness", s) for s in ("min", "max", "mean", "variance")], **MEAN}
    table = rank_table(lines(a=[1.0, 9.0], b=[2.0, 4.0]), parts).set_index(["part", "algorithm"])
    assert list(table.loc["all", "rank_sum"]) == [7.0, 5.0]
    assert list(table.loc["all", "place"]) == [2.0, 1.0]
    assert list(table.loc["fitness", "rank_sum"]) == [2.0, 1.0]
    assert (table.loc["all", "rows"] == 4).all()


def test_interval_is_one_place_where_searches_lie_apart():
    table = rank_table(lines(a=[1.0, 1.1, 1.2], b=[2.0, 2.1, 2.2], c=[3.0, 3.1, 3.2]), MEAN)
    assert list(table["place"]) == list(table["place_low"]) == list(table["place_high"]) == [1.0, 2.0, 3.0]


def test_interval_of_equal_algorithms_is_all_places():
    """Ten searches each from one distribution: whoever leads, the seeds do not tell (5 % of a place each side needs far less)."""
    rng = np.random.default_rng(3)
    table = rank_table(lines(**{name: rng.normal(10.0, 1.0, 10) for name in "abcd"}), MEAN)
    assert (table["place_high"] - table["place_low"] >= 1.0).all()
    assert table["place_low"].min() == 1.0 and table["place_high"].max() == 4.0


def test_a_bootstrap_covers_the_place_that_many_searches_have():
    """Means 0, 0.5 and 1 with sigma 1 and 20 searches each: the true places lie in their intervals in 95 % of 60 trials (binomial: at least 51)."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(60):
        table = rank_table(
            lines(a=rng.normal(0.0, 1.0, 20), b=rng.normal(0.5, 1.0, 20), c=rng.normal(1.0, 1.0, 20)), MEAN
        )
        held += bool(((table["place_low"] <= [1, 2, 3]) & (table["place_high"] >= [1, 2, 3])).all())
    assert held >= 51


def test_too_few_searches_are_refused():
    with pytest.raises(InputError, match="got a 2, b 1"):
        rank_table(lines(a=[1.0, 2.0], b=[1.0]), MEAN)
