"""The innovation tests accept what is white, normal and of its stated size, and name each way of not being so."""

from __future__ import annotations

import html
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from result_folder import OUTAGES, make_result
from scipy.signal import lfilter

from testbed.report import innovations, render
from testbed.report.results import load_result

N = 2000
NAMES = [*innovations.PREFERRED]


def frame(values: np.ndarray, sigma: float = 1.0) -> pd.DataFrame:
    t = 0.1 * np.arange(1, len(values) + 1)
    return pd.DataFrame({"time_s": t, "nu_0": values, "nu_1": 10.0 * values, "s_0": sigma, "s_1": 10.0 * sigma})


def first(values: np.ndarray, sigma: float = 1.0) -> innovations.Channel:
    return innovations.analyse(frame(values, sigma), NAMES)[0]


def test_an_honest_filter_passes() -> None:
    """Mean within 4 / sqrt(N); share inside within 4 binomial sigmas of 95.45 %; lags as 20 draws at 5 %: above 5 in 0.03 %."""
    found = first(np.random.default_rng(1).standard_normal(N))
    assert abs(found.scaled.mean()) < 4.0 / np.sqrt(N)
    assert found.inside_pct == pytest.approx(innovations.INSIDE_PCT, abs=400.0 * np.sqrt(0.9545 * 0.0455 / N))
    assert found.normal_p > 1e-3 and found.lags_outside <= 5


def test_p_values_of_normal_innovations_are_uniform() -> None:
    """Share below 5 % over 400 honest sequences: 5 % within 4 binomial sigmas."""
    rng = np.random.default_rng(2)
    share = np.mean([first(rng.standard_normal(200)).normal_p < 0.05 for _ in range(400)])
    assert share == pytest.approx(0.05, abs=4.0 * np.sqrt(0.05 * 0.95 / 400))


def test_heavy_tails_are_not_normal() -> None:
    found = first(np.random.default_rng(3).standard_t(4, N))
    assert found.normal_p < 1e-6 and found.lags_outside <= 5


def test_a_correlated_sequence_is_not_white() -> None:
    """First-order sequence with coefficient 0.9: r(k) = 0.9^k, whose first lags stand far above 1.96 / sqrt(N) = 0.044."""
    white = np.random.default_rng(4).standard_normal(N)
    found = first(lfilter([1.0], [1.0, -0.9], white))
    assert found.correlation[0] == pytest.approx(0.9, abs=0.05)
    assert found.lags_outside >= 10


def test_too_small_a_covariance_leaves_too_few_inside() -> None:
    """sqrt(S) half of the truth: ±2 sqrt(S) is one sigma, 68.3 % within 4 binomial sigmas."""
    found = first(np.random.default_rng(5).standard_normal(N), sigma=0.5)
    assert found.inside_pct == pytest.approx(68.3, abs=400.0 * np.sqrt(0.683 * 0.317 / N))


def test_no_pair_spans_a_gap_and_outages_are_left_out() -> None:
    """Alternating signs, with a gap of an odd number of samples: r(1) = -1 by time, less by row."""
    values = (-1.0) ** np.arange(400)
    table = frame(values).drop(index=range(100, 201))
    t = table["time_s"].to_numpy()
    assert innovations.autocorrelation(t, table["nu_0"].to_numpy())[:2] == pytest.approx([-1.0, 1.0], abs=1e-3)
    kept = innovations.analyse(frame(values), NAMES, [(10.0, 20.0)])[0]
    assert not ((kept.time_s >= 10.0) & (kept.time_s <= 20.0)).any() and len(kept.time_s) == 299


def test_channels_are_those_of_the_paper_where_there_are_any() -> None:
    assert innovations.shown(["north, m", "east, m", "down, m", "north, m/s"]) == [3, 1]
    assert innovations.shown(["yaw", "pitch", "roll"]) == [0, 1]


def test_report_shows_table_and_figure(tmp_path: Path) -> None:
    folder = make_result(tmp_path / "r", runs=3)
    render(folder, svg=False)
    result = load_result(folder)
    table = innovations.table(result)
    assert table is not None and [name for name, _ in table.rows] == result.estimators
    page = html.unescape((folder / "report.html").read_text())
    text, latex = (folder / "report.md").read_text(), (folder / "tables.tex").read_text()
    inside = table.rows[0][1][1]
    assert inside.text in page and 'id="table-innovations"' in page
    assert (
        "figures/innovations_imm-rstekf.png" in text and "lags outside" in text and "tab:synthetic-innovations" in latex
    )
    assert (folder / "figures" / "innovations_imm-rstekf.png").stat().st_size > 5000
    assert OUTAGES and inside.value is not None and 90.0 < inside.value < 99.0


def test_filters_with_the_same_innovations_share_a_row(tmp_path: Path) -> None:
    folder = make_result(tmp_path / "r", factors={"a": 1.0, "b": 1.0, "c": 1.0}, runs=2)
    details = folder / "details"
    (details / "innovations-b.parquet").write_bytes((details / "innovations-a.parquet").read_bytes())
    table = innovations.table(load_result(folder))
    assert table is not None and [name for name, _ in table.rows] == ["a, b", "c"]


def test_values_of_one_time_count_as_one():
    """Nine satellites that swing together from epoch to epoch; alone, each pair of rows would be of one time or of two."""
    epochs = np.repeat(np.arange(40.0), 9)
    swing = np.where(epochs % 2.0 == 0.0, 1.0, -1.0)
    assert innovations.autocorrelation(epochs, swing)[:3] == pytest.approx([-1.0, 1.0, -1.0], abs=1e-12)
    table = pd.DataFrame({"time_s": epochs, "nu_0": swing, "s_0": 1.0})
    assert innovations.analyse(table, ["range"])[0].bound == pytest.approx(1.96 / np.sqrt(40.0))
    assert np.isnan(innovations.autocorrelation(np.zeros(5), np.arange(5.0))).all(), "one time has no lags"
