"""A .plan of QGroundControl becomes the flight that it describes, or is refused with the item that cannot be flown."""

import copy
import json
import math
import os
import random

import numpy as np
import pytest
from plans import SAMPLE_HOME, SAMPLE_POINTS, item, plan, sample, waypoint, written

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.flight import FlightConfig, fly_flight
from testbed.scenario import list_scenarios, load_scenario

HOME = [45.0, 10.0, 400.0]
METRES = 111_131.8, 78_847.0
"""Metres per degree at 45 degrees, from the radii of curvature of WGS-84 (6,367,382 and 6,388,838 m)."""


def place(north, east, height):
    return [HOME[0] + north / METRES[0], HOME[1] + east / METRES[1], height]


def config(folder, content, aircraft="aerosonde", **keys):
    return validate(FlightConfig, {"aircraft": aircraft, "plan": written(folder, content)} | keys, "flight")


def track(truth):
    """North and east of home, m."""
    return (np.degrees(truth.lat) - HOME[0]) * METRES[0], (np.degrees(truth.lon) - HOME[1]) * METRES[1]


def square(*last):
    points = [place(0, 900, 200), place(900, 900, 250), place(900, 1800, 250), place(0, 1800, 250)]
    take_off = item(22, [15, 0, 0, None, *place(0, 0, 200)])
    return plan([take_off, *(waypoint(point, 150.0) for point in points), *last], HOME, vehicleType=1)


def test_an_aeroplane_keeps_to_the_legs_and_circles_about_the_centre(tmp_path):
    """Between corners it is on the line within 10 m, a wing's length or two; a fillet of 90 degrees passes the corner at
    R (sqrt 2 - 1), R = v²/(g tan 36°) = 126 m: 52 m; circles keep their radius within 5 %, as every loiter does."""
    turns = item(18, [2, 0, -200.0, 1, *place(-500, 900, 250)])
    truth = fly_flight(config(tmp_path, square(turns)), use_cache=False)
    assert truth.h[0] == pytest.approx(600.0, abs=0.5) and np.degrees(truth.lat[0]) == pytest.approx(HOME[0])
    north, east = track(truth)
    legs, circle = truth.phases
    flown = truth.t < legs.end
    corners = [(0, 0), (0, 900), (900, 900), (900, 1800), (0, 1800)]
    for a, b in zip(corners, corners[1:], strict=False):
        along = ((north - a[0]) * (b[0] - a[0]) + (east - a[1]) * (b[1] - a[1])) / 900.0
        across = ((east - a[1]) * (b[0] - a[0]) - (north - a[0]) * (b[1] - a[1])) / 900.0
        middle = flown & (along > 350.0) & (along < 700.0) & (np.abs(across) < 150.0)
        assert middle.sum() > 500 and np.abs(across[middle]).max() < 10.0
    for corner in corners[1:4]:
        assert 40.0 < np.hypot(north - corner[0], east - corner[1])[flown].min() < 60.0
    last = np.hypot(north, east - 1800.0)[flown]
    assert last.min() < 5.0, "nothing is cut at the last point"
    assert truth.h[flown][last.argmin()] == pytest.approx(650.0, abs=1.0)
    # the last turn of the circle, to the left
    arrived = truth.t > circle.end - 2.0 * math.pi * 200.0 / 30.0
    radius = np.hypot(north + 500.0, east - 900.0)[arrived]
    assert np.abs(radius - 200.0).max() < 10.0
    assert np.sum(np.diff(np.unwrap(np.arctan2(east[arrived] - 900.0, north[arrived] + 500.0)))) < -5.5


def test_what_a_plan_becomes(tmp_path):
    """Speeds, radii, heights and numbers of a mission with every command that an aeroplane flies."""
    items = square(
        item(178, [0, 25, -1, 0, 0, 0, 0], frame=2),
        item(19, [45, 1, 180.0, 0, *place(-500, 900, 900)], frame=0),
        waypoint(place(-2000, 0, 150)),
        item(17, [0, 0, 0, None, *place(-2000, -900, 150)]),
    )
    flown = config(tmp_path, items, duration_s=300.0).model_dump(exclude_none=True)
    assert flown["initial"]["speed_mps"] == 30.0 and flown["initial"]["heading_deg"] == pytest.approx(90.0, abs=0.1)
    points, timed, further, last = flown["manoeuvres"]
    assert [p["alt_m"] for p in points["points"]] == [600.0, 650.0, 650.0, 650.0]
    assert {p["radius_m"] for p in points["points"]} == {150.0} and points["follow"] == "legs"
    assert (timed["duration_s"], timed["speed_mps"], timed["radius_m"]) == (45.0, 25.0, 180.0)
    assert timed["centre"]["alt_m"] == 900.0, "frame 0 counts from mean sea level"
    assert timed["leave_towards"]["lat_deg"] == pytest.approx(HOME[0] - 2000 / METRES[0])
    assert further["name"] == "8 waypoint" and last["name"] == "9 loiter"
    higher = config(tmp_path, items, duration_s=300.0, plan_undulation_m=48.0).model_dump(exclude_none=True)
    assert higher["initial"]["alt_m"] == flown["initial"]["alt_m"] + 48.0
    assert "plan" not in flown, "the scenario is whole without the file"


