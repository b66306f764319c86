"""Motion scripts of car, rover and pedestrian, ``[flight] type = "drive"``: what JSBSim does not fly, as pure kinematics.

The middle of the rear axle moves along the track and the body looks along it: no side slip, no suspension, level across.
Every change of speed, heading or slope follows the same smooth step, so that acceleration and its rate are continuous. A
walker's trunk rises and falls at every step and sways at every other (`Gait`); a wheel may slip as it pulls. Truth comes
from the splines of `testbed.flight.truth`, as for flights. Angles in degrees in the keys; SI units and radians inside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from testbed.base.errors import FlightError
from testbed.base.schema import Table

if TYPE_CHECKING:
    from testbed.data.records import Array, Trajectory

Speed = Annotated[float, Field(gt=0, le=100)]
STANDSTILL = 1e-9
"""m/s: below it a vehicle stands."""
FULL_STRIDE_MPS = 1.0
"""Speed from which on a walker's steps are of full height."""
HILL_EDGE = 0.2
"""Share of a stretch with a grade over which the slope builds up, and again over which it goes."""


class DriveStart(Table):
    """``[flight.initial]`` of a drive."""

    lat_deg: float = Field(default=45.0, ge=-85, le=85, description="Latitude, °")
    lon_deg: float = Field(default=10.0, ge=-180, le=180, description="Longitude, °")
    alt_m: float = Field(default=200.0, ge=-500, le=9000, description="Height above the ellipsoid, m")
    speed_mps: float = Field(default=0.0, ge=0, le=100, description="Speed along the track, m/s")
    heading_deg: float = Field(default=0.0, ge=-360, le=360, description="Heading from north, clockwise, °")


class _Part(Table):
    name: str = Field(default="", max_length=60, description="Name of the phase; default: the type")

    @property
    def label(self) -> str:
        """The name of its phase."""
        return self.name or self.type  # type: ignore[attr-defined]


class StraightRoad(_Part):
    """Keep speed and heading; over a hill, if there is a grade, that begins and ends level."""

    type: Literal["straight"]
    duration_s: float = Field(gt=0, le=200_000, description="How long, s")
    grade_pct: float = Field(
        default=0.0, ge=-40, le=40, description="Slope in the middle of the stretch, positive up, %"
    )


class Bend(_Part):
    """Turn by an angle; the curvature rises to that of the tightest radius in the middle, and falls."""

    type: Literal["turn"]
    radius_m: float = Field(gt=0, le=100_000, description="Tightest radius, m")
    heading_change_deg: float = Field(gt=0, le=36_000, description="By how much, °")
    direction: Literal["left", "right"] = Field(default="right", description="Side")


class SpeedChange(_Part):
    """Speed up or slow down to a speed; the acceleration is largest in the middle."""

    type: Literal["accelerate"]
    to_speed_mps: Speed = Field(description="Speed at the end, m/s")
    acceleration_mps2: float = Field(default=2.0, gt=0, le=20, description="Largest size of the acceleration, m/s²")


class Stop(_Part):
    """Brake to a standstill, and stand."""

    type: Literal["stop"]
    duration_s: float = Field(default=5.0, ge=0, le=200_000, description="How long to stand, s")
    acceleration_mps2: float = Field(default=2.0, gt=0, le=20, description="Largest deceleration, m/s²")


class Spin(_Part):
    """Turn on the spot, as rovers with a wheel on each side and walkers do; needs a standstill."""

    type: Literal["spin"]
    heading_change_deg: float = Field(gt=0, le=36_000, description="By how much, °")
    rate_dps: float = Field(default=60.0, gt=0, le=360, description="Largest rate, in the middle of the turn, °/s")
    direction: Literal["left", "right"] = Field(default="right", description="Side")


AnyPart = Annotated[StraightRoad | Bend | SpeedChange | Stop | Spin, Field(discriminator="type")]


class Gait(Table):
    """``[flight.gait]``: how the trunk of a walker moves about its way, while it walks.

    Defaults: an adult at 1.4 m/s takes 1.9 steps per second, and the trunk rises and falls by 4 cm and sways by as much
    (Zijlstra and Hof, Gait and Posture 18, 2003); it nods and rolls by about 2 degrees.
    """

    step_rate_hz: float = Field(default=1.9, gt=0.2, le=5, description="Steps per second, Hz")
    bounce_m: float = Field(default=0.02, ge=0, le=0.2, description="Amplitude up and down, once per step, m")
    sway_m: float = Field(default=0.02, ge=0, le=0.2, description="Amplitude to the sides, once per two steps, m")
    pitch_deg: float = Field(default=2.0, ge=0, le=20, description="Amplitude of the nod, once per step, °")
    roll_deg: float = Field(default=2.0, ge=0, le=20, description="Amplitude of the roll, once per two steps, °")


