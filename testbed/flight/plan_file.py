"""Reading a mission as QGroundControl keeps it: a ``.plan`` file (JSON, file format version 1 with a mission of version 2).

What a command's seven parameters mean is MAVLink's ``MAV_CMD``. Every number is checked here, so that what follows works with
finite ones; whatever is wrong is one InputError that names the file and the item.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from testbed.base.errors import InputError, shown

TAKE_OFF, WAYPOINT, LOITER, LOITER_TURNS, LOITER_TIME, LAND, SPEED = 22, 16, 17, 18, 19, 21, 178
NAMES = {
    16: "waypoint",
    17: "loiter for ever",
    18: "loiter turns",
    19: "loiter time",
    20: "return to launch",
    21: "land",
    22: "take-off",
    31: "loiter to altitude",
    82: "spline waypoint",
    84: "VTOL take-off",
    85: "VTOL land",
    93: "delay",
    112: "condition delay",
    114: "condition distance",
    115: "condition yaw",
    177: "jump",
    178: "change speed",
    189: "start of a landing",
    195: "region of interest",
    201: "region of interest",
    206: "camera trigger distance",
    530: "camera mode",
    2000: "take pictures",
    2500: "record a video",
    3000: "VTOL transition",
}
"""Of MAVLink's commands what they do, for messages; those of the first line of constants are flown."""
ABSOLUTE, NO_PLACE, RELATIVE, TERRAIN = (0, 5), (2,), (3, 6), (10, 11)
"""MAVLink's frames, each with its twin for integers."""
MOST_BYTES, MOST_ITEMS = 10_000_000, 2000
PARAMETERS = 7
LATITUDE_DEG, HEIGHT_M = 85.0, 30_000.0
"""What the bench flies at all."""


class Item(NamedTuple):
    """One command of a mission; parameters that are null are None."""

    number: int
    """Its place in the mission, from 1 on, as QGroundControl shows it."""
    command: int
    frame: int
    parameters: tuple[float | None, ...]
    place: str
    """How messages call it."""

    def value(self, index: int) -> float:
        """Parameter ``index`` (1 to 7), 0 where it is not given."""
        found = self.parameters[index - 1]
        return 0.0 if found is None else found

    def fail(self, what: str) -> NoReturn:
        """Raise InputError about this item."""
        raise InputError(f"{self.place}: {what}")


class Plan(NamedTuple):
    """A mission."""

    file: str
    home: tuple[float, float, float]
    """Latitude and longitude, degrees, and height above mean sea level, m."""
    cruise_mps: float | None
    hover_mps: float | None
    items: tuple[Item, ...]
    unflown: tuple[str, ...]
    """What the file holds beside the mission: fences, rally points."""


def read_plan(path: Path, skip: frozenset[int]) -> Plan:
    """The mission of a file, without the items whose numbers are in ``skip``. Raises InputError."""
    data = _load(path)
    file = str(path)
    if not isinstance(data, dict) or data.get("fileType") != "Plan" or not isinstance(data.get("mission"), dict):
        raise InputError(f'{file}: not a plan of QGroundControl: it needs fileType = "Plan" and a mission')
    mission = data["mission"]
    if mission.get("version") != 2:
        raise InputError(f"{file}: the mission has version {shown(mission.get('version'))}; 2 is read")
    listed = mission.get("items")
    if not isinstance(listed, list) or not 1 <= len(listed) <= MOST_ITEMS:
        raise InputError(f"{file}: 'mission.items' should be a list of 1 to {MOST_ITEMS} items")
    if beyond := sorted(number for number in skip if not 1 <= number <= len(listed)):
        raise InputError(f"{file}: plan_skip names item {beyond[0]}, but the plan has items 1 to {len(listed)}")
    items = [_item(file, k, raw) for k, raw in enumerate(listed, 1) if k not in skip]
    if not items:
        raise InputError(f"{file}: plan_skip leaves no item to fly")
    unflown = [
        text
        for text, key, lists in (
            ("fence", "geoFence", ("circles", "polygons")),
            ("rally point", "rallyPoints", ("points",)),
        )
        if isinstance(data.get(key), dict) and any(data[key].get(name) for name in lists)
    ]
    return Plan(
        file,
        _home(file, mission),
        _speed(file, mission, "cruiseSpeed"),
        _speed(file, mission, "hoverSpeed"),
        tuple(items),
        tuple(unflown),
    )


