"""The block of conditions says what a scenario sets, with units, and nothing that it leaves at zero."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from testbed.report import conditions
from testbed.scenario import load_scenario


def rows_of(name: str, **changes):
    scenario = load_scenario(name, overrides=changes).to_data()
    table = conditions.table(SimpleNamespace(scenario=scenario))
    return {row: cells[0].text for row, cells in table.rows}


def test_the_quickstart_in_words():
    rows = rows_of("quickstart")
    assert rows["Vehicle"] == "aerosonde"
    assert rows["Wind"] == "north 3 m/s, east -2 m/s, turbulence light"
    assert rows["Start, 1 sigma"].startswith("position 3 m, velocity 0.3 m/s, roll pitch 1 °, yaw 3 °")
    assert rows["GNSS outages"] == "80 to 90 s"
    assert "misalignment" in rows["Switched off"] and "GNSS outliers" not in rows


@pytest.mark.parametrize(
    ("name", "changes", "row", "told"),
    [
        ("quickstart", {"sensors.gnss.outliers": {"count": 3, "offset_m": 30.0}}, "GNSS outliers", "count 3, duration 1 s, offset 30 m"),
        ("quickstart", {"sensors.gnss.outages": []}, "GNSS outages", "none"),
        ("rover", {}, "Script", ", 4 laps"),
        ("field-mission", {}, "Script", "2-4 waypoints, 5 loiter"),
        ("whole-flight", {}, "Start, 1 sigma", "align at rest 60 s"),
    ],
)  # fmt: skip
def test_what_else_a_scenario_may_say(name, changes, row, told):
    assert told in rows_of(name, **changes)[row]


def test_a_result_without_its_scenario_has_no_block():
    assert conditions.table(SimpleNamespace(scenario={})) is None