class DriveConfig(Table):
    """``[flight]`` with ``type = "drive"``: who drives what."""

    type: Literal["drive"]
    vehicle: str = Field(default="car", max_length=60, description="Its name in tables")
    rate_hz: float = Field(default=100.0, ge=10, le=1000, description="Rows of the truth per second, Hz")
    initial: DriveStart = DriveStart()
    manoeuvres: list[AnyPart] = Field(min_length=1, description="What it does, one after the other")
    laps: int = Field(default=1, ge=1, le=1000, description="How often it does all that")
    wheelbase_m: float = Field(
        default=2.7, gt=0, le=20, description="From axle to axle, for the steering angle; a middle-class car's, m"
    )
    slip_pct: float = Field(
        default=0.0,
        ge=-20,
        le=20,
        description="By how much the wheels turn too fast at an acceleration of 1 m/s² (too slow when braking), %; "
        "0.3 on dry asphalt, some per cent on gravel",
    )
    gait: Gait | None = Field(default=None, description="Of a walker; wheels have none")


@dataclass(frozen=True)
class Leg:
    """A stretch of time over which speed, heading or path angle take one smooth step (or none)."""

    name: str
    duration: float
    speed: tuple[float, float]
    heading: tuple[float, float]
    slope: float = 0.0


def drive(config: DriveConfig) -> Trajectory:
    """The truth of a drive. Raises FlightError for what a vehicle cannot do."""
    from testbed.data.records import Phase
    from testbed.flight.truth import make_trajectory

    legs = plan(config)
    ends = np.cumsum([leg.duration for leg in legs])
    t = np.arange(math.floor(ends[-1] * config.rate_hz + 1e-6) + 1) / config.rate_hz
    if len(t) < 4:
        raise FlightError(f"a drive of {ends[-1]:.3g} s is too short")
    motion = _motion(legs, ends, t)
    v_n, euler = _along_the_track(motion) if config.gait is None else _walk(motion, t, config.gait)
    start = config.initial
    place = (math.radians(start.lat_deg), math.radians(start.lon_deg), start.alt_m)
    phases: list[Phase] = []
    for leg, end in zip(legs, ends, strict=True):
        begin = phases[-1].end if phases else 0.0
        if phases and phases[-1].name == leg.name and leg.speed == (0.0, 0.0):  # a stop brakes, then stands
            begin = phases.pop().start
        phases.append(Phase(leg.name, begin, float(min(end, t[-1]))))
    extra = {"speed_mps": motion.speed}
    if config.gait is None:
        # Ackermann: the tangent of the steering angle is the wheelbase over the radius
        moving = motion.speed > STANDSTILL
        curvature = np.divide(motion.turn_rate, motion.speed, out=np.zeros(len(t)), where=moving)
        slip = 0.01 * config.slip_pct * motion.acceleration
        extra |= {
            "wheel_slip": slip,
            "wheel_speed_mps": motion.speed * (1.0 + slip),
            "steering_deg": np.degrees(np.arctan(config.wheelbase_m * curvature)),
        }
    return make_trajectory(v_n, euler, config.rate_hz, place, extra, tuple(phases), config.vehicle)


