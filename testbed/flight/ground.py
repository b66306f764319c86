"""The manoeuvres on a runway and next to it: park, line up, take off, approach, land.

Guidance after Stevens and Lewis, *Aircraft Control and Simulation*, section 4.6 (glide path and flare). Each loop is some three
times slower than the one inside it: bank about 1 s, course 2.5 s, offset from a line 8 s. Metres, SI units and radians.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from testbed.base.errors import FlightError
from testbed.flight import autopilot_kernels as ap
from testbed.flight import manoeuvre_config as cfg
from testbed.flight.aircraft import Ground
from testbed.flight.manoeuvres import Generator, Situation, bank_at, during, height_lead, local, until, wrap
from testbed.flight.undercarriage import Undercarriage
from testbed.physics.earth import G0

TICK_S = 0.1
"""Between two calls of guidance."""
LINE_S, COURSE_S = 8.0, 2.5
INTERCEPT = math.radians(60.0)
"""Steepest angle at which a line is met."""
THROTTLE_PER_S = 0.5
"""Share of its range that the throttle is moved in a second."""
RUNWAY_HALF_M = 22.5
"""Half the width of a runway of 45 m (ICAO Annex 14, code 4)."""
AIM_M = 300.0
"""From the threshold, which is where the take-off began, to the aiming point (ICAO Annex 14: 250 to 400 m)."""
CLEAR_M = 12.0
"""Wheels above the runway at which the climb takes over from the rotation and the gear goes up."""
TAXI_SIDEWAYS_MPS2, TAXI_RADIUS_M = 0.5, 20.0
"""A gentle turn on the ground, and wide enough for a nose wheel that turns by 10 degrees."""
STEER_S, STEER_LIMIT = 3.0, 0.1
"""Time in which an offset from the centreline is driven back, and the heading (rad) that is spent on it at most."""
TRIM_PER_S, TRIM_LIMIT = 0.3, 0.4
"""Share of a heading error (rad) that steering learns in a second: what a crosswind needs for good."""
DECRAB_M = 2.0
"""Wheels above the runway at which the nose is turned along it."""
BRAKE_AFTER_S, BRAKE_OVER_S = 2.0, 3.0
STOPPED_MPS = 0.05
HELD = 1e-3
"""Speed (m/s) and rates (rad/s) below which a parked aircraft is held: a jolt of 0.1 m/s² in a sample of 0.01 s."""
FINAL_S = 40.0
"""Level flight on the extended centreline before the glide path, so that the aircraft is established there."""
TURN_ON = 1.15
"""Speed of the turn on to final over that of the approach: with 25 degrees of bank the stall speed is 1.05 times as high."""
ESTABLISHED_M = 60.0


def _within(limit: float, value: float) -> float:
    return min(limit, max(-limit, value))


class _Runway:
    """A place and a direction: how far along it, and to the right of it, the aircraft is."""

    def __init__(self, s: Situation, north: float, east: float, heading: float) -> None:
        self.s, self.north, self.east, self.heading = s, north, east, heading
        self.cosine, self.sine = math.cos(heading), math.sin(heading)
        self.trim = 0.0

    def along(self) -> float:
        """Metres beyond the place."""
        return (self.s.north - self.north) * self.cosine + (self.s.east - self.east) * self.sine

    def right(self) -> float:
        """Metres to the right of the line."""
        return (self.s.east - self.east) * self.cosine - (self.s.north - self.north) * self.sine

    def steer(self) -> None:
        """Nose wheel and rudder back to the line; FlightError beside the runway."""
        s, off = self.s, self.right()
        if abs(off) > RUNWAY_HALF_M:
            raise FlightError(f"left the runway: {abs(off):.0f} m beside its centreline")
        wanted = self.heading - _within(STEER_LIMIT, off / (10.0 + STEER_S * s.of(ap.AIRSPEED)))
        error = wrap(wanted - s.of(ap.YAW))
        self.trim = _within(TRIM_LIMIT, self.trim + TRIM_PER_S * TICK_S * error)
        s.target[ap.STEERING] = 1.0
        s.target[ap.HEADING] = wrap(wanted + self.trim)

    def follow(self, bank_limit: float) -> None:
        """Bank back to the line, over ground."""
        s = self.s
        speed = max(math.hypot(s.v_north, s.v_east), 1.0)
        back = math.atan(self.right() / (LINE_S * speed))
        wanted = self.heading - _within(INTERCEPT, back)
        bank = math.atan(wrap(wanted - s.course) / COURSE_S * speed / G0)
        s.target[ap.STEERING] = 0.0
        bank_at(s, _within(bank_limit, bank))


def _parts(s: Situation) -> tuple[Undercarriage, Ground]:
    """Undercarriage and ground settings; the script is checked, so both are there."""
    ground = s.aircraft.ground
    assert s.undercarriage is not None and ground is not None
    return s.undercarriage, ground


def _throttle(s: Situation, wanted: float) -> None:
    """Move the throttle towards a share of its range, by hand."""
    step = THROTTLE_PER_S * TICK_S
    now = float(s.target[ap.THROTTLE_SET]) if s.target[ap.THROTTLE_MODE] == ap.BY_HAND else wanted
    s.target[ap.THROTTLE_MODE] = ap.BY_HAND
    s.target[ap.THROTTLE_SET] = now + _within(step, wanted - now)


def _hands_off(s: Situation) -> None:
    s.target[ap.VERTICAL_MODE] = ap.HANDS_OFF
    bank_at(s, 0.0)


def _pitch_towards(s: Situation, pitch: float, rate: float) -> None:
    """Hold a pitch angle that moves towards ``pitch`` at ``rate`` (rad/s) from the present one."""
    target = s.target
    if target[ap.VERTICAL_MODE] != ap.HOLD_PITCH:
        target[ap.VERTICAL_MODE], target[ap.PITCH_ANGLE] = ap.HOLD_PITCH, s.of(ap.PITCH)
    step = rate * TICK_S
    target[ap.PITCH_ANGLE] += _within(step, pitch - target[ap.PITCH_ANGLE])


def _park(m: cfg.Park, s: Situation) -> Iterator[None]:
    wheels, _ = _parts(s)
    _hands_off(s)
    s.target[ap.STEERING], s.target[ap.HEADING] = 1.0, s.of(ap.YAW)
    wheels.brake(1.0)
    held = False
    for _ in during(s, m.duration_s):
        _throttle(s, 0.0)
        if not held and wheels.stands(HELD):
            wheels.hold(True)
            held = True
        yield


def _line_up(m: cfg.LineUp, s: Situation) -> Iterator[None]:
    wheels, ground = _parts(s)
    _hands_off(s)
    wheels.hold(False)
    wheels.brake(0.0)
    goal, target = math.radians(m.to_heading_deg), s.target
    target[ap.STEERING], target[ap.HEADING] = 1.0, s.of(ap.YAW)
    throttle, trim, v = 0.0, 0.0, ground.taxi_mps

    def straight() -> bool:
        nonlocal throttle, trim
        speed = math.hypot(s.v_north, s.v_east)
        # so slow an integral waits for the aircraft to gather speed
        throttle = min(1.0, max(0.0, throttle + 0.02 * TICK_S * (v - speed)))
        _throttle(s, min(1.0, throttle + 0.05 * max(0.0, v - speed)))
        wheels.brake(min(ground.brake, max(0.0, 0.2 * (speed - v - 0.5))))
        step = min(TAXI_SIDEWAYS_MPS2 / v, speed / TAXI_RADIUS_M) * TICK_S
        off = wrap(goal - s.of(ap.YAW))
        if abs(off) < TRIM_LIMIT:
            trim = _within(TRIM_LIMIT, trim + TRIM_PER_S * TICK_S * off)
        target[ap.HEADING] = wrap(float(target[ap.HEADING]) + _within(step, wrap(goal + trim - target[ap.HEADING])))
        return abs(off) < math.radians(0.5) and abs(s.of(ap.R)) < math.radians(0.3)

    yield from until(s, straight, 60.0, f"a heading of {m.to_heading_deg:g}° on the ground")
    yield from _stop(s)


def _stop(s: Situation) -> Iterator[None]:
    """Brake until the aircraft stands."""
    wheels, ground = _parts(s)
    wheels.brake(ground.brake)

    def stopped() -> bool:
        _throttle(s, 0.0)
        return math.hypot(s.v_north, s.v_east) < STOPPED_MPS

    yield from until(s, stopped, 20.0, "a standstill")
    wheels.brake(1.0)


def _take_off(m: cfg.TakeOff, s: Situation) -> Iterator[None]:
    wheels, ground = _parts(s)
    s.runway = s.north, s.east, s.of(ap.YAW)
    runway = _Runway(s, *s.runway)
    _hands_off(s)
    wheels.hold(False)
    wheels.brake(0.0)
    wheels.flaps(ground.flaps_take_off)
    _throttle(s, 0.0)

    def fast() -> bool:
        _throttle(s, 1.0)
        runway.steer()
        return s.of(ap.AIRSPEED) >= ground.rotate_mps

    yield from until(s, fast, 30.0, f"{ground.rotate_mps:g} m/s on the runway")
    pitch, rate = math.radians(ground.rotate_pitch_deg), 0.5 * math.radians(ground.pitch_rate_limit_dps)

    def clear() -> bool:
        _throttle(s, 1.0)
        _pitch_towards(s, pitch, rate)
        if wheels.wheels_down():
            runway.steer()
        else:
            runway.follow(math.radians(10.0))
        return wheels.height() > CLEAR_M

    yield from until(s, clear, 15.0, f"a height of {CLEAR_M:g} m")
    s.low = False
    target = s.target
    wheels.gear(not ground.retracts)
    target[ap.THROTTLE_MODE], target[ap.SPEED] = ap.HOLD_SPEED, m.speed_mps or ground.climb_mps
    target[ap.VERTICAL_MODE], target[ap.CLIMB] = ap.HOLD_CLIMB, ground.climb_rate_mps

    def high() -> bool:
        runway.follow(math.radians(15.0))
        return wheels.height() > m.to_height_m - height_lead(s, ground.climb_rate_mps)

    yield from until(s, high, m.to_height_m / ground.climb_rate_mps, f"{m.to_height_m:g} m above the runway")
    wheels.flaps(0.0)
    target[ap.ALTITUDE] = s.of(ap.HEIGHT) - wheels.height() + m.to_height_m
    target[ap.HEADING] = runway.heading


def _approach(m: cfg.Approach, s: Situation) -> Iterator[None]:
    wheels, ground = _parts(s)
    if m.point is None or m.heading_deg is None:
        north, east, heading = s.runway
        north, east = north + AIM_M * math.cos(heading), east + AIM_M * math.sin(heading)
    else:
        (north, east), heading = local(m.point, s), math.radians(m.heading_deg)
    runway = _Runway(s, north, east, heading)
    slope = math.tan(math.radians(m.glide_deg))
    final, target = m.speed_mps or ground.final_mps, s.target
    begins = wheels.height() / slope
    gate = begins + FINAL_S * max(final, s.of(ap.AIRSPEED))
    bank_limit = math.radians(min(25.0, 0.6 * s.aircraft.limits.bank_max_deg))
    yield from _to_gate(s, runway, gate, bank_limit)
    target[ap.SPEED] = min(TURN_ON * final, max(final, s.of(ap.AIRSPEED)))
    wheels.gear(True)
    wheels.flaps(ground.flaps_approach)

    def met() -> bool:
        runway.follow(bank_limit)
        return -runway.along() * slope <= wheels.height() + 2.0

    yield from until(s, met, gate / final, "the glide path")
    off, astray = abs(runway.right()), abs(wrap(s.course - heading))
    if off > ESTABLISHED_M or astray > math.radians(15.0):
        raise FlightError(
            f"is not established on final where the glide path begins: {off:.0f} m beside the centreline, {math.degrees(astray):.0f}° off"
        )
    wheels.flaps(ground.flaps_landing)
    target[ap.SPEED] = final
    target[ap.VERTICAL_MODE] = ap.HOLD_CLIMB

    def down() -> bool:
        runway.follow(bank_limit)
        # the path goes back, and so does a height error, with the altitude loop's time constant
        sink = math.hypot(s.v_north, s.v_east) * slope
        back = s.aircraft.autopilot.altitude * (-runway.along() * slope - wheels.height())
        target[ap.CLIMB] = min(0.0, max(-2.0 * sink, back - sink))
        return wheels.height() < ground.flare_m

    yield from until(s, down, begins / final, "the runway")
    s.runway = runway.north, runway.east, heading


def _to_gate(s: Situation, runway: _Runway, gate: float, bank: float) -> Iterator[None]:
    """Fly to where a turn on to final can begin: abeam a point so many metres before the aiming point, two radii of turn to the
    side, which leaves room for half a circle less the intercept. Who is behind that point already goes on from there."""
    speed = max(s.of(ap.AIRSPEED), 1.0)
    radius = speed * speed / (G0 * math.tan(bank))
    if runway.along() < -gate:
        return
    side = math.copysign(2.0 * radius, runway.right())
    north = runway.north - gate * runway.cosine - side * runway.sine
    east = runway.east - gate * runway.sine + side * runway.cosine

    def near() -> bool:
        to_north, to_east = north - s.north, east - s.east
        drift = wrap(s.course - s.of(ap.YAW))
        s.target[ap.HEADING] = wrap(math.atan2(to_east, to_north) - drift)
        return math.hypot(to_north, to_east) < 0.5 * radius

    distance = math.hypot(north - s.north, east - s.east)
    yield from until(s, near, distance / speed, "the approach")


def _land(_: cfg.Land, s: Situation) -> Iterator[None]:
    wheels, ground = _parts(s)
    runway, target = _Runway(s, *s.runway), s.target
    target[ap.VERTICAL_MODE] = ap.HOLD_CLIMB
    target[ap.THROTTLE_SET], target[ap.THROTTLE_MODE] = s.throttle, ap.BY_HAND

    def down() -> bool:
        # the throttle closes in the lower half: the elevator has the flare alone for a few seconds only
        _throttle(s, 0.0 if wheels.height() < 0.5 * ground.flare_m else s.throttle)
        target[ap.CLIMB] = -(max(0.0, wheels.height()) / ground.flare_s + ground.sink_mps)
        runway.follow(math.radians(10.0))
        if wheels.height() < DECRAB_M:
            bank_at(s, 0.0)
            target[ap.RUDDER_OFFSET] = 1.5 * wrap(runway.heading - s.of(ap.YAW))
        return wheels.wheels_down() > 0

    yield from until(s, down, 10.0, "the ground")
    target[ap.RUDDER_OFFSET] = 0.0
    touched = s.t
    _pitch_towards(s, s.of(ap.PITCH), 0.0)

    def slow() -> bool:
        _throttle(s, 0.0)
        runway.steer()
        bank_at(s, 0.0)
        if s.of(ap.AIRSPEED) > 0.5 * ground.final_mps:
            # not below the attitude of the parked aircraft: the nose wheel carries no weight yet
            _pitch_towards(s, wheels.parked_pitch, math.radians(1.5))
        else:
            _hands_off(s)
        on = wheels.wheels_down() > 1
        wheels.brake(ground.brake * min(1.0, max(0.0, (s.t - touched - BRAKE_AFTER_S) / BRAKE_OVER_S)) if on else 0.0)
        return math.hypot(s.v_north, s.v_east) < STOPPED_MPS

    yield from until(s, slow, 40.0, "a standstill")
    wheels.brake(1.0)


GENERATORS: dict[type, Generator] = {
    cfg.Park: _park,
    cfg.LineUp: _line_up,
    cfg.TakeOff: _take_off,
    cfg.Approach: _approach,
    cfg.Land: _land,
}
