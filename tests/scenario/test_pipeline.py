"""What varies from run to run is what the scenario says, and nothing else."""

import os

import numpy as np
import pytest

from testbed import make_estimator, pipeline, run, score
from testbed.base.errors import InputError
from testbed.scenario import list_scenarios, load_scenario, overlays_of

TEXT = """
[scenario]
name = "varied"
[flight]
aircraft = "aerosonde"
initial = { speed_mps = 30.0 }
wind = { turbulence = "moderate" }
manoeuvres = [{ type = "straight", duration_s = 3.0 }, { type = "turn", bank_deg = 20.0, duration_s = 5.0 }]
[sensors.imu]
model = "ADIS16448"
disable = ["quantisation", "misalignment", "nonlinearity", "g_sensitivity"]
[sensors.gnss]
model = "Garmin16x"
random_outages = { count = 1, duration_s = 1.0, after_s = 1.0, gap_s = 0.5 }
[initial]
position_m = 3.0
roll_pitch_deg = 1.0
[[estimators]]
name = "ins"
[monte_carlo]
vary = VARY
disperse = { "manoeuvres.1.bank_deg" = { uniform = [10.0, 40.0] } }
"""


@pytest.fixture
def varied(tmp_path):
    def _varied(*groups: str):
        path = tmp_path / "varied.toml"
        path.write_text(TEXT.replace("VARY", str(list(groups))))
        return load_scenario(path)

    return _varied


def drawn(scenario, run):
    """White noise, turn-on bias, initial error and outage of a run on the flight of run 0."""
    trajectory = pipeline.fly(scenario)
    log, errors = pipeline.sense(scenario, trajectory, run=run)
    return {
        "noise": tuple((log.imu.gyro[0] - errors.gyro_bias[0]).round(12)),
        "turn_on": tuple(errors.constants["gyro_turn_on_bias"]),
        "alignment": log.initial.lat - trajectory.lat[0],
        "outages": log.gnss.outages,
    }


@pytest.mark.parametrize("group", ["noise", "turn_on", "alignment", "outages"])
def test_only_the_named_group_varies(varied, group):
    first, second = (drawn(varied(group), run) for run in (0, 1))
    for name in first:
        assert (first[name] != second[name]) == (name == group), name


def test_manoeuvres_are_dispersed_within_their_distribution(varied):
    scenario = varied("manoeuvres")
    banks = [pipeline.flight_of_run(scenario, run)[0].manoeuvres[1].bank_deg for run in range(200)]
    assert banks == [pipeline.flight_of_run(scenario, run)[0].manoeuvres[1].bank_deg for run in range(200)]
    assert 10.0 <= min(banks) < 12.0 and 38.0 < max(banks) <= 40.0
    # the mean of 200 uniform draws over 30° scatters by 30 / sqrt(12 * 200) = 0.61°
    assert np.mean(banks) == pytest.approx(25.0, abs=4 * 0.61)
    assert pipeline.flight_varies(scenario)


def test_a_factor_keeps_the_side_and_each_manoeuvre_draws_its_own(varied, tmp_path):
    more = 'manoeuvres = [{ type = "turn", bank_deg = -30.0, duration_s = 4.0 }, '
    disperse = '"manoeuvres.*.bank_deg" = { factor = [0.5, 1.5] }, "manoeuvres.*.duration_s" = { factor = [0.9, 1.1] }'
    text = TEXT.replace("VARY", '["manoeuvres"]').replace("manoeuvres = [", more)
    text = text.replace('"manoeuvres.1.bank_deg" = { uniform = [10.0, 40.0] }', disperse)
    path = tmp_path / "factor.toml"
    path.write_text(text)
    flights = [pipeline.flight_of_run(load_scenario(path), run)[0].manoeuvres for run in range(200)]
    left, right = (np.array([flight[k].bank_deg for flight in flights]) for k in (0, 2))
    assert -45.0 <= left.min() < left.max() <= -15.0 and 10.0 <= right.min() < right.max() <= 30.0
    # the correlation of 200 independent pairs scatters by 1 / sqrt(200) = 0.07
    assert abs(np.corrcoef(left, right)[0, 1]) < 4 * 0.071
    assert len({flight[1].duration_s for flight in flights}) == 200
    path.write_text(text.replace("manoeuvres.*.bank_deg", "manoeuvres.*.radius_m"))
    with pytest.raises(InputError, match=r"'manoeuvres.\*.radius_m': no row of 'manoeuvres' has 'radius_m'"):
        pipeline.flight_of_run(load_scenario(path), 0)
    path.write_text(text.replace("manoeuvres.*.bank_deg", "manoeuvres.1.bank_deg"))
    with pytest.raises(InputError, match=r"'manoeuvres.1.bank_deg': the flight has no such number"):
        pipeline.flight_of_run(load_scenario(path), 0)


