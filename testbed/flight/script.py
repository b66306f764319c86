"""A flight's script: what of it can be flown at all, and the way through its manoeuvres. SI units and radians."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from testbed.base.errors import FlightError, InputError, TestbedError, tell_user
from testbed.data.records import Phase
from testbed.flight import ground, manoeuvres, paths
from testbed.flight import manoeuvre_config as cfg
from testbed.flight.aircraft import Aircraft
from testbed.flight.config import FlightConfig, InitialFlightState
from testbed.flight.manoeuvre_config import AnyManoeuvre, Approach, Land, LineUp, Loiter, Park, TakeOff
from testbed.physics.earth import G0
from testbed.physics.earth import A as EARTH_RADIUS

FEWEST_SAMPLES = 4
"""The spline through the velocities needs as many knots (de Boor, chapter IV, not-a-knot ends)."""
MOST_SAMPLES = 2e7
"""A sample of the truth has 30 columns: with more, a flight needs above 5 GB of memory."""
ABOUT_S = 90.0
"""What a take-off, an approach or a landing takes, in the estimate of a flight's length."""
ABOUT_MPS = 50.0
"""Speed of a flight that began parked, in that estimate, until a manoeuvre states one."""
LOWEST_CLIMB_M = 30.0
"""Of a take-off: the gear is up and the climb is established."""
LONG_S = 20_000.0
"""A longer flight takes above half a minute (about 1000 s of flight in 1 s), which is announced."""


GENERATORS = manoeuvres.GENERATORS | paths.GENERATORS | ground.GENERATORS
"""What an aeroplane can do."""
Guide = Callable[[AnyManoeuvre], Iterator[None]]
"""Starts a manoeuvre, which then yields at each tick of guidance."""


def script_duration(config: FlightConfig) -> float | None:
    """Length of the flight (s) where the script fixes it, else None."""
    if config.duration_s is not None:
        return config.duration_s
    durations = [None if getattr(m, "centre", None) else getattr(m, "duration_s", None) for m in config.manoeuvres]
    return None if None in durations else float(sum(durations))  # type: ignore[arg-type]


def check_length(config: FlightConfig, about_s: float) -> None:
    """Refuse a flight that is too long or too short; ``about_s`` is how long its script takes where nothing fixes it."""
    duration = script_duration(config)
    expected = about_s if duration is None else duration
    if expected * config.rate_hz > MOST_SAMPLES:
        raise FlightError(
            f"a flight of about {expected:.3g} s at {config.rate_hz:g} Hz has more than the {MOST_SAMPLES:.0e} samples that are kept"
        )
    if expected > LONG_S:
        tell_user(f"the flight lasts about {expected:.0f} s; that takes its time")
    if duration is not None and round(duration * config.rate_hz) + 1 < FEWEST_SAMPLES:
        raise FlightError(
            f"a flight of {duration:g} s at {config.rate_hz:g} Hz is too short: it needs {FEWEST_SAMPLES} samples"
        )


def expected_duration(config: FlightConfig) -> float:
    """About how long the script takes (s), from durations, and from speed, bank and distance where it ends by those."""
    total, speed = 0.0, config.initial.speed_mps
    place = (0.0, 0.0)
    for m in config.manoeuvres:
        speed = m.speed_mps or speed or ABOUT_MPS
        turn = speed / (G0 * math.tan(math.radians(abs(getattr(m, "bank_deg", 45.0)))))
        if (duration := getattr(m, "duration_s", None)) is not None:
            total += duration
        elif isinstance(m, cfg.Turn):
            total += turn * math.radians(m.heading_change_deg or 360.0)
        elif isinstance(m, cfg.STurn):
            total += turn * math.radians(m.heading_change_deg) * (m.legs or 0)
        elif isinstance(m, cfg.FigureEight):
            total += turn * 2.0 * math.pi * (m.circles or 0)
        elif isinstance(m, cfg.Loiter):
            total += 2.0 * math.pi * m.radius_m * (m.turns or 0.0) / speed
        elif isinstance(m, cfg.LineUp | cfg.TakeOff | cfg.Approach | cfg.Land):
            total += ABOUT_S
        elif isinstance(m, cfg.Waypoints):
            for point in m.points:
                to = about(point, config.initial)
                total += math.dist(place, to) / speed
                place = to
        speed = getattr(m, "to_speed_mps", None) or speed
    return total


