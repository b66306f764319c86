"""The aircraft folders: which JSBSim model flies, how the autopilot is tuned, and what the aircraft can stand.

``aircraft/<name>/aircraft.toml`` names a model that the jsbsim package ships, or one whose XML lies beside it. Angles
in the file are in degrees where the key says so, else SI and radians.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from testbed.base.errors import InputError, nearest, shown
from testbed.base.resources import aircraft_root
from testbed.base.schema import Table, read_toml, validate
from testbed.flight.models import Correction, check_model, files_of

Positive = Annotated[float, Field(gt=0)]
_STEP = r"[A-Za-z_][A-Za-z0-9_.-]*(\[[0-9]{1,3}\])?"
_PROPERTY = re.compile(f"{_STEP}(/{_STEP})*")


def _property(name: str) -> str:
    if len(name) > 200 or not _PROPERTY.fullmatch(name):
        raise ValueError("not a name in JSBSim's property tree (like propulsion/engine[0]/n1)")
    return name


Property = Annotated[str, AfterValidator(_property)]
"""A name in JSBSim's property tree; JSBSim aborts on a malformed one."""


class Model(Table):
    """``[model]``: the JSBSim model and where it keeps what the bench reads and sets."""

    jsbsim: str = Field(pattern=r"^[A-Za-z0-9_+-][A-Za-z0-9_.+-]*$")
    shipped: bool
    """True for a model of the jsbsim package, false for XML in this folder."""
    engine_property: Property
    """Engine speed, or what stands for it; times ``engine_scale`` it is in revolutions per minute."""
    engine_scale: Positive = 1.0
    engines: int = Field(default=1, ge=1, le=100)
    payload_property: Property | Literal[""] = ""
    """Weight in pounds that a payload adds to."""
    setup: dict[Property, float] = Field(default={})
    """Properties set once after loading: gear up, flaps."""
    alpha_deg: float = 3.0
    """Incidence at which the settling before a flight starts."""
    corrections: list[Correction] = []
    """Of a shipped model only: XML of one's own is corrected where it stands."""
    external_thrust: bool = False
    """The model has no JSBSim engine that needs to be started."""


class Limits(Table):
    """``[limits]``: beyond these the flight is refused or has failed."""

    speed_min_mps: Positive
    speed_max_mps: Positive
    bank_max_deg: Positive
    load_factor_max: Positive
    load_factor_min: float
    alpha_max_deg: Positive
    """The autopilot keeps below this incidence."""
    alpha_stall_deg: Positive
    climb_max_mps: Positive
    acceleration_mps2: Positive


class Autopilot(Table):
    """``[autopilot]``: gains; the meaning of each is in `autopilot_kernels`."""

    speed_nominal_mps: Positive
    roll_angle: Positive
    roll_rate: Positive
    roll_rate_integral: float
    roll_rate_feedforward: float
    roll_rate_limit_dps: Positive
    pitch_rate: Positive
    pitch_rate_integral: float
    load_feedforward: float
    sideslip: float
    yaw_rate: float
    yaw_feedforward: float
    heading: Positive
    altitude: Positive
    climb: Positive
    climb_integral: float
    climb_acceleration_mps2: Positive
    speed: Positive
    speed_integral: float
    thrust_to_weight: Positive
    throttle_trim: float
    elevator_trim: float = 0.0
    """Pull (0 to 1) at nominal speed, where the integral starts."""


Share = Annotated[float, Field(ge=0, le=1)]


class Ground(Table):
    """``[ground]``: how an aircraft takes off and lands; one without it stays in the air."""

    taxi_mps: Positive
    rotate_mps: Positive
    """Airspeed at which the nose comes up."""
    rotate_pitch_deg: Positive
    climb_mps: Positive
    """Airspeed of the first climb."""
    climb_rate_mps: Positive
    final_mps: Positive
    """Airspeed of the approach."""
    flare_m: Positive
    """Height of the wheels at which the descent begins to fade, with the time constant ``flare_s``, to ``sink_mps``."""
    flare_s: Positive
    sink_mps: Positive
    flaps_take_off: Share
    flaps_approach: Share
    flaps_landing: Share
    retracts: bool
    """The gear goes up after take-off."""
    brake: Share
    """Of the brakes in the landing roll."""
    pitch_angle: Positive
    """Pitch rate per pitch error, 1/s."""
    pitch_rate_limit_dps: Positive
    steer_heading: Positive
    """Nose wheel and rudder (shares of their range) per rad of heading error, and per rad/s of yaw rate."""
    steer_rate: Positive
    steer_full_mps: Positive
    """Above this speed the nose wheel is turned less, by the ratio."""


class Aircraft(Table):
    """``aircraft.toml``."""

    title: str
    source: str
    model: Model
    limits: Limits
    autopilot: Autopilot
    ground: Ground | None = None


def list_aircraft() -> list[str]:
    """Names of the aircraft that can fly."""
    return sorted(path.parent.name for path in aircraft_root().glob("*/aircraft.toml"))


def load_aircraft(name: str) -> tuple[Aircraft, Path]:
    """The checked ``aircraft.toml`` and its folder, of a shipped aircraft or of a folder (a name with a ``/``).

    Raises InputError with the nearest name.
    """
    if "/" in name:
        folder = Path(name)
        files_of(folder)
    else:
        names = list_aircraft()
        if name not in names:
            raise InputError(f"unknown aircraft {shown(name)}; {nearest(name, names)}; a folder of your own is ./NAME")
        folder = aircraft_root() / name
    aircraft = validate(Aircraft, read_toml(folder / "aircraft.toml"), str(folder / "aircraft.toml"))
    if not aircraft.model.shipped:
        if aircraft.model.corrections:
            raise InputError(f"{folder / 'aircraft.toml'}: 'model.corrections' is for models of the jsbsim package")
        check_model(folder, aircraft.model.jsbsim)
    return aircraft, folder
