"""A report on filters with different states and aidings: nobody is shown on what it does not estimate."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from testbed.data.registry import load_plugin
from testbed.montecarlo import runner
from testbed.report import innovations, render
from testbed.report.results import load_result
from testbed.scenario import load_scenario
from testbed.scoring import quantities
from testbed.scoring.quantities import QUANTITIES, axis_title, metric_label, metric_names, short_label, unit

SCENARIO = """
[scenario]
name = "town"
[flight]
type = "drive"
manoeuvres = [{ type = "accelerate", to_speed_mps = 14.0 }, { type = "turn", radius_m = 20.0, heading_change_deg = 180.0 },
  { type = "straight", duration_s = 20.0 }]
[sensors.imu]
model = "ADIS16448"
[sensors.gnss]
model = "Garmin16x"
[sensors.mag]
model = "ADIS16448"
[sensors.baro]
model = "ADIS16448"
[[estimators]]
name = "lkf9"
[[estimators]]
name = "ahrs-kf"
[[estimators]]
name = "two-aidings"
[monte_carlo]
runs = 2
"""


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("states")
    (folder / "town.toml").write_text(SCENARIO)
    plugin = Path(__file__).parents[1] / "plugins" / "two_aidings.py"
    load_plugin(plugin)
    runner.run(load_scenario(folder / "town.toml"), folder / "out", jobs=1, plugins=[plugin])
    render(folder / "out", svg=False)
    return load_result(folder / "out")


def test_an_attitude_filter_has_no_position(result):
    """Neither in the tables nor in the series of run 0; its column in the page's table is empty."""
    of_ahrs = result.summary[result.summary["estimator"] == "ahrs-kf"]["metric"]
    told = {metric for metric in of_ahrs if not metric.startswith(("nees", "nis", "diverged"))}
    assert told == {
        f"{s}_{q}"
        for s in quantities.STATISTICS
        for q in ("roll_deg", "pitch_deg", "yaw_deg", "attitude_deg", "heading_deg", "inclination_deg")
    }
    frame = result.errors["ahrs-kf"]
    assert frame[["north_m", "v_east_mps", "lat_deg"]].isna().all(axis=None) and frame["yaw_deg"].notna().all()
    assert "sigma_north_m" not in frame and frame["sigma_yaw_deg"].gt(0.0).all()
    assert "| ahrs-kf | – | – | – |" in (result.folder / "report.md").read_text()
    assert (result.folder / "figures" / "envelope.png").stat().st_size > 5000


def test_consistency_is_of_the_states_that_there_are(result):
    tested = result.consistency.set_index(["estimator", "quantity"])["dof"]
    assert "nees_bias" not in tested["lkf9"] and set(tested["ahrs-kf"].index) == {"nees_attitude", "nis"}
    assert tested["two-aidings", "nees_bias"] == 6.0
    assert (tested["two-aidings", "nis_gnss"], tested["two-aidings", "nis_baro"]) == (6.0, 1.0)
    assert "nis_gnss" not in tested["lkf9"]  # one aiding: nis says it


def test_every_aiding_has_its_innovations(result):
    """Those of the barometer are ±1 sigma and one in ten was rejected, which its tests leave out."""
    frames = result.innovations["two-aidings"]
    assert list(frames) == ["gnss", "baro"] and "nu_1" not in frames["baro"] and "nu_5" in frames["gnss"]
    assert frames["baro"]["rejected"].mean() == pytest.approx(0.1, abs=0.01)
    table = innovations.table(result)
    cells = dict(table.rows)["two-aidings"]
    of_baro = [k for k, column in enumerate(table.columns) if column.group == "baro: height, m"]
    assert cells[of_baro[1]].value == 100.0  # inside two sigma
    assert "two-aidings rejected 10" in table.note and "with baro" in table.note
    page = (result.folder / "report.html").read_text()
    assert "two-aidings, baro" in page and "rejected" in page


def test_results_of_version_0_1_are_read(result, tmp_path):
    """Its innovations had no column for the aiding, and its info a list of channels: they were of GNSS."""
    import json
    import shutil

    folder = tmp_path / "old"
    shutil.copytree(result.folder, folder)
    path = folder / "details" / "innovations-lkf9.parquet"
    pd.read_parquet(path).drop(columns=["aiding", "rejected"]).to_parquet(path)
    info = json.loads((folder / "details" / "info.json").read_text())
    info["innovations"]["lkf9"] = info["innovations"]["lkf9"]["gnss"]
    info.pop("sha256", None)
    (folder / "details" / "info.json").write_text(json.dumps(info))
    manifest = json.loads((folder / "manifest.json").read_text())
    without_hashes = {key: value for key, value in manifest.items() if key not in ("files", "sha256")}
    (folder / "manifest.json").write_text(json.dumps(without_hashes))
    old = load_result(folder)
    assert list(old.innovations["lkf9"]) == ["gnss"] and old.channels("lkf9")[0] == "north, m"


def test_each_quantity_is_computed_as_it_says():
    """3-4-12 triangles: 5 m in the plane, 13 m in space; 0.1 rad of rotation are 5.73 degrees."""
    values = np.array([[3.0, 4.0, 12.0, 0.3, 0.4, 1.2, 1.0, 2.0, 3.0]])
    phi = np.array([[0.0, 0.1, 0.0]])
    found = {name: float(q.of(values, phi)[0]) for name, q in QUANTITIES.items()}
    assert found == pytest.approx(
        {
            **{"north_m": 3.0, "east_m": 4.0, "down_m": 12.0, "position_2d_m": 5.0, "position_3d_m": 13.0},
            **{"v_north_mps": 0.3, "v_east_mps": 0.4, "v_down_mps": 1.2, "velocity_3d_mps": 1.3},
            **{"roll_deg": 1.0, "pitch_deg": 2.0, "yaw_deg": 3.0, "attitude_deg": 5.729577951},
            **{"heading_deg": 0.0, "inclination_deg": 5.729577951},
        }
    )


def test_words_and_units_of_every_metric():
    assert metric_label("rmse_position_3d_m") == "3-D position RMSE" and unit("rmse_position_3d_m") == "m"
    assert (
        metric_label("rmse_gnss_v_down_mps") == "Down velocity against GNSS RMSE"
        and unit("mean_gnss_v_down_mps") == "m/s"
    )
    assert axis_title("max_yaw_deg") == "Largest yaw error, °" and axis_title("nees_bias") == "NEES bias"
    assert short_label("rmse_roll_deg") == "Roll" and short_label("max_position_3d_m") == "Max 3-D pos."
    assert axis_title("us_per_sample") == "Computation time per sample, µs"
    assert metric_label("nis_baro") == "NIS baro" and metric_label("mode_probability") == "mode probability"
    assert all("_" not in metric_label(name) for name in metric_names())
