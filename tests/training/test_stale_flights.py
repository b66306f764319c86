"""What was learned, recorded or stored from flights of another maker is not taken for this one's."""

import pytest

from testbed.flight import cache
from testbed.scenario import load_scenario
from testbed.training.dataset import dataset_key
from testbed.training.flights import training_digest


@pytest.mark.parametrize(
    ("key", "scenario"),
    [(training_digest, "narx-ukf-2021"), (dataset_key, "ahrs-lstm-2022"), (lambda s: s.digest(), "quickstart")],
)
def test_the_maker_of_the_flights_counts(monkeypatch, key, scenario):
    made = load_scenario(scenario)
    now = key(made)
    monkeypatch.setattr(cache, "CODE_VERSION", cache.CODE_VERSION + 1)
    assert key(made) != now
    monkeypatch.undo()
    assert key(made) == now
