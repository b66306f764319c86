"""The scenario language: overlays, round trip, and one clear message per mistake."""

import pytest

from testbed.base.errors import InputError
from testbed.scenario import list_scenarios, load_scenario, parse_setting

MINIMAL = """
[scenario]
name = "tiny"
[flight]
aircraft = "aerosonde"
initial = { speed_mps = 30.0 }
[[flight.manoeuvres]]
type = "straight"
duration_s = 10.0
[sensors.imu]
model = "ADIS16448"
[sensors.gnss]
model = "Garmin16x"
[[estimators]]
name = "indirect-kf"
[monte_carlo]
runs = 7
[profiles.paper.monte_carlo]
runs = 1000
[variants.rough]
flight.wind = { turbulence = "severe" }
"""


@pytest.fixture
def write(tmp_path):
    def _write(text: str = MINIMAL, **replacements: str):
        for old, new in replacements.items():
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "tiny.toml"
        path.write_text(text)
        return path

    return _write


@pytest.mark.parametrize("name", list(list_scenarios()))
def test_shipped_scenarios_load_in_every_profile_and_variant(name):
    import tomllib

    tables = tomllib.loads(list_scenarios()[name].read_text())
    for profile in [None, *tables.get("profiles", {})]:
        for variant in [None, *tables.get("variants", {})]:
            assert load_scenario(name, profile, variant).name == name


def test_overlays_reach_only_what_they_name(write):
    path = write()
    plain, paper = load_scenario(path), load_scenario(path, profile="paper", variant="rough")
    assert (plain.monte_carlo.runs, paper.monte_carlo.runs) == (7, 1000)
    assert paper.flight.wind.turbulence == "severe"
    assert paper.flight.initial == plain.flight.initial


def test_an_overlay_changes_rows_of_the_estimators_by_label(write):
    """The other rows and the other parameters of that row stay; a row that is not there is named with the nearest."""
    rows = """[[estimators]]
name = "indirect-kf"
label = "tuned"
params = { accel_noise_scale = 2.0, gyro_noise_scale = 3.0 }
[[estimators]]
name = "ins"
[monte_carlo]"""
    change = "[variants.rough.estimators]\n{} = {{ params = {{ gyro_noise_scale = 9.0 }} }}"
    old = '[variants.rough]\nflight.wind = { turbulence = "severe" }'
    changed = load_scenario(write(**{"[monte_carlo]": rows, old: change.format("tuned")}), variant="rough").estimators
    assert [entry.row for entry in changed] == ["indirect-kf", "tuned", "ins"]
    assert changed[1].params == {"accel_noise_scale": 2.0, "gyro_noise_scale": 9.0} and not changed[0].params
    with pytest.raises(
        InputError, match=r"tiny.toml: 'variants.rough': 'estimators' has no row 'tund'; did you mean 'tuned'"
    ):
        load_scenario(write(**{"[monte_carlo]": rows, old: change.format("tund")}), variant="rough")


def test_settings_stand_above_the_file(write):
    settings = dict(
        [parse_setting("flight.manoeuvres.0.duration_s=12.5"), parse_setting("sensors.imu.model=ADIS16405")]
    )
    scenario = load_scenario(write(), overrides=settings)
    assert scenario.flight.manoeuvres[0].duration_s == 12.5
    assert scenario.sensors.imu.model == "ADIS16405"


def test_resolved_scenario_reads_back_the_same(write, tmp_path):
    scenario = load_scenario(write())
    again = tmp_path / "again.toml"
    again.write_text(scenario.to_toml())
    assert load_scenario(again).to_data() == scenario.to_data()
    assert load_scenario(again).digest() == scenario.digest()


def test_digest_ignores_the_number_of_runs_and_nothing_else(write):
    path = write()
    digest = load_scenario(path).digest()
    assert load_scenario(path, profile="paper").digest() == digest
    assert load_scenario(path, overrides={"monte_carlo.seed": 9}).digest() != digest
    assert load_scenario(path, variant="rough").digest() != digest


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration_s", "duration_sec", "duration_sec' is not a known key; did you mean 'duration_s'"),
        ("speed_mps = 30.0", "speed_kmh = 100.0", "did you mean 'speed_mps'"),
        ("runs = 7", 'runs = "seven"', "monte_carlo.runs'.*got 'seven'"),
        ("duration_s = 10.0", "duration_s = nan", "duration_s'.*finite"),
        ("duration_s = 10.0", "duration_s = -3.0", "greater than 0.*got -3.0"),
        ('"straight"', '"strait"', "unknown type 'strait'; did you mean 'straight'"),
        ('"indirect-kf"', '"indirekt-kf"', "unknown estimator 'indirekt-kf'; did you mean 'indirect-kf'"),
        ("[scenario]", "[scenario", "not valid TOML"),
        ('name = "tiny"', "", "'scenario.name' is missing"),
    ],
)
def test_a_mistake_is_named_with_its_place_and_its_remedy(write, old, new, message):
    with pytest.raises(InputError, match=message) as caught:
        load_scenario(write(**{old: new}))
    assert "tiny.toml" in str(caught.value)


def test_unknown_names_get_the_nearest_valid_one(write):
    with pytest.raises(InputError, match="did you mean 'quickstart'"):
        load_scenario("quikstart")
    with pytest.raises(InputError, match=r"no \[profiles.papper\]; did you mean 'paper'"):
        load_scenario(write(), profile="papper")
    with pytest.raises(InputError, match="no such scenario file"):
        load_scenario("absent.toml")
    with pytest.raises(InputError, match="expected KEY=VALUE"):
        parse_setting("runs")
