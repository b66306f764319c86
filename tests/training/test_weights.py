"""Files of weights and checkpoints: the same training is the same bytes, and what is damaged is refused by name."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from small_training import Flight, trained

from estimators.learning.ahrs_weights import BY_NAME, SHIPPED, load_weights
from estimators.learning.networks.mlp import load_networks, new_mlp, save_networks
from estimators.learning.networks.tensor_file import read_arrays, write_arrays
from testbed.base.errors import InputError
from testbed.scenario import load_scenario

FILES = ("checkpoint.safetensors", "ahrs-lstm.safetensors", "learning-curve.csv")
SCRIPT = Path(__file__).parents[1] / "run_training.py"
SCENARIO = """
[scenario]
name = "short"
[flight]
aircraft = "aerosonde"
rate_hz = 50.0
initial = { alt_m = 500.0, speed_mps = 30.0 }
manoeuvres = [{ type = "straight", duration_s = 6.0 }]
[sensors.imu]
model = "ADIS16448"
[sensors.mag]
model = "ADIS16405"
[monte_carlo]
runs = 2
[[estimators]]
name = "ahrs-lstm"
params = { weights = "victim.txt" }
"""


@pytest.fixture(scope="module")
def flights():
    return [Flight(seed) for seed in range(3)]


@pytest.fixture(scope="module")
def made(flights, tmp_path_factory):
    """A folder with a finished training of six epochs."""
    return trained(flights, tmp_path_factory.mktemp("training"), epochs=6).parent


def with_array(name, change):
    """The shipped weights with one array changed, and a checksum that fits: a file that somebody made so."""

    def write(path):
        arrays, texts = read_arrays(SHIPPED, "weights")
        write_arrays(path, arrays | {name: change(arrays[name].copy())}, texts)

    return write


def nan_in_the_middle(values):
    values.flat[values.size // 2] = np.nan
    return values


VICTIMS = {
    "a NaN": (with_array("head.weight", nan_in_the_middle), "not finite"),
    "a wrong shape": (with_array("head.bias", lambda v: v[:-1]), "shape"),
    "a narrow layer": (with_array("lstm.weight_hh_l1", lambda v: v[:, :-1]), "shape"),
    "no scale": (with_array("unit", lambda v: 0.0 * v), "above 0"),
    "cut": (lambda path: path.write_bytes(SHIPPED.read_bytes()[:100_000]), "not a file of its weights"),
    "empty": (lambda path: path.write_bytes(b""), "not a file of its weights"),
    "text": (lambda path: path.write_text("weights, they said"), "not a file of its weights"),
    "another network": (
        lambda path: save_networks(path, {"a": new_mlp(np.arange(8.0).reshape(4, 2), np.arange(4.0), 2, 1)}),
        "has no array",
    ),
}


@pytest.mark.parametrize("kind", VICTIMS)
def test_wrong_weights_end_with_2_and_leave_no_folder(kind, tmp_path, monkeypatch, capsys):
    from testbed.cli import main

    write, said = VICTIMS[kind]
    write(tmp_path / "victim.txt")
    (tmp_path / "w.toml").write_text(SCENARIO)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["testbed", "run", "w.toml", "--out", "out", "--jobs", "1"])
    with pytest.raises(SystemExit) as end:
        main()
    told = " ".join(capsys.readouterr().err.split())
    assert end.value.code == 2 and "victim.txt" in told and said in told, told
    assert not (tmp_path / "out").exists()


def test_one_flipped_bit_is_found_wherever_it_is(made, tmp_path):
    """300 bits, half of them in the header: refused by name, or the content is what it was (a letter of an ignored key)."""
    rng = np.random.default_rng(5)
    net = {"a": new_mlp(np.arange(8.0).reshape(4, 2), np.arange(4.0), 2, 1)}
    save_networks(tmp_path / "net.safetensors", net, {"training": "x"})
    for source in (made / FILES[0], made / FILES[1], tmp_path / "net.safetensors"):
        content, victim = bytearray(source.read_bytes()), tmp_path / "victim.safetensors"
        header = 8 + int.from_bytes(content[:8], "little")
        arrays = read_arrays(source, "x")[0]
        for k in range(100):
            bit = int(rng.integers(8 * (header if k % 2 else len(content))))
            content[bit // 8] ^= 1 << bit % 8
            victim.write_bytes(content)
            content[bit // 8] ^= 1 << bit % 8
            again = arrays_or_refusal(victim)
            assert isinstance(again, dict) or victim.name in again
            assert isinstance(again, str) or all(np.array_equal(again[key], arrays[key]) for key in arrays | again)


def arrays_or_refusal(path):
    try:
        return read_arrays(path, "x")[0]
    except InputError as error:
        return str(error)


def test_the_same_training_is_the_same_bytes(flights, made, tmp_path):
    """The order of a header's keys is not left to chance; another process is seen to below."""
    trained(flights, tmp_path, epochs=6)
    for name in FILES:
        assert (tmp_path / name).read_bytes() == (made / name).read_bytes(), name


