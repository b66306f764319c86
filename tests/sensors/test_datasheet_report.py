"""The page on the catalogue's units at rest: a row per figure of the data sheet, judged where there is a limit."""

from testbed.sensors import datasheet_report


def test_page_has_a_row_per_figure_and_judges_those_with_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(datasheet_report, "list_sensors", lambda: {"imu": ["ideal", "ADIS16405"]})
    table = datasheet_report.write_report(tmp_path, duration_s=1200.0)
    whole = table[table["axis"] == "all"]
    page = (tmp_path / "README.md").read_text()
    rows = {
        tuple(cell.strip() for cell in line.split("|")[1:3]): line
        for line in page.splitlines()
        if "ADIS16405 |" in line
    }
    assert set(rows) == {
        ("ADIS16405", f"{triad} {figure}") for triad, figure in zip(whole["triad"], whole["figure"], strict=True)
    }
    # white noise is seen within a second: at 20 minutes to a per cent, so that it must be met
    assert "| 3 % | met |" in rows["ADIS16405", "gyro ARW"]
    assert "| 3 % | met |" in rows["ADIS16405", "accel VRW"]
    assert "MISSED" not in rows["ADIS16405", "gyro correlation time"]
    assert "nan" not in page
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ADIS16405.png", "README.md", "allan.csv"]