def test_a_sample_that_others_made_is_flown_by_the_multirotor(tmp_path):
    """MAVSDK's sample without its camera and with a landing in place of the return: each point within 2 m, on the ground
    at home again within 0.3 m (what a landing asks for)."""
    land = item(21, [0, 0, 0, None, *SAMPLE_HOME[:2], 0])
    flown = config(tmp_path, sample([land]), "multirotor", plan_skip=[3], rate_hz=50.0)
    truth = fly_flight(flown, use_cache=False)
    assert [p.name for p in truth.phases] == ["1 take-off", "2-5 waypoints", "6 way", "6 land"]
    north = 111_131.8 * 1.0003  # degrees of latitude lengthen towards the poles: 111,170 m at 47.4 degrees
    east = 111_320.0 * math.cos(math.radians(SAMPLE_HOME[0])) * 1.0018
    for lat, lon, height in [*SAMPLE_POINTS, [*SAMPLE_HOME[:2], 0]]:
        away = np.hypot((np.degrees(truth.lat) - lat) * north, (np.degrees(truth.lon) - lon) * east)
        near = away.argmin()
        assert away[near] < 2.05
        if height:
            assert truth.h[away < 2.0] - SAMPLE_HOME[2] == pytest.approx(height, abs=2.2)
    assert away[-1] < 0.3
    assert truth.h[-1] == pytest.approx(truth.h[0], abs=0.005) and np.abs(truth.v_n[-1]).max() < 1e-3


def test_an_aeroplane_with_wheels_takes_off_and_lands(tmp_path):
    """From home towards the take-off's point; down in the direction from the last point, in the middle of a runway of 45 m,
    within the 600 m beyond its point that a flare of 5 s and 40 s of rolling and braking from 33 m/s can take."""
    points = [place(-600, 2500, 110), place(-1800, 2500, 140), place(-1800, -2500, 200), place(-150, -2500, 180)]
    items = [item(22, [10, 0, 0, None, *place(0, 1000, 100)]), *(waypoint(point) for point in points)]
    content = plan([*items, item(21, [0, 0, 0, None, *place(0, 400, 0)])], HOME, vehicleType=1, cruiseSpeed=45)
    truth = fly_flight(config(tmp_path, content, "trainer", rate_hz=50.0), use_cache=False)
    assert [p.name for p in truth.phases] == ["1 take-off", "2-5 waypoints", "6 approach", "6 land"]
    north, east = track(truth)
    climbing = truth.t < truth.phases[0].end
    assert truth.h[0] == pytest.approx(truth.h[-1], abs=0.05) and np.abs(truth.v_n[-1]).max() < 0.1
    assert np.abs(north[climbing]).max() < 22.5 and truth.h[climbing][-1] > truth.h[0] + 75.0, (
        "the climb fades from there"
    )
    first = np.hypot(north + 600.0, east - 2500.0).argmin()
    assert truth.h[first] == pytest.approx(HOME[2] + 110.0, abs=15.0), "five seconds of its climb"
    course = math.atan2(2900.0, 150.0)
    forward = north[-1] * math.cos(course) + (east[-1] - 400.0) * math.sin(course)
    right = (east[-1] - 400.0) * math.cos(course) - north[-1] * math.sin(course)
    assert abs(right) < 22.5 and 0.0 < forward < 600.0
    with pytest.raises(InputError, match=r"item 2.*a landing needs a take-off before it"):
        config(tmp_path, plan([waypoint(points[0]), item(21, [0, 0, 0, None, *HOME])], HOME, cruiseSpeed=45), "trainer")


