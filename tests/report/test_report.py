"""Reports say what the result folder holds: the same numbers in every format, the right winner, nothing from outside."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from result_folder import make_result

from testbed.base.errors import InputError
from testbed.report import render, render_index, tables
from testbed.report.geometry import local
from testbed.report.headline import headline
from testbed.report.labels import number, percent, verdict_kind, window_label
from testbed.report.results import load_result
from testbed.report.sensors import sensor_tables
from testbed.scoring.quantities import metric_label


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_result(tmp_path_factory.mktemp("report") / "result")
    render(folder)
    return folder


def test_every_format_holds_every_number_of_the_comparison(folder: Path) -> None:
    table = tables.comparison(load_result(folder), "all")
    page = html.unescape((folder / "report.html").read_text())
    text, latex = (folder / "report.md").read_text(), (folder / "tables.tex").read_text()
    assert len(table.rows) == 4 and len(table.columns) == 11
    for name, cells in table.rows:
        for cell in cells:
            assert cell.text in page and cell.interval in page
            assert cell.text in text and cell.interval in text
            assert cell.text in latex
        assert name in page and name in text and name in latex


def test_comparison_prints_the_mean_of_the_runs_and_marks_the_lowest(folder: Path) -> None:
    metrics = pd.read_parquet(folder / "metrics.parquet").query("window == 'all' and metric == 'rmse_north_m'")
    means = metrics.groupby("estimator")["value"].mean()
    table = tables.comparison(load_result(folder), "all")
    for name, cells in table.rows:
        assert cells[0].value == pytest.approx(means[name])
        assert cells[0].best == (name == means.idxmin())


def test_equal_figures_are_marked_alike(tmp_path: Path) -> None:
    folder = make_result(tmp_path, factors={"a": 1.0, "b": 1.0, "c": 2.0}, runs=5)
    summary = pd.read_csv(folder / "summary.csv")
    summary.loc[summary["estimator"] != "c", "mean"] = 1.0
    summary.to_csv(folder / "summary.csv", index=False)
    marked = {name: cells[0].best for name, cells in tables.comparison(load_result(folder), "all").rows}
    assert marked == {"a": True, "b": True, "c": False}


def test_headline_names_the_winner_and_its_lead(folder: Path) -> None:
    found = headline(load_result(folder))
    assert found.winner == "imm-rstekf"
    assert found.sentences[0].startswith("imm-rstekf has the lowest 3-D position RMSE over the whole flight")
    # true lead 20 %; each run scatters by 5 % / sqrt(3) or less in either method, so the mean of 20 by 1 %: allow 4 sigma
    assert found.gain.percent == pytest.approx(20.0, abs=4.0)
    assert found.gain.low < found.gain.percent < found.gain.high
    assert any("Runs lost: imm-rstekf 1 of 20" in s for s in found.sentences)


def test_headline_does_not_crown_a_tie(tmp_path: Path) -> None:
    folder = make_result(tmp_path, factors={"a": 1.0, "b": 1.0}, runs=8, diverged=0)
    metrics = pd.read_parquet(folder / "metrics.parquet")
    flip = (metrics["run"] % 2).map({0: 1.1, 1: 0.9}).where(metrics["estimator"] == "a", 1.0)
    twin = metrics["estimator"].eq("b").map({True: 1.0, False: 1.0})
    base = metrics.groupby(["run", "window", "metric"])["value"].transform("first")
    metrics.assign(value=base * flip * twin).to_parquet(folder / "metrics.parquet")
    assert "do not tell it apart" in headline(load_result(folder)).sentences[0]


def test_without_the_runs_nothing_is_called_a_tie(tmp_path: Path) -> None:
    """A copied report has the tables but not the runs: the ranking of the means stands, no test is made up."""
    folder = make_result(tmp_path, runs=8)
    (folder / "metrics.parquet").unlink()
    first = headline(load_result(folder)).sentences[0]
    assert "tell it apart" not in first and first.endswith("; next is kf.")


def test_single_run_has_no_interval(tmp_path: Path) -> None:
    folder = make_result(tmp_path, factors={"a": 1.0, "b": 3.0}, runs=1, diverged=0)
    assert "one run: no interval" in " ".join(headline(load_result(folder)).sentences)
    render(folder, svg=False)


def test_claims_stand_with_paper_value_interval_and_word(folder: Path) -> None:
    (table,) = tables.claims(load_result(folder))
    first = dict(zip([c.label for c in table.columns], table.rows[0][1], strict=True))
    assert [first[label].text for label in ("Claim", "Stated", "Measured", "95 % interval", "Verdict")] == [
        "imm-rstekf lowers the position RMSE against kf",
        "12.0",
        "20.1",
        "18.3 to 22.0",
        "reproduced",
    ]
    assert [cells[-1].kind for _, cells in table.rows] == ["good", "part", "bad", "open"]
    page = (folder / "report.html").read_text()
    assert '<span class="verdict bad">not reproduced</span>' in page


@pytest.mark.parametrize(
    ("verdict", "kind"),
    [
        ("reproduced", "good"),
        ("direction reproduced", "part"),
        ("not reproduced", "bad"),
        ("reversed", "bad"),
        ("not tested", "open"),
        ("undecided", "open"),
        ("depends on runaways", "part"),
    ],
)
def test_verdict_colours(verdict: str, kind: str) -> None:
    assert verdict_kind(verdict) == kind


def test_papers_table_stands_beside_ours(folder: Path) -> None:
    result = load_result(folder)
    (table,) = tables.paper_tables(result)
    assert [c.group for c in table.columns[:2]] == ["kf", "kf"]
    name, cells = table.rows[0]
    assert name == "Latitude, m"
    assert cells[0].text == "1.400"
    assert cells[1].value == pytest.approx(result.means["all", "rmse_north_m", "kf"]["mean"])
    assert table.rows[2][1][1].text == "3.10"  # µs per sample, from timings.csv


def test_page_refers_to_nothing_outside(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    visible = re.sub(r'<script type="text/plain".*?</script>', "", page, flags=re.DOTALL)
    assert not re.search(r'(src|href)\s*=\s*"(?!#|data:)', visible)
    assert not re.search(r"@import|url\(|//[a-z0-9-]+\.[a-z]{2,}", visible)
    assert "default-src 'none'" in page


def test_five_reports_stay_below_ten_megabytes(folder: Path) -> None:
    assert 5 * (folder / "report.html").stat().st_size < 10e6 * 0.7  # the rest is left for figures


def test_names_are_text_and_not_markup(tmp_path: Path) -> None:
    folder = make_result(tmp_path / "r", factors={"a": 1.0, "b<script>alert(1)</script>": 2.0}, runs=3, name="x")
    info = json.loads((folder / "details" / "info.json").read_text())
    (folder / "details" / "info.json").write_text(json.dumps(info | {"title": "<img src=x>"}))
    render(folder, svg=False)
    page = (folder / "report.html").read_text()
    assert "<img" not in page and "<script>alert" not in page
    assert "<b>no</b>" not in page  # of findings.md


def test_rendering_twice_gives_the_same_bytes(folder: Path) -> None:
    files = [p for p in sorted(folder.rglob("*")) if p.suffix in {".html", ".md", ".tex", ".png", ".svg"}]
    before = {p: p.read_bytes() for p in files}
    assert len(files) >= 20
    render(folder)
    assert {p: p.read_bytes() for p in files} == before


def test_summary_alone_is_enough(tmp_path: Path) -> None:
    whole = make_result(tmp_path / "whole", runs=3)
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("summary.csv", "manifest.json"):
        (bare / name).write_bytes((whole / name).read_bytes())
    render(bare)
    assert "imm-rstekf has the lowest" in (bare / "report.md").read_text()
    assert (bare / "figures" / "rmse.png").exists()


def test_attitude_only_result_is_judged_by_attitude(tmp_path: Path) -> None:
    folder = make_result(tmp_path, runs=4)
    summary = pd.read_csv(folder / "summary.csv")
    summary[summary["metric"].str.contains("roll|pitch|yaw|attitude")].to_csv(folder / "summary.csv", index=False)
    (folder / "scenario.toml").unlink()
    assert headline(load_result(folder)).metric == "rmse_attitude_deg"
    render(folder, svg=False)


def test_missing_and_damaged_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no result folder"):
        render(tmp_path)
    folder = make_result(tmp_path / "r", runs=2)
    (folder / "envelopes.parquet").write_bytes(b"not parquet")
    with pytest.raises(InputError, match="damaged"):
        render(folder)


def test_latex_rows_have_as_many_cells_as_columns(folder: Path) -> None:
    text = (folder / "tables.tex").read_text()
    assert text.count("\\begin{tabular}") == text.count("\\bottomrule") >= 5
    for body in re.findall(r"\\begin\{tabular\}\{([^\n]*)\}\n(.*?)\\end\{tabular\}", text, re.DOTALL):
        columns = len(re.sub(r"p\{[^}]*\}", "p", body[0]))
        rows = re.findall(r"^ {4}([^\\\n].*|\\textbf.*) \\\\$", body[1].split("\\midrule")[1], re.MULTILINE)
        assert rows
        assert all(len(re.findall(r"(?<!\\)&", row)) == columns - 1 for row in rows)
    assert not re.search(r"(?<!\\)[_#]", re.sub(r"\\label\{.*?\}", "", text))


def test_sensor_table_gives_the_data_sheet_back(folder: Path) -> None:
    imu = sensor_tables(load_result(folder))[0]
    rows = dict(imu.rows)
    # the sample's specification: 2 °/√h and 0.2 m/s/√h, 3 °/s and 50 mg, range ±350 °/s
    assert [c.text for c in rows["Angle or velocity random walk"]] == ["2.00 °/√h", "0.200 m/s/√h"]
    assert [c.text for c in rows["Turn-on bias, 1σ"]] == ["3.00 °/s", "50.0 mg"]
    assert [c.text for c in rows["Range, ±"]] == ["350 °/s", "–"]
    assert "Bias instability" not in rows


def test_index_counts_verdicts_and_links(folder: Path, tmp_path: Path) -> None:
    page = render_index([folder, folder], tmp_path / "site")
    text = page.read_text()
    assert page.name == "index.html"
    link = re.findall(r'<a href="([^"]+)"', text)[0]
    assert (page.parent / link).resolve() == (folder / "report.html").resolve()
    assert "of 8 claims 2 reproduced, 2 in part, 2 not reproduced, 2 not tested" in re.sub(r"\s+", " ", text)
    assert "imm-rstekf has the lowest" in page.with_suffix(".md").read_text()


def test_index_has_one_row_per_scenario_with_its_variants_and_studies_behind_it(tmp_path: Path) -> None:
    names = ("as-it-stands", "wind", "another")
    folders = [make_result(tmp_path / name, factors={"a": 1.0, "b": 2.0}, runs=3) for name in names]
    changes: list[dict[str, object]] = [
        {"variant": None},
        {"variant": "wind"},
        {"scenario": "another", "variant": None},
    ]
    for folder, change in zip(folders, changes, strict=True):
        path = folder / "manifest.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | change))
        render(folder)
    study = tmp_path / "study"
    study.mkdir()
    told = {"scenario": "s", "variant": None, "title": "Tuned", "source": "", "sentence": "No gain.", "runs": 7}
    (study / "report.json").write_text(json.dumps(told | {"verdicts": ["not reproduced", "in part: here"]}))
    page = render_index([folders[1], folders[0], folders[2], study], tmp_path / "site")
    rows = re.findall(r"<tr>.*?</tr>", page.read_text(), flags=re.DOTALL)[1:]
    links = [re.findall(r'<a href="\.\./([^/"]+)[^"]*">', row) for row in rows]
    assert links == [["as-it-stands", "wind"], ["another"], ["study"]]
    assert "3 scenarios, 4 reports" in page.read_text()
    assert (
        "1 in part" in rows[2] and "1 not reproduced" in rows[2] and "No gain." in page.with_suffix(".md").read_text()
    )


def test_numbers_have_three_figures() -> None:
    found = [number(x) for x in (0.04217, 1.4012, 12.34, 712.72, 10542.0, 0.99951, 0.0, -2.5, float("nan"), None)]
    assert found == ["0.0422", "1.40", "12.3", "713", "10542", "1.00", "0", "−2.50", "–", "–"]
    assert [percent(x) for x in (12.34, -120.4, 99.97, 100.0)] == ["12.3", "−120", "> 99.9", "100"]


def test_labels_read_as_words() -> None:
    assert metric_label("rmse_position_3d_m") == "3-D position RMSE"
    assert metric_label("final_yaw_deg") == "Yaw error at the end"
    assert window_label("phase_3_s_turn") == "phase 3, s turn"


def test_local_plane_agrees_with_pymap3d() -> None:
    pymap3d = pytest.importorskip("pymap3d")
    frame = pd.DataFrame({"lat_deg": [47.0, 47.005], "lon_deg": [179.998, -179.998], "alt_m": [500.0, 520.0]})
    east, north, _ = local(frame, frame)
    e, n, _ = pymap3d.geodetic2enu(47.005, -179.998, 520.0, 47.0, 179.998, 500.0)
    # the plane's error is of second order: 636 m / Earth radius times 636 m, and the height difference times 1e-4
    assert np.hypot(east[1] - e, north[1] - n) < 0.2
