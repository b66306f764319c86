"""Starting files: valid as they are, under any allowed name, and all that their comments offer is valid too."""

import re
from dataclasses import replace

import numpy as np
import pytest
from synthetic import sensor_log, weaving_flight

from testbed import fly
from testbed.base.errors import InputError
from testbed.cli.templates import NAME, TEMPLATES, new_file
from testbed.data import registry
from testbed.data.registry import load_plugin, make_estimator
from testbed.scenario import load_scenario

SHORT_FLIGHT = """
[scenario]
name = "short"
[flight]
aircraft = "{aircraft}"
initial = {{ lat_deg = 45.0, lon_deg = 5.0, alt_m = 1000.0, speed_mps = {speed}, heading_deg = 0.0 }}
manoeuvres = [{{ type = "turn", bank_deg = 30.0, duration_s = 4.0 }}]
[sensors.imu]
model = "ideal"
[[estimators]]
name = "ins"
"""


@pytest.fixture(autouse=True)
def _no_plugins(monkeypatch):
    monkeypatch.setattr(registry, "_plugins", {})


@pytest.mark.parametrize("name", ["mine", "my-filter_2", "none", "nav-solution", "class-var", "A"])
@pytest.mark.parametrize("kind", ["estimator", "policy"])
def test_a_plugin_loads_under_its_name(kind, name, tmp_path):
    """Also where the class's name would be a keyword or one that the file imports."""
    path = new_file(kind, name, tmp_path)
    assert load_plugin(path) == [name]


@pytest.mark.parametrize(("kind", "lines"), [("estimator", 30), ("policy", 20)])
def test_a_plugin_is_short_and_runs(kind, lines, tmp_path):
    """Where fixes are ten times as far off as their receiver says for a while, it is better than the filter that believes."""
    path = new_file(kind, f"short-{kind}", tmp_path)
    load_plugin(path)
    code = [line for line in path.read_text().splitlines() if line.strip()]
    assert len(code) < lines
    truth = weaving_flight(30.0, rate=50.0)
    log = sensor_log(truth, 1, position_sigma=3.0, velocity_sigma=0.2, std=(10.0, 1.0, 0.01))
    bad = (log.gnss.t > 15.0) & (log.gnss.t < 25.0)
    v_n = log.gnss.v_n + bad[:, None] * 2.0 * np.random.default_rng(0).standard_normal((len(bad), 3))
    log = replace(log, gnss=replace(log.gnss, v_n=v_n))
    error = {}
    for name in ("eskf", f"short-{kind}"):
        solution = make_estimator(name).run(log)
        error[name] = np.sqrt(np.mean((solution.v_n - truth.v_n[1:])[500:] ** 2))
    assert error[f"short-{kind}"] < 0.9 * error["eskf"]


def test_everything_that_the_scenario_offers_in_comments_is_valid(tmp_path):
    path = new_file("scenario", "my-flight", tmp_path)
    assert load_scenario(path).name == "my-flight"
    (tmp_path / "sensors.toml").write_text('[imu.own]\nsource = "none"\n')
    text = re.sub(r"^# (\[|\w+ = )", r"\1", path.read_text(), flags=re.M)
    assert text.count("\n# ") < path.read_text().count("\n# ") - 15
    path.write_text(text.replace("outages = [[30.0, 40.0]]", "", 1))
    scenario = load_scenario(path, profile="smoke", variant="better-imu")
    assert scenario.monte_carlo.runs == 2 and scenario.sensors.mag is not None and len(scenario.estimators) == 3


@pytest.mark.parametrize(
    ("kind", "name", "word"),
    [
        ("estimator", "a b", "my-estimator"),
        ("estimator", "../x", "my-estimator"),
        ("estimator", "2fast", "my-estimator"),
        ("estimator", "x-", "my-estimator"),
        ("estimator", "", "my-estimator"),
        ("estimator", "numpy", "hide"),
        ("estimator", "indirect-kf", "already"),
        ("scenario", "quickstart", "shipped"),
        ("scenarios", "x", "did you mean 'scenario'"),
        ("aircraft", "a/b", "my-aircraft"),
    ],
)
def test_bad_names_are_refused(kind, name, word, tmp_path):
    with pytest.raises(InputError, match=word):
        new_file(kind, name, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("like", ["aerosonde", "agile"])
def test_an_aircraft_flies_like_the_one_that_it_copies(like, tmp_path, monkeypatch):
    """Also one with XML of its own, in a folder of another name; the scenario names the folder from its own."""
    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path / "cache"))
    new_file("aircraft", "mine", tmp_path, like=like)
    flown = []
    for name in (like, "./mine"):
        speed = {"aerosonde": 30.0, "agile": 200.0}[like]
        (tmp_path / "flight.toml").write_text(SHORT_FLIGHT.format(aircraft=name, speed=speed))
        flown.append(fly(load_scenario(tmp_path / "flight.toml")))
    np.testing.assert_array_equal(flown[0].w_ib_b, flown[1].w_ib_b)


def test_a_changed_aircraft_of_ones_own_is_another_scenario(tmp_path):
    folder = new_file("aircraft", "mine", tmp_path)
    (tmp_path / "flight.toml").write_text(SHORT_FLIGHT.format(aircraft="./mine", speed=30.0))
    before = load_scenario(tmp_path / "flight.toml").digest()
    text = (folder / "aircraft.toml").read_text()
    (folder / "aircraft.toml").write_text(text.replace("roll_angle = 3.0", "roll_angle = 2.0"))
    assert load_scenario(tmp_path / "flight.toml").digest() != before


def test_a_folder_that_is_no_aircraft(tmp_path):
    (tmp_path / "flight.toml").write_text(SHORT_FLIGHT.format(aircraft="./nothing", speed=30.0))
    with pytest.raises(InputError, match=r"nothing: not an aircraft: it has no aircraft\.toml"):
        fly(load_scenario(tmp_path / "flight.toml"))
    with pytest.raises(InputError, match="did you mean 'agile'"):
        new_file("aircraft", "mine", tmp_path, like="agle")
    with pytest.raises(InputError, match="--like is for an aircraft"):
        new_file("estimator", "mine", tmp_path, like="agile")


def test_an_existing_file_is_kept(tmp_path):
    path = new_file("scenario", "mine", tmp_path)
    path.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        new_file("scenario", "mine", tmp_path)
    assert path.read_text() == "mine"


def test_the_templates_hold_no_name_but_the_one_that_is_replaced():
    for file, name in (("estimator.py", "my-estimator"), ("policy.py", "my-policy"), ("scenario.toml", "my-scenario")):
        assert name in (TEMPLATES / file).read_text()
        assert NAME.fullmatch(name)
