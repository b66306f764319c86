"""The flights do what their scripts say, repeat exactly, and fail with a message that names the manoeuvre."""

from __future__ import annotations

import hashlib
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from flights import coordinated_rate, flight, straight, turn

from testbed import flight as flying
from testbed.base.errors import FlightError, InputError
from testbed.flight import cache, fly_flight, list_aircraft
from testbed.flight.aircraft import load_aircraft
from testbed.physics.rotations import quats_to_eulers, wrap

CRUISE = {"aerosonde": (30.0, 500.0), "transport": (170.0, 3000.0), "agile": (220.0, 3000.0)}


def fly(config, seed=0):
    return fly_flight(config, seed, use_cache=False)


def rows(trajectory, start, end):
    return (trajectory.t >= start) & (trajectory.t <= end)


def test_shipped_aircraft():
    assert list_aircraft() == ["aerosonde", "agile", "multirotor", "trainer", "transport"]


@pytest.mark.parametrize(("name", "bank"), [("aerosonde", 50), ("aerosonde", -50), ("transport", 45), ("agile", -75)])
def test_level_turn_is_coordinated(name, bank):
    """A level coordinated turn has load factor 1/cos(bank) and turns at g tan(bank)/V; 3 % for bank and side force."""
    speed, alt = CRUISE[name]
    truth = fly(flight(name, speed, turn(bank, 40.0), alt=alt))
    steady = rows(truth, 20.0, 40.0)
    yaw = np.unwrap(quats_to_eulers(truth.q_nb)[steady, 2])
    rate = (yaw[-1] - yaw[0]) / 20.0
    v = truth.extra["airspeed_mps"][steady].mean()
    assert rate == pytest.approx(coordinated_rate(bank, v), rel=0.03)
    assert truth.extra["load_factor"][steady].mean() == pytest.approx(1.0 / math.cos(math.radians(bank)), rel=0.03)
    assert np.abs(truth.extra["beta_deg"][steady]).max() < 1.0
    assert np.ptp(truth.h[steady]) < 0.1 * speed


def test_vertical_and_speed_targets_are_reached():
    """Each manoeuvre with a goal ends at its goal: within the tolerance that its end condition declares."""
    goals = (
        {"type": "climb", "climb_rate_mps": 3.0, "to_alt_m": 560.0},
        {"type": "accelerate", "to_speed_mps": 36.0},
        {"type": "descent", "path_angle_deg": 4.0, "to_alt_m": 500.0},
        {"type": "decelerate", "to_speed_mps": 27.0},
        {"type": "turn", "bank_deg": -40.0, "to_heading_deg": 90.0},
        straight(5.0),
    )
    truth = fly(flight("aerosonde", 30.0, *goals, alt=500.0))
    ends = {p.name: round(p.end * 100) - 1 for p in truth.phases}
    assert truth.h[ends["climb"]] == pytest.approx(560.0, abs=2.5)
    assert truth.extra["airspeed_mps"][ends["accelerate"]] == pytest.approx(36.0, abs=0.4)
    assert truth.h[ends["descent"]] == pytest.approx(500.0, abs=2.5)
    assert truth.extra["airspeed_mps"][ends["decelerate"]] == pytest.approx(27.0, abs=0.4)
    yaw = quats_to_eulers(truth.q_nb)[ends["straight"], 2]
    assert abs(math.degrees(wrap(yaw - math.pi / 2))) < 3.0


def test_loiter_keeps_its_radius_over_ground_in_wind():
    """The guidance corrects the radius over ground: within 5 % while wind turns from head to tail."""
    circle = {"type": "loiter", "radius_m": 250.0, "direction": "left", "duration_s": 120.0}
    truth = fly(flight("aerosonde", 28.0, circle, alt=500.0, wind={"north_mps": 4.0, "east_mps": 2.0}))
    late = rows(truth, 60.0, 120.0)
    north = (truth.lat - truth.lat[0]) * 6.37e6
    east = (truth.lon - truth.lon[0]) * 6.39e6 * np.cos(truth.lat[0])
    centre_north, centre_east = (np.mean((x[late].min(), x[late].max())) for x in (north, east))
    radius = np.hypot(north - centre_north, east - centre_east)[late]
    assert np.abs(radius - 250.0).max() < 12.5


