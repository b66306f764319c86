"""The multirotor hovers, reaches its waypoints, turns and lands, also in gusts; what it cannot do is refused by name."""

import functools
import math
import shutil

import numpy as np
import pytest
from flights import straight, turn

from testbed.base.errors import FlightError, InputError
from testbed.base.resources import aircraft_root
from testbed.base.schema import validate
from testbed.flight import FlightConfig, fly_flight, models
from testbed.physics.rotations import quats_to_eulers
from testbed.scenario import load_scenario

TAKE_OFF = {"type": "take_off", "to_height_m": 10.0}
GUSTS = {"north_mps": 5.0, "turbulence": "light", "seed": 1}


def rotor(*manoeuvres, alt=0.0, parked=True, aircraft="multirotor", **keys):
    initial = {"lat_deg": 45.0, "lon_deg": 10.0, "alt_m": alt, "heading_deg": 30.0} | (
        {"parked": True} if parked else {}
    )
    data = {"aircraft": aircraft, "initial": initial, "manoeuvres": list(manoeuvres)} | keys
    return validate(FlightConfig, data, "flight")


def hover(seconds, **keys):
    return {"type": "hover", "duration_s": seconds} | keys


def points(*places, **keys):
    return {"type": "waypoints", "points": [{"north_m": n, "east_m": e, "alt_m": h} for n, e, h in places]} | keys


def track(truth):
    """North, east and height since the start, m; radii of curvature of WGS-84 at 45 degrees."""
    north, east = (truth.lat - truth.lat[0]) * 6.36738e6, (truth.lon - truth.lon[0]) * 6.38884e6 * np.cos(truth.lat[0])
    return north, east, truth.h - truth.h[0]


def during(truth, name, last_s=None):
    phase = next(p for p in truth.phases if p.name == name)
    return (truth.t >= (phase.start if last_s is None else phase.end - last_s)) & (truth.t <= phase.end)


BOX = ((20.0, 0.0, 12.0), (20.0, 20.0, 15.0), (0.0, 20.0, 15.0))


@functools.cache
def in_gusts():
    park = {"type": "park", "duration_s": 5.0}
    script = (park, TAKE_OFF, hover(20.0, heading_deg=90.0), points(*BOX), {"type": "land"}, park | {"name": "landed"})
    return fly_flight(rotor(*script, wind=GUSTS), use_cache=False)


def test_a_hover_holds_its_place_in_gusts():
    """Gusts of 1.4 m/s about 5 m/s of wind on 0.016 m² and 1.4 kg are 0.1 m/s² (1 sigma); against a stiffness of 0.8 x 1.6
    1/s² that is 8 cm: three sigma are 0.25 m. Carried by its thrust alone it feels gravity along b's z axis."""
    truth = in_gusts()
    settled = during(truth, "hover", last_s=15.0)
    north, east, height = track(truth)
    assert np.hypot(north, east)[settled].max() < 0.25 and np.abs(height[settled] - 10.0).max() < 0.25
    assert truth.f_b[settled].mean(axis=0)[2] == pytest.approx(-9.806, abs=0.01)
    assert np.abs(truth.f_b[settled].mean(axis=0)[:2]).max() < 0.3, "what is left is drag"
    yaw = np.degrees(quats_to_eulers(truth.q_nb)[settled, 2])
    assert np.abs(yaw - 90.0).max() < 1.0


def test_waypoints_are_reached_along_the_legs():
    """Each within the 2 m that nothing else asks for; between them off the line by no more than the corner was cut."""
    truth = in_gusts()
    north, east, height = track(truth)
    flown = during(truth, "waypoints")
    for n, e, h in BOX:
        away = np.hypot(north - n, east - e)[flown]
        near = away.argmin()
        assert away[near] < 2.05 and abs(height[flown][near] - h) < 2.05
    middle = flown & (east > 4.0) & (east < 16.0) & (north > 10.0)
    assert np.abs(north[middle] - 20.0).max() < 2.0
    assert np.linalg.norm(truth.v_n[flown], axis=1).max() < 6.0, "5 m/s, and some overshoot"