def about(point: cfg.Waypoint, start: InitialFlightState) -> tuple[float, float]:
    """A waypoint north and east of the start (m), on a sphere."""
    if point.north_m is not None and point.east_m is not None:
        return point.north_m, point.east_m
    north = math.radians((point.lat_deg or 0.0) - start.lat_deg)
    east = manoeuvres.wrap(math.radians((point.lon_deg or 0.0) - start.lon_deg)) * math.cos(math.radians(start.lat_deg))
    return north * EARTH_RADIUS, east * EARTH_RADIUS


def check_script(config: FlightConfig, aircraft: Aircraft) -> None:
    """Refuse what the aircraft cannot do before it takes off: speeds, banks, loads and climbs beyond its limits."""
    name, limits, speed = config.aircraft, aircraft.limits, config.initial.speed_mps
    for number, m in enumerate(config.manoeuvres, 1):
        if type(m) not in GENERATORS:
            raise FlightError(
                f"manoeuvre {number} of {len(config.manoeuvres)} ({m.type}): '{name}' is an aeroplane and cannot do this"
            )
    check_length(config, expected_duration(config))
    if not config.initial.parked:
        if speed == 0.0:
            raise InputError(
                f"initial: a flight of '{name}' that begins in the air needs speed_mps above 0; on the ground say parked = true"
            )
        _check_speed("initial", name, aircraft, speed)
    _check_ground(config, aircraft)
    for number, m in enumerate(config.manoeuvres, 1):
        place = f"manoeuvre {number} of {len(config.manoeuvres)} ({m.type})"
        if isinstance(m, TakeOff) and m.to_height_m < LOWEST_CLIMB_M:
            raise FlightError(f"{place}: '{name}' climbs straight ahead to {LOWEST_CLIMB_M:g} m at least (to_height_m)")
        for point in getattr(m, "points", []):
            if point.hold_s is not None or point.heading_deg is not None:
                raise FlightError(f"{place}: hold_s and heading_deg of a point are for multirotors, not for '{name}'")
            if point.speed_mps is not None:
                _check_speed(place, name, aircraft, point.speed_mps)
        if aircraft.ground is not None and isinstance(m, TakeOff | Approach):
            speed = aircraft.ground.climb_mps if isinstance(m, TakeOff) else aircraft.ground.final_mps
        wanted = getattr(m, "to_speed_mps", None) or m.speed_mps
        if wanted is not None:
            _check_speed(place, name, aircraft, wanted)
            speed = wanted
        bank = abs(getattr(m, "bank_deg", 0.0))
        if isinstance(m, Loiter):
            bank = math.degrees(math.atan(speed * speed / (G0 * m.radius_m)))
        load = 1.0 / math.cos(math.radians(bank))
        if bank > limits.bank_max_deg or load > limits.load_factor_max:
            raise FlightError(
                f"{place}: needs {bank:.0f}° of bank and {load:.1f} g at {speed:g} m/s, but '{name}' stands "
                f"{limits.bank_max_deg:g}° and {limits.load_factor_max:g} g"
            )
        climb = abs(getattr(m, "climb_rate_mps", None) or 0.0)
        if angle := getattr(m, "path_angle_deg", None):
            climb = speed * math.sin(math.radians(angle))
        if climb > limits.climb_max_mps:
            raise FlightError(
                f"{place}: {climb:.1f} m/s up or down, but '{name}' climbs and descends at most {limits.climb_max_mps:g} m/s"
            )


