"""Every key of a scenario says what it means, and `testbed explain` finds it."""

import pytest
from command_line import call

from testbed.base.errors import InputError
from testbed.cli.explain import explain
from testbed.scenario import Scenario
from testbed.scenario.explain import examples, find, keys


def test_every_key_is_described():
    silent = sorted({f"{key.table.__name__}.{key.name}" for key in keys(Scenario) if not key.meaning})
    assert not silent, f"declare a description below: {', '.join(silent)}"


@pytest.mark.parametrize(
    ("path", "full", "takes", "unit", "default"),
    [
        ("monte_carlo.runs", "monte_carlo.runs", "a whole number, at least 1, at most 999999", "", "20"),
        (
            "flight.manoeuvres.2.bank_deg",
            "flight.manoeuvres.bank_deg",
            "a number, at least -85, at most 85",
            "°",
            "none",
        ),
        ("variants.mine.sensors.gnss.mode", "sensors.gnss.mode", 'one of "errors", "satellites"', "", '"errors"'),
        ("crab_deg", "recording.initial.crab_deg", "a number, at least 0, at most 180", "°", "10.0"),
        (
            "sensors.imu.vibration.band_accel_g",
            "sensors.imu.vibration.band_accel_g",
            "a list of 3: a number",
            "g",
            "[0.0",
        ),
    ],
)
def test_what_is_known_of_a_key(path, full, takes, unit, default):
    key = find(list(keys(Scenario)), path)[0]
    assert (key.path, key.takes, key.unit) == (full, takes, unit)
    assert key.default.startswith(default)


def test_examples_stand_in_shipped_scenarios():
    assert ("quickstart", "[[80.0, 90.0]]") in examples("sensors.gnss.outages", most=100)


@pytest.mark.parametrize(("path", "told"), [("sensors.gnss.outage", "did you mean"), ("foo", "lists the tables")])
def test_a_key_that_there_is_not(path, told):
    with pytest.raises(InputError, match=told):
        find(list(keys(Scenario)), path)


def test_tables_of_tools_and_figures_of_a_sensor(capsys):
    explain("extra.dataset")
    explain("extra.tune.population")
    explain("sensors.odometer")
    told = capsys.readouterr().out
    assert "no training ever sees" in told and "Candidates per iteration" in told and "scale_factor_pct" in told


def test_the_verb(capsys):
    explain("bank_deg")
    explain("sensors.imu.gyro_arw_dpsqrth")
    told = capsys.readouterr().out
    assert "Bank angle" in told and "white_noise" in told
    code, told = call("explain", "sensors.imu.gyro_arv_dpsqrth")
    assert code == 2 and "gyro_arw_dpsqrth" in told
