"""Starting files: valid as they are, under any allowed name, and all that their comments offer is valid too."""

import re

import pytest

from testbed.errors import InputError
from testbed.new import NAME, TEMPLATES, new_file
from testbed.registry import load_plugin
from testbed.scenario import load_scenario


@pytest.mark.parametrize("name", ["mine", "my-filter_2", "none", "nav-solution", "class-var", "A"])
def test_an_estimator_loads_under_its_name(name, tmp_path):
    """Also where the class's name would be a keyword or one that the file imports."""
    path = new_file("estimator", name, tmp_path)
    assert load_plugin(path) == [name]


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
    ],
)
def test_bad_names_are_refused(kind, name, word, tmp_path):
    with pytest.raises(InputError, match=word):
        new_file(kind, name, tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_kept(tmp_path):
    path = new_file("scenario", "mine", tmp_path)
    path.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        new_file("scenario", "mine", tmp_path)
    assert path.read_text() == "mine"


def test_the_templates_hold_no_name_but_the_one_that_is_replaced():
    for file, name in (("estimator.py", "my-estimator"), ("scenario.toml", "my-scenario")):
        assert name in (TEMPLATES / file).read_text()
        assert NAME.fullmatch(name)