def _check_ground(config: FlightConfig, aircraft: Aircraft) -> None:
    """Refuse what does not follow each other: on the ground an aircraft parks, lines up and takes off, in the air it flies,
    and after an approach it lands."""
    name, where = config.aircraft, "on the ground" if config.initial.parked else "in the air"
    if config.initial.parked and aircraft.ground is None:
        raise FlightError(f"initial: '{name}' does not stand on a runway: its aircraft.toml has no [ground]")
    took_off = False
    for number, m in enumerate(config.manoeuvres, 1):
        begins = "on the ground" if isinstance(m, Park | LineUp | TakeOff) else "in the air"
        if isinstance(m, Land):
            begins = "on final approach"
        if where != begins and not (where == "on final approach" and begins == "in the air"):
            raise FlightError(
                f"manoeuvre {number} of {len(config.manoeuvres)} ({m.type}): it begins {begins}, but here '{name}' is {where}"
            )
        took_off = took_off or isinstance(m, TakeOff)
        if isinstance(m, Approach) and not took_off:
            raise FlightError(
                f"manoeuvre {number} of {len(config.manoeuvres)} (approach): only a flight that began parked knows its ground"
            )
        where = {Approach: "on final approach", Land: "on the ground", Park: where, LineUp: where}.get(
            type(m), "in the air"
        )


def _check_speed(place: str, name: str, aircraft: Aircraft, speed: float) -> None:
    low, high = aircraft.limits.speed_min_mps, aircraft.limits.speed_max_mps
    if not low <= speed <= high:
        raise FlightError(f"{place}: speed {speed:g} m/s, but '{name}' flies {low:g} to {high:g} m/s")


class Script:
    """Goes through the manoeuvres, keeps their phases, and names the current one in errors."""

    def __init__(
        self,
        config: FlightConfig,
        situation: manoeuvres.Journey,
        guide: Guide,
        rest: AnyManoeuvre,
    ) -> None:
        self.config, self.s, self.guide = config, situation, guide
        self.rest = rest
        """What a flight does that is longer than its script."""
        self.number = 0
        self.current: Iterator[None] | None = None
        self.begins: list[float] = []
        self.labels: list[str] = []

    @property
    def _now(self) -> str:
        total = len(self.config.manoeuvres)
        if self.number > total:
            return f"after manoeuvre {total} of {total} ({self.rest.type})"
        return f"manoeuvre {self.number} of {total} ({self.config.manoeuvres[self.number - 1].type})"

    @property
    def manoeuvre(self) -> AnyManoeuvre:
        """The current manoeuvre."""
        total = len(self.config.manoeuvres)
        return self.rest if self.number > total else self.config.manoeuvres[max(0, self.number - 1)]

    def fail(self, what: str) -> None:
        """Raise FlightError with place and time."""
        raise FlightError(f"{self._now} at t = {self.s.t:.1f} s: '{self.config.aircraft}' {what}")

    def advance(self, open_ended: bool) -> bool:
        """One guidance tick; False when the script is over and the flight may end."""
        while True:
            try:
                if self.current is not None:
                    next(self.current)
                    return True
            except StopIteration:
                self.current = None
            except TestbedError as error:
                self.fail(str(error))
            if self.number >= len(self.config.manoeuvres):
                if not open_ended:
                    return False
                self._begin(self.rest)
            else:
                self._begin(self.config.manoeuvres[self.number])

    def _begin(self, manoeuvre: AnyManoeuvre) -> None:
        self.number += 1
        self.current = self.guide(manoeuvre)
        self.begins.append(self.s.begin)
        self.labels.append(manoeuvre.label)

    def phases(self, end: float) -> tuple[Phase, ...]:
        """One phase per manoeuvre, cut at the end of the flight."""
        stops = [*self.begins[1:], end]
        pairs = zip(self.labels, self.begins, stops, strict=True)
        return tuple(Phase(label, begin, min(stop, end)) for label, begin, stop in pairs if begin < end)
