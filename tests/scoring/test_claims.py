"""Claims in a result folder, sweeps and comparisons of results."""

from __future__ import annotations

import math
import re

import monte_carlo as mc
import pandas as pd
import pytest

from testbed import pipeline
from testbed.base.checksums import read_json, sealed_json
from testbed.base.errors import InputError
from testbed.cli import commands
from testbed.montecarlo import runner
from testbed.montecarlo.compare import compare_all, compare_results
from testbed.montecarlo.sweep import parse_grid, parse_sweep, sweep


@pytest.fixture(autouse=True)
def real_pipeline():
    """The plug-in of these tests replaces two functions of the pipeline; put them back."""
    before = pipeline.fly, pipeline.sense
    yield
    pipeline.fly, pipeline.sense = before


def run(scenario, out, **options):
    return runner.run(scenario, out, jobs=1, plugins=[mc.PLUGIN], **options)


def test_claims_of_another_variant_are_not_tested_and_timings_stand_apart(tmp_path):
    claims = [mc.CLAIM, mc.CLAIM | {"id": "2", "variant": "other"}, mc.CLAIM | {"id": "3", "metric": "us_per_sample"}]
    result = run(mc.scenario([mc.GOOD, mc.BAD], claims=claims), tmp_path / "out")
    assert result.claims["id"].tolist() == ["1", "3"]
    assert pd.read_csv(result.out / "claims.csv")["id"].tolist() == [1]
    assert pd.read_csv(result.out / "claims-timings.csv")["id"].tolist() == [3]


def test_parse_sweep():
    assert parse_sweep("a.b=1,2.5") == ("a.b", [1, 2.5])
    assert parse_sweep("outages=[[1,2]],[]") == ("outages", [[[1, 2]], []])
    assert parse_sweep("model=ADIS16405,ideal") == ("model", ["ADIS16405", "ideal"])
    with pytest.raises(InputError, match="expected KEY="):
        parse_sweep("a.b")


def test_points_that_are_one_are_refused(tmp_path):
    """Both would be the same row of the table; words that print alike are one, too."""
    with pytest.raises(InputError, match="1 stands twice"):
        parse_grid(["a.b=1,1"])
    with pytest.raises(InputError, match="a is given twice"):
        parse_grid(["a=1,2", "a=3,4"])
    with pytest.raises(InputError, match="leaves nothing of 'a"):
        parse_grid(["a.b=1,2", "a={b=1}"])
    with pytest.raises(InputError, match="1 stands twice"):
        sweep(lambda point: mc.scenario([mc.GOOD]), {"a": [1, "1"]}, tmp_path / "out", jobs=1)
    assert not (tmp_path / "out").exists()
    assert parse_grid(["a=1,2", "a.b=3"]) == {"a": [1, 2], "a.b": [3]}


def test_sweep_is_one_table_and_one_plot_over_the_grid(tmp_path):
    def load(point):
        params = {"sigma_m": point["sigma"], "common_m": point["common"]}
        return mc.scenario([{"name": "noisy", "params": params}], runs=30)

    options = {"jobs": 1, "plugins": [mc.PLUGIN]}
    table = sweep(load, {"sigma": [1.0, 2.0, 4.0], "common": [0.0, 3.0]}, tmp_path / "out", **options)
    read = pd.read_csv(tmp_path / "out" / "sweep.csv")
    assert len(read) == len(table) and (tmp_path / "out" / "sweep.png").stat().st_size > 5000
    north = read[(read["metric"] == "rmse_north_m") & (read["window"] == "all")].set_index(["sigma", "common"])["mean"]
    for (sigma, common), mean in north.items():
        total = math.hypot(sigma, common)
        assert abs(mean - total * math.sqrt(2 / math.pi)) < 4 * total * math.sqrt((1 - 2 / math.pi) / 30)
    again = sweep(load, {"sigma": [1.0, 2.0, 4.0], "common": [0.0, 3.0]}, tmp_path / "out", resume=True, **options)
    pd.testing.assert_frame_equal(again, table)


def test_sweep_checks_every_point_before_it_runs_one(tmp_path):
    def load(point):
        if point["sigma"] < 0:
            raise InputError("sigma must not be negative")
        return mc.scenario([mc.GOOD])

    with pytest.raises(InputError, match="negative"):
        sweep(load, {"sigma": [1.0, -1.0]}, tmp_path / "out", jobs=1, plugins=[mc.PLUGIN])
    assert not (tmp_path / "out").exists()


def test_sweep_senses_every_point_before_it_runs_one(tmp_path):
    def load(point):
        sensors = {"imu": {"model": "ideal"}, "gnss": {"outages": [[20.0, point["end_s"]]]}}
        return mc.scenario([{"name": "ins"}], sensors=sensors)

    with pytest.raises(InputError, match=r"\[20, 70\] lies outside of the flight"):
        sweep(load, {"end_s": [50.0, 70.0]}, tmp_path / "out", jobs=1)
    assert not (tmp_path / "out").exists()


def test_comparison_finds_what_got_worse_and_is_quiet_otherwise(tmp_path):
    def result(name, sigma, seed=1):
        row = {"name": "noisy", "params": {"sigma_m": sigma, "common_m": 5.0}}
        return run(mc.scenario([row], runs=60, seed=seed), tmp_path / name).out

    old = result("old", 1.0)
    assert compare_results(old, result("same", 1.0)).empty
    assert compare_results(old, result("chance", 1.0, seed=2)).empty
    worse = compare_results(old, result("worse", 20.0)).set_index(["window", "metric"])["verdict"]
    assert worse["all", "rmse_north_m"] == "worse"
    better = compare_results(tmp_path / "worse", old)
    assert set(better["verdict"]) == {"better"}
    unpaired = compare_results(old, result("worse-2", 20.0, seed=3))
    assert "worse" in set(unpaired["verdict"])
    assert set(compare_all(old, tmp_path / "same")["verdict"]) == {"same"}


def test_comparison_counts_lost_runs_and_missing_estimators(tmp_path):
    fine = run(mc.scenario([{"name": "noisy", "label": "x"}, mc.GOOD], runs=60), tmp_path / "fine").out
    lossy = run(mc.scenario([{"name": "nan", "label": "x"}], runs=60), tmp_path / "lossy").out
    changes = compare_results(fine, lossy)
    assert set(changes["verdict"][changes["estimator"] == "good"]) == {"missing"}
    lost = changes[(changes["estimator"] == "x") & (changes["metric"] == "lost_runs")]
    assert lost["verdict"].tolist() == ["worse"] and lost["new"].iloc[0] == pytest.approx(0.2)
    with pytest.raises(InputError, match="no result"):
        compare_results(tmp_path / "nowhere", lossy)


def test_comparison_tells_what_is_missing_and_refuses_another_scenario(tmp_path, capsys):
    rows = [{"name": "noisy", "label": label, "params": {"sigma_m": 1.0}} for label in ("a", "b")]
    both = run(mc.scenario(rows, runs=3), tmp_path / "both").out
    one = run(mc.scenario(rows[:1], runs=3), tmp_path / "one").out
    assert commands.compare(both, one) == 1
    told = capsys.readouterr().out
    assert re.search(r"missing in .*one: \d+ metrics of b \(all\)", told) and "nan" not in told.lower()
    assert commands.compare(one, both) == 0
    manifest = read_json(one / "manifest.json")
    (one / "manifest.json").write_bytes(sealed_json(manifest | {"scenario": "another"}))
    with pytest.raises(InputError, match="only results of one scenario compare"):
        commands.compare(both, one)
