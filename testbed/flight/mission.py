"""A mission of QGroundControl as manoeuvres: `mission_keys` gives the keys of ``[flight]`` that a ``.plan`` stands for.

| command | becomes |
| --- | --- |
| 22 take-off | ``take_off`` from the ground at home's height; an aeroplane without wheels begins in the air at its point |
| 16 waypoint | a point of ``waypoints``, along the legs; hold and heading for multirotors; acceptance radius |
| 17, 18, 19 loiter | ``loiter`` about the centre; of a multirotor 17 and 19 ``hover``, as MAVLink says |
| 21 land | a multirotor: to its point, and ``land``; an aeroplane: ``approach`` from where it comes, and ``land`` |
| 178 change speed | ``speed_mps`` of the next point or manoeuvre |

What cannot be mapped is refused with the item's number. Degrees, metres, m/s.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any, NamedTuple

from testbed.base.errors import InputError, tell_user
from testbed.flight import plan_file as pf
from testbed.flight.aircraft import Aircraft, AnyAircraft, Multirotor
from testbed.flight.plan_file import Item, Plan
from testbed.physics.earth import G0
from testbed.physics.earth import A as EARTH_RADIUS

FOR_EVER_S = 200_000.0
SAME_PLACE_M = 1.0
"""Nearer to each other two points of a plan are one."""
BANK_SHARE = 0.6
"""Of the bank limit that turns between legs use."""
LOITER_SHARE = 0.5
"""Of the bank limit, for a loiter whose radius the plan leaves open."""


class Choices(NamedTuple):
    """What a scenario says beside the plan."""

    skip: frozenset[int] = frozenset()
    """Items that are left out."""
    undulation_m: float = 0.0
    """Height of mean sea level above the ellipsoid."""
    duration_s: float | None = None
    speed_mps: float | None = None
    """In place of the plan's first speed."""
    heading_given: bool = False
    """The scenario says the heading of the start."""


def mission_keys(path: Path, aircraft: AnyAircraft, choices: Choices) -> dict[str, Any]:
    """``initial`` and ``manoeuvres`` of a plan for an aircraft. Raises InputError."""
    plan = pf.read_plan(path, choices.skip)
    for what in plan.unflown:
        _tell_once(f"{plan.file}: its {what}s are not looked at")
    return _Mapping(plan, aircraft, choices).keys()


@functools.cache
def _tell_once(text: str) -> None:
    """A scenario is read more than once in a sweep."""
    tell_user(text)


