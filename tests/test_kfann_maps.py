"""The map of KFANN against its rivals: cells land where they belong, and shorter outages may be read off a longer one."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from synthetic import sensor_log, weaving_flight

from estimators.kfann import Kfann
from estimators.lkf9 import Lkf9
from testbed.scenario import load_scenario


@pytest.fixture(scope="module")
def maps():
    path = Path(__file__).resolve().parent.parent / "reports" / "kfann_maps.py"
    spec = importlib.util.spec_from_file_location("kfann_maps", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def rows(maps) -> pd.DataFrame:
    """RMSE of run 0 = (100 bias + length) times 1, 2, 3, 0.5 by estimator; run 1 ten times that, and lost by KFANN."""
    found = []
    for bias in (1.0, 0.1):
        for scale, name in zip((1.0, 2.0, 3.0, 0.5), (*maps.PAPER, maps.MODERN), strict=True):
            for length in (30, 120):
                value = scale * (100.0 * bias + length)
                lost = name == "KFANN NN3"
                found += [(bias, 0, name, length, value), (bias, 1, name, length, np.nan if lost else 10.0 * value)]
    return pd.DataFrame(found, columns=["gyro_bias_dps", "run", "estimator", "outage_s", "value"])


def test_cells_of_the_map_are_means_over_runs_that_all_finished(maps, rows) -> None:
    table = maps.map_table(rows)
    assert len(table) == 2 * 2 * 4 and (table["runs"] == 1).all()
    first = table[(table["gyro_bias_dps"] == 0.1) & (table["outage_s"] == 30)].set_index("estimator")["mean_m"]
    assert first.to_dict() == {"Update INS": 40.0, "ANN NN3": 80.0, "KFANN NN3": 120.0, "15-state coasting": 20.0}


def test_map_is_drawn_with_the_ratio_in_every_cell(maps, rows) -> None:
    first, best, modern = maps.draw_map(maps.map_table(rows)).axes
    assert [text.get_text() for text in first.texts] == ["3.0"] * 4
    assert [text.get_text() for text in best.texts] == ["40", "130", "130", "220"]
    assert [text.get_text() for text in modern.texts] == ["20", "65", "65", "110"]


@pytest.mark.parametrize("estimator", [Lkf9(restart=True), Kfann(inputs="nn1", epochs=5)])
def test_a_longer_outage_holds_the_shorter(estimator) -> None:
    """The same draws without fixes from 40 to 60 s and to 90 s: bit for bit the same up to the first fix after 60 s."""
    flight = weaving_flight(100.0)
    short, long = (estimator.run(sensor_log(flight, 3, ((40.0, end),), gyro_bias=1e-3)) for end in (60.0, 90.0))
    rows = short.t <= 60.0
    for key in ("lat", "lon", "h"):
        assert np.array_equal(getattr(short, key)[rows], getattr(long, key)[rows])
        assert not np.array_equal(getattr(short, key)[~rows], getattr(long, key)[~rows])


def test_windows_of_the_scenario_start_with_its_outage() -> None:
    scenario = load_scenario("kfann-2018", variant="long-outage")
    ((start, end),) = scenario.sensors.gnss.outages
    assert scenario.flight.duration_s > end
    assert all(window.start == start and start < window.end <= end for window in scenario.windows)
    assert max(window.end for window in scenario.windows) == end
