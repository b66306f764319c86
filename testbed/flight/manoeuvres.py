"""The manoeuvres: each is a generator that sets autopilot targets about ten times a second and returns when it is done.

Guidance laws: Beard and McLain, *Small Unmanned Aircraft*, chapter 10 (orbit and waypoint following). Positions are
metres north and east of the start of the flight; angles in radians, positive bank to the right.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import FlightError
from testbed.flight import autopilot_kernels as ap
from testbed.flight import manoeuvre_config as cfg
from testbed.flight.aircraft import Aircraft
from testbed.flight.undercarriage import Undercarriage
from testbed.physics.earth import G0

ROLL_OUT_LAG_S = 0.4
"""How long the bank loop lags behind its ramp: heading that a turn still gains after it is told to end."""
Generator = Callable[..., Iterator[None]]
PATIENCE = 3.0
"""A manoeuvre that takes this many times what it should, and a minute more, has failed."""


@dataclass(kw_only=True)
class Journey:
    """Where a flight is in time and place, whatever flies."""

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Latitude, longitude (rad) and height (m) where the flight starts."""
    metres: tuple[float, float] = (0.0, 0.0)
    """Metres per radian of latitude and longitude there."""
    t: float = 0.0
    begin: float = 0.0
    """Planned start of the manoeuvre: the planned end of the one before, not the tick at which it was noticed."""
    north: float = 0.0
    east: float = 0.0
    v_north: float = 0.0
    v_east: float = 0.0
    end: float = field(default=0.0)

    @property
    def course(self) -> float:
        """Direction of the velocity over ground, rad."""
        return math.atan2(self.v_east, self.v_north)


@dataclass
class Situation(Journey):
    """What guidance sees and sets: the time, the measurements of the autopilot, the place, and the targets."""

    aircraft: Aircraft
    measured: memoryview[float] | NDArray[np.float64]
    target: NDArray[np.float64]
    undercarriage: Undercarriage | None = None
    runway: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """North and east (m) of the place where the last take-off began, and its heading (rad)."""
    throttle: float = 0.0
    """Its last command."""
    low: bool = False
    """On the ground, or so close above it that what is a fault elsewhere is none."""

    def of(self, index: int) -> float:
        """A measurement by its kernel index."""
        return float(self.measured[index])

    @property
    def turn_rate(self) -> float:
        """Rate of turn (rad/s) that the bank brings."""
        return G0 * math.tan(self.of(ap.ROLL)) / max(self.of(ap.AIRSPEED), 1.0)


def wrap(angle: float) -> float:
    """Angle (rad) into [-pi, pi), in plain Python: a compiled call costs more here."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def guide(manoeuvre: cfg.Manoeuvre, s: Situation, generator: Generator) -> Iterator[None]:
    """Run one manoeuvre: yields once per guidance tick, returns when it is done, raises FlightError when it cannot."""
    limits, target = s.aircraft.limits, s.target
    target[ap.BANK_LIMIT] = math.radians(0.6 * limits.bank_max_deg)
    target[ap.ACCELERATION] = limits.acceleration_mps2
    target[[ap.AILERON_OFFSET, ap.ELEVATOR_OFFSET, ap.RUDDER_OFFSET, ap.THROTTLE_MODE, ap.STEERING]] = 0.0
    s.low = isinstance(manoeuvre, cfg.ON_THE_GROUND)
    if manoeuvre.speed_mps is not None:
        target[ap.SPEED] = manoeuvre.speed_mps
    _hold_level(s)
    s.end = math.nan
    yield from generator(manoeuvre, s)
    if math.isnan(s.end):
        s.end = s.t
    s.begin = s.end


def _hold_level(s: Situation) -> None:
    s.target[ap.LATERAL_MODE] = ap.HOLD_HEADING
    s.target[ap.VERTICAL_MODE] = ap.HOLD_ALTITUDE


def during(s: Journey, duration_s: float) -> Iterator[None]:
    """Wait until a duration since the planned start is over."""
    s.end = s.begin + duration_s
    while s.t < s.end - 1e-9:
        yield


def until(s: Journey, done: Callable[[], bool], expected_s: float, goal: str) -> Iterator[None]:
    """Wait until ``done()``; FlightError when it takes much longer than expected."""
    latest = s.t + PATIENCE * expected_s + 60.0
    while not done():
        if s.t > latest:
            raise FlightError(f"did not reach {goal} within {latest - s.begin:.0f} s")
        yield


def _straight(m: cfg.Straight, s: Situation) -> Iterator[None]:
    yield from during(s, m.duration_s)


def climb_while_turning(m: cfg.Climbing, s: Situation) -> None:
    if m.climb_rate_mps is not None:
        s.target[ap.VERTICAL_MODE] = ap.HOLD_CLIMB
        s.target[ap.CLIMB] = m.climb_rate_mps


def level_off(m: cfg.Climbing, s: Situation) -> None:
    if m.climb_rate_mps is not None:
        s.target[ap.ALTITUDE] = s.of(ap.HEIGHT) + height_lead(s, m.climb_rate_mps)
    s.target[ap.VERTICAL_MODE] = ap.HOLD_ALTITUDE


def height_lead(s: Situation, climb_rate: float) -> float:
    """Height still gained when the climb rate fades with the altitude loop's time constant."""
    return climb_rate / s.aircraft.autopilot.altitude


