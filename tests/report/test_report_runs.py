"""What the page shows of single runs and single updates, how its lines and numbers are drawn, and pictures between findings."""

from __future__ import annotations

from pathlib import Path

import monte_carlo as mc
import numpy as np
import pandas as pd
import pytest
from result_folder import make_result

from testbed import pipeline
from testbed.montecarlo import runner
from testbed.report import charts, chosen_runs, figures, html, normalised, render, render_index
from testbed.report.headline import headline
from testbed.report.results import load_result
from testbed.report.traces import dash_of, rounded


def test_the_threshold_holds_of_independent_innovations_and_more_so_of_others() -> None:
    """One in a thousand of 1e6 updates: within four sigma of the binomial distribution, 0.000126."""
    rng, limit = np.random.default_rng(1), normalised.threshold(6)
    sizes = np.abs(rng.standard_normal((1_000_000, 6)))
    beyond = np.mean(sizes.max(axis=1) > limit)
    assert beyond == pytest.approx(1.0 - normalised.PASSED, abs=1.3e-4)
    sizes[:, 1:] = sizes[:, :1]  # wholly correlated
    assert np.mean(sizes.max(axis=1) > limit) < beyond


def test_the_statistic_is_the_largest_of_each_update_and_gaps_are_told() -> None:
    t = np.concatenate([np.arange(0.0, 10.0), np.arange(30.0, 40.0)])
    frame = pd.DataFrame({"time_s": t, "nu_0": 1.0, "nu_1": -6.0, "s_0": 2.0, "s_1": 3.0, "rejected": t == 5.0})
    when, size, refused, channels = normalised.largest(frame)
    assert channels == 2 and np.array_equal(when, t) and np.all(size == 2.0) and np.array_equal(refused, t == 5.0)
    assert normalised.gaps(t) == [(9.0, 30.0)]
    drawn = normalised.chart("kf", {"gnss": frame}, 0, [], [])
    assert drawn is not None
    by_name = {trace["name"]: trace for trace in drawn["data"]}
    assert by_name["rejected"]["x"] == [5.0] and by_name["no update"]["x"] == [9.0, 30.0]
    assert 5.0 not in by_name["taken"]["x"] and len(by_name["taken"]["x"]) == len(t) - 1


def test_every_rejection_is_drawn_at_its_own_time() -> None:
    """Among more updates than points, behind one without a number."""
    t = np.arange(5000.0)
    frame = pd.DataFrame({"time_s": t, "nu_0": 1.0, "s_0": 1.0, "rejected": np.isin(t, [7.0, 8.0, 4999.0])})
    frame.loc[3, "nu_0"] = np.nan
    drawn = normalised.chart("kf", {"gnss": frame}, 0, [], [])
    assert drawn is not None
    by_name = {trace["name"]: trace for trace in drawn["data"]}
    assert by_name["rejected"]["x"] == [7.0, 8.0, 4999.0]


@pytest.fixture
def real_pipeline(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plug-in of these runs replaces two functions of the pipeline; they are put back afterwards."""
    for name in ("fly", "sense"):
        monkeypatch.setattr(pipeline, name, getattr(pipeline, name))


@pytest.mark.usefixtures("real_pipeline")
def test_a_run_is_chosen_by_its_place_and_shows_its_own_errors(tmp_path: Path) -> None:
    """The synthetic estimator's error north is a constant of each run: the series of the worst is that run's RMSE."""
    runner.run(mc.scenario([mc.GOOD, mc.BAD], runs=9, claims=[mc.CLAIM]), tmp_path / "out", plugins=[mc.PLUGIN], jobs=1)
    result = load_result(tmp_path / "out")
    lead = headline(result)
    metrics = pd.read_parquet(tmp_path / "out" / "metrics.parquet").query(
        "metric == @lead.metric and window == @lead.window"
    )
    values = metrics[metrics["estimator"] == lead.winner].set_index("run")["value"]
    places = chosen_runs.chosen(result, lead)
    assert places["best"] == values.idxmin() and places["worst"] == values.idxmax()
    assert values[places["median"]] == values.median()
    views = charts.charts(result, lead)["runs"]["views"]
    assert next(iter(views)) == f"run {places['best']}, best" and len(views) == 5
    worst = chosen_runs.series(result, places["worst"])
    for label, frame in worst.items():
        stored = metrics[(metrics["estimator"] == label) & (metrics["run"] == places["worst"])]["value"].iloc[0]
        # at 1 Hz instead of 100 Hz, of noise: a mean square of 60 samples is known to 2 sqrt(2 / 60) at two sigma, 37 %
        assert np.sqrt(np.mean(frame["north_m"] ** 2)) == pytest.approx(stored, rel=0.4)
    (tmp_path / "out" / "runs" / f"{places['worst']:06d}.parquet").unlink()
    assert not chosen_runs.series(result, places["worst"])


def test_small_numbers_keep_their_figures() -> None:
    """On a logarithmic axis steps of a ten-thousandth of the largest are stairs; beside an offset the differences count."""
    assert rounded([12345.678, 0.0123456, np.nan, 0.0]) == [12346.0, 0.012346, None, 0.0]
    assert rounded([1e6 + 0.01234, 1e6 + 0.02345]) == [1000000.01234, 1000000.02345]


def test_lines_that_run_together_differ_in_their_dashes() -> None:
    assert all(dash_of(k) != dash_of(k + 1) for k in range(12))


def test_page_and_paper_have_the_same_scale(tmp_path: Path) -> None:
    result = load_result(make_result(tmp_path, factors={"kf": 1.0, "ins": 100.0}))
    page = charts.charts(result, headline(result))["errors"]["views"]["Position"]
    paper = figures.error_traces(result.errors, ["north_m", "east_m", "down_m"])
    for name, ax in zip(("yaxis", "yaxis2", "yaxis3"), paper.axes, strict=True):
        assert page["layout"][name]["range"] == pytest.approx(ax.get_ylim())
        assert any("ins" in text.get_text() for text in ax.texts)


def test_pictures_stand_between_findings_but_no_foreign_ones(tmp_path: Path) -> None:
    folder = make_result(tmp_path / "result")
    render(folder, svg=False)
    name = sorted((folder / "figures").glob("*.png"))[0].name
    (tmp_path / "secret.png").write_bytes(b"secret")
    (folder / "findings.md").write_text(
        f"### One\n\n![Shown](figures/{name})\n\n### Two\n\n![Left out](../secret.png)\n"
    )
    render(folder, svg=False)
    page = (folder / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 1 and page.index("One") < page.index("data:image/png") < page.index(
        "Two"
    )
    assert "Left out" in page and '<a href="#findings">' in page


def test_a_doi_is_a_link_and_markup_in_a_source_is_not() -> None:
    shown = html.template("report.html.j2").environment.filters["with_links"](
        "A. <b>Author</b>, doi 10.3390/data6070072."
    )
    assert '<a href="https://doi.org/10.3390/data6070072">' in shown and "&lt;b&gt;" in shown


def test_the_index_explains_itself(tmp_path: Path) -> None:
    page = render_index([make_result(tmp_path / "result")], tmp_path / "site").read_text()
    assert all(f">{word}</span></dt>" in page for word in ("reproduced", "in part", "not reproduced", "not tested"))
    assert "Each row is a scenario" in page and 'data-label="Headline"' in page