def _load(path: Path) -> Any:
    def refuse(text: str) -> NoReturn:
        raise InputError(f"{path}: {text} is no number that a plan can hold")

    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise InputError(
                f"{path}: not a plan: it has {size / 1e6:.0f} MB, above the {MOST_BYTES / 1e6:.0f} MB that are read"
            )
        return json.loads(path.read_bytes().decode(), parse_constant=refuse)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start} of the file)") from None
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: not JSON: line {error.lineno}: {error.msg}") from None
    except RecursionError:
        raise InputError(f"{path}: not a plan: nested too deep") from None
    except ValueError as error:  # an integer of thousands of digits, a name with a zero byte
        raise InputError(f"{shown(str(path))}: cannot be read ({error})") from None


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{what} should be a number, got {shown(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise InputError(f"{what} should be a finite number")
    return number


def _home(file: str, mission: dict[str, Any]) -> tuple[float, float, float]:
    raw = mission.get("plannedHomePosition")
    if not isinstance(raw, list) or len(raw) != 3:
        raise InputError(f"{file}: 'mission.plannedHomePosition' should be [latitude, longitude, height]")
    what = f"{file}: 'mission.plannedHomePosition'"
    lat, lon, height = (_number(value, what) for value in raw)
    _check_place(what, lat, lon)
    _check_height(what, height)
    return lat, lon, height


def _check_place(what: str, lat: float, lon: float) -> None:
    if abs(lat) > LATITUDE_DEG or abs(lon) > 180.0:
        raise InputError(
            f"{what}: {lat:g}, {lon:g} is no place that is flown: latitudes within ±{LATITUDE_DEG:g}°, longitudes within ±180°"
        )


def _check_height(what: str, height: float) -> None:
    if not 0.0 <= height <= HEIGHT_M:
        raise InputError(f"{what}: a height of {height:g} m; 0 to {HEIGHT_M:g} m are flown")


def _speed(file: str, mission: dict[str, Any], key: str) -> float | None:
    if mission.get(key) is None:
        return None
    speed = _number(mission[key], f"{file}: 'mission.{key}'")
    if not 0.0 < speed <= 1000.0:
        raise InputError(f"{file}: 'mission.{key}' should be above 0 and at most 1000 m/s, got {speed:g}")
    return speed


def _item(file: str, number: int, raw: Any) -> Item:
    place = f"{file}: item {number}"
    if not isinstance(raw, dict):
        raise InputError(f"{place}: should be an object, got {shown(raw)}")
    if raw.get("type") != "SimpleItem":
        kind = raw.get("complexItemType", raw.get("type"))
        raise InputError(f"{place}: {shown(kind)} is not flown; {_without(number)}")
    command = raw.get("command")
    if isinstance(command, bool) or not isinstance(command, int):
        raise InputError(f"{place}: 'command' should be an integer, got {shown(command)}")
    place = f"{place} ({NAMES.get(command, 'command')}, {shown(command)})"
    frame = raw.get("frame")
    if isinstance(frame, bool) or not isinstance(frame, int):
        raise InputError(f"{place}: 'frame' should be an integer, got {shown(frame)}")
    listed = raw.get("params")
    if not isinstance(listed, list) or len(listed) != PARAMETERS:
        raise InputError(f"{place}: 'params' should be a list of {PARAMETERS} numbers or null")
    parameters = tuple(
        None if value is None else _number(value, f"{place}: parameter {k}") for k, value in enumerate(listed, 1)
    )
    return Item(number, command, frame, parameters, place)


def _without(number: int) -> str:
    return f"take it out of the plan, or leave it out with plan_skip = [{number}]"


def refuse_command(item: Item) -> NoReturn:
    """Raise InputError for a command that is not flown."""
    item.fail(f"this command is not flown; {_without(item.number)}")


def place_of(item: Item, plan: Plan, undulation_m: float) -> tuple[float, float, float]:
    """Latitude and longitude, degrees, and height above the ellipsoid, m, of an item with a place. Raises InputError.

    ``undulation_m`` is the height of mean sea level above the ellipsoid, which a plan does not know.
    """
    lat, lon, alt = item.parameters[4:]
    if item.frame in TERRAIN:
        item.fail(
            "its height is above the terrain (frame 10), and the bench has no terrain; use heights relative to home"
        )
    if item.frame not in ABSOLUTE + RELATIVE:
        item.fail(f"frame {item.frame} is not flown; 0 (above mean sea level) and 3 (above home) are")
    if lat is None or lon is None or alt is None:
        item.fail("latitude, longitude and height (parameters 5, 6, 7) are needed")
    height = alt + undulation_m + (plan.home[2] if item.frame in RELATIVE else 0.0)
    _check_place(item.place, lat, lon)
    _check_height(item.place, height)
    return lat, lon, height
