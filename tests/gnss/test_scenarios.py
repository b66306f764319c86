"""A scenario down to the satellites, from its file to the report."""

import pytest

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.montecarlo import runner
from testbed.report import render
from testbed.scenario import load_scenario


def test_a_tightly_coupled_filter_has_a_report(tmp_path):
    """Several satellites in one epoch make several innovations of one time."""
    scenario = load_scenario("spoofing", overrides={"monte_carlo.runs": 1, "claims": []})
    tight = scenario.model_copy(update={"estimators": [e for e in scenario.estimators if e.name == "tight-kf"]})
    runner.run(tight, tmp_path / "out", jobs=1)
    render(tmp_path / "out", svg=False)
    assert "pseudorange: range" in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.parametrize("name", ["spoofing", "jamming"])
def test_interference_after_the_flight_is_refused(name):
    short = load_scenario(name, overrides={"flight.duration_s": 30.0})
    with pytest.raises(InputError, match=rf"satellites\] {name}: begins at .* no effect"):
        pipeline.sense(short, pipeline.fly(short))
