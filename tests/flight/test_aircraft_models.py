"""A user's aircraft is looked through and tried before JSBSim gets it: no file, no socket, no way out, no crash."""

import os
import shutil
import socket
import sys
from pathlib import Path

import pytest
from flights import flight

from testbed.base.errors import InputError
from testbed.base.resources import aircraft_root
from testbed.flight import fly_flight, models, trial
from testbed.flight.aircraft import load_aircraft

OUTPUT = '<output name="victim.txt" type="CSV" rate="10"><rates>ON</rates></output>'
INPUT = '<input port="15137" type="SOCKET" rate="10"/>'


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A copy of the aerosonde in an empty current folder; call it with replacements in its XML or TOML."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path / ".cache"))
    folder = tmp_path / "own"
    shutil.copytree(aircraft_root() / "aerosonde", folder)

    def change(old: str = "", new: str = "", file: str = "aerosonde.xml") -> Path:
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new, 1))
        return folder

    return change


def fly(folder: Path) -> None:
    fly_flight(flight(f"{folder}/", 30.0, {"type": "straight", "duration_s": 1.0}))


@pytest.mark.parametrize("element", [OUTPUT, INPUT, OUTPUT.replace("CSV", "SOCKET").replace("victim.txt", "127.0.0.1")])
def test_a_model_opens_no_file_and_no_socket(own, element, tmp_path):
    folder = own("</fdm_config>", f"{element}</fdm_config>")
    with pytest.raises(InputError, match=r"aerosonde.xml: <(output|input)> below <fdm_config>"):
        fly(folder)
    assert not list(tmp_path.rglob("victim*"))
    with socket.socket() as free:
        free.bind(("", 15137))  # nobody listens there


@pytest.mark.parametrize("name", ["part.xml", "part.data"])
def test_an_included_file_is_looked_through_as_well(own, name):
    folder = own("</fdm_config>", f'<flight_control file="{name}"/></fdm_config>')
    (folder / name).write_text(f"<flight_control>{INPUT}</flight_control>")
    with pytest.raises(InputError, match=f"{name}: <input> below <flight_control>"):
        load_aircraft(str(folder))


def test_signals_of_the_flight_control_are_ordinary(own):
    assert "<input>" in (own() / "aerosonde.xml").read_text()
    fly(own())


@pytest.mark.parametrize("name", ["../other", "/etc/passwd", "C:\\other", "sub\\..\\..\\other"])
def test_no_path_leaves_the_folder(own, name):
    folder = own("</fdm_config>", f'<system file="{name}"/></fdm_config>')
    with pytest.raises(InputError, match=r"aerosonde.xml: <system file=.*leaves the aircraft's folder"):
        load_aircraft(str(folder))


def test_no_link_leaves_the_folder(own, tmp_path):
    (tmp_path / "elsewhere.xml").write_text("<system/>")
    folder = own()
    os.symlink(tmp_path / "elsewhere.xml", folder / "part.xml")
    with pytest.raises(InputError, match=r"part.xml: a link that leaves"):
        load_aircraft(str(folder))
    with pytest.raises(InputError, match=r"model.jsbsim"):
        load_aircraft(str(own('jsbsim = "aerosonde"', 'jsbsim = "../aerosonde"', "aircraft.toml")))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("</fdm_config>", "", "not valid XML"),
        ("<fdm_config", "\x00<fdm_config", "not valid XML"),
        ("<fdm_config", '<!DOCTYPE x [<!ENTITY a "b">]><fdm_config', "DOCTYPE"),
    ],
)
def test_broken_xml_is_named(own, old, new, told):
    with pytest.raises(InputError, match=rf"aerosonde.xml: .*{told}"):
        load_aircraft(str(own(old, new)))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"fcs/engine-rpm"', '"no/such/prop"', "model.engine_property.*no property 'no/such/prop'"),
        ('"fcs/engine-rpm"', '"a b[[[/../.."', "model.engine_property.*property tree"),
        ("shipped = false", "shipped = false\nengines = 100000", "model.engines.*100"),
        ("shipped = false", "shipped = false\nengines = 3", "model.engines.*no property"),
        ("[limits]", '[model.setup]\n"../..x" = 1.0\n[limits]', "model.setup.*property tree"),
        ("[limits]", '[model.setup]\n"simulation/terminate" = 1.0\n[limits]', "model.setup.*steers JSBSim"),
    ],
)
def test_bad_properties_are_named_with_their_key(own, old, new, told):
    with pytest.raises(InputError, match=rf"aircraft.toml: .*{told}"):
        fly(own(old, new, "aircraft.toml"))


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("import os; os.abort()", "SIGABRT"),
        ("import time; time.sleep(60)", "does not return"),
        ("1/0", "division by zero"),
    ],
)
def test_a_model_that_kills_or_hangs_its_process_is_one_message(own, monkeypatch, tmp_path, code, told):
    """The interpreter of the trial is replaced by one that dies as JSBSim does on a malformed property."""
    stand_in = tmp_path / "python"
    stand_in.write_text(f"#!{sys.executable}\n{code}\n")
    stand_in.chmod(0o755)
    monkeypatch.setattr(trial.sys, "executable", str(stand_in))
    monkeypatch.setattr(trial, "LONGEST_S", 2.0)
    monkeypatch.setattr(trial, "_passed", set())
    with pytest.raises(InputError, match=told):
        fly(own())


def test_a_folder_that_is_no_aircraft_is_not_read_through(tmp_path):
    """``aircraft = "/"`` once hashed the whole disk."""
    with pytest.raises(InputError, match=r"/: not an aircraft: it has no aircraft.toml"):
        load_aircraft("/")
    (tmp_path / "aircraft.toml").touch()
    for k in range(models.MOST_FILES):
        (tmp_path / f"{k}").touch()
    with pytest.raises(InputError, match="more than 200 files"):
        load_aircraft(f"{tmp_path}/")
    with pytest.raises(InputError, match="not an aircraft: File name too long"):
        load_aircraft("x" * 300 + "/y")


@pytest.mark.parametrize("model", ["c172x", "737"])
def test_models_of_the_package_come_without_their_outputs_and_inputs(model):
    source = Path(models.importlib.util.find_spec("jsbsim").origin).parent / "aircraft" / model / f"{model}.xml"
    assert [child for child in models.parse(source) if child.tag in models.OPENING]
    with models.clean_copy(model) as paths:
        root = models.parse(paths.model / f"{model}.xml")
        assert not [child for child in root if child.tag in models.OPENING]
        assert model == "737" or list(root.iter("input"))  # signals of the flight control stay
    assert not paths.model.exists()