def test_varying_manoeuvres_needs_something_to_draw(tmp_path):
    path = tmp_path / "nothing.toml"
    path.write_text(TEXT.replace("VARY", '["manoeuvres"]').replace("disperse =", "# disperse ="))
    with pytest.raises(InputError, match=r"no table \[monte_carlo.disperse\] says what is drawn"):
        load_scenario(path)


DRAWN = [
    (name, variant)
    for name, path in list_scenarios().items()
    for variant in [None, *overlays_of(path)[1]]
    if not (variant or name).startswith("navego") and name != "broad"  # recordings
]


@pytest.mark.parametrize(("name", "variant"), DRAWN)
def test_every_shipped_flight_can_be_drawn_anew(name, variant):
    """Path, bank and speed differ from run to run, of a drive its stretches and bends; with TESTBED_FULL_COUNTS=1 the first
    three are flown."""
    scenario = load_scenario(name, variant=variant, overrides={"monte_carlo.vary": ["manoeuvres"]})
    flights = [pipeline.flight_of_run(scenario, run)[0] for run in range(10)]
    bends = ("radius_m", "heading_change_deg")
    driven = (
        lambda f: [m.duration_s for m in f.manoeuvres if hasattr(m, "duration_s")],
        lambda f: [getattr(m, key) for m in f.manoeuvres for key in bends if hasattr(m, key)],
    )
    flown = (
        lambda f: f.initial.speed_mps or f.initial.heading_deg,  # a parked aircraft has no speed
        lambda f: f.initial.heading_deg,
        lambda f: [m.duration_s for m in f.manoeuvres if hasattr(m, "duration_s")],
        lambda f: [m.bank_deg for m in f.manoeuvres if hasattr(m, "bank_deg")],
    )
    if name in ("field-mission", "multirotor"):  # their places are given, and a quadrotor has no bank to give
        flown = (str,)
    for value in flown if scenario.flight.type == "jsbsim" else driven:
        assert len({str(value(flight)) for flight in flights}) == 10
    if os.environ.get("TESTBED_FULL_COUNTS"):
        ends = [pipeline.fly(scenario, run) for run in range(3)]
        assert len({round(float(flight.lat[-1]), 9) for flight in ends}) == 3
        assert all(pipeline.sense(scenario, flight, run=run) for run, flight in enumerate(ends))


def test_turbulence_makes_each_run_a_flight_of_its_own(varied):
    scenario = varied("turbulence")
    assert pipeline.flight_varies(scenario) and not pipeline.flight_varies(varied("noise"))
    one, two = (pipeline.fly(scenario, run) for run in (0, 1))
    assert np.abs(one.v_n - two.v_n).max() > 0.05
    np.testing.assert_array_equal(one.v_n, pipeline.fly(scenario, 0).v_n)


def test_an_impossible_dispersion_names_the_run(varied):
    scenario = varied("manoeuvres")
    broken = scenario.monte_carlo.disperse["manoeuvres.1.bank_deg"].model_copy(update={"uniform": [200.0, 300.0]})
    settings = scenario.monte_carlo.model_copy(update={"disperse": {"manoeuvres.1.bank_deg": broken}})
    with pytest.raises(InputError, match=r"flight of run 3.*bank_deg"):
        pipeline.flight_of_run(scenario.model_copy(update={"monte_carlo": settings}), 3)


def test_an_imu_with_a_lever_arm_is_scored_where_it_sits(varied, tmp_path):
    """An ideal IMU three metres ahead, integrated from the truth, stays at its own place: the arm's acceleration is taken
    from rates at the ends of intervals, which in these 8 s of turbulence costs millimetres."""
    path = tmp_path / "arm.toml"
    text = TEXT.replace("VARY", "[]").replace('model = "ADIS16448"', 'model = "ideal"\nlever_arm_m = [3.0, 0.0, 0.0]')
    path.write_text(text.replace("position_m = 3.0\nroll_pitch_deg = 1.0", "perfect = true"))
    scenario = load_scenario(path)
    trajectory = pipeline.fly(scenario)
    log, _ = pipeline.sense(scenario, trajectory)
    solution = make_estimator("ins").run(log)
    table = score(scenario, trajectory, solution, log).set_index(["window", "metric"])["value"]
    assert table["all", "max_position_3d_m"] < 0.03
    assert (
        score(scenario, trajectory, solution).set_index(["window", "metric"])["value"]["all", "rmse_position_3d_m"]
        > 2.9
    )
    summary = run(scenario, tmp_path / "out", runs=1, jobs=1).summary.set_index(["window", "metric"])["mean"]
    assert summary["all", "rmse_position_3d_m"] == pytest.approx(table["all", "rmse_position_3d_m"], rel=1e-9)
