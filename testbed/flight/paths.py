"""Manoeuvres along lines and circles over the ground: waypoints and loiter of an aeroplane.

Guidance after Beard and McLain, *Small Unmanned Aircraft*, chapter 10 (vector fields about a line and an orbit) and 11
(fillets between legs). Places are metres north and east of the start, angles in radians.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from testbed.base.errors import FlightError
from testbed.flight import autopilot_kernels as ap
from testbed.flight import manoeuvre_config as cfg
from testbed.flight.manoeuvres import (
    ROLL_OUT_LAG_S,
    Generator,
    Situation,
    bank_at,
    climb_while_turning,
    during,
    level_off,
    local,
    roll_out_lead,
    until,
    wrap,
)
from testbed.physics.earth import G0

RADIUS_M = 100.0
"""How near a waypoint is passed where nothing is said: 3 s of a small aircraft's flight."""
INTERCEPT = math.radians(60.0)
"""Course towards a line from far away, off that of the line (Beard and McLain take up to 90 degrees)."""
SHARPEST = 2.6
"""Turns beyond 150 degrees are not cut any further: the lead, a tangent of the half angle, would grow without end."""
SMALL_TURN = math.radians(10.0)
"""Onto a leg: so little is left to the line's own guidance, whose bank stays below its limit at any usual speed."""
ARRIVED, ALONG = 0.1, math.radians(15.0)
"""Of a circle's radius, and off its direction: as near to both the turns begin to count."""
HEIGHT_S = 5.0
"""A waypoint is passed at its height as near as the aircraft climbs in so many seconds."""


def loiter(m: cfg.Loiter, s: Situation) -> Iterator[None]:
    """Circle about a centre, or about the point abeam."""
    climb_while_turning(m, s)
    side = 1.0 if m.direction == "right" else -1.0
    orbit = _Orbit(m, s, side)
    if m.centre is not None:
        if m.centre.alt_m is not None:
            s.target[ap.ALTITUDE] = m.centre.alt_m
        yield from until(s, orbit.arrived, orbit.distance() / max(s.of(ap.AIRSPEED), 1.0), "the circle of the loiter")
        s.begin = s.t
    orbit.swept = 0.0
    if m.duration_s is not None:
        for _ in during(s, m.duration_s):
            orbit.follow()
            yield
    else:
        seconds = 2.0 * math.pi * m.radius_m * (m.turns or 0.0) / max(s.of(ap.AIRSPEED), 1.0)
        yield from until(s, lambda: orbit.turned(m.turns or 0.0), seconds, f"{m.turns:g} turns of the loiter")
    if m.leave_towards is not None:
        to = local(m.leave_towards, s)
        if math.dist(to, orbit.centre) <= m.radius_m:
            raise FlightError("leave_towards lies on or inside the circle, which has no tangent to it")
        s.end = math.nan
        lap = 2.0 * math.pi * m.radius_m / max(s.of(ap.AIRSPEED), 1.0)
        yield from until(s, lambda: orbit.looks_at(to), lap, "the tangent to the next point")
    s.target[ap.HEADING] = wrap(s.of(ap.YAW) + roll_out_lead(s))
    level_off(m, s)