def bank_at(s: Situation, bank: float) -> None:
    s.target[ap.LATERAL_MODE] = ap.HOLD_BANK
    s.target[ap.BANK] = bank


def roll_out_lead(s: Situation) -> float:
    """Heading (rad) that the turn still gains while the wings come level."""
    seconds = 0.5 * abs(s.of(ap.ROLL)) / math.radians(s.aircraft.autopilot.roll_rate_limit_dps) + ROLL_OUT_LAG_S
    return s.turn_rate * seconds


class _Swept:
    """Heading swept since the start (rad), without wrapping."""

    def __init__(self, s: Situation) -> None:
        self.s, self.last, self.total = s, s.of(ap.YAW), 0.0

    def __call__(self) -> float:
        yaw = self.s.of(ap.YAW)
        self.total += wrap(yaw - self.last)
        self.last = yaw
        return self.total


def _seconds_of_turn(s: Situation, angle: float, bank: float) -> float:
    return abs(angle) * max(s.of(ap.AIRSPEED), 1.0) / (G0 * math.tan(abs(bank)))


def _turn(m: cfg.Turn, s: Situation) -> Iterator[None]:
    climb_while_turning(m, s)
    bank = math.radians(m.bank_deg)
    bank_at(s, bank)
    if m.duration_s is not None:
        yield from during(s, m.duration_s)
        s.target[ap.HEADING] = wrap(s.of(ap.YAW) + roll_out_lead(s))
    else:
        side, start = math.copysign(1.0, bank), s.of(ap.YAW)
        if m.heading_change_deg is not None:
            change = math.radians(m.heading_change_deg)
        else:
            change = (side * (math.radians(m.to_heading_deg or 0.0) - start)) % (2.0 * math.pi)
        swept = _Swept(s)
        near = lambda: side * (swept() + roll_out_lead(s)) >= change  # noqa: E731
        yield from until(s, near, _seconds_of_turn(s, change, bank), f"a heading change of {math.degrees(change):.0f}°")
        s.target[ap.HEADING] = wrap(start + side * change)
        _hold_level_laterally(s, bank)

        def settled() -> bool:
            off = abs(wrap(s.target[ap.HEADING] - s.of(ap.YAW)))
            return off < math.radians(3) and abs(s.of(ap.ROLL)) < math.radians(8)

        yield from until(s, settled, 20.0, f"heading {math.degrees(s.target[ap.HEADING]) % 360:.0f}°")
    level_off(m, s)


def _hold_level_laterally(s: Situation, bank: float) -> None:
    s.target[ap.LATERAL_MODE] = ap.HOLD_HEADING
    s.target[ap.BANK_LIMIT] = abs(bank)


def _vertical(m: cfg.Climb | cfg.Descent, s: Situation) -> Iterator[None]:
    up = 1.0 if isinstance(m, cfg.Climb) else -1.0

    def rate() -> float:
        if m.climb_rate_mps is not None:
            return up * m.climb_rate_mps
        return up * s.of(ap.AIRSPEED) * math.sin(math.radians(m.path_angle_deg or 0.0))

    s.target[ap.VERTICAL_MODE] = ap.HOLD_CLIMB
    s.target[ap.CLIMB] = rate()
    if m.duration_s is not None:
        for _ in during(s, m.duration_s):
            s.target[ap.CLIMB] = rate()
            yield
        s.target[ap.ALTITUDE] = s.of(ap.HEIGHT) + height_lead(s, s.of(ap.CLIMB_RATE))
        return
    goal = float(m.to_alt_m or 0.0)
    if up * (goal - s.of(ap.HEIGHT)) < -5.0:
        raise FlightError(f"to_alt_m {goal:.0f} lies on the wrong side: the height is {s.of(ap.HEIGHT):.0f} m")

    def near() -> bool:
        s.target[ap.CLIMB] = rate()
        return up * (goal - s.of(ap.HEIGHT)) <= abs(height_lead(s, rate()))

    expected = abs(goal - s.of(ap.HEIGHT)) / abs(rate()) + 5.0 / s.aircraft.autopilot.altitude
    yield from until(s, near, expected, f"a height of {goal:.0f} m")
    s.target[ap.ALTITUDE] = goal
    s.target[ap.VERTICAL_MODE] = ap.HOLD_ALTITUDE
    level = lambda: abs(goal - s.of(ap.HEIGHT)) < 1.0 + 0.1 * abs(height_lead(s, rate()))  # noqa: E731
    yield from until(s, level, expected, f"a height of {goal:.0f} m")


