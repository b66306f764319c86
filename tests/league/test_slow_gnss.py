"""The shipped plug-in that takes a lasting receiver error for what it is: its sigmas are right where those of `indirect-kf` are not."""

import tomllib
from pathlib import Path

import numpy as np
from league.tracks import TRACK

from testbed.base.schema import validate
from testbed.data import registry
from testbed.data.registry import load_plugin, make_estimator
from testbed.league import cells
from testbed.league.suite import Track, TrackTable
from testbed.scenario import Scenario
from testbed.scoring.judged import judge

PLUGIN = Path(__file__).resolve().parents[2] / "estimators" / "league" / "slow-gnss" / "slow_gnss.py"
RUNS = 40


def test_its_position_is_as_uncertain_as_it_says(monkeypatch):
    """A car on a road of a minute with a module-class receiver, whose error is 1.1 m and 2.84 m for half an hour.

    Each run has one draw of that error: NEES over three degrees of freedom scatters by sqrt(2 / 3), its mean over 40 runs by 0.13;
    0.45 is 3.5 sigma. `indirect-kf` averages 5 fixes a second: its sigma is several times too small.
    """
    monkeypatch.setattr(registry, "_plugins", {})
    load_plugin(PLUGIN)
    data = tomllib.loads(TRACK)
    data["sensors"]["gnss"] = {"model": "module-class"}
    data["sensors"]["imu"]["disable"] = ["misalignment", "nonlinearity", "g_sensitivity"]
    data["initial"] = {"position_m": 3.0, "velocity_mps": 0.3, "roll_pitch_deg": 0.5, "yaw_deg": 1.0}
    scenario = validate(Scenario, data, "roll")
    track = Track("roll", scenario, validate(TrackTable, data["extra"]["league"], "roll"))
    found = {}
    for name in ("slow-gnss", "indirect-kf"):
        values = []
        for sensed in cells.sense(track, range(RUNS)):
            solution = make_estimator(name).run(sensed.log)
            judged = judge(solution, sensed.truth, sensed.log, None, sensed.windows, 1000.0)
            values.append(cells.normalised(solution, judged)["position"])
        found[name] = float(np.mean(values))
    assert abs(found["slow-gnss"] - 1.0) < 0.45
    assert found["indirect-kf"] > 5.0
