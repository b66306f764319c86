"""Flight scripts that several tests fly: one per aircraft, and the shapes of the papers' flights.

Plain data as a scenario holds it under ``[flight]``.
"""

from __future__ import annotations

import math
from typing import Any

from testbed.base.schema import validate
from testbed.flight import FlightConfig


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


def coordinated_rate(bank_deg: float, speed: float) -> float:
    """Turn rate (rad/s) of a level coordinated turn: g tan(bank) / speed."""
    return 9.80665 * math.tan(math.radians(bank_deg)) / speed
