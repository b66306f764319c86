"""Flight scripts that several tests fly: one per aircraft, and the shapes of the papers' flights.

Plain data as a scenario holds it under ``[flight]``.
"""

from __future__ import annotations

import functools
import math
from typing import Any

from testbed.base.schema import validate
from testbed.data.records import Trajectory
from testbed.flight import FlightConfig, fly_flight


def flight(aircraft: str, speed: float, *manoeuvres: dict[str, Any], alt: float = 1000.0, **keys: Any) -> FlightConfig:
    """A checked flight north from 45°N 10°E."""
    initial = {"lat_deg": 45.0, "lon_deg": 10.0, "alt_m": alt, "speed_mps": speed, "heading_deg": 0.0}
    data = {"aircraft": aircraft, "initial": initial, "manoeuvres": list(manoeuvres)} | keys
    return validate(FlightConfig, data, "flight")


def turn(bank: float, duration: float, **keys: Any) -> dict[str, Any]:
    """A turn for a time."""
    return {"type": "turn", "bank_deg": bank, "duration_s": duration} | keys


def straight(duration: float) -> dict[str, Any]:
    """Straight flight for a time."""
    return {"type": "straight", "duration_s": duration}


def hard(rate_hz: float = 100.0) -> FlightConfig:
    """300 s of high-g turns, climbs and reversals of the agile aircraft in turbulence."""
    block = [
        turn(72.0, 25.0),
        turn(-75.0, 25.0, climb_rate_mps=20.0),
        {"type": "s_turn", "bank_deg": 70.0, "heading_change_deg": 100.0, "duration_s": 30.0, "speed_mps": 250.0},
        turn(74.0, 20.0, climb_rate_mps=-20.0, speed_mps=225.0),
    ]
    wind = {"north_mps": 5.0, "east_mps": -4.0, "turbulence": "light", "seed": 3}
    return flight("agile", 225.0, *(block * 3), alt=3000.0, rate_hz=rate_hz, duration_s=300.0, wind=wind)


def transport(bank: float = 45.0) -> FlightConfig:
    """150 s of an airliner: turns both ways, acceleration, climb, descent."""
    script = (
        straight(10.0),
        turn(bank, 22.0),
        {"type": "accelerate", "to_speed_mps": 165.0},
        {"type": "climb", "climb_rate_mps": 8.0, "duration_s": 18.0},
        turn(-bank, 24.0),
        {"type": "descent", "climb_rate_mps": 8.0, "duration_s": 16.0},
    )
    wind = {"turbulence": "light", "seed": 2}
    return flight("transport", 150.0, *script, alt=2500.0, duration_s=150.0, wind=wind)


def circuit(aircraft: str, **keys: Any) -> FlightConfig:
    """A whole flight from and to a runway of heading 70: parked, line-up, take-off, right-hand circuit, approach, landing."""
    speed, height, leg = (120.0, 400.0, 7000.0) if aircraft == "transport" else (45.0, 150.0, 1500.0)
    along, right = ((math.cos(math.radians(a)), math.sin(math.radians(a))) for a in (70.0, 160.0))
    corners = ((2.0, 0.0), (2.0, 1.0))
    points = [{"north_m": leg * (x * along[0] + y * right[0]), "east_m": leg * (x * along[1] + y * right[1])} for x, y in corners]  # fmt: skip
    script = [
        {"type": "park", "duration_s": 70.0},
        {"type": "line_up", "to_heading_deg": 70.0},
        {"type": "take_off"},
        {"type": "climb", "climb_rate_mps": 0.055 * speed, "to_alt_m": 500.0 + height, "speed_mps": speed},
        {"type": "waypoints", "radius_m": 0.25 * leg, "points": points},
        {"type": "approach"},
        {"type": "land"},
        {"type": "park", "duration_s": 20.0},
    ]
    initial = {"parked": True, "lat_deg": 47.0, "lon_deg": 11.0, "alt_m": 500.0, "heading_deg": 20.0}
    return validate(FlightConfig, {"aircraft": aircraft, "initial": initial, "manoeuvres": script} | keys, "flight")


@functools.cache
def whole_flight(aircraft: str) -> Trajectory:
    """`circuit` flown, at 200 Hz."""
    return fly_flight(circuit(aircraft, rate_hz=200.0), 1, use_cache=False)


def coordinated_rate(bank_deg: float, speed: float) -> float:
    """Turn rate (rad/s) of a level coordinated turn: g tan(bank) / speed."""
    return 9.80665 * math.tan(math.radians(bank_deg)) / speed
