"""A flight's script: what of it can be flown at all, and the way through its manoeuvres. SI units and radians."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from testbed.base.errors import FlightError, TestbedError, tell_user
from testbed.data.records import Phase
from testbed.flight import manoeuvres, paths
from testbed.flight.aircraft import Aircraft
from testbed.flight.config import AnyManoeuvre, FlightConfig, Loiter
from testbed.physics.earth import G0

FEWEST_SAMPLES = 4
"""The spline through the velocities needs as many knots (de Boor, chapter IV, not-a-knot ends)."""
MOST_SAMPLES = 2e7
"""A sample of the truth has 30 columns: with more, a flight needs above 5 GB of memory."""
ABOUT_S = 90.0
"""What a take-off, an approach or a landing takes, in the estimate of a flight's length."""
LONG_S = 20_000.0
"""A longer flight takes above half a minute (about 1000 s of flight in 1 s), which is announced."""


GENERATORS = manoeuvres.GENERATORS | paths.GENERATORS
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


def check_script(config: FlightConfig, aircraft: Aircraft) -> None:
    """Refuse what the aircraft cannot do before it takes off: speeds, banks, loads and climbs beyond its limits."""
    name, limits, speed = config.aircraft, aircraft.limits, config.initial.speed_mps
    check_length(config, manoeuvres.expected_duration(config))
    _check_speed("initial", name, aircraft, speed)
    for number, m in enumerate(config.manoeuvres, 1):
        place = f"manoeuvre {number} of {len(config.manoeuvres)} ({m.type})"
        if type(m) not in GENERATORS:
            raise FlightError(f"{place}: '{name}' is an aeroplane and cannot do this")
        for point in getattr(m, "points", []):
            if point.hold_s is not None or point.heading_deg is not None:
                raise FlightError(f"{place}: hold_s and heading_deg of a point are for multirotors, not for '{name}'")
            if point.speed_mps is not None:
                _check_speed(place, name, aircraft, point.speed_mps)
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
