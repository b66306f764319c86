"""Drives that several tests look at."""

from testbed.base.schema import validate
from testbed.flight.drive import DriveConfig, drive

TOWN = [
    {"type": "accelerate", "to_speed_mps": 14.0, "acceleration_mps2": 3.0},
    {"type": "turn", "radius_m": 12.0, "heading_change_deg": 90.0},
    {"type": "straight", "duration_s": 20.0, "grade_pct": 8.0},
    {"type": "turn", "radius_m": 30.0, "heading_change_deg": 135.0, "direction": "left"},
    {"type": "stop", "duration_s": 6.0},
    {"type": "accelerate", "to_speed_mps": 5.0},
    {"type": "straight", "duration_s": 10.0},
]


def made(*parts, **keys):
    return drive(validate(DriveConfig, {"type": "drive", "manoeuvres": list(parts)} | keys, "drive"))
