"""A user's adaptive filter: a plug-in of 25 lines, at the speed of what ships, tuned by ``testbed tune``; entries of tables."""

import sys
import tomllib

import numpy as np
import pytest

from testbed import cli
from testbed.base.errors import InputError
from testbed.data import registry
from testbed.tuning.space import AxisConfig, make_space

PLUGIN = """
from dataclasses import dataclass

import numpy as np

from estimators.methods.eskf import Eskf
from estimators.policies import Policy, add_policy


def judge(memory, residual, s, r, h, p):
    for i in range(residual.shape[0]):
        memory[1 + i] += memory[0] * ((residual[i] ** 2 - (s[i, i] - r[i])) / r[i] - memory[1 + i])
        r[i] *= max(memory[1 + i], 0.01)
    return 1.0


add_policy(Policy("own-sage-husa", judge, lambda rows, share=0.05: np.array([share] + rows * [1.0])))


@dataclass(frozen=True)
class OwnSageHusa(Eskf):
    name = "own-sage-husa-kf"
    policy: object = "own-sage-husa"
    parameter_space = {"policy.own-sage-husa.share": (1e-3, 0.3, "log"), "std_scale.gnss": (0.1, 10.0, "log")}
"""
SCENARIO = """
[scenario]
name = "tuned"
[flight]
aircraft = "aerosonde"
rate_hz = 50.0
initial = { alt_m = 500.0, speed_mps = 30.0 }
manoeuvres = [{ type = "straight", duration_s = 12.0 }]
[sensors]
imu = { model = "ADIS16405" }
gnss = { model = "Garmin16x" }
[[estimators]]
name = "own-sage-husa-kf"
params = { noise_scale = { gyro = 1.5 } }
[extra.tune]
algorithms = ["pso"]
iterations = [3]
population = 4
train_runs = [0]
test_runs = [1]
innovation_search = "none"
"""


def test_a_users_sage_husa_is_tuned(tmp_path, monkeypatch, capsys):
    """From the file to a parameter file that gives the stored objective; what is not searched stays."""
    (tmp_path / "own.py").write_text(PLUGIN)
    (tmp_path / "tuned.toml").write_text(SCENARIO)
    assert sum(bool(line.strip()) for line in PLUGIN.splitlines()) <= 25
    monkeypatch.setattr(registry, "_plugins", {})
    monkeypatch.chdir(tmp_path)
    arguments = ["testbed", "tune", "tuned.toml", "--plugin", "own.py", "--jobs", "1", "--out", "study"]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert not end.value.code, capsys.readouterr()
    (best,) = (tmp_path / "study" / "best").glob("*.toml")
    params = tomllib.loads(best.read_text())["params"]
    assert params["noise_scale"] == {"gyro": 1.5}
    assert 1e-3 <= params["policy"]["own-sage-husa"]["share"] <= 0.3 and 0.1 <= params["std_scale"]["gnss"] <= 10.0
    assert registry.make_estimator("own-sage-husa-kf", **params).policy == params["policy"]


def test_entries_of_tables_are_coordinates():
    axes = [AxisConfig(name="std_scale.gnss", low=0.1, high=10.0, axis="log"), AxisConfig(name="noise_scale.accel")]
    space = make_space("eskf", axes)
    fixed = {"noise_scale": {"gyro": 3.0}, "policy": "gate"}
    made = space.over(fixed, np.array([1.0, -2.0]))
    assert made == {"noise_scale": {"gyro": 3.0, "accel": 0.01}, "policy": "gate", "std_scale": {"gnss": 10.0}}
    assert fixed == {"noise_scale": {"gyro": 3.0}, "policy": "gate"}
    assert space.names == ["std_scale.gnss", "noise_scale.accel"]
    assert make_space("eskf", []).names == ["noise_scale.accel", "noise_scale.gyro"]
    registry.make_estimator("eskf", **made)


def test_wrong_entries_are_refused():
    with pytest.raises(InputError, match=r"no parameter 'noise\.accel'; did you mean 'noise_scale'"):
        make_space("eskf", [AxisConfig(name="noise.accel", low=0.1, high=1.0)])
    space = make_space("eskf", [AxisConfig(name="policy.gate.gate", low=0.9, high=0.999)])
    with pytest.raises(InputError, match=r"policy\.gate\.gate: 'policy' is 'plain' and not a table"):
        space.over({"policy": "plain"}, np.array([0.95]))
    with pytest.raises(InputError, match="noise_scale: no 'acel' in this filter; did you mean 'accel'"):
        registry.make_estimator("eskf", noise_scale={"acel": 2.0})


def test_list_prints_parameters_and_parts(monkeypatch, capsys):
    def listed(*arguments):
        monkeypatch.setattr(sys, "argv", ["testbed", "list", *arguments])
        with pytest.raises(SystemExit, match=r"^0$"):
            cli.main()
        return capsys.readouterr().out

    shown = " ".join(listed("estimators", "eskf").split())
    for text in (
        "eskf: Error-state filter from parts.",
        'states ["accel-bias", "gyro-bias"] blocks beside position',
        'policy "plain" one for all aidings, or a table with one per aiding',
        "smooth false",
        "noise_scale.accel 0.001 to 1000 (log)",
        "accel-scale scale factor error, one constant per axis",
        "baro height of the standard atmosphere",
        "(gate = 0.999)",
    ):
        assert text in shown
    shown = " ".join(listed("estimators", "indirect-kf").split())
    assert "gyro_bias_scale 1.0 0.001 to 1000 (log) of what drives the biases process" not in shown
    assert "gyro_bias_scale 1.0 0.001 to 1000 (log) of what drives the biases" in shown
    assert "keep_biases false" in " ".join(listed("estimators", "update-ins").split())
    rows = registry.describe_parameters("indirect-kf")
    assert all(meaning for *_, meaning in rows)
    with pytest.raises(InputError, match="did you mean 'eskf'"):
        registry.describe_parameters("eskg")