class _Orbit:
    """Follows a circle over the ground."""

    def __init__(self, m: cfg.Loiter, s: Situation, side: float) -> None:
        self.s, self.radius, self.side = s, m.radius_m, side
        if m.centre is not None:
            self.centre = local(m.centre, s)
        else:
            across = s.course + side * math.pi / 2.0
            self.centre = s.north + m.radius_m * math.cos(across), s.east + m.radius_m * math.sin(across)
        self.bank_limit = math.radians(s.aircraft.limits.bank_max_deg)
        self.swept, self.last = 0.0, math.nan

    def distance(self) -> float:
        """To the centre, m."""
        return math.dist(self.centre, (self.s.north, self.s.east))

    def follow(self) -> None:
        """Set the bank."""
        s, radius, side = self.s, self.radius, self.side
        north, east = s.north - self.centre[0], s.east - self.centre[1]
        distance, place = math.hypot(north, east), math.atan2(east, north)
        if not math.isnan(self.last):
            self.swept += side * wrap(place - self.last)
        self.last = place
        speed = math.hypot(s.v_north, s.v_east)
        wanted = place + side * (math.pi / 2.0 + math.atan(2.0 * (distance - radius) / radius))
        feed = side * speed * speed / (G0 * max(distance, 0.7 * radius))
        correction = s.aircraft.autopilot.heading * wrap(wanted - s.course) * speed / G0
        bank_at(s, min(self.bank_limit, max(-self.bank_limit, math.atan(feed + correction))))

    def arrived(self) -> bool:
        """Whether it flies on the circle, the right way round."""
        self.follow()
        way_round = self.last + self.side * math.pi / 2.0
        return (
            abs(self.distance() - self.radius) < ARRIVED * self.radius and abs(wrap(way_round - self.s.course)) < ALONG
        )

    def turned(self, turns: float) -> bool:
        """Whether so many turns are flown."""
        self.follow()
        return self.swept >= 2.0 * math.pi * turns

    def looks_at(self, to: tuple[float, float]) -> bool:
        """Whether the course, when the wings are level again, points at a place."""
        self.follow()
        s = self.s
        bearing = math.atan2(to[1] - s.east, to[0] - s.north)
        # in half a tick of guidance and more the course passes the bearing: the side on which it lies changes sign
        ahead = wrap(bearing - s.course) * self.side
        return -0.5 < ahead <= self.side * roll_out_lead(s)


def waypoints(m: cfg.Waypoints, s: Situation) -> Iterator[None]:
    """One point after the other: straight to each, or along the legs between them."""
    here = s.north, s.east
    points = [local(point, s) for point in m.points]
    for k, point in enumerate(m.points):
        if point.speed_mps is not None:
            s.target[ap.SPEED] = point.speed_mps
        radius = point.radius_m or m.radius_m or RADIUS_M
        if m.follow == "legs":
            further = points[k + 1] if k + 1 < len(points) else None
            yield from _Leg(here, points[k], further, radius, s).fly(point, f"waypoint {k + 1}")
            here = points[k]
        else:
            if point.alt_m is not None:
                s.target[ap.ALTITUDE] = point.alt_m
            yield from _straight_to(points[k], radius, s, f"waypoint {k + 1}")
    if m.follow == "legs":
        s.target[ap.LATERAL_MODE] = ap.HOLD_HEADING
    s.target[ap.HEADING] = s.of(ap.YAW)


def _straight_to(to: tuple[float, float], radius: float, s: Situation, goal: str) -> Iterator[None]:
    closest = math.inf

    def reached() -> bool:
        nonlocal closest
        to_north, to_east = to[0] - s.north, to[1] - s.east
        distance = math.hypot(to_north, to_east)
        closest = min(closest, distance)
        drift = wrap(s.course - s.of(ap.YAW))
        s.target[ap.HEADING] = wrap(math.atan2(to_east, to_north) - drift)
        return distance <= radius

    seconds = math.dist(to, (s.north, s.east)) / max(s.of(ap.AIRSPEED), 1.0)
    try:
        yield from until(s, reached, seconds, goal)
    except FlightError as error:
        raise FlightError(f"{error}; it came within {closest:.0f} m (radius_m is {radius:g})") from None