def test_it_lands_and_stands():
    """On legs of 100 N/(m/s) and 1.4 kg; then it is a body fixed to the Earth, as long as the flight lasts."""
    truth = in_gusts()
    parked, landed = during(truth, "park"), during(truth, "landed", last_s=4.0)
    assert truth.h[-1] == pytest.approx(truth.h[0], abs=2e-3)
    for stands in (parked, landed):
        assert np.abs(truth.v_n[stands]).max() < 1e-9
        assert np.linalg.norm(truth.f_b[stands], axis=1) == pytest.approx(9.8062, abs=2e-4), "gravity at 45 degrees"
        assert truth.extra["throttle"][stands][:-10].max() == 0.0


def test_a_circle_is_banked_as_its_speed_wants():
    """In still air the thrust's tilt is atan(v²/(g R)), but for drag along the path: 6 m/s on 15 m, 13.7 degrees."""
    truth = fly_flight(
        rotor(hover(1.0), {"type": "loiter", "radius_m": 15.0, "turns": 1.6, "speed_mps": 6.0}, parked=False, alt=50.0),
        use_cache=False,
    )
    steady = during(truth, "loiter", last_s=8.0)
    north, east, _ = track(truth)
    centre = 15.0 * math.cos(math.radians(120.0)), 15.0 * math.sin(math.radians(120.0))
    assert np.abs(np.hypot(north - centre[0], east - centre[1])[steady] - 15.0).max() < 0.75
    roll = np.degrees(quats_to_eulers(truth.q_nb)[steady, 0])
    assert roll.mean() == pytest.approx(math.degrees(math.atan(36.0 / 9.806 / 15.0)), rel=0.05)


def test_gusts_have_the_strength_of_the_specification():
    """MIL-F-8785C, light: 0.1 x 25 ft/s down, at 10 m across and along that over (0.177 + 0.000823 x 33)^0.4. In 200 s and
    more than 20 correlation times (L/V = 12 s along, 2 s down) the rms is uncertain by 16 %: twice that is allowed."""
    truth = fly_flight(rotor(TAKE_OFF, hover(250.0), wind=GUSTS | {"north_mps": 6.0}, rate_hz=50.0), use_cache=False)
    settled = during(truth, "hover")
    down = 0.1 * 25.0 * 0.3048
    across = down / (0.177 + 0.000823 * 33.0) ** 0.4
    for axis, mean, wanted in (("north", 6.0, across), ("east", 0.0, across), ("down", 0.0, down)):
        wind = truth.extra[f"wind_{axis}_mps"][settled]
        assert np.sqrt(np.mean((wind - mean) ** 2)) == pytest.approx(wanted, rel=0.32)


def test_the_control_rate_is_the_aircrafts(tmp_path):
    """A rate gain of 0.10 leaves 31 degrees of margin at 31 rad/s. Half a tick and the tick in which a command is worked out
    take 53 degrees of it at 50 Hz, where the loop chatters, and 13 at 200 Hz, where it is quiet after a leg."""
    shaken = {}
    folder = tmp_path / "firm"
    shutil.copytree(aircraft_root() / "multirotor", folder)
    file = folder / "aircraft.toml"
    firm = file.read_text().replace("rate = 0.04", "rate = 0.10")
    script = (points((8.0, 0.0, 50.0)), hover(12.0))
    for rate_hz in (50.0, 200.0):
        file.write_text(firm.replace("rate_hz = 200.0", f"rate_hz = {rate_hz}"))
        truth = fly_flight(rotor(*script, parked=False, alt=50.0, aircraft=f"{folder}/"), use_cache=False)
        shaken[rate_hz] = np.degrees(truth.w_ib_b[during(truth, "hover", last_s=4.0)]).std(axis=0).max()
    assert shaken[50.0] > 3.0 and shaken[200.0] < 0.3
    file.write_text(firm.replace("rate_hz = 200.0", "rate_hz = 60.0"))
    with pytest.raises(InputError, match=r"autopilot.rate_hz.*one of 50, 100, 200, 400 Hz"):
        fly_flight(rotor(hover(5.0), parked=False, alt=50.0, aircraft=f"{folder}/"), use_cache=False)