REFUSED = {
    "return": (item(20, [0] * 7, frame=2), r"item 6 \(return to launch, 20\).*not flown.*plan_skip = \[6\]"),
    "unknown": (item(4242, [0] * 7, frame=2), r"item 6 \(command, 4242\)"),
    "survey": ({"type": "ComplexItem", "complexItemType": "survey"}, "item 6: 'survey' is not flown"),
    "pattern": ({"type": "ComplexItem", "complexItemType": "fwLandingPattern"}, "item 6: 'fwLandingPattern'"),
    "terrain": (item(16, [0, 0, 0, None, *place(0, 0, 50)], frame=10), r"item 6 \(waypoint, 16\): .*terrain"),
    "frame": (item(16, [0, 0, 0, None, *place(0, 0, 50)], frame=4), "item 6.*frame 4"),
    "hold": (waypoint(place(0, 0, 200), hold=5.0), "item 6.*cannot hold.*19"),
    "beside": (item(16, [0, 0, 30, None, *place(0, 0, 50)]), r"item 6.*parameter 3"),
    "yaw": (item(16, [0, 0, 0, 90, *place(0, 0, 50)]), r"item 6.*heading"),
    "no place": (item(16, [0, 0, 0, None, None, None, 50]), "item 6.*latitude, longitude and height"),
    "high": (waypoint([*HOME[:2], 1e7]), "item 6.*a height of 1.00004e.07 m; 0 to 30000 m"),
    "nowhere": (waypoint([145.0, 10.0, 100.0]), "item 6.*no place that is flown"),
    "land": (item(21, [0, 0, 0, None, *HOME]), r"item 6 \(land, 21\).*no wheels.*plan_skip = \[6\]"),
    "for ever": (item(17, [0, 0, 100, None, *place(0, 0, 200)]), "item 6.*never ends.*duration_s"),
    "ground speed": (item(178, [1, 30, -1, 0, 0, 0, 0], frame=2), "item 6.*through the air"),
    "throttle": (item(178, [0, 30, 50, 0, 0, 0, 0], frame=2), "item 6.*throttle"),
    "speed": (item(178, [0, 90, -1, 0, 0, 0, 0], frame=2), "item 6.*parameter 2: 90 m/s.*19 to 42"),
    "circle": (item(18, [1, 0, 10, 0, *place(0, 0, 200)]), "item 6.*a circle of 10 m"),
    "turns": (item(18, [0, 0, 100, 0, *place(0, 0, 200)]), "item 6.*0 turns"),
    "again": (item(22, [0, 0, 0, None, *place(0, 0, 200)]), "item 6.*one take-off"),
    "six": (item(16, [0] * 6), "item 6.*list of 7"),
    "text": (item(16, [0, 0, 0, None, "45", 10, 50]), "item 6.*parameter 5 should be a number, got '45'"),
    "true": (item(16, [0, 0, 0, None, True, 10, 50]), "item 6.*parameter 5 should be a number"),
    "command": (item(16.0, [0] * 7), "item 6: 'command' should be an integer"),
    "list": ([], r"item 6: should be an object, got \[\]"),
}


@pytest.mark.parametrize("what", list(REFUSED))
def test_what_cannot_be_mapped_is_refused_with_its_number(tmp_path, what):
    wrong, message = REFUSED[what]
    with pytest.raises(InputError, match=message) as caught:
        config(tmp_path, square(copy.deepcopy(wrong)))
    assert str(caught.value).startswith(str(tmp_path)) and caught.value.exit_code == 2


def test_a_plan_stands_alone_and_files_are_named(tmp_path):
    with pytest.raises(InputError, match="plan and manoeuvres exclude each other"):
        config(tmp_path, square(), manoeuvres=[{"type": "straight", "duration_s": 1.0}])
    for text, message in (
        ("{", "not JSON: line 1"),
        ("[]", "not a plan"),
        ('{"a": NaN}', "NaN"),
        ("[" * 99_999, "deep"),
    ):
        (tmp_path / "x.plan").write_text(text)
        with pytest.raises(InputError, match=message):
            validate(FlightConfig, {"aircraft": "aerosonde", "plan": str(tmp_path / "x.plan")}, "flight")
    with pytest.raises(InputError, match=r"absent.plan: cannot be read"):
        validate(FlightConfig, {"aircraft": "aerosonde", "plan": "absent.plan"}, "flight")
    with pytest.raises(InputError, match="plan_skip names item 9, but the plan has items 1 to 5"):
        config(tmp_path, square(), plan_skip=[9])
    land = item(21, [0, 0, 0, None, *SAMPLE_HOME])
    with pytest.raises(InputError, match=r"item 7.*never reached: item 6 lands"):
        config(tmp_path, sample([land, waypoint(SAMPLE_POINTS[0])]), "multirotor", plan_skip=[3, 4])


def test_no_damage_gets_through_as_another_error(tmp_path):
    """Every node of a plan in turn is replaced by what a broken writer may leave: an InputError, or a flight."""
    whole = square(item(18, [1, 1, -200.0, 1, *place(-500, 900, 250)]), item(178, [0, 25, -1, 0, 0, 0, 0], frame=2))
    rubbish = [None, "x", True, -1e9, 1e300, 10**400, [], {}, [[]], math.nan]
    found = []

    def walk(node, path):
        found.append(path)
        if isinstance(node, dict | list):
            for key in node if isinstance(node, dict) else range(len(node)):
                walk(node[key], (*path, key))

    walk(whole, ())
    refused = 0
    for path in found[1:]:
        broken = copy.deepcopy(whole)
        node = broken
        for key in path[:-1]:
            node = node[key]
        node[path[-1]] = random.Random(str(path)).choice(rubbish)
        try:
            config(tmp_path, broken)
        except InputError:
            refused += 1
    assert refused > 50


def test_the_shipped_mission(monkeypatch, tmp_path):
    """At least eight items; a scenario, its own text without the plan, and a plan from the command line agree."""
    monkeypatch.chdir(tmp_path)
    scenario = load_scenario("field-mission")
    raw = json.loads((list_scenarios()["field-mission"].parent / "field-mission.plan").read_text())
    assert len(raw["mission"]["items"]) >= 8
    (tmp_path / "again.toml").write_text(scenario.to_toml())
    assert load_scenario(tmp_path / "again.toml").digest() == scenario.digest()
    own = written(tmp_path, square())
    flown = load_scenario("quickstart", overrides={"flight.plan": os.path.abspath(own)}).flight
    assert flown.initial.lat_deg == HOME[0] and flown.manoeuvres[0].type == "waypoints"
