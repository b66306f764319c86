"""What a scenario says without effect is told once, kept in the manifest and shown in the report; extras are never in the way."""

import json
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from command_line import SHORT, call

from testbed.base.errors import InputError
from testbed.base.notes import notes_of
from testbed.data.registry import GROUP, estimator_class, make_estimator
from testbed.formats import export_log
from testbed.pipeline import fly, sense
from testbed.scenario import load_scenario

FLIGHT = {"flight.duration_s": 10.0, "sensors.gnss.outages": [], "windows": [], "claims": [], "sensors.baro": {}}


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path / ".cache"))
    return tmp_path


def quickstart(**more):
    return load_scenario("quickstart", overrides=FLIGHT | {key.replace("__", "."): v for key, v in more.items()})


def test_every_shipped_estimator_says_which_sensors_it_uses():
    # nobody knows what the program behind an external row has read
    for name in sorted({entry.name for entry in entry_points(group=GROUP)} - {"external"}):
        kind = estimator_class(name)
        definer = next(k for k in kind.__mro__ if "run" in vars(k))
        sensors = make_estimator(name).sensors if isinstance(kind.sensors, property) else kind.sensors
        assert set(sensors) <= {"imu", "gnss", "gnss_raw", "mag", "baro"} and "imu" in sensors
        assert any("sensors" in vars(k) for k in kind.__mro__[: kind.__mro__.index(definer) + 1]), name


def test_a_sensor_that_no_estimator_uses_is_told():
    idle = "no estimator of this run uses the sensor baro"
    assert notes_of(quickstart(estimators=[{"name": "ins"}, {"name": "indirect-kf"}])) == [idle]
    only_ins = notes_of(quickstart(estimators=[{"name": "ins"}]))
    assert only_ins == ["no estimator of this run uses the sensor gnss", idle]


PLUGIN = """
from estimators.methods.indirect_kf import IndirectKf
class Says(IndirectKf):
    name = "says"
    sensors = ("imu", "gnss", "baro")
class Silent(IndirectKf):
    name = "silent"
    def run(self, log):
        return super().run(log)
"""


@pytest.mark.parametrize("name", ["says", "silent"])
def test_what_an_estimator_may_use_is_not_told(name, workplace):
    """One that says so, and one whose own ``run`` makes what its parent said worthless."""
    from testbed.data.registry import load_plugin

    Path("plugin.py").write_text(PLUGIN)
    load_plugin("plugin.py")
    assert notes_of(quickstart(estimators=[{"name": name}])) == []


def test_dispersed_keys_without_effect_are_told():
    disperse = {"manoeuvres.1.bank_deg": {"normal": [30.0, 2.0]}}
    settings = {"monte_carlo__disperse": disperse, "estimators": [{"name": "ahrs-kf"}], "sensors__mag": {}}
    assert "monte_carlo.disperse has no effect" in notes_of(quickstart(**settings))[0]


@pytest.fixture
def recording(workplace):
    scenario = quickstart()
    truth = fly(scenario)
    log, _ = sense(scenario, truth)
    export_log(log, workplace / "table", "csv", reference=truth)
    text = '[scenario]\nname = "r"\n[recording]\nformat = "table"\ndir = "table"\n[[estimators]]\nname = "ins"\n'
    Path("r.toml").write_text(text)
    return "r.toml"


def test_sensors_beside_a_recording_leave_its_own_aside(recording):
    given = load_scenario(recording, overrides={"sensors.imu.model": "ADIS16448"})
    assert "the recording's own sensors (imu, gnss" in notes_of(given)[0]


def test_keys_without_effect_on_a_recording_are_told(recording):
    assert notes_of(load_scenario(recording, overrides={"estimators.0.name": "indirect-kf"})) == [
        "no estimator of this run uses the sensor baro"
    ]
    given = {"recording.initial.heading": "none", "initial.yaw_deg": 9.0, "monte_carlo.vary": ["noise"]}
    told = " | ".join(notes_of(load_scenario(recording, overrides=given)))
    for key in ("initial.yaw_deg", "monte_carlo.vary"):
        assert f"{key} has no effect" in told
    assert "recording.initial.heading" not in told  # acts: the heading, which the log states, is unknown now
    assert "nothing tells the heading at the start" in told


def test_notes_are_printed_once_and_kept(workplace):
    options = [*SHORT, "--runs", "1", "--jobs", "1", "--estimators", "indirect-kf", "--set", "sensors.baro={}"]
    code, said = call("run", "quickstart", *options, "--out", "out")
    idle = "no estimator of this run uses the sensor baro"
    assert code == 0 and said.count(idle) == 1
    assert json.loads(Path("out/manifest.json").read_text())["notes"] == [idle]
    assert f"Note: {idle}." in Path("out/report.md").read_text()
    assert idle in Path("out/report.html").read_text()


def test_flying_without_the_extra_formats_leaves_out_the_track(workplace, monkeypatch):
    monkeypatch.setitem(sys.modules, "simplekml", None)
    code, said = call("fly", "quickstart", "--set", "flight.duration_s=5", "--out", "out")
    assert code == 0, said
    assert said.startswith("note: trajectory.kml is left out: KML needs the package simplekml")
    assert sorted(path.name for path in Path("out").iterdir()) == [
        "trajectory.csv",
        "trajectory.mat",
        "trajectory.parquet",
    ]


def test_tuning_without_the_extra_tuning_leaves_out_its_algorithm(monkeypatch, capsys):
    from testbed.tuning.command import _without_extras
    from testbed.tuning.config import TuneConfig

    monkeypatch.setitem(sys.modules, "cma", None)
    config = _without_extras(TuneConfig(algorithms=["de", "cma-es"]), asked=False)
    assert config.algorithms == ["de"] and config.innovation_search == "de"
    assert capsys.readouterr().err.count("note: ") == 2
    with pytest.raises(InputError, match="needs the package cma"):
        _without_extras(TuneConfig(algorithms=["de", "cma-es"]), asked=True)