def call(out: Path, *arguments: str) -> subprocess.Popen:
    paths = os.pathsep.join([str(SCRIPT.parent), str(SCRIPT.parent.parent)])
    command = [sys.executable, str(SCRIPT), str(out), *arguments]
    environment = os.environ | {"PYTHONPATH": paths}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def kill_and_resume(out: Path, line: int, delay_s: float) -> str:
    """Kill -9 so long after a line of the training's output, then resume to the end; what the resumed call said."""
    process = call(out)
    for _ in range(line):
        process.stdout.readline()
    time.sleep(delay_s)
    process.send_signal(signal.SIGKILL)
    process.wait()
    resumed = call(out, "--resume")
    said, _ = resumed.communicate()
    assert resumed.returncode == 0, said
    return said


KILLS = int(os.environ.get("TESTBED_KILLS", "1"))


@pytest.mark.parametrize("seed", range(KILLS))
def test_a_killed_training_ends_in_the_same_bytes(made, tmp_path, seed):
    """Kill -9 at a drawn moment (TESTBED_KILLS draws), then --resume."""
    rng = np.random.default_rng(seed)
    kill_and_resume(tmp_path, int(rng.integers(1, 10)), float(rng.uniform(0.0, 0.05)))
    for name in FILES:
        assert (tmp_path / name).read_bytes() == (made / name).read_bytes(), name


def test_damaged_checkpoints_and_flights_are_refused(flights, made, tmp_path):
    class Stopped(Exception):
        pass

    def stop(text):
        if text.startswith("epoch 2"):
            raise Stopped

    with pytest.raises(Stopped):
        trained(flights, tmp_path / "a", tell=stop, epochs=6)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    lesson = next((tmp_path / "a" / "lessons").rglob("*.f32"))
    content = bytearray(lesson.read_bytes())
    content[len(content) // 2] ^= 4
    lesson.write_bytes(content)
    with pytest.raises(InputError, match=rf"{lesson.name}: damaged"):
        trained(flights, tmp_path / "a", resume=True, epochs=6)
    for damaged in (b"", b"text", (made / FILES[1]).read_bytes()):
        (tmp_path / "b" / FILES[0]).write_bytes(damaged)
        with pytest.raises(InputError, match=r"checkpoint\.safetensors: not a checkpoint"):
            trained(flights, tmp_path / "b", resume=True, epochs=6)


def test_a_damaged_network_of_the_cache_is_made_again(tmp_path):
    from estimators.learning.pretrained import _trained_on

    path = tmp_path / "n.safetensors"
    save_networks(path, {"a": new_mlp(np.arange(8.0).reshape(4, 2), np.arange(4.0), 2, 1)}, {"training": "flights"})
    assert _trained_on(path) == "flights"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    assert _trained_on(path) is None
    with pytest.raises(InputError, match="damaged"):
        load_networks(path)


def test_half_precision_is_of_the_file_alone(tmp_path):
    """11 bits of each number (IEEE 754 binary16) come as singles, so that sums of them are of singles: 1 + 2^-12 stays."""
    write_arrays(tmp_path / "h", {"a": np.array([[1.0, 2.0**-12, 1.0 / 3.0]], np.float16)}, {})
    found = read_arrays(tmp_path / "h", "numbers")[0]["a"]
    assert found.dtype == np.float32 and found[0, 0] + found[0, 1] == np.float32(1.0 + 2.0**-12)
    assert abs(found[0, 2] - 1.0 / 3.0) <= 2.0**-13


@pytest.mark.parametrize("name", BY_NAME)
def test_the_shipped_weights_are_whole_and_say_how_they_were_made(name):
    weights = load_weights(name)
    assert weights.network.w_lstm.shape[0] == 2
    assert '"checksum":"' in BY_NAME[name].read_bytes()[:20_000].decode(errors="ignore")
    told = load_scenario("ahrs-lstm-2022", variant=name or None).extra["train"]
    assert {key: weights.filter[key] for key in told["filter"]} == told["filter"]
    made = weights.metadata["training"]
    assert {key: made[key] for key in told.keys() - {"filter"}} == {k: v for k, v in told.items() if k != "filter"}