def test_waypoints_are_overflown():
    points = [{"north_m": 1500.0, "east_m": 0.0}, {"north_m": 1500.0, "east_m": 1500.0, "alt_m": 550.0}]
    truth = fly(flight("aerosonde", 30.0, {"type": "waypoints", "radius_m": 60.0, "points": points}, alt=500.0))
    north = (truth.lat - truth.lat[0]) * 6.3674e6
    east = (truth.lon - truth.lon[0]) * 6.3888e6 * np.cos(truth.lat[0])
    for point in points:
        assert np.hypot(north - point["north_m"], east - point["east_m"]).min() < 65.0


def test_every_manoeuvre_flies_in_moderate_turbulence():
    """One of each; the phases follow each other without gaps and the flight is as long as it says."""
    script = (
        {"type": "doublet", "surface": "elevator", "amplitude": 0.2, "period_s": 2.0, "duration_s": 6.0},
        {"type": "doublet", "surface": "rudder", "amplitude": -0.3, "duration_s": 6.0, "name": "rudder kick"},
        {"type": "s_turn", "bank_deg": 35.0, "heading_change_deg": 60.0, "legs": 3},
        {"type": "figure_eight", "bank_deg": -40.0, "circles": 2},
        turn(30.0, 10.0, climb_rate_mps=2.0, speed_mps=32.0),
    )
    wind = {"north_mps": 4.0, "turbulence": "moderate"}
    truth = fly(flight("aerosonde", 30.0, *script, alt=800.0, wind=wind), seed=5)
    assert [p.name for p in truth.phases] == ["doublet", "rudder kick", "s_turn", "figure_eight", "turn"]
    assert all(a.end == b.start for a, b in zip(truth.phases, truth.phases[1:], strict=False))
    assert truth.phases[0].start == 0.0
    assert truth.phases[-1].end == pytest.approx(truth.t[-1], abs=0.2)
    assert abs(truth.extra["wind_down_mps"]).max() > 0.5


def test_duration_cuts_and_pads():
    cut = fly(flight("aerosonde", 30.0, turn(30.0, 20.0), straight(20.0), duration_s=10.0))
    padded = fly(flight("aerosonde", 30.0, turn(30.0, 5.0), duration_s=12.0))
    assert cut.t[-1] == pytest.approx(10.0) and [p.name for p in cut.phases] == ["turn"]
    assert padded.t[-1] == pytest.approx(12.0) and [(p.name, p.end) for p in padded.phases] == [
        ("turn", 5.0),
        ("straight", 12.0),
    ]


def test_same_seed_same_bytes_in_another_process():
    """JSBSim's turbulence draws from the flight's seed alone."""
    code = (
        "import sys, hashlib; sys.path[:0] = sys.argv[1:]\n"
        "from test_flight import gusty\nfrom testbed.flight import fly_flight\n"
        "print(hashlib.sha256(fly_flight(gusty(), 7, False).f_b.tobytes()).hexdigest())"
    )
    there = subprocess.run(
        [sys.executable, "-c", code, *map(str, Path(__file__).parents[:2])], capture_output=True, text=True, check=True
    )
    here = hashlib.sha256(fly(gusty(), 7).f_b.tobytes()).hexdigest()
    assert there.stdout.strip() == here, "and nothing else is printed: JSBSim is silent"
    assert hashlib.sha256(fly(gusty(), 8).f_b.tobytes()).hexdigest() != here


def gusty():
    return flight("aerosonde", 30.0, straight(4.0), turn(30.0, 4.0), wind={"turbulence": "moderate"})


def test_turbulence_has_the_strength_of_the_specification():
    """MIL-F-8785C, low altitude: vertical sigma is 0.1 of the wind at 20 ft (15.2 m/s when moderate) below 300 m.

    200 s at 30 m/s hold about 15 independent gusts of 2 x 150 m, so the sigma is known to some 25 %.
    """
    truth = fly(flight("aerosonde", 30.0, straight(200.0), alt=250.0, wind={"turbulence": "moderate"}, rate_hz=50.0), 3)
    assert truth.extra["wind_down_mps"].std() == pytest.approx(1.52, rel=0.5)


