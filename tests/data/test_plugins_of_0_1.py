"""Plug-ins that were written for version 0.1 go on working for one version, and are told how to write it now."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from synthetic import weaving_flight

from testbed.base.schema import validate
from testbed.data.records import STATE_NAMES, NavSolution, SensorErrors, SensorLog
from testbed.data.registry import load_plugin, make_estimator
from testbed.scenario.windows import Window
from testbed.scoring import metrics
from testbed.sensors import sense_flight
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SensorsConfig

PLUGINS = Path(__file__).parents[1] / "plugins"
SENSORS = {
    "imu": {"model": "ideal", "rate_hz": 50.0},
    "gnss": {"model": "ideal"},
    "mag": {"model": "ideal"},
    "baro": {"model": "ideal"},
}


def solve(file: str) -> tuple[dict[str, float], NavSolution, SensorLog]:
    truth = weaving_flight(20.0, 50.0)
    log, errors = sense_flight(validate(SensorsConfig, SENSORS, "sensors"), InitialConfig(perfect=True), truth, seed=1)
    (name,) = load_plugin(PLUGINS / file)
    solution = make_estimator(name).run(log)
    assert isinstance(errors, SensorErrors)
    table = metrics.score(truth, solution, [Window("all", ((-1.0, 20.0),))], errors, log.gnss)
    return dict(zip(table["metric"], table["value"], strict=True)), solution, log


def test_fifteen_columns_without_names_are_scored_and_told():
    """An error of sigma in each of 6 channels at each update: NIS 6; biases known exactly: NEES 0."""
    with pytest.warns(FutureWarning, match="states=testbed.data.records.STATE_NAMES") as told:
        scored, solution, log = solve("v01_filter.py")
    assert {Path(each.filename).name for each in told} == {"v01_filter.py"}  # where its author has to change it
    assert solution.states == STATE_NAMES and solution.std.shape == (len(log.imu.t), 15)
    assert scored["nis"] == pytest.approx(6.0) and scored["nees_bias"] == 0.0
    assert scored["rmse_position_3d_m"] > 100.0  # it stands where it started


def test_the_strapdown_and_the_sensors_of_a_log_are_where_they_were():
    """Free navigation from the truth with ideal sensors: the test flight is the same strapdown's integral."""
    scored, solution, log = solve("v01_strapdown.py")
    assert scored["rmse_position_3d_m"] < 1e-6
    expected = [len(log.gnss.t), len(log.mag.t), len(log.baro.t), log.gnss.spec.rate_hz]
    np.testing.assert_array_equal(solution.extras["seen"][1][0, :4], expected)


def test_a_module_under_its_old_name_is_told_once_where_it_is_imported():
    """In a process of its own: a module that another test imported already says nothing more."""
    code = "import warnings; warnings.simplefilter('always')\nfrom testbed import earth\nimport testbed.earth, testbed.physics.earth as new\n"
    code += "from estimators.strapdown import integrate\nassert earth.gravity is new.gravity"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    told = [line for line in done.stderr.splitlines() if "FutureWarning" in line]
    assert [line.partition("FutureWarning: ")[2].partition(";")[0] for line in told] == [
        "'testbed.earth' has moved to 'testbed.physics.earth'",
        "'estimators.strapdown' has moved to 'estimators.core.strapdown'",
    ]
    assert told[0].startswith("<string>:2:"), "the line that imports"