class _Mapping:
    """Goes through the items and collects the manoeuvres."""

    def __init__(self, plan: Plan, aircraft: AnyAircraft, choices: Choices) -> None:
        self.plan, self.choices, self.undulation = plan, choices, choices.undulation_m
        self.rotor = isinstance(aircraft, Multirotor)
        self.aircraft = aircraft
        self.speed = choices.speed_mps or self._first_speed()
        self.waiting_speed: float | None = None
        self.here = plan.home[:2]
        self.wheels = isinstance(aircraft, Aircraft) and aircraft.ground is not None
        self.took_off = False
        self.manoeuvres: list[dict[str, Any]] = []
        self.points: list[dict[str, Any]] = []
        self.first = 0
        self.over = ""
        """Why nothing can follow any more."""

    def _first_speed(self) -> float:
        key, planned = ("hoverSpeed", self.plan.hover_mps) if self.rotor else ("cruiseSpeed", self.plan.cruise_mps)
        if planned is None:
            return self.aircraft.autopilot.speed_nominal_mps
        self._check_speed(planned, f"{self.plan.file}: 'mission.{key}'")
        return planned

    def _check_speed(self, speed: float, what: str) -> None:
        limits = self.aircraft.limits
        low = 0.1 if isinstance(self.aircraft, Multirotor) else self.aircraft.limits.speed_min_mps
        if not low <= speed <= limits.speed_max_mps:
            raise InputError(f"{what}: {speed:g} m/s, but the aircraft flies {low:g} to {limits.speed_max_mps:g} m/s")

    def keys(self) -> dict[str, Any]:
        """The keys of ``[flight]``."""
        items = list(self.plan.items)
        initial = self._start(items)
        for item in items:
            if self.over:
                item.fail(f"it is never reached: {self.over}")
            mapped = {
                pf.TAKE_OFF: self._second_take_off,
                pf.WAYPOINT: self._waypoint,
                pf.LOITER: self._loiter,
                pf.LOITER_TURNS: self._loiter,
                pf.LOITER_TIME: self._loiter,
                pf.LAND: self._land,
                pf.SPEED: self._change_speed,
            }
            mapped.get(item.command, pf.refuse_command)(item)
        self._close()
        if not self.manoeuvres:
            raise InputError(f"{self.plan.file}: the plan has nothing to fly to after its start")
        return {"initial": initial, "manoeuvres": self.manoeuvres}

    def _place(self, item: Item) -> tuple[float, float, float]:
        return pf.place_of(item, self.plan, self.undulation)

    def _start(self, items: list[Item]) -> dict[str, Any]:
        """Where the flight begins; takes the take-off out of the items."""
        home_lat, home_lon, home = self.plan.home
        ground = home + self.undulation
        places = [item for item in items if item.frame not in pf.NO_PLACE]
        begins = [item for item in places if item.command == pf.TAKE_OFF][:1]
        if begins and begins[0] is not places[0]:
            begins[0].fail("a take-off comes before all other places")
        if self.rotor:
            if not begins:
                raise InputError(f"{self.plan.file}: a multirotor's plan begins with a take-off (command 22)")
            return self._rotor_start(items, begins[0], ground)
        if not places:
            raise InputError(f"{self.plan.file}: no item has a place to fly to")
        if begins and self.wheels:
            return self._runway_start(items, begins[0], ground)
        if begins:
            lat, lon, alt = self._place(self._with_place(begins[0]))
            items.remove(begins[0])
            places = places[1:]
            _tell_once(f"{begins[0].place}: the flight begins in the air at this point, flying level")
        else:
            # towards its first point, from above home
            (lat, lon), alt = (home_lat, home_lon), self._place(places[0])[2]
        initial = {"lat_deg": lat, "lon_deg": lon, "alt_m": alt, "speed_mps": self.speed}
        if places and places[0].command in (pf.WAYPOINT, pf.LOITER, pf.LOITER_TURNS, pf.LOITER_TIME):
            to = self._place(places[0])
            north, east = _metres((lat, lon), to)
            if math.hypot(north, east) > SAME_PLACE_M:
                initial["heading_deg"] = math.degrees(math.atan2(east, north))
        self.here = lat, lon
        return initial

    def _runway_start(self, items: list[Item], take_off: Item, ground: float) -> dict[str, Any]:
        """Parked at home, to take off in the direction of the take-off's point."""
        lat, lon, alt = self._place(self._with_place(take_off))
        home = self.plan.home[:2]
        north, east = _metres(home, (lat, lon))
        initial: dict[str, Any] = {"lat_deg": home[0], "lon_deg": home[1], "alt_m": ground, "parked": True}
        if math.hypot(north, east) > SAME_PLACE_M:
            initial["heading_deg"] = math.degrees(math.atan2(east, north))
        elif not self.choices.heading_given:
            take_off.fail("its point is home, which gives no direction; say initial.heading_deg, that of the runway")
        height = alt - ground
        if not 30.0 <= height <= 1000.0:
            take_off.fail(f"it climbs to {height:g} m above home; 30 to 1000 m are flown")
        items.remove(take_off)
        self.manoeuvres.append({"type": "take_off", "to_height_m": height, "name": f"{take_off.number} take-off"})
        self.manoeuvres[-1]["speed_mps"] = self.speed
        self.here, self.took_off = home, True
        return initial

    def _rotor_start(self, items: list[Item], take_off: Item, ground: float) -> dict[str, Any]:
        lat, lon, alt = self._place(self._with_place(take_off))
        height = alt - ground
        if not 1.0 <= height <= 1000.0:
            take_off.fail(f"it climbs to {height:g} m above home; 1 to 1000 m are flown")
        items.remove(take_off)
        initial = {"lat_deg": lat, "lon_deg": lon, "alt_m": ground, "parked": True}
        if take_off.parameters[3] is not None:
            initial["heading_deg"] = take_off.value(4) % 360.0
        self.manoeuvres.append({"type": "take_off", "to_height_m": height, "name": f"{take_off.number} take-off"})
        self.manoeuvres[-1]["speed_mps"] = self.speed
        self.here = lat, lon
        return initial

    def _with_place(self, item: Item) -> Item:
        """A take-off or a landing without a place, or with MAVLink's 0, 0 for none: where the vehicle is, so home."""
        lat, lon, alt = item.parameters[4:]
        if (lat is None and lon is None) or (lat == 0.0 and lon == 0.0):
            return item._replace(parameters=(*item.parameters[:4], *self.plan.home[:2], alt))
        return item

    def _second_take_off(self, item: Item) -> None:
        item.fail("the plan has begun already; one take-off is flown")

    def _waypoint(self, item: Item) -> None:
        lat, lon, alt = self._place(item)
        hold, radius, beside = item.value(1), item.value(2), item.value(3)
        if hold < 0.0 or radius < 0.0:
            item.fail("hold and acceptance radius (parameters 1, 2) cannot be negative")
        if beside != 0.0:
            item.fail("passing beside a waypoint (parameter 3) is not flown; set it to 0")
        point: dict[str, Any] = {"lat_deg": lat, "lon_deg": lon, "alt_m": alt}
        if self.rotor:
            if hold > 0.0:
                point["hold_s"] = self._seconds(item, hold)
            if item.parameters[3] is not None:
                point["heading_deg"] = item.value(4) % 360.0
        elif hold > 0.0:
            item.fail("an aeroplane cannot hold at a point (parameter 1); a loiter time (19) circles there")
        elif item.value(4) != 0.0:
            item.fail("an aeroplane's heading at a point (parameter 4) follows from its way; set it to 0 or null")
        if radius > 100_000.0:
            item.fail(f"an acceptance radius (parameter 2) of {radius:g} m; at most 100000 m are flown")
        self._take_speed(point)
        point["radius_m"] = radius or self._radius()
        if not self.points:
            self.first = item.number
        self.points.append(point)
        self.last = item.number
        self.here = lat, lon

    def _radius(self) -> float:
        """Acceptance radius where a plan leaves it open: where a turn of 90 degrees onto the next leg begins; of a multirotor
        the bench's own."""
        if isinstance(self.aircraft, Multirotor):
            return 2.0
        bank = math.radians(BANK_SHARE * self.aircraft.limits.bank_max_deg)
        return float(math.ceil(self.speed**2 / (G0 * math.tan(bank)) + 2.0 * self.speed))

    def _seconds(self, item: Item, seconds: float) -> float:
        if not 0.0 < seconds <= FOR_EVER_S:
            item.fail(f"a time of {seconds:g} s (parameter 1); above 0 and at most {FOR_EVER_S:g} s are flown")
        return seconds

    def _take_speed(self, keys: dict[str, Any]) -> None:
        if self.waiting_speed is not None:
            keys["speed_mps"] = self.waiting_speed
            self.waiting_speed = None

    def _close(self) -> None:
        """End the list of waypoints."""
        if self.points:
            name = f"{self.first} waypoint" if self.first == self.last else f"{self.first}-{self.last} waypoints"
            self.manoeuvres.append({"type": "waypoints", "points": self.points, "follow": "legs", "name": name})
            self.points = []

    def _loiter(self, item: Item) -> None:
        lat, lon, alt = self._place(item)
        if item.command == pf.LOITER:
            if self.choices.duration_s is None:
                item.fail("it never ends; give the flight a duration_s")
            self.over = f"item {item.number} loiters for ever"
        if self.rotor and item.command != pf.LOITER_TURNS:
            self._hover_at(item, (lat, lon, alt))
            return
        self._close()
        radius = abs(item.value(3)) or self._loiter_radius(item)
        loiter: dict[str, Any] = {
            "type": "loiter",
            "name": f"{item.number} loiter",
            "centre": {"lat_deg": lat, "lon_deg": lon, "alt_m": alt},
            "radius_m": radius,
            "direction": "left" if item.value(3) < 0.0 else "right",
        }
        if item.command == pf.LOITER_TURNS:
            turns = item.value(1)
            if not 0.0 < turns <= 1000.0:
                item.fail(f"{turns:g} turns (parameter 1); above 0 and at most 1000 are flown")
            loiter["turns"] = turns
        else:
            loiter["duration_s"] = FOR_EVER_S if item.command == pf.LOITER else self._seconds(item, item.value(1))
        if item.command != pf.LOITER and item.value(2) != 0.0:
            to = self._next_place(item)
            # from inside of the circle no course of it leads there: the loiter ends where it ends
            if to is not None and math.hypot(*_metres((lat, lon), to)) > radius:
                loiter["leave_towards"] = {"lat_deg": to[0], "lon_deg": to[1]}
        self._take_speed(loiter)
        self._check_circle(item, radius)
        self.manoeuvres.append(loiter)
        self.here = lat, lon

    def _hover_at(self, item: Item, place: tuple[float, float, float]) -> None:
        point: dict[str, Any] = dict(zip(("lat_deg", "lon_deg", "alt_m"), place, strict=True))
        self._take_speed(point)
        self._close()
        to = {"type": "waypoints", "points": [point | {"radius_m": self._radius()}], "follow": "legs"}
        seconds = FOR_EVER_S if item.command == pf.LOITER else self._seconds(item, item.value(1))
        self.manoeuvres.append(to | {"name": f"{item.number} way"})
        self.manoeuvres.append({"type": "hover", "duration_s": seconds, "name": f"{item.number} hover"})
        self.here = place[:2]

    def _loiter_radius(self, item: Item) -> float:
        if isinstance(self.aircraft, Multirotor):
            item.fail("a radius (parameter 3) is needed")
        bank = math.radians(LOITER_SHARE * self.aircraft.limits.bank_max_deg)
        return float(math.ceil(self.speed**2 / (G0 * math.tan(bank))))

    def _check_circle(self, item: Item, radius: float) -> None:
        if isinstance(self.aircraft, Multirotor):
            least = self.speed**2 / self.aircraft.limits.acceleration_mps2
        else:
            least = self.speed**2 / (G0 * math.tan(math.radians(self.aircraft.limits.bank_max_deg)))
        if not least <= radius <= 100_000.0:
            item.fail(
                f"a circle of {radius:g} m (parameter 3); at {self.speed:g} m/s the aircraft flies {math.ceil(least)} to 100000 m"
            )

    def _next_place(self, item: Item) -> tuple[float, float] | None:
        later = self.plan.items[self.plan.items.index(item) + 1 :]
        for other in later:
            if other.frame not in pf.NO_PLACE and other.command != pf.LAND:
                return self._place(other)[:2]
        return None

    def _land(self, item: Item) -> None:
        if not self.rotor and not self.took_off:
            why = "a landing needs a take-off before it" if self.wheels else "this aircraft has no wheels to land on"
            item.fail(f"{why}; take it out of the plan, or leave it out with plan_skip = [{item.number}]")
        if item.value(1) != 0.0 or item.value(2) != 0.0:
            item.fail("abort height and precision landing (parameters 1, 2) are not flown; set them to 0")
        lat, lon, _ = self._place(self._with_place(item))
        north, east = _metres(self.here, (lat, lon))
        away = math.hypot(north, east) > SAME_PLACE_M
        point: dict[str, Any] = {"lat_deg": lat, "lon_deg": lon}
        if self.rotor and away:
            self._take_speed(point)
            self._close()
            points = [point | {"radius_m": self._radius()}]
            self.manoeuvres.append(
                {"type": "waypoints", "points": points, "follow": "legs", "name": f"{item.number} way"}
            )
        self._close()
        if not self.rotor:
            approach: dict[str, Any] = {"type": "approach", "name": f"{item.number} approach"}
            if away:
                approach |= {"heading_deg": math.degrees(math.atan2(east, north)), "point": point}
            self.manoeuvres.append(approach)
        self.manoeuvres.append({"type": "land", "name": f"{item.number} land"})
        self.over = f"item {item.number} lands"

    def _change_speed(self, item: Item) -> None:
        kind, speed, throttle = item.value(1), item.value(2), item.parameters[2]
        if kind not in (0.0, 1.0):
            item.fail(f"speed of type {kind:g} (parameter 1); 0 (through the air) and 1 (over ground) are flown")
        if kind == 1.0 and not self.rotor:
            item.fail("an aeroplane keeps its speed through the air; set parameter 1 to 0")
        if throttle is not None and throttle != -1.0:
            item.fail("a throttle (parameter 3) is not set; set it to -1")
        if speed == -1.0:
            return
        self._check_speed(speed, f"{item.place}: parameter 2")
        self.speed = self.waiting_speed = speed


def _metres(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float]:
    """From one place to another, north and east, on a sphere."""
    east = (b[1] - a[1] + 180.0) % 360.0 - 180.0
    return math.radians(b[0] - a[0]) * EARTH_RADIUS, math.radians(east) * EARTH_RADIUS * math.cos(math.radians(a[0]))