AIR = {"parked": False, "alt": 50.0}
REFUSED = {
    "turn": (
        rotor(turn(30.0, 5.0), **AIR),
        r"manoeuvre 1 of 1 \(turn\): 'multirotor' is a multirotor.*it can do climb",
    ),
    "straight": (rotor(straight(5.0), **AIR), r"\(straight\).*cannot do this"),
    "speed": (rotor(hover(5.0), points(*BOX, speed_mps=20.0), **AIR), r"manoeuvre 2 .*20 m/s.*at most 12 m/s"),
    "circle": (rotor({"type": "loiter", "radius_m": 5.0, "turns": 1.0}, **AIR), r"needs 5.0 m/s².*takes 3 m/s²"),
    "descent": (rotor({"type": "descent", "climb_rate_mps": 3.0, "duration_s": 2.0}, **AIR), "3 m/s down.*at most 1.5"),
    "path": (rotor({"type": "climb", "path_angle_deg": 9.0, "duration_s": 2.0}, **AIR), "no path angle"),
    "ground": (rotor(hover(1.0), {"type": "land"}, **AIR), "manoeuvre 2 .*began parked"),
    "in the air": (rotor(TAKE_OFF, **AIR), "begins on the ground, but here 'multirotor' is in the air"),
    "on the ground": (rotor(hover(1.0)), "stands on the ground; take_off comes first"),
    "calm gusts": (rotor(hover(1.0), **AIR, wind={"turbulence": "light"}), "a wind of at least 1 m/s"),
    "long": (rotor(hover(1.0), **AIR, duration_s=0.01), "too short"),
}


@pytest.mark.parametrize("what", list(REFUSED))
def test_what_it_cannot_do_is_refused_before_it_flies(what):
    config, message = REFUSED[what]
    with pytest.raises(FlightError, match=message):
        fly_flight(config, use_cache=False)


def test_aeroplanes_do_not_hover():
    keys = {"aircraft": "aerosonde", "initial": {"speed_mps": 30.0}}
    for script, message in (
        ([hover(5.0)], r"manoeuvre 1 of 1 \(hover\): 'aerosonde' is an aeroplane"),
        ([points((900.0, 0.0, 1000.0)) | {"points": [{"north_m": 9.0, "east_m": 0.0, "hold_s": 3.0}]}], "hold_s"),
    ):
        with pytest.raises(FlightError, match=message):
            fly_flight(validate(FlightConfig, keys | {"manoeuvres": script}, "flight"), use_cache=False)


def test_a_pitot_tube_reads_nothing_there(monkeypatch, tmp_path):
    from testbed import fly, sense

    monkeypatch.chdir(tmp_path)
    script = [hover(4.0)]
    overrides = {"flight.manoeuvres": script, "flight.initial.parked": False, "sensors.airspeed": {"model": "pitot"}}
    scenario = load_scenario("multirotor", overrides=overrides | {"initial": {}, "sensors.gnss.outages": []})
    with pytest.raises(InputError, match=r"\[sensors.airspeed\] 'multirotor' has no air data.*multirotors"):
        sense(scenario, fly(scenario), seed=0)


def test_what_is_left_out_of_a_model_must_be_there():
    with (
        pytest.raises(InputError, match=r"no system 'SensorOdd.xml', which 'model.leave_out' names"),
        models.clean_copy("F450", leave_out=["SensorOdd.xml"]),
    ):
        pass


def test_loading_it_is_silent(capfd):
    """JSBSim's own sensors of this model write to the terminal whatever it is told."""
    fly_flight(rotor(hover(0.5), **AIR), use_cache=False)
    assert capfd.readouterr() == ("", "")