def plan(config: DriveConfig) -> list[Leg]:
    """The manoeuvres as legs. Raises FlightError that names the manoeuvre which cannot be driven."""
    speed, heading = config.initial.speed_mps, math.radians(config.initial.heading_deg)
    legs: list[Leg] = []
    for k, part in enumerate(config.manoeuvres * config.laps):
        lap, number = divmod(k, len(config.manoeuvres))
        place = f"manoeuvre {number + 1} of {len(config.manoeuvres)} ({part.type})" + (
            f" in lap {lap + 1}" if lap else ""
        )
        if isinstance(part, SpeedChange | Stop):
            wanted = part.to_speed_mps if isinstance(part, SpeedChange) else 0.0
            # the smooth step is steepest in its middle, twice its mean: 2 dv / T = the largest acceleration
            if (needed := 2.0 * abs(wanted - speed) / part.acceleration_mps2) > 0.0:
                legs.append(Leg(part.label, needed, (speed, wanted), (heading, heading)))
            speed = wanted
            if isinstance(part, Stop) and part.duration_s:
                legs.append(Leg(part.label, part.duration_s, (0.0, 0.0), (heading, heading)))
            continue
        if isinstance(part, StraightRoad):
            if part.grade_pct and speed <= STANDSTILL:
                raise FlightError(f"{place}: grade_pct needs a moving vehicle; accelerate first")
            slope = math.atan(0.01 * part.grade_pct)
            legs.append(Leg(part.label, part.duration_s, (speed, speed), (heading, heading), slope))
            continue
        change = math.radians(part.heading_change_deg)
        end = heading + math.copysign(change, 1.0 if part.direction == "right" else -1.0)
        if isinstance(part, Spin):
            if speed > STANDSTILL:
                raise FlightError(f"{place}: a spin begins and ends at a standstill; stop first")
            needed = 2.0 * change / math.radians(part.rate_dps)
        elif speed <= STANDSTILL:
            raise FlightError(f"{place}: a vehicle that stands cannot turn; accelerate first")
        else:
            needed = 2.0 * change * part.radius_m / speed
        legs.append(Leg(part.label, needed, (speed, speed), (heading, end)))
        heading = end
    if not legs:
        raise FlightError("the drive does nothing: its manoeuvres change neither speed nor place, and take no time")
    return legs


def smooth_step(x: Array) -> Array:
    """From 0 at x = 0 to 1 at x = 1: x - sin(2 pi x) / (2 pi), whose first two derivatives vanish at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x - np.sin(2.0 * np.pi * x) / (2.0 * np.pi)


def smooth_rate(x: Array) -> Array:
    """Derivative of `smooth_step`."""
    return 1.0 - np.cos(2.0 * np.pi * np.clip(x, 0.0, 1.0))


class Motion(NamedTuple):
    """At the rows of the truth, all (N,): speed (m/s), heading, path angle (rad), and the rates of the first two."""

    speed: Array
    heading: Array
    slope: Array
    acceleration: Array
    turn_rate: Array


def _motion(legs: list[Leg], ends: Array, t: Array) -> Motion:
    out = Motion(*(np.zeros(len(t)) for _ in Motion._fields))
    which = np.minimum(np.searchsorted(ends, t, side="right"), len(legs) - 1)
    for k, leg in enumerate(legs):
        rows = slice(*np.searchsorted(which, [k, k + 1]))
        x = (t[rows] - (ends[k] - leg.duration)) / leg.duration
        step, rate = smooth_step(x), smooth_rate(x) / leg.duration
        out.speed[rows] = leg.speed[0] + step * (leg.speed[1] - leg.speed[0])
        out.acceleration[rows] = rate * (leg.speed[1] - leg.speed[0])
        out.heading[rows] = leg.heading[0] + step * (leg.heading[1] - leg.heading[0])
        out.turn_rate[rows] = rate * (leg.heading[1] - leg.heading[0])
        if leg.slope:
            out.slope[rows] = leg.slope * smooth_step(x / HILL_EDGE) * smooth_step((1.0 - x) / HILL_EDGE)
    return out


def _along_the_track(motion: Motion) -> tuple[Array, Array]:
    """Velocity in n (N,3) and Euler angles (N,3) of a body that looks along its way."""
    level = motion.speed * np.cos(motion.slope)
    v_n = np.column_stack(
        [level * np.cos(motion.heading), level * np.sin(motion.heading), -motion.speed * np.sin(motion.slope)]
    )
    return v_n, np.column_stack([np.zeros(len(level)), motion.slope, motion.heading])


def _walk(motion: Motion, t: Array, gait: Gait) -> tuple[Array, Array]:
    """`_along_the_track` upright, with the movements of the trunk: full above `FULL_STRIDE_MPS`, none at a standstill."""
    v_n, euler = _along_the_track(motion)
    share = smooth_step(motion.speed / FULL_STRIDE_MPS)
    step, stride = 2.0 * np.pi * gait.step_rate_hz, np.pi * gait.step_rate_hz
    sideways = share * gait.sway_m * stride * np.cos(stride * t)
    v_n[:, 0] -= sideways * np.sin(motion.heading)
    v_n[:, 1] += sideways * np.cos(motion.heading)
    v_n[:, 2] += share * gait.bounce_m * step * np.cos(step * t)
    euler[:, 0] = share * math.radians(gait.roll_deg) * np.sin(stride * t)
    euler[:, 1] = share * math.radians(gait.pitch_deg) * np.sin(step * t)
    return v_n, euler
