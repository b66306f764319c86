"""What an interpreter and a notebook show of the records, and the errors that one call gives."""

import matplotlib.figure
import numpy as np
import pytest
from synthetic import sensor_log, weaving_flight

import testbed
from testbed.data.shown import in_words


@pytest.fixture(scope="module")
def nouns():
    flight = weaving_flight()
    log = sensor_log(flight)
    return flight, log, testbed.make_estimator("indirect-kf").run(log)


def test_a_few_lines_in_place_of_all_numbers(nouns):
    for noun in nouns:
        text = repr(noun)
        assert len(text) < 2000 and text.startswith(type(noun).__name__) and "Hz" in text
        assert noun._repr_html_().startswith("<table>")
    assert "gnss" in repr(nouns[1]) and "15: position_north_m" in repr(nouns[2])


def test_a_scenario_in_five_lines():
    lines = repr(testbed.load_scenario("quickstart")).splitlines()
    assert lines[0] == "Scenario quickstart" and "aerosonde" in lines[1] and "imu, gnss" in lines[2] and len(lines) == 5
    assert "table" in repr(testbed.load_scenario("navego")) or "navego" in repr(testbed.load_scenario("navego"))


def test_a_batch_in_a_line_per_estimator(tmp_path):
    result = testbed.run("quickstart", tmp_path / "out", runs=2, jobs=1, estimators=["indirect-kf", "ins"])
    lines = repr(result).splitlines()
    assert lines[0].endswith("2 runs, 3-D position RMSE") and len(lines) == 4 and "claims" in lines[3]
    mean = result.metrics.query("estimator == 'ins' and window == 'all' and metric == 'rmse_position_3d_m'")[
        "value"
    ].mean()
    assert f"{mean:.4g} m" in lines[1]
    figure = result.plot("errors", "indirect-kf", metric="position")
    assert isinstance(figure, matplotlib.figure.Figure) and len(figure.axes) == 3
    with pytest.raises(testbed.InputError, match="no figure 'erors'"):
        result.plot("erors")


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (None, ""),
        ((0.0, 0.0, 0.0), ""),
        (np.array([1.0, 2.5]), "[1.  2.5]"),
        (np.arange(12.0).reshape(4, 3), "4x3, 0 to 11"),
        (np.full(9, np.nan), "9, no number"),
        ({"a": 1, "b": 2}, "a, b"),
        ("x" * 100, "x" * 67 + "..."),
    ],
)
def test_values_in_words(value, words):
    assert in_words(value) == words


def test_errors_with_sigmas_in_one_call(nouns):
    flight, log, solution = nouns
    frame = testbed.solution_errors(flight, solution, log)
    assert len(frame) == len(solution.t)
    k = len(frame) // 2
    assert frame["v_east_mps"][k] == solution.v_n[k, 1] - np.interp(solution.t[k], flight.t, flight.v_n[:, 1])
    assert frame["sigma_north_m"][k] == solution.std[k, 0]


def test_everything_draws_itself(nouns):
    flight, log, solution = nouns
    figures = [noun.plot() for noun in nouns]
    figures.append(testbed.plot_errors(flight, solution, log))
    assert all(isinstance(figure, matplotlib.figure.Figure) and figure.axes for figure in figures)
    assert len(figures[-1].axes) == 9


def test_no_public_name_is_an_old_module():
    """An old module that a plug-in of 0.1 imports becomes an attribute of the package, and would hide the name."""
    from testbed.base.old_names import MOVED

    assert not {f"testbed.{name}" for name in testbed.__all__} & set(MOVED)
