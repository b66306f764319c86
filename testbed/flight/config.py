"""What a flight is asked to be (``[flight]`` of a scenario): aircraft, initial state, wind, a list of manoeuvres, or a plan.

The manoeuvre language is this project's own. Angles in degrees, speeds are true airspeeds in m/s, heights are above the
WGS-84 ellipsoid in metres; positive bank and `right` turn to the right, positive climb rates go up.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from testbed.base.schema import Table
from testbed.flight.manoeuvre_config import AnyManoeuvre, Duration


class InitialFlightState(Table):
    """``[flight.initial]``: where the flight starts, level and trimmed in the air, or parked on a runway at ``alt_m``."""

    lat_deg: float = Field(default=45.0, ge=-85, le=85)
    """Geodetic latitude."""
    lon_deg: float = Field(default=10.0, ge=-180, le=180)
    """Longitude, positive east."""
    alt_m: float = Field(default=1000.0, ge=0, le=30_000)
    """Height above the ellipsoid."""
    speed_mps: float = Field(default=0.0, ge=0, le=1000)
    """True airspeed; the aircraft is trimmed for it."""
    heading_deg: float = Field(default=0.0, ge=-360, le=360)
    """From true north, clockwise."""
    parked: bool | None = Field(default=None, description="On the ground, which lies at alt_m, with brakes set")

    @model_validator(mode="after")
    def _moves_or_stands(self) -> InitialFlightState:
        if self.parked and self.speed_mps:
            raise ValueError("a parked aircraft has no speed_mps; remove one of the two")
        return self


class Wind(Table):
    """``[flight.wind]``: steady wind (the velocity of the air over ground) and Dryden turbulence."""

    north_mps: float = Field(default=0.0, ge=-60, le=60)
    """Towards north."""
    east_mps: float = Field(default=0.0, ge=-60, le=60)
    """Towards east."""
    down_mps: float = Field(default=0.0, ge=-20, le=20)
    """Downwards."""
    turbulence: Literal["none", "light", "moderate", "severe"] = "none"
    """Strength of the Dryden gusts, in the classes of MIL-F-8785C."""
    seed: int | None = Field(default=None, ge=0)
    """Turbulence seed; without it the seed of the flight."""


class FlightConfig(Table):
    """``[flight]``: who flies what. ``duration_s`` cuts the script short, or ends it with straight flight."""

    type: Literal["jsbsim"] = Field(default="jsbsim", exclude=True, description="Who makes the motion: JSBSim")
    aircraft: str
    """Name of a shipped one, or a folder of the user's own: anything with a ``/``, from the scenario's folder on."""
    rate_hz: float = Field(default=100.0, ge=10, le=1000)
    """Rows of the truth per second."""
    duration_s: Duration | None = None
    """Length of the flight; default: until the last manoeuvre ends."""
    payload_kg: float = Field(default=0.0, ge=0, le=100_000)
    """Mass added at the centre of gravity."""
    initial: InitialFlightState
    wind: Wind = Wind()
    manoeuvres: list[AnyManoeuvre] = Field(min_length=1)
    plan: str | None = Field(
        default=None,
        exclude=True,
        description="A mission of QGroundControl (.plan, from the scenario's folder on) in place of initial and manoeuvres",
    )
    plan_skip: list[Annotated[int, Field(ge=1)]] = Field(
        default=[], exclude=True, description="Numbers of items of the plan that are left out, from 1 on"
    )
    plan_undulation_m: float = Field(
        default=0.0,
        ge=-200,
        le=200,
        exclude=True,
        description="Height of mean sea level, which a plan's heights count from, above the ellipsoid, m",
    )

    @model_validator(mode="before")
    @classmethod
    def _from_plan(cls, data: Any, info: ValidationInfo) -> Any:
        """The keys that a plan stands for; `testbed.flight.mission` says how."""
        if not isinstance(data, Mapping) or not isinstance(data.get("plan"), str):
            return data
        return _planned(dict(data), (info.context or {}).get("folder"))

    @field_validator("aircraft")
    @classmethod
    def _from_folder(cls, value: str, info: ValidationInfo) -> str:
        return _resolved(value, (info.context or {}).get("folder"))


def _resolved(aircraft: str, folder: Path | None) -> str:
    return str((folder / aircraft).resolve()) if "/" in aircraft and folder is not None else aircraft


def _planned(data: dict[str, Any], folder: Path | None) -> dict[str, Any]:
    """``[flight]`` with initial state and manoeuvres from its plan; keys of ``[flight.initial]`` stand above the plan's."""
    if "manoeuvres" in data:
        raise ValueError("plan and manoeuvres exclude each other; remove one of the two")
    aircraft, own, skip = data.get("aircraft"), data.get("initial", {}), data.get("plan_skip", [])
    numbers = {
        "undulation_m": data.get("plan_undulation_m", 0.0),
        "duration_s": data.get("duration_s"),
        "speed_mps": own.get("speed_mps") if isinstance(own, Mapping) else None,
    }
    plain = isinstance(aircraft, str) and isinstance(own, Mapping) and isinstance(skip, list)
    if not plain or not all(value is None or type(value) in (int, float) for value in numbers.values()):
        return data | {
            "manoeuvres": [{"type": "straight", "duration_s": 1.0}]
        }  # the wrong key is told by its own check
    # this reads kernels of the Earth, which are not needed to read a scenario without a plan
    from testbed.flight.aircraft import load_aircraft
    from testbed.flight.mission import Choices, mission_keys

    path = Path(data["plan"]) if folder is None else folder / data["plan"]
    flown, _ = load_aircraft(_resolved(str(aircraft), folder))
    left_out = frozenset(number for number in skip if type(number) is int)
    keys = mission_keys(path, flown, Choices(left_out, **numbers, heading_given="heading_deg" in own))
    return data | keys | {"initial": keys["initial"] | dict(own)}