def test_cached_flight_is_the_flown_one(tmp_path, monkeypatch):
    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path))
    config = flight("aerosonde", 30.0, turn(30.0, 5.0))
    flown = fly_flight(config)
    (file,) = (tmp_path / "flights").iterdir()
    with monkeypatch.context() as patch:
        patch.setattr(flying, "_fly", lambda *_: pytest.fail("flew again"))
        again = fly_flight(config, seed=9)
    assert all(
        np.array_equal(getattr(again, key), getattr(flown, key)) for key in ("t", "lat", "lon", "h", "v_n", "q_nb")
    )
    assert np.array_equal(again.f_b, flown.f_b) and np.array_equal(again.w_ib_b, flown.w_ib_b)
    assert again.phases == flown.phases and all(np.array_equal(again.extra[k], v) for k, v in flown.extra.items())
    # degrees in the file round the last bit of an angle, no more: half of 2.2e-16 of at most 1 rad, twice
    assert np.allclose(fly(config).lat, flown.lat, rtol=0.0, atol=1e-15)
    file.write_bytes(b"broken")
    assert cache.load(file) is None


def test_cache_key_sees_seed_only_where_it_matters():
    _, folder = load_aircraft("aerosonde")
    calm, rough = flight("aerosonde", 30.0, straight(5.0)), gusty()
    assert cache.path_of(calm, folder, 1) == cache.path_of(calm, folder, 2)
    assert cache.path_of(rough, folder, 1) != cache.path_of(rough, folder, 2)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (lambda: flight("aerosonde", 30.0, straight(2.0), turn(75.0, 9.0)), "manoeuvre 2 of 2 (turn): needs 75°"),
        (lambda: flight("aerosonde", 90.0, straight(2.0)), "flies 19 to 42 m/s"),
        (lambda: flight("aerosonde", 30.0, {"type": "loiter", "radius_m": 30.0, "turns": 1.0}), "(loiter): needs 72°"),
        (
            lambda: flight("transport", 150.0, {"type": "climb", "climb_rate_mps": 40.0, "duration_s": 9.0}),
            "at most 15",
        ),
        (lambda: flight("aerosonde", 30.0, {"type": "climb", "climb_rate_mps": 2.0, "to_alt_m": 9.0}), "wrong side"),
        (
            lambda: flight(
                "aerosonde", 30.0, {"type": "descent", "climb_rate_mps": 4.0, "duration_s": 60.0}, alt=120.0
            ),
            "manoeuvre 1 of 1 (descent) at t = 3",
        ),
        (
            lambda: flight(
                "aerosonde", 30.0, {"type": "waypoints", "radius_m": 1.0, "points": [{"north_m": 9.0, "east_m": 9.0}]}
            ),
            "it came within",
        ),
        (lambda: flight("aerosonde", 30.0, straight(9.0), payload_kg=60.0), "finds no steady level flight"),
        (lambda: flight("agile", 130.0, turn(81.0, 60.0), alt=2000.0), "(turn)"),
    ],
)
def test_impossible_flight_names_manoeuvre_and_time(config, words):
    with pytest.raises(FlightError) as caught:
        fly(config())
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("manoeuvre", "words"),
    [
        ({"type": "trun", "bank_deg": 30.0}, "did you mean 'turn'?"),
        (
            {"type": "turn", "bank_deg": 30.0},
            "exactly one of duration_s, heading_change_deg, to_heading_deg; none is given",
        ),
        (
            {"type": "turn", "bank_deg": 30.0, "duration_s": 5.0, "to_heading_deg": 3.0},
            "not duration_s and to_heading_deg",
        ),
        ({"type": "turn", "bank_deg": 0.2, "duration_s": 5.0}, "at least 1 degree"),
        ({"type": "turn", "bank": 30.0, "duration_s": 5.0}, "did you mean 'bank_deg'?"),
        ({"type": "climb", "to_alt_m": 900.0}, "exactly one of climb_rate_mps and path_angle_deg"),
        ({"type": "straight", "duration_s": -1.0}, "greater than 0"),
        ({"type": "straight", "duration_s": "5"}, "valid number"),
        ({"type": "straight", "duration_s": math.nan}, "finite"),
        ({"type": "waypoints", "points": [{"north_m": 1.0}]}, "north_m and east_m or lat_deg and lon_deg"),
    ],
)
def test_wrong_script_is_refused_with_the_key(manoeuvre, words):
    with pytest.raises(InputError) as caught:
        flight("aerosonde", 30.0, manoeuvre)
    assert words in str(caught.value) and "manoeuvres.0" in str(caught.value)


def test_unknown_aircraft_and_payload():
    with pytest.raises(InputError, match="did you mean 'aerosonde'"):
        fly(flight("aerosond", 30.0, straight(5.0)))
    with pytest.raises(InputError, match="takes no payload"):
        fly(flight("transport", 170.0, straight(5.0), payload_kg=5.0))
