"""The map of KFANN against its rivals: cells land where they belong, and shorter outages may be read off a longer one."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from report_studies import study
from synthetic import sensor_log, weaving_flight

from estimators.learning.kfann import Kfann
from estimators.methods.lkf9 import Lkf9, Measurements
from testbed.scenario import load_scenario

fed, maps = study("kfann_fed"), study("kfann_maps")


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    """RMSE of run 0 = (100 bias + length) times 1, 2, 3, 0.5 by estimator; run 1 ten times that, and lost by KFANN."""
    found = []
    for bias in (1.0, 0.1):
        for scale, name in zip((1.0, 2.0, 3.0, 0.5), (*maps.PAPER, maps.MODERN), strict=True):
            for length in (30, 120):
                value = scale * (100.0 * bias + length)
                lost = name == "KFANN NN3"
                found += [(bias, 0, name, length, value), (bias, 1, name, length, np.nan if lost else 10.0 * value)]
    return pd.DataFrame(found, columns=["gyro_bias_dps", "run", "estimator", "outage_s", "value"])


def test_cells_of_the_map_are_means_over_runs_that_all_finished(rows) -> None:
    table = maps.map_table(rows)
    assert len(table) == 2 * 2 * 4 and (table["runs"] == 1).all()
    first = table[(table["gyro_bias_dps"] == 0.1) & (table["outage_s"] == 30)].set_index("estimator")["mean_m"]
    assert first.to_dict() == {"Update INS": 40.0, "ANN NN3": 80.0, "KFANN NN3": 120.0, "15-state coasting": 20.0}


def test_map_is_drawn_with_the_ratio_in_every_cell(rows) -> None:
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


def test_a_straight_line_goes_on_straight() -> None:
    """Of errors that grow evenly; what came before the last seconds does not count."""
    t = np.arange(0.0, 80.0, 0.1)
    rate = np.array([1.0, 2.0, 3.0, 1e-6, 2e-6, -4.0])
    value = 5.0 + np.outer(t, rate)
    value[t < 60.0] = 1e6
    real = Measurements(t, value, np.ones_like(value), np.zeros(len(t), dtype=np.int64))
    times = np.array([80.0, 110.0])
    np.testing.assert_allclose(fed.straight_line(real, 79.9, times), 5.0 + np.outer(times, rate), rtol=1e-9)


def test_what_the_filter_is_fed_with_decides() -> None:
    """Of one flight with a gyro bias: the rows of the networks are `kfann`; hidden positions beat what its networks say of them
    by a factor of five (as `test_extrapolation_is_what_fails` has it), and R that admits their errors loses less than the
    receiver's."""
    flight, outage = weaving_flight(), (80.0, 110.0)
    log, full = (sensor_log(flight, 1, outages, gyro_bias=1e-3) for outages in ((outage,), ()))
    solutions = fed.answers(log, full)
    error = {name: fed.rmse(flight, solution, *outage) for name, solution in solutions.items()}
    for name, velocity in (("networks (KFANN NN3)", True), ("networks, positions", False)):
        assert np.array_equal(solutions[name].lat, Kfann(inputs="nn3", velocity=velocity).run(log).lat)
    assert 5.0 * error["hidden positions"] < error["networks, positions"]
    for name in ("", ", positions"):
        assert error[f"networks{name}, R their true error"] < error[f"networks{name or ' (KFANN NN3)'}"]
    np.testing.assert_allclose(solutions["hidden fixes"].lat, solutions["no outage"].lat, atol=1e-12)
    assert error["no outage"] < error["hidden positions"]


def test_the_two_logs_of_a_run_differ_by_the_outage_alone() -> None:
    """The hidden fixes are only hidden if noise and biases are those of the log without the outage, bit for bit."""
    from testbed.sensors import sense_flight

    flight = weaving_flight(120.0)
    logs = []
    for overrides in ({}, {"sensors.gnss.outages": []}):
        scenario = load_scenario("kfann-2018", reading="matched", overrides=overrides)
        logs.append(sense_flight(scenario.sensors, scenario.initial, flight, 1, 3)[0])
    log, full = logs
    seen = np.isin(full.gnss.t, log.gnss.t)
    assert 0 < (~seen).sum() < len(seen)
    for key in ("lat", "lon", "h", "v_n"):
        assert np.array_equal(getattr(full.gnss, key)[seen], getattr(log.gnss, key))
    assert np.array_equal(full.imu.gyro, log.imu.gyro) and full.initial.lat == log.initial.lat


def test_table_of_what_was_fed() -> None:
    rows = pd.DataFrame(
        [
            ("t", "r", run, name, scale * (run + 1.0), 1.0)
            for run in range(3)
            for name, scale in (("a", 1.0), ("b", 10.0))
        ],
        columns=["trajectory", "reading", "run", "fed", "outage_m", "first_m"],
    )
    table = fed.summarise(rows).set_index("fed")
    assert table["mean_m"].to_dict() == {"a": 2.0, "b": 20.0} and (table["runs"] == 3).all()
    assert (table["ci_low_m"] < table["mean_m"]).all() and (table["mean_m"] < table["ci_high_m"]).all()