def _s_turn(m: cfg.STurn, s: Situation) -> Iterator[None]:
    half = 0.5 * math.radians(m.heading_change_deg)
    yield from _alternate(m, s, first=half, later=2.0 * half, count=m.legs)
    # the heading target is still the one from before


def _figure_eight(m: cfg.FigureEight, s: Situation) -> Iterator[None]:
    yield from _alternate(m, s, first=2.0 * math.pi, later=2.0 * math.pi, count=m.circles)


def _alternate(
    m: cfg.STurn | cfg.FigureEight, s: Situation, first: float, later: float, count: int | None
) -> Iterator[None]:
    """Bank to one side until the heading has swept an angle, then to the other, a number of times or for a duration."""
    climb_while_turning(m, s)
    bank = math.radians(m.bank_deg)
    seconds = _seconds_of_turn(s, later, bank) + 4.0 * abs(bank) / math.radians(
        s.aircraft.autopilot.roll_rate_limit_dps
    )
    if m.duration_s is not None:
        s.end = s.begin + m.duration_s
    leg = 0
    while count is None or leg < count:
        bank_at(s, bank if leg % 2 == 0 else -bank)
        side, swept = math.copysign(1.0, s.target[ap.BANK]), _Swept(s)
        angle = first if leg == 0 else later
        done = lambda side=side, swept=swept, angle=angle: (  # noqa: E731
            side * (swept() + roll_out_lead(s)) >= angle or s.t >= s.end - 1e-9
        )
        yield from until(s, done, seconds, f"the end of leg {leg + 1}")
        if s.t >= s.end - 1e-9:
            break
        leg += 1
    level_off(m, s)


def _change_speed(m: cfg.Accelerate | cfg.Decelerate, s: Situation) -> Iterator[None]:
    up = 1.0 if isinstance(m, cfg.Accelerate) else -1.0
    now = s.of(ap.AIRSPEED)
    if up * (m.to_speed_mps - now) < -0.05 * now:
        raise FlightError(f"to_speed_mps {m.to_speed_mps:g} lies on the wrong side: the speed is {now:.1f} m/s")
    if m.acceleration_mps2 is not None:
        s.target[ap.ACCELERATION] = m.acceleration_mps2
    s.target[ap.SPEED] = m.to_speed_mps
    tolerance = max(0.3, 0.01 * m.to_speed_mps)
    done = lambda: up * (m.to_speed_mps - s.of(ap.AIRSPEED)) < tolerance  # noqa: E731
    expected = abs(m.to_speed_mps - now) / float(s.target[ap.ACCELERATION])
    yield from until(s, done, expected, f"a speed of {m.to_speed_mps:g} m/s (it flies {now:.1f} m/s at the start)")


def _doublet(m: cfg.Doublet, s: Situation) -> Iterator[None]:
    index = {"aileron": ap.AILERON_OFFSET, "elevator": ap.ELEVATOR_OFFSET, "rudder": ap.RUDDER_OFFSET}[m.surface]
    for _ in during(s, m.duration_s):
        since = s.t - s.begin
        side = 1.0 if since < 0.5 * m.period_s else -1.0
        s.target[index] = side * m.amplitude if since < m.period_s else 0.0
        yield
    s.target[index] = 0.0


def local(point: cfg.Waypoint, s: Journey) -> tuple[float, float]:
    if point.north_m is not None and point.east_m is not None:
        return point.north_m, point.east_m
    north = math.radians(point.lat_deg or 0.0) - s.origin[0]
    east = wrap(math.radians(point.lon_deg or 0.0) - s.origin[1])
    return north * s.metres[0], east * s.metres[1]


GENERATORS: dict[type, Generator] = {
    cfg.Straight: _straight,
    cfg.Turn: _turn,
    cfg.Climb: _vertical,
    cfg.Descent: _vertical,
    cfg.STurn: _s_turn,
    cfg.FigureEight: _figure_eight,
    cfg.Accelerate: _change_speed,
    cfg.Decelerate: _change_speed,
    cfg.Doublet: _doublet,
}
