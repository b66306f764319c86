"""Plans as QGroundControl writes them, for tests: made of items, or with the points of a sample that others made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

SAMPLE_HOME = [47.3977507, 8.5456075, 488.93101752001763]
SAMPLE_POINTS = [[47.39777106, 8.5466122, 50], [47.39827377, 8.54660532, 50], [47.39827842, 8.54560824, 50]]
"""Home and waypoints of the sample plan of MAVSDK (cpp/src/mavsdk/plugins/mission_raw/test_plans), a multirotor's."""


def item(command: int, parameters: list[Any], frame: int = 3) -> dict[str, Any]:
    """A simple item."""
    return {"autoContinue": True, "command": command, "frame": frame, "params": parameters, "type": "SimpleItem"}


def waypoint(place: list[float], radius: float = 0.0, hold: float = 0.0) -> dict[str, Any]:
    """A waypoint above home."""
    return item(16, [hold, radius, 0, None, *place])


def plan(items: list[Any], home: list[float] = SAMPLE_HOME, **mission: Any) -> dict[str, Any]:
    """A whole plan, numbered as QGroundControl does."""
    for number, entry in enumerate(items, 1):
        if isinstance(entry, dict):
            entry["doJumpId"] = number
    head = {"cruiseSpeed": 30, "hoverSpeed": 5, "firmwareType": 12, "vehicleType": 2, "version": 2}
    return {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "groundStation": "QGroundControl",
        "mission": head | {"items": items, "plannedHomePosition": home} | mission,
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }


def sample(last: list[dict[str, Any]] | None = None) -> dict[str, Any]:
    """MAVSDK's sample: take-off, three waypoints with a camera command among them, return to launch (or ``last``)."""
    first, *rest = (waypoint(point) for point in SAMPLE_POINTS)
    take_off = item(22, [15, 0, 0, None, *SAMPLE_HOME[:2], 50])
    pictures, back = item(2000, [0, 0, 1, 0, 0, 0, 0], frame=2), item(20, [0] * 7, frame=2)
    return plan([take_off, first, pictures, *rest, *([back] if last is None else last)])


def written(folder: Path, content: dict[str, Any]) -> str:
    """Path of a file that holds it."""
    path = folder / "mission.plan"
    path.write_text(json.dumps(content))
    return str(path)
