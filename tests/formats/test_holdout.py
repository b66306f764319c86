"""Withheld fixes: no filter sees them, the error at each is estimate minus fix, and what varies is what is drawn."""

from __future__ import annotations

import json
from pathlib import Path

import formats_flight
import numpy as np
import pytest

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.data.records import NavSolution, SensorLog
from testbed.formats import export_log
from testbed.physics import earth
from testbed.scenario import Scenario, load_scenario


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return formats_flight.make_log(formats_flight.make_trajectory(60.0))


def scenario(log: SensorLog, folder: Path, holdout: dict, **top) -> Scenario:
    export_log(log, folder / "data", "csv")
    lines = ['[scenario]\nname = "own"', '[recording]\nformat = "table"\ndir = "data"', "[recording.holdout]"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in holdout.items()]
    lines += ['[[estimators]]\nname = "ins"', *(f"[{k}]\n{v}" for k, v in top.items())]
    (folder / "own.toml").write_text("\n".join(lines))
    return load_scenario(folder / "own.toml")


def test_fixes_of_the_windows_are_withheld_and_scored_against(log: SensorLog, tmp_path: Path) -> None:
    """A solution that is the fixes' own antenna place plus 3 m north errs by 3 m, at the fixes of the windows and nowhere else."""
    made = scenario(log, tmp_path, {"windows": [[10.0, 20.0], [40.0, 45.0]]})
    truth = pipeline.fly(made)
    seen, _ = pipeline.sense(made, truth)
    inside = ((log.gnss.t > 10.0) & (log.gnss.t <= 20.0)) | ((log.gnss.t > 40.0) & (log.gnss.t <= 45.0))
    assert np.array_equal(truth.t, log.gnss.t[inside])
    assert np.array_equal(seen.gnss.t, log.gnss.t[~inside])
    assert seen.gnss.outages == ((10.0, 20.0), (40.0, 45.0))
    assert truth.known == ("position", "velocity")
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(log.gnss.t), 1))
    per_lat, per_lon = earth.metres_per_radian(log.gnss.lat, log.gnss.h)
    lever = log.gnss.spec.lever_arm_b  # of a level vehicle that heads north: north, east, down
    g = log.gnss
    answer = NavSolution(
        g.t, g.lat + (3.0 - lever[0]) / per_lat, g.lon - lever[1] / per_lon, g.h + lever[2], g.v_n, level
    )
    scores = pipeline.score(made, truth, answer, seen)
    table = scores.set_index(["window", "metric"])["value"]
    for window in ("outage_1", "outage_2", "outages"):
        assert table[window, "rmse_north_m"] == pytest.approx(3.0, abs=1e-4)
        assert table[window, "final_position_3d_m"] == pytest.approx(3.0, abs=1e-4)
        assert table[window, "rmse_velocity_3d_mps"] == pytest.approx(0.0, abs=1e-9)
    assert not any("roll" in metric for metric in scores["metric"])


def test_windows_at_regular_times(log: SensorLog, tmp_path: Path) -> None:
    made = scenario(log, tmp_path, {"every_s": 20.0, "length_s": 5.0, "first_s": 10.0})
    seen, _ = pipeline.sense(made, pipeline.fly(made))
    assert seen.gnss.outages == ((10.0, 15.0), (30.0, 35.0), (50.0, 55.0))


def test_drawn_windows_differ_between_runs_and_do_not_overlap(log: SensorLog, tmp_path: Path) -> None:
    made = scenario(log, tmp_path, {"draw": 3, "length_s": 6.0, "first_s": 5.0}, monte_carlo="runs = 4")
    assert pipeline.flight_varies(made)
    drawn = []
    for run in range(4):
        truth = pipeline.fly(made, run)
        seen, _ = pipeline.sense(made, truth, run=run)
        spans = np.array(seen.gnss.outages)
        assert spans[0, 0] >= 5.0
        assert spans[-1, 1] <= 60.0
        assert (spans[1:, 0] >= spans[:-1, 1]).all()
        again, _ = pipeline.sense(made, truth, run=run)
        assert again.gnss.outages == seen.gnss.outages
        drawn.append(seen.gnss.outages)
    assert len(set(drawn)) == 4


@pytest.mark.parametrize(
    ("holdout", "words"),
    [
        ({"windows": [[100.0, 110.0]]}, "100 to 110 s holds no fix"),
        ({"windows": [[10.0, 5.0]]}, "must rise"),
        ({"windows": [[10.0, 20.0], [15.0, 25.0]]}, "before the one before it ends"),
        ({"every_s": 10.0}, "must be above length_s"),
        ({"every_s": 30.0, "draw": 2}, "exactly one"),
        ({"draw": 50}, "do not fit"),
        ({"every_s": 500.0, "first_s": 300.0}, "no window fits"),
    ],
)
def test_windows_that_cannot_be_are_refused(holdout: dict, words: str, log: SensorLog, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"own\.toml") as caught:
        pipeline.fly(scenario(log, tmp_path, holdout))
    assert words in str(caught.value)


def test_withheld_fixes_beside_simulated_sensors_are_refused(log: SensorLog, tmp_path: Path) -> None:
    both = scenario(log, tmp_path, {"windows": [[10.0, 20.0]]}, sensors='imu = { model = "ideal" }')
    with pytest.raises(
        InputError, match=r"own\.toml: \[recording\.holdout\] withholds fixes that \[sensors\] replaces"
    ):
        pipeline.fly(both)
