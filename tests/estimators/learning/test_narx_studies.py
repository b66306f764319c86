"""Studies of the NARX thesis: windows with GNSS, tables from runs, and the recorded drive where it is there."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from report_studies import study

filters = study("narx_filters")
DRIVE = Path(__file__).resolve().parents[4] / "shared" / "data" / "drive"


def test_with_gnss_is_what_lies_between_outages_once_the_filter_has_settled():
    found = filters.with_gnss([(249.9, 309.9), (320.0, 330.0)], 500.0)
    assert found == [(100.0, 249.9), (350.0, 500.0)]  # nothing is left between the two: 329.9 s is after 320 s


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    """Two runs of every case. With 300 times both noises the UKF's accelerometer biases are half as wrong as the EKF's, elsewhere
    they are equal but for chance; it leaves its band as often."""
    out = []
    for case in filters.CASES:
        for run in range(2):
            for k, label in enumerate(filters.FILTERS):
                better = 0.5 if case == filters.BOTH and k else 1.0 + 1e-3 * k * (-1) ** run
                put = {("right_pct", axis): 100.0 - 20.0 * better - 0.01 * run for axis in filters.AXES}
                put |= {("truth", axis): 2e-3 if axis.startswith("accel") else 3e-6 for axis in filters.AXES}
                put |= {("estimate", axis): 1e-3 for axis in filters.AXES} | {
                    ("convergence_s", axis): 7.0 for axis in filters.AXES
                }
                put |= {("growth", group): (3.0 + k + run) ** 2 for group in filters.GROUPS}
                put |= {
                    (where, s): 0.01 + 1e-4 * k * (-1) ** run + 1e-5 * run
                    for where in ("with GNSS", "in outages")
                    for s in filters.STATES
                }
                out += [(label, run, kind, item, value, case) for (kind, item), value in put.items()]
            out.append(("EKF", run, "apart", "m", 4.0, case))
    return pd.DataFrame(out, columns=["filter", "run", "kind", "item", "value", "case"])


def test_tables_have_a_row_per_case_and_filter_in_order(rows):
    growth, biases, bands = filters.growth_table(rows), filters.bias_rows(rows), filters.band_table(rows)
    names = [(case, label) for case in filters.CASES for label in filters.FILTERS]
    assert list(zip(growth["case"], growth["filter"], strict=True)) == names
    assert growth["all of it"][0] == pytest.approx(((3.0**2 + 4.0**2) / 2) ** 0.5) and growth["ekf_to_ukf"][0] == 2.0
    assert len(biases) == 60 and len(bands) == 20
    first = biases[biases["axis"] == "accel x"].iloc[0]
    assert (first["truth"], first["estimate"]) == (pytest.approx(2.0), pytest.approx(1.0))  # mm/s^2
    assert biases[biases["axis"] == "gyro z"]["truth"].iloc[0] == pytest.approx(3.0)  # urad/s
    assert bands["position N"][0] == pytest.approx(1.0, rel=0.01)  # per cent


def test_a_claim_that_holds_under_one_q_depends_on_it(rows):
    table = filters.verdicts(rows).set_index(["claim", "reading"])
    biases, bands = table.loc["1-biases"], table.loc["1-bands"]
    assert biases.loc[filters.BOTH, "verdict"] == "reproduced" and biases.loc[
        filters.BOTH, "effect_pct"
    ] == pytest.approx(50.0, abs=0.1)
    assert biases["class"].str.startswith("depends on Q").all()
    assert (bands["class"] == "fails").all()


@pytest.mark.skipif(not DRIVE.is_dir(), reason="the recorded drive is not here")
def test_the_recorded_drive_has_rows_of_all_filters(monkeypatch):
    """Seven windows of 15 s; EKF and UKF coast alike on a recording too: within 1 %, where they are some 10 m off."""
    drive = study("narx_drive")
    monkeypatch.setattr(drive, "filters", lambda: {"EKF": ("direct-ekf", {}), "UKF": ("direct-ukf", {})})
    table = drive.drive_table(DRIVE).set_index("filter")
    assert (table["windows"] == 7).all() and 1.0 < table["rms_end_m"]["EKF"] < 100.0
    assert table["rms_end_m"]["UKF"] == pytest.approx(table["rms_end_m"]["EKF"], rel=0.01)


def test_without_the_recording_the_table_stays_as_it_is(tmp_path, monkeypatch):
    drive, jobs = study("narx_drive"), study("jobs")
    monkeypatch.delenv(drive.PLACE, raising=False)
    (tmp_path / "drive.csv").write_text("as committed\n")
    with pytest.raises(jobs.Kept, match=drive.PLACE):
        drive.make_table(SimpleNamespace(target=tmp_path))
    assert (tmp_path / "drive.csv").read_text() == "as committed\n"
