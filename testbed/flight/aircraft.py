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
    leave_out: list[str] = []
    """Of a shipped model only: files of systems that the copy which is loaded goes without, as the model names them."""
    stand_in: dict[Property, float] = {}
    """Properties that exist before the model is loaded, for parts that read what was left out."""
    external_thrust: bool = False
    """The model has no JSBSim engine that needs to be started."""


class Motor(Table):
    """``[[model.motors]]``: a motor of a multirotor, and what its command adds to the moments."""

    name: str = Field(min_length=1, max_length=40, description="Where it sits")
    property: Annotated[Property, Field(description="The model's input of its command, 0 to 1")]
    roll: float = Field(ge=-1, le=1, description="Share of the roll command that it takes, right side down positive")
    pitch: float = Field(ge=-1, le=1, description="Share of the pitch command that it takes, nose up positive")
    yaw: float = Field(ge=-1, le=1, description="Share of the yaw command that it takes, to the right positive")


class MultirotorModel(Model):
    """``[model]`` of a multirotor."""

    motors: list[Motor] = Field(min_length=3, max_length=16)


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


CONTROL_RATES = (50.0, 100.0, 200.0, 400.0)
"""Hz: parts of JSBSim's rate of 400 Hz, and multiples of guidance (10 Hz) and of the recorded air data (25 Hz)."""


def _control_rate(rate_hz: float) -> float:
    if rate_hz not in CONTROL_RATES:
        raise ValueError(f"an autopilot ticks at one of {', '.join(f'{rate:g}' for rate in CONTROL_RATES)} Hz")
    return rate_hz


ControlRate = Annotated[float, AfterValidator(_control_rate)]


class Autopilot(Table):
    """``[autopilot]``: gains; the meaning of each is in `autopilot_kernels`."""

    speed_nominal_mps: Positive
    rate_hz: ControlRate = 50.0
    """An aeroplane's fastest loop, its roll rate, is some 10 rad/s wide: five ticks and more per radian of it."""
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
    """``aircraft.toml`` of an aeroplane."""

    type: Literal["fixed-wing"] = "fixed-wing"
    title: str
    source: str
    model: Model
    limits: Limits
    autopilot: Autopilot
    ground: Ground | None = None


class MultirotorLimits(Table):
    """``[limits]`` of a multirotor: what guidance keeps to, and beyond what a flight is refused."""

    speed_max_mps: Positive = Field(description="Fastest over ground, m/s")
    climb_max_mps: Positive = Field(description="Fastest climb, m/s")
    descent_max_mps: Positive = Field(description="Fastest descent, m/s: faster ones sink into the rotors' own wake")
    tilt_max_deg: float = Field(gt=0, le=60, description="Largest tilt that is commanded, °")
    acceleration_mps2: Positive = Field(description="Of changes of speed, m/s²")


class Cascade(Table):
    """``[autopilot]`` of a multirotor: gains from the outer loop to the inner one, see `multirotor_kernels`."""

    speed_nominal_mps: Positive = Field(description="Speed where a manoeuvre gives none, m/s")
    rate_hz: ControlRate = Field(description="Ticks per second, Hz")
    hover_throttle: float = Field(gt=0, lt=1, description="Command that carries the weight at sea level, 0 to 1")
    position: Positive = Field(description="Speed per distance, 1/s")
    velocity: Positive = Field(description="Acceleration per error of velocity, 1/s")
    velocity_integral: float = Field(ge=0, description="Its integral, 1/s²")
    attitude: Positive = Field(description="Rate per error of roll and pitch, 1/s")
    rate_limit_dps: Positive = Field(description="Largest rate of roll and pitch, °/s")
    rate: Positive = Field(description="Command per error of the rate of roll and pitch, s/rad")
    rate_integral: float = Field(ge=0, description="Integral of the three rate loops, 1/rad")
    heading: Positive = Field(description="Rate per error of heading, 1/s")
    yaw_rate: Positive = Field(description="Command per error of the yaw rate, s/rad")
    yaw_rate_limit_dps: Positive = Field(description="Largest yaw rate, °/s")


class Multirotor(Table):
    """``aircraft.toml`` of a multirotor."""

    type: Literal["multirotor"]
    title: str
    source: str
    model: MultirotorModel
    limits: MultirotorLimits
    autopilot: Cascade


AnyAircraft = Aircraft | Multirotor


def list_aircraft() -> list[str]:
    """Names of the aircraft that can fly."""
    return sorted(path.parent.name for path in aircraft_root().glob("*/aircraft.toml"))


def load_aircraft(name: str) -> tuple[AnyAircraft, Path]:
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
    file = folder / "aircraft.toml"
    data = read_toml(file)
    kind: type[Aircraft] | type[Multirotor] = Multirotor if data.get("type") == "multirotor" else Aircraft
    aircraft: AnyAircraft = validate(kind, data, str(file))
    if not aircraft.model.shipped:
        for key in ("corrections", "leave_out"):
            if getattr(aircraft.model, key):
                raise InputError(f"{file}: 'model.{key}' is for models of the jsbsim package")
        check_model(folder, aircraft.model.jsbsim)
    return aircraft, folder
