"""`testbed plot` and the files of a sweep: what is drawn is what the tables hold, in the size that was asked for."""

from __future__ import annotations

import re
from pathlib import Path

import monte_carlo as mc
import numpy as np
import pandas as pd
import pytest
from command_line import call

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.montecarlo.runner import run
from testbed.montecarlo.sweep import read_sweep, sweep, write_page
from testbed.report import single, sweeps
from testbed.report.single import Wanted, draw
from testbed.scenario import load_scenario


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    short = {"flight.manoeuvres": [{"type": "straight", "duration_s": 12.0}], "sensors.gnss.outages": [[8.0, 10.0]]}
    scenario = load_scenario("quickstart", overrides=short)
    scenario = scenario.model_copy(update={"windows": [], "claims": []})
    out = tmp_path_factory.mktemp("figures") / "result"
    run(scenario, out, runs=3, jobs=1, estimators=["update-ins", "indirect-kf"])
    return out


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """Its plug-in replaces two functions of the pipeline; they are put back."""
    out, before = tmp_path_factory.mktemp("sweep") / "out", (pipeline.fly, pipeline.sense)
    sweep(
        lambda o: mc.scenario([mc.GOOD, mc.BAD], runs=4, seed=o["seed"]),
        {"seed": [1, 2, 30]},
        out,
        jobs=1,
        plugins=[mc.PLUGIN],
    )
    pipeline.fly, pipeline.sense = before
    return out


@pytest.mark.parametrize("kind", single.KINDS)
@pytest.mark.parametrize(("size", "width"), [("column", 3.5), ("page", 7.16), ("5x4", 5.0)])
def test_a_figure_has_the_width_that_was_asked_for_and_its_labels_inside(result, kind, size, width):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = draw(result, kind, Wanted(), size)
    assert figure.get_figwidth() == pytest.approx(width)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    page = figure.bbox
    for axes in figure.axes:
        box = axes.get_tightbbox(canvas.get_renderer())
        assert box.x0 >= page.x0 - 1 and box.x1 <= page.x1 + 1 and box.y0 >= page.y0 - 1 and box.y1 <= page.y1 + 1


def test_the_cdf_passes_through_cep_and_r95(result):
    """Half of the time the horizontal error lies below CEP, 95 % of it below R95: counted in the stored errors."""
    frame = pd.read_parquet(result / "details/errors-indirect-kf.parquet")
    radius = np.hypot(frame["north_m"], frame["east_m"])
    figure = draw(result, "cdf", Wanted(("indirect-kf",)))
    marks = [line.get_xydata()[0] for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert len(marks) == 2
    for x, share in marks:
        assert np.mean(radius <= x) == pytest.approx(share, abs=1.0 / len(radius))


def test_biases_and_nees_of_run_0_are_kept(result):
    """The filter starts three turn-on sigmas from a bias at most, and 12 s leave NEES near its degrees of freedom."""
    biases = pd.read_parquet(result / "details/biases-indirect-kf.parquet")
    assert {"gyro_bias_x_radps", "sigma_gyro_bias_x_radps", "true_gyro_bias_x_radps"} <= set(biases)
    off = biases["gyro_bias_x_radps"] - biases["true_gyro_bias_x_radps"]
    assert (off.abs() < 5.0 * biases["sigma_gyro_bias_x_radps"]).all()
    nees = pd.read_parquet(result / "details/nees-indirect-kf.parquet")
    assert set(nees["quantity"]) == {"nees_position", "nees_velocity", "nees_attitude", "nees_bias"}
    assert set(nees["dof"]) == {3.0, 6.0}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("nix", "there is no figure 'nix'"),
        ("errors --metric altitude", "valid: .*attitude|did you mean 'attitude'"),
        ("errors --estimators ukf", "has no estimator 'ukf'"),
        ("box --size 3", "WIDTHxHEIGHT"),
        ("box --style tufte9", "no style of matplotlib"),
        ("box --out figure.jpg", ".png, .svg, .pdf"),
        ("box --out there.pdf", "already exists"),
        ("sweep", "no finished sweep"),
        ("allan", "holds no log"),
    ],
)
def test_a_mistake_is_one_message_and_no_file(result, tmp_path, monkeypatch, words, told):
    monkeypatch.chdir(tmp_path)
    Path("there.pdf").write_text("mine")
    code, said = call("plot", str(result), *words.split())
    assert code == 2 and re.search(told, said), said
    assert [path.name for path in tmp_path.iterdir()] == ["there.pdf"] and Path("there.pdf").read_text() == "mine"


def test_a_sweep_writes_figures_table_and_page(swept):
    """The table's cells are the means of ``sweep.csv``; figures are vectors with real letters, and a page names the keys."""
    table = pd.read_csv(swept / "sweep.csv")
    rows = table[(table["metric"] == "rmse_position_3d_m") & (table["window"] == "all")]
    tex = (swept / "sweep.tex").read_text()
    assert "\\toprule" in tex and all(sweeps.number(value) in tex for value in rows["mean"])
    assert (swept / "sweep.pdf").read_bytes()[:5] == b"%PDF-" and "3-D position RMSE, m" in (
        swept / "sweep.svg"
    ).read_text()
    assert "Over seed (1, 2, 30)" in (swept / "report.html").read_text()


def test_a_sweep_is_reported_again_with_the_same_bytes(swept):
    before = {name: (swept / name).read_bytes() for name in sweeps.FILES}
    for name in sweeps.FILES:
        (swept / name).unlink()
    write_page(swept)
    assert {name: (swept / name).read_bytes() for name in sweeps.FILES} == before


def test_intervals_are_bands_and_a_wide_setting_is_logarithmic(swept):
    table, shown = read_sweep(swept)
    axes = sweeps.figure(table, shown["keys"], shown["metric"]).axes[0]
    assert len(axes.collections) == table["estimator"].nunique()
    assert axes.get_xscale() == "log"  # 1 to 30
    assert sweeps.figure(table, shown["keys"], shown["metric"], log="none").axes[0].get_xscale() == "linear"
    with pytest.raises(InputError, match="did you mean 'rmse_position_3d_m'"):
        sweeps.figure(table, shown["keys"], "rmse_positions_3d_m")


@pytest.mark.parametrize(
    ("key", "label"),
    [
        ("sensors.gnss.rate_hz", "gnss rate, Hz"),
        ("flight.manoeuvres.1.bank_deg", "manoeuvres bank, °"),
        ("sensors.imu.model", "imu model"),
        ("estimators.eskf.params.gate", "eskf gate"),
    ],
)
def test_a_setting_is_labelled_with_its_unit(key, label):
    assert sweeps.key_label(key) == label
