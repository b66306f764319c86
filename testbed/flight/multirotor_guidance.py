"""The manoeuvres of a multirotor: generators like those of `manoeuvres`, which set the targets of its cascade ten times a second.

Places are metres north and east of the start, angles in radians, SI units.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import FlightError
from testbed.flight import manoeuvre_config as cfg
from testbed.flight import multirotor_kernels as mk
from testbed.flight.aircraft import Multirotor
from testbed.flight.manoeuvres import Journey, during, local, until, wrap

RADIUS_M = 2.0
"""How near a waypoint is passed where nothing is said: what a receiver without corrections knows of its place."""
NEAR_M, SLOW_MPS = 0.3, 0.2
"""A height, and a place to land on, are reached within these; a thrust that is 2 % off moves a hover by as much."""
LOST_M = 10.0
"""A hover that is blown farther off has failed."""
TOUCHED_M = 0.05
"""Over the height at which it stands: the legs touch the ground."""
LAST_METRES = 0.5
"""1/s: close to the ground the descent fades with the height, down to `TOUCH_DOWN_MPS`."""
TOUCH_DOWN_MPS = 0.3
STANDING_MPS = 1e-3
"""Slower, and held fast from there on, the step of the velocity is below the noise of any accelerometer here."""


@dataclass
class RotorSituation(Journey):
    """What guidance sees and sets: the measurements, the memory and the targets of the cascade."""

    aircraft: Multirotor
    measured: memoryview[float] | NDArray[np.float64]
    target: NDArray[np.float64]
    memory: NDArray[np.float64]
    over_ground: float = 0.0
    """Height of the legs over the ground, m."""
    held_down: bool = False
    on_ground: bool = False

    def stop_here(self) -> None:
        """Make the place where it comes to rest the target."""
        speed = math.hypot(self.v_north, self.v_east)
        way = 0.5 * speed / self.aircraft.limits.acceleration_mps2
        self.go_to(self.north + way * self.v_north, self.east + way * self.v_east)

    def go_to(self, north: float, east: float) -> None:
        """Make a place the target, along the line from the one before, or from here when that is far away."""
        target = self.target
        start = (float(target[mk.NORTH]), float(target[mk.EAST]))
        if target[mk.MODE] != mk.TO_POINT or math.dist(start, (self.north, self.east)) > 2.0 * RADIUS_M:
            start = self.north, self.east
        if math.dist(start, (north, east)) > 1e-3:
            target[mk.COURSE] = math.atan2(east - start[1], north - start[0])
        target[mk.MODE] = mk.TO_POINT
        target[mk.NORTH], target[mk.EAST] = north, east

    def distance(self) -> float:
        """Horizontal distance to the target, m."""
        return math.hypot(self.target[mk.NORTH] - self.north, self.target[mk.EAST] - self.east)

    @property
    def height(self) -> float:
        """Height above the ellipsoid, m."""
        return float(self.measured[mk.HEIGHT])

    @property
    def v_down(self) -> float:
        """Velocity down, m/s."""
        return float(self.measured[mk.V_DOWN])


def guide(manoeuvre: cfg.AnyManoeuvre, s: RotorSituation) -> Iterator[None]:
    """Run one manoeuvre: yields once per guidance tick, returns when it is done, raises FlightError when it cannot."""
    limits, target = s.aircraft.limits, s.target
    target[mk.CLIMB], target[mk.DESCENT] = limits.climb_max_mps, limits.descent_max_mps
    if manoeuvre.speed_mps is not None:
        target[mk.SPEED] = manoeuvre.speed_mps
    if s.on_ground and not isinstance(manoeuvre, cfg.Park | cfg.TakeOff):
        raise FlightError("begins in the air, but it stands on the ground; take_off comes first")
    s.end = math.nan
    yield from GENERATORS[type(manoeuvre)](manoeuvre, s)
    if math.isnan(s.end):
        s.end = s.t
    s.begin = s.end


def _hover(m: cfg.Hover, s: RotorSituation) -> Iterator[None]:
    if s.target[mk.MODE] != mk.TO_POINT:
        s.stop_here()
    if m.heading_deg is not None:
        s.target[mk.HEADING] = wrap(math.radians(m.heading_deg))
    begin = s.distance()
    for _ in during(s, m.duration_s):
        _check_place(s, begin)
        yield


def _check_place(s: RotorSituation, begin: float) -> None:
    if s.distance() > begin + LOST_M:
        raise FlightError(f"could not hold its place: it is {s.distance():.0f} m off")


def _waypoints(m: cfg.Waypoints, s: RotorSituation) -> Iterator[None]:
    for number, point in enumerate(m.points, 1):
        if point.speed_mps is not None:
            s.target[mk.SPEED] = point.speed_mps
        radius = point.radius_m or m.radius_m or RADIUS_M
        yield from _go(local(point, s), point.alt_m, point.heading_deg, radius, s, f"waypoint {number}")
        if point.hold_s is not None:
            leave = s.t + point.hold_s
            while s.t < leave - 1e-9:
                _check_place(s, radius)
                yield


def _go(
    to: tuple[float, float], alt: float | None, heading_deg: float | None, radius: float, s: RotorSituation, goal: str
) -> Iterator[None]:
    """Along the straight line to a point, also in height, until it is passed within ``radius``."""
    target, floor = s.target, float(s.target[mk.ALTITUDE])
    s.go_to(*to)
    length = s.distance()
    up = alt if alt is not None else floor
    if heading_deg is not None:
        target[mk.HEADING] = wrap(math.radians(heading_deg))
    elif length > radius:
        target[mk.HEADING] = target[mk.COURSE]

    def reached() -> bool:
        left = s.distance()
        flown = min(1.0, max(0.0, 1.0 - (left - radius) / (length - radius))) if length > radius else 1.0
        target[mk.ALTITUDE] = floor + flown * (up - floor)
        return left <= radius and abs(s.height - up) <= max(radius, NEAR_M)

    limits = s.aircraft.limits
    seconds = length / float(target[mk.SPEED]) + abs(up - s.height) / min(limits.climb_max_mps, limits.descent_max_mps)
    try:
        yield from until(s, reached, seconds, goal)
    except FlightError as error:
        raise FlightError(
            f"{error}; it is {s.distance():.0f} m from it and {abs(s.height - up):.0f} m off its height"
        ) from None
    target[mk.ALTITUDE] = up


def _vertical(m: cfg.Climb | cfg.Descent, s: RotorSituation) -> Iterator[None]:
    up = 1.0 if isinstance(m, cfg.Climb) else -1.0
    rate = float(m.climb_rate_mps or 0.0)
    s.target[mk.CLIMB if up > 0.0 else mk.DESCENT] = rate
    if m.duration_s is not None:
        for _ in during(s, m.duration_s):
            s.target[mk.ALTITUDE] = s.height + up * (10.0 * rate + 10.0)
            yield
        s.target[mk.ALTITUDE] = s.height + up * 0.5 * rate * rate / s.aircraft.limits.acceleration_mps2
        return
    goal = float(m.to_alt_m or 0.0)
    if up * (goal - s.height) < -NEAR_M:
        raise FlightError(f"to_alt_m {goal:g} lies on the wrong side: the height is {s.height:.1f} m")
    yield from _climb_to(goal, rate, s)


def _climb_to(goal: float, rate: float, s: RotorSituation) -> Iterator[None]:
    s.target[mk.ALTITUDE] = goal
    there = lambda: abs(s.height - goal) < NEAR_M and abs(s.v_down) < SLOW_MPS  # noqa: E731
    yield from until(s, there, abs(goal - s.height) / rate, f"a height of {goal:g} m")


def _loiter(m: cfg.Loiter, s: RotorSituation) -> Iterator[None]:
    side = 1.0 if m.direction == "right" else -1.0
    if m.centre is not None:
        centre = local(m.centre, s)
        # the nearest point of the circle, or its north where it begins at the centre
        north, east = s.north - centre[0], s.east - centre[1]
        away = math.hypot(north, east)
        north, east = (north / away, east / away) if away > 1.0 else (1.0, 0.0)
        begin = centre[0] + m.radius_m * north, centre[1] + m.radius_m * east
        yield from _go(begin, m.centre.alt_m, None, RADIUS_M, s, "its circle")
        if m.duration_s is not None:
            s.begin = s.t
    else:
        course = s.course if math.hypot(s.v_north, s.v_east) > 1.0 else float(s.measured[mk.YAW])
        across = course + side * math.pi / 2.0
        centre = s.north + m.radius_m * math.cos(across), s.east + m.radius_m * math.sin(across)
    target = s.target
    target[mk.NORTH], target[mk.EAST] = centre
    target[mk.RADIUS], target[mk.SIDE], target[mk.MODE] = m.radius_m, side, mk.CIRCLE
    if m.climb_rate_mps is not None:
        target[mk.CLIMB] = target[mk.DESCENT] = abs(m.climb_rate_mps)
    swept, last = 0.0, math.atan2(s.east - centre[1], s.north - centre[0])

    def turn() -> None:
        nonlocal swept, last
        if m.climb_rate_mps:
            target[mk.ALTITUDE] = s.height + 20.0 * m.climb_rate_mps
        place = math.atan2(s.east - centre[1], s.north - centre[0])
        swept += side * wrap(place - last)
        last = place

    def turned() -> bool:
        turn()
        return swept >= 2.0 * math.pi * (m.turns or 0.0)

    lap = 2.0 * math.pi * m.radius_m / float(target[mk.SPEED])
    if m.duration_s is not None:
        for _ in during(s, m.duration_s):
            turn()
            yield
    else:
        yield from until(s, turned, lap * (m.turns or 0.0), f"{m.turns:g} turns of the loiter")
    if m.leave_towards is not None:
        north, east = local(m.leave_towards, s)
        if math.dist((north, east), centre) <= m.radius_m:
            raise FlightError("leave_towards lies on or inside the circle, which has no tangent to it")

        def looks() -> bool:
            turn()
            return abs(wrap(math.atan2(east - s.east, north - s.north) - s.course)) < math.radians(5.0)

        s.end = math.nan
        yield from until(s, looks, lap, "the tangent to the next point")
    if m.climb_rate_mps is not None:
        target[mk.ALTITUDE] = s.height
    target[mk.HEADING] = s.course
    s.stop_here()


def _park(m: cfg.Park, s: RotorSituation) -> Iterator[None]:
    if not s.on_ground:
        raise FlightError("parks on the ground, but it is in the air")
    yield from during(s, m.duration_s)


def _take_off(m: cfg.TakeOff, s: RotorSituation) -> Iterator[None]:
    if not s.on_ground:
        raise FlightError("begins on the ground, but it is in the air")
    target, limits = s.target, s.aircraft.limits
    goal = s.height + m.to_height_m
    target[mk.NORTH], target[mk.EAST], target[mk.HEADING] = s.north, s.east, float(s.measured[mk.YAW])
    target[mk.MODE], target[mk.STATE] = mk.TO_POINT, mk.ON_GROUND
    target[mk.ALTITUDE] = goal
    s.held_down = s.on_ground = False

    def lifted() -> bool:
        return s.over_ground > TOUCHED_M

    yield from until(s, lifted, 2.0, "the air")
    target[mk.STATE] = mk.FLYING
    yield from _climb_to(goal, limits.climb_max_mps, s)


def _land(_: cfg.Land, s: RotorSituation) -> Iterator[None]:
    target = s.target
    if target[mk.MODE] != mk.TO_POINT:
        s.stop_here()
    slow = lambda: s.distance() < NEAR_M and math.hypot(s.v_north, s.v_east) < SLOW_MPS  # noqa: E731
    yield from until(s, slow, s.distance() / float(target[mk.SPEED]) + 10.0, "the place above where it lands")
    fastest = s.aircraft.limits.descent_max_mps

    def touched() -> bool:
        target[mk.DESCENT] = min(fastest, TOUCH_DOWN_MPS + LAST_METRES * max(0.0, s.over_ground))
        target[mk.ALTITUDE] = s.height - s.over_ground - 2.0
        return s.over_ground < TOUCHED_M

    yield from until(s, touched, s.over_ground / fastest + 3.0, "the ground")
    target[mk.STATE] = mk.ON_GROUND
    stand = s.t + 0.5
    while s.t < stand:
        yield
    target[mk.STATE] = mk.MOTORS_OFF
    still = lambda: math.hypot(s.v_north, s.v_east, s.v_down) < STANDING_MPS  # noqa: E731
    yield from until(s, still, 10.0, "rest on the ground")
    s.held_down = s.on_ground = True


GENERATORS: dict[type[cfg.Manoeuvre], Callable[..., Iterator[None]]] = {
    cfg.Hover: _hover,
    cfg.Waypoints: _waypoints,
    cfg.Climb: _vertical,
    cfg.Descent: _vertical,
    cfg.Loiter: _loiter,
    cfg.Park: _park,
    cfg.TakeOff: _take_off,
    cfg.Land: _land,
}
"""What a multirotor can do; the other manoeuvres bank, or move surfaces that it has not."""
