"""Sensors on recorded motion: [recording] with [sensors] senses the reference anew; sweeps complete settings, zero means none."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from command_line import call

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.base.notes import notes_of
from testbed.formats import export_log
from testbed.physics import earth
from testbed.scenario import load_scenario

RECORDED = """
[scenario]
name = "anew"
[recording]
format = "table"
dir = "log"
[[estimators]]
name = "ins"
"""
SENSORS = """
[sensors.imu]
model = "ADIS16488"
[sensors.gnss]
model = "Garmin16x"
[sensors.mag]
model = "ADIS16448"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording of 25 s of the quickstart with its cheap unit, as tables."""
    place = tmp_path_factory.mktemp("anew")
    cut = {"flight.duration_s": 25.0, "sensors.gnss.outages": [], "windows": [], "claims": []}
    scenario = load_scenario("quickstart", overrides=cut)
    truth = pipeline.fly(scenario)
    log, _ = pipeline.sense(scenario, truth)
    export_log(log, place / "log", "csv", reference=truth)
    (place / "anew.toml").write_text(RECORDED + SENSORS)
    (place / "as-recorded.toml").write_text(RECORDED)
    return place


def test_sensors_record_the_reference_anew(folder):
    """The reference stays the truth; unit, magnetometer and seeds are the scenario's, so that runs differ."""
    anew, recorded = (load_scenario(folder / f"{name}.toml") for name in ("anew", "as-recorded"))
    truth, reference = pipeline.fly(anew), pipeline.fly(recorded)
    # 100 Hz in light turbulence: as a flight taken from a file (tests/flight/test_own_trajectory.py)
    miss = earth.position_difference(truth.lat, truth.lon, truth.h, reference.lat, reference.lon, reference.h)
    assert np.abs(miss).max() < 1e-4 and np.abs(truth.q_nb - reference.q_nb).max() < 1e-9
    logs = [pipeline.sense(anew, truth, run=run)[0] for run in (0, 1)]
    assert logs[0].imu.spec.name == "ADIS16488" and logs[0].mag is not None
    assert not np.array_equal(logs[0].imu.gyro, logs[1].imu.gyro)
    assert pipeline.sense(anew, truth)[1] is not None and pipeline.sense(recorded, reference)[1] is None
    assert anew.monte_carlo.runs == 20 and recorded.monte_carlo.runs == 1
    assert any("sense its reference anew" in note for note in notes_of(anew))
    slow = load_scenario(folder / "anew.toml", overrides={"sensors.imu.rate_hz": 60.0})
    assert pipeline.sense(slow, pipeline.fly(slow))[0].imu.spec.rate_hz == 60.0


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("recording.imu.model", "ADIS16448", r"\[recording.imu\] has no meaning beside \[sensors\]"),
        ("recording.initial.start", "reference", r"\[recording.initial\] has no meaning .*use \[initial\]"),
        ("monte_carlo.vary", ["manoeuvres"], "disperse"),
        ("monte_carlo.vary", ["turbulence"], "recorded motion is the same in every run"),
    ],
)
def test_what_has_no_meaning_is_refused(folder, key, value, message):
    with pytest.raises(InputError, match=message):
        load_scenario(folder / "anew.toml", overrides={key: value})


def test_a_sweep_completes_settings_and_zero_means_none(tmp_path, monkeypatch):
    """The setting alone is incomplete; its points are ordered as numbers, 0 without any outage."""
    monkeypatch.chdir(tmp_path)
    random = "sensors.gnss.random_outages"
    words = (
        "testbed run quickstart --jobs 1 --runs 1 --estimators ins --set sensors.gnss.outages=[] "
        f"--set {random}.count=1 --set {random}.after_s=5 --set {random}.gap_s=1 --set flight.duration_s=40.0 "
        f"--sweep {random}.duration_s=10,0,2 --out swept"
    )
    code, said = call(*words.split()[1:])
    assert code == 0, said
    table = pd.read_csv("swept/sweep.csv")
    table = table[(table["metric"] == "rmse_position_3d_m") & (table["window"] == "outages")]
    assert table[f"{random}.duration_s"].tolist() == [10, 2], "no window of outages where there is none"
    assert table[f"{random}.duration_s"].dtype.kind in "if"
    none = load_scenario(
        "quickstart", overrides={"sensors.gnss.outages": [], f"{random}.count": 0, f"{random}.duration_s": 5.0}
    )
    log, _ = pipeline.sense(none, pipeline.fly(none))
    assert log.gnss.outages == ()