class _Leg:
    """The line from one point to the next, and the turn onto the line after it."""

    def __init__(
        self,
        here: tuple[float, float],
        to: tuple[float, float],
        further: tuple[float, float] | None,
        radius: float,
        s: Situation,
    ) -> None:
        self.here, self.to, self.radius, self.s = here, to, radius, s
        self.length = math.dist(here, to)
        self.course = math.atan2(to[1] - here[1], to[0] - here[0]) if self.length > 1e-3 else s.course
        self.turn = 0.0
        if further is not None and math.dist(to, further) > 1e-3:
            onward = math.atan2(further[1] - to[1], further[0] - to[0])
            self.turn = min(SHARPEST, abs(wrap(onward - self.course)))
        self.bank_limit = float(s.target[ap.BANK_LIMIT])

    def lead(self) -> float:
        """How far before the point the turn onto the next leg begins, m: a fillet's tangent, and what rolling in takes."""
        s, speed = self.s, math.hypot(self.s.v_north, self.s.v_east)
        if self.turn == 0.0:
            return 0.0
        circle = speed * speed / (G0 * math.tan(self.bank_limit))
        rolling = 0.5 * self.bank_limit / math.radians(s.aircraft.autopilot.roll_rate_limit_dps) + ROLL_OUT_LAG_S
        return min(circle * math.tan(0.5 * self.turn) + speed * rolling, self.radius, 0.5 * self.length)

    def fly(self, point: cfg.Waypoint, goal: str) -> Iterator[None]:
        """Follow the line, also in height; FlightError when the point is passed too high or too low."""
        s = self.s
        floor = float(s.target[ap.ALTITUDE])
        up = floor if point.alt_m is None else point.alt_m

        yield from self._turn_in(goal)

        def reached() -> bool:
            along, across = self._place()
            lead = self.lead()
            share = min(1.0, max(0.0, along / max(self.length - lead, 1.0)))
            s.target[ap.ALTITUDE] = floor + share * (up - floor)
            self._steer(across)
            return along >= self.length - lead

        yield from until(s, reached, self.length / max(s.of(ap.AIRSPEED), 1.0), goal)
        _, across = self._place()
        if abs(across) > self.radius:
            raise FlightError(f"passes {goal} {abs(across):.0f} m beside it (radius_m is {self.radius:g})")
        miss = s.of(ap.HEIGHT) - up
        if abs(miss) > HEIGHT_S * s.aircraft.limits.climb_max_mps:
            raise FlightError(
                f"passes {goal} {abs(miss):.0f} m too {'high' if miss > 0.0 else 'low'}: the leg of {self.length:.0f} m is too "
                "short for its change of height"
            )
        s.target[ap.ALTITUDE] = up

    def _turn_in(self, goal: str) -> Iterator[None]:
        """The arc of the fillet: all the bank that there is, until what rolling out still turns brings the course of the leg."""
        s = self.s
        left = wrap(self.course - s.course)
        if abs(left) < SMALL_TURN:
            return
        side = math.copysign(1.0, left)
        swept, last = 0.0, s.course

        def there() -> bool:
            nonlocal swept, last
            bank_at(s, side * self.bank_limit)
            swept += side * wrap(s.course - last)
            last = s.course
            return swept + side * roll_out_lead(s) >= abs(left)

        speed = max(math.hypot(s.v_north, s.v_east), 1.0)
        seconds = abs(left) * speed / (G0 * math.tan(self.bank_limit))
        yield from until(s, there, seconds, f"the course to {goal}")

    def _place(self) -> tuple[float, float]:
        """Metres along the leg and to the right of it."""
        north, east = self.s.north - self.here[0], self.s.east - self.here[1]
        c, sine = math.cos(self.course), math.sin(self.course)
        return c * north + sine * east, c * east - sine * north

    def _steer(self, across: float) -> None:
        s = self.s
        speed = math.hypot(s.v_north, s.v_east)
        heading = s.aircraft.autopilot.heading
        # near the line both loops make one of second order: back to the line at half the rate of the course has a damping of 0.7
        gain = heading / (2.0 * max(speed, 1.0)) * math.pi / (2.0 * INTERCEPT)
        wanted = self.course - INTERCEPT * 2.0 / math.pi * math.atan(gain * across)
        bank = math.atan(heading * wrap(wanted - s.course) * speed / G0)
        bank_at(s, min(self.bank_limit, max(-self.bank_limit, bank)))


GENERATORS: dict[type, Generator] = {cfg.Loiter: loiter, cfg.Waypoints: waypoints}
