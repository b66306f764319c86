"""A result in which an estimator finishes no run at all is still a result: it is reported, and the row says so."""

from command_line import call

SCENARIO = """
[scenario]
name = "lost"
[flight]
type = "drive"
manoeuvres = [{ type = "accelerate", to_speed_mps = 20.0 }, { type = "straight", duration_s = 20.0 }]
[sensors.imu]
model = "ADIS16448"
[sensors.gnss]
model = "Garmin16x"
[[estimators]]
name = "ins"
[[estimators]]
name = "indirect-kf"
[monte_carlo]
runs = 2
divergence_position_m = 15.0
"""


def test_an_estimator_that_diverges_in_every_run_is_reported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lost.toml").write_text(SCENARIO)
    code, said = call("run", "lost.toml", "--jobs", "1", "--out", "lost")
    assert code == 0, said
    assert "ins: not ok in 2 of 2 runs" in said
    assert (tmp_path / "lost" / "report.html").exists()
    assert "ins," not in (tmp_path / "lost" / "timings.csv").read_text()
