"""The sky in a report: a small flight with a wrong satellite and a partial outage, its table, figures and page."""

import re

import numpy as np
import pandas as pd
import pytest
from browser import CHROMIUM, visit

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.data.satellites import name_of
from testbed.montecarlo import runner
from testbed.report import render, satellites
from testbed.report.results import load_result
from testbed.scenario import load_scenario

WRONG = "G13"


@pytest.fixture(scope="module")
def scenario():
    """On an open road one satellite is wrong for four seconds, and two are left for ten."""
    sky = "sensors.gnss.satellites"
    plain = load_scenario(
        "city-partial",
        overrides={
            "monte_carlo.runs": 1,
            "claims": [],
            "windows": [],
            "flight.manoeuvres": [{"type": "straight", "duration_s": 50.0}],
            f"{sky}.walls": [],
            f"{sky}.faults": [{"sv": WRONG, "start_s": 20.0, "end_s": 24.0, "step_m": 60.0}],
            f"{sky}.keep": [{"start_s": 30.0, "end_s": 40.0, "highest": 2}],
        },
    )
    return plain.model_copy(update={"estimators": [e for e in plain.estimators if e.name == "indirect-kf"]})


@pytest.fixture(scope="module")
def folder(scenario, tmp_path_factory):
    out = tmp_path_factory.mktemp("sky") / "out"
    runner.run(scenario, out, jobs=1)
    render(out, svg=False)
    return out


def test_the_sky_of_a_run_is_kept(scenario, folder):
    """Every epoch with an exclusion, and what the log says of each satellite there."""
    raw = pipeline.sense(scenario, pipeline.fly(scenario))[0].gnss_raw
    frame = load_result(folder).satellites
    wrong = frame[frame["used"] == 2]
    assert set(wrong["satellite"]) == {WRONG} and wrong["time_s"].between(20.0, 24.0).all()
    assert len(wrong) == np.sum(raw.used == 2) > 10
    assert (wrong["residual_m"].abs() > 20.0).all()
    row = frame.iloc[17]
    k = np.flatnonzero((raw.t == row["time_s"]) & (np.array([name_of(c) for c in raw.sv]) == row["satellite"]))[0]
    assert row["azimuth_deg"] == pytest.approx(np.degrees(raw.azimuth[k])) and row["cn0_dbhz"] == raw.cn0[k]
    few = satellites.epochs(frame).set_index("time_s").loc[31.0:39.0]
    assert (few["tracked"] == 2).all() and (few["used"] == 0).all() and few["hdop"].isna().all()
    many = satellites.epochs(frame).set_index("time_s").loc[:19.0]
    assert (
        (many["used"] > 4).all() and many["hdop"].between(0.5, 5.0).all() and (many["vdop"] > many["hdop"]).mean() > 0.5
    )


def test_table_and_figures_are_in_the_report(folder):
    text = (folder / "report.md").read_text()
    assert "## Satellites" in text
    for name in ("sky", "satellites", "residuals"):
        assert f"figures/{name}.png" in text and (folder / "figures" / f"{name}.png").stat().st_size > 5000
    rows = re.findall(r"^\| ([GE]\d\d) \|.*\| (\d+) \|$", text, re.M)
    counts = {name: int(count) for name, count in rows}
    assert [name for name, count in counts.items() if count] == [WRONG] and counts[WRONG] > 10
    assert 'id="satellites"' in (folder / "report.html").read_text()


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_the_page_draws_the_sky(folder):
    seen = visit(
        folder / "report.html",
        """
        await until(() => document.documentElement.dataset.plots === "drawn");
        seen.sky = document.querySelectorAll("#chart-sky .scatterlayer .trace").length;
        seen.names = document.querySelector("#chart-sky .plot").textContent;
        seen.panels = document.querySelectorAll("#chart-satellites .ytitle, #chart-satellites [class*='y'][class*='title']").length;
        """,
    )
    assert not seen["errors"] and seen["sky"] > 8 and "excluded" in seen["names"] and seen["panels"] >= 4


def test_a_damaged_sky_is_named(folder, tmp_path):
    import shutil

    copy = tmp_path / "out"
    shutil.copytree(folder, copy)
    path = copy / "details" / "satellites.parquet"
    pd.read_parquet(path).drop(columns="hdop").to_parquet(path)
    with pytest.raises(InputError, match=r"satellites\.parquet"):
        load_result(copy)
