"""The manoeuvre language of a flight's script (``[[flight.manoeuvres]]``), this project's own.

Angles in degrees, speeds are true airspeeds in m/s, heights are above the WGS-84 ellipsoid in metres; positive bank and
`right` turn to the right, positive climb rates go up.
"""

from __future__ import annotations

import typing
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from testbed.base.schema import Name, Table

Metres = Annotated[float, Field(ge=-2e7, le=2e7)]
"""Half around the Earth to either side."""
Duration = Annotated[float, Field(gt=0, le=200_000)]
Speed = Annotated[float, Field(gt=0, le=1000)]
Bank = Annotated[float, Field(ge=-85, le=85)]
Direction = Literal["left", "right"]


def _not_level(bank_deg: float) -> float:
    if abs(bank_deg) < 1.0:
        raise ValueError("must be at least 1 degree to either side")
    return bank_deg


class Manoeuvre(Table):
    """Keys that every manoeuvre has. A new speed target holds until the next one."""

    ends: ClassVar[tuple[str, ...]] = ()
    """Names of the keys of which exactly one says when the manoeuvre ends."""

    name: Annotated[Name, Field(max_length=60)] = ""
    """Name of its phase in tables and figures; default: its type."""
    speed_mps: Speed | None = None
    """True airspeed to hold from here on; default: the one before."""

    @model_validator(mode="after")
    def _one_end(self) -> Manoeuvre:
        given = [key for key in self.ends if getattr(self, key) is not None]
        if self.ends and len(given) != 1:
            which = f"not {' and '.join(given)}" if given else "none is given"
            raise ValueError(f"it ends by exactly one of {', '.join(self.ends)}; {which}")
        return self

    @property
    def label(self) -> str:
        """The name of its phase."""
        return self.name or self.type  # type: ignore[attr-defined]


class Climbing(Manoeuvre):
    """Keys of the turning manoeuvres, which may climb or descend meanwhile (positive up)."""

    climb_rate_mps: float | None = Field(default=None, ge=-200, le=200)
    """Climb meanwhile, positive up; default: level."""


class Straight(Manoeuvre):
    """Hold heading, height and speed."""

    type: Literal["straight"]
    duration_s: Duration
    """How long."""


class Turn(Climbing):
    """Turn at a bank angle (the sign gives the side) for a time, by an angle, or to a heading."""

    type: Literal["turn"]
    bank_deg: Bank
    """Bank angle to hold; positive turns to the right."""
    duration_s: Duration | None = None
    """Ends it after this time."""
    heading_change_deg: float | None = Field(default=None, gt=0, le=36_000)
    """Ends it after turning by this angle."""
    to_heading_deg: float | None = Field(default=None, ge=-360, le=360)
    """Ends it at this heading."""
    ends: ClassVar[tuple[str, ...]] = ("duration_s", "heading_change_deg", "to_heading_deg")

    @field_validator("bank_deg")
    @classmethod
    def _banked(cls, value: float) -> float:
        return _not_level(value)


class _Vertical(Manoeuvre):
    climb_rate_mps: Annotated[float, Field(gt=0, le=200)] | None = None
    """Vertical speed, positive in a descent, too."""
    path_angle_deg: Annotated[float, Field(gt=0, le=60)] | None = None
    """Instead: angle of the path against the horizon, positive in a descent, too."""
    to_alt_m: float | None = Field(default=None, ge=0, le=30_000)
    """Ends it at this height above the ellipsoid."""
    duration_s: Duration | None = None
    """Ends it after this time."""
    ends: ClassVar[tuple[str, ...]] = ("to_alt_m", "duration_s")

    @model_validator(mode="after")
    def _one_rate(self) -> _Vertical:
        if (self.climb_rate_mps is None) == (self.path_angle_deg is None):
            raise ValueError("give exactly one of climb_rate_mps and path_angle_deg (both positive)")
        return self


class Climb(_Vertical):
    """Climb, at a rate or a path angle (one of them), to a height or for a time."""

    type: Literal["climb"]


class Descent(_Vertical):
    """Descend, at a rate or a path angle (one of them, positive), to a height or for a time."""

    type: Literal["descent"]


class Waypoint(Table):
    """A point to overfly: north and east of the start in metres, or latitude and longitude."""

    north_m: Metres | None = None
    """North of the start."""
    east_m: Metres | None = None
    """East of the start."""
    lat_deg: float | None = Field(default=None, ge=-85, le=85)
    """Instead: latitude."""
    lon_deg: float | None = Field(default=None, ge=-180, le=180)
    """With it: longitude."""
    alt_m: float | None = Field(default=None, ge=0, le=30_000)
    """Height above the ellipsoid; default: the one before."""
    radius_m: float | None = Field(default=None, gt=0, le=100_000)
    """Reached when passed within it; default that of the manoeuvre."""
    speed_mps: Speed | None = None
    """From here on, on the way to this point first."""
    hold_s: Duration | None = None
    """Multirotors: hover at the point."""
    heading_deg: float | None = Field(default=None, ge=-360, le=360)
    """Multirotors: heading on the way; default along it."""

    @model_validator(mode="after")
    def _one_frame(self) -> Waypoint:
        local = self.north_m is not None and self.east_m is not None
        geodetic = self.lat_deg is not None and self.lon_deg is not None
        given = sum(v is not None for v in (self.north_m, self.east_m, self.lat_deg, self.lon_deg))
        if local == geodetic or given != 2:
            raise ValueError("a waypoint needs either north_m and east_m or lat_deg and lon_deg")
        return self


class Loiter(Climbing):
    """Circle at a radius over the ground, around a centre, or around the point abeam at the start."""

    type: Literal["loiter"]
    radius_m: float = Field(gt=0, le=100_000)
    """Radius of the circle over the ground."""
    direction: Direction = "right"
    """Side to which it circles."""
    turns: float | None = Field(default=None, gt=0, le=1000)
    """Ends it after so many full circles."""
    duration_s: Duration | None = None
    """Ends it after this time."""
    centre: Waypoint | None = None
    """The way to the circle is part of the manoeuvre; turns and duration count from its arrival there."""
    leave_towards: Waypoint | None = None
    """Stay on the circle beyond its end until the course points here."""
    ends: ClassVar[tuple[str, ...]] = ("turns", "duration_s")


class STurn(Climbing):
    """Swing to and fro about the initial heading; each leg changes heading by ``heading_change_deg``."""

    type: Literal["s_turn"]
    bank_deg: Bank
    """Bank angle of each leg; positive begins to the right."""
    heading_change_deg: float = Field(default=60.0, gt=0, le=360)
    """By how much each leg changes the heading."""
    legs: int | None = Field(default=None, ge=1, le=1000)
    """Ends it after so many legs."""
    duration_s: Duration | None = None
    """Ends it after this time."""
    ends: ClassVar[tuple[str, ...]] = ("legs", "duration_s")

    @field_validator("bank_deg")
    @classmethod
    def _banked(cls, value: float) -> float:
        return _not_level(value)


class FigureEight(Climbing):
    """Full circles to one side and the other in turn; positive bank starts to the right."""

    type: Literal["figure_eight"]
    bank_deg: Bank
    """Bank angle; positive begins to the right."""
    circles: int | None = Field(default=None, ge=1, le=1000)
    """Ends it after so many full circles."""
    duration_s: Duration | None = None
    """Ends it after this time."""
    ends: ClassVar[tuple[str, ...]] = ("circles", "duration_s")

    @field_validator("bank_deg")
    @classmethod
    def _banked(cls, value: float) -> float:
        return _not_level(value)


class _SpeedChange(Manoeuvre):
    to_speed_mps: Speed
    """True airspeed at the end; it holds from then on."""
    acceleration_mps2: Annotated[float, Field(gt=0, le=20)] | None = None
    """Without it the aircraft's usual one."""

    @model_validator(mode="after")
    def _one_speed(self) -> _SpeedChange:
        if self.speed_mps is not None:
            raise ValueError("give to_speed_mps, not speed_mps")
        return self


class Accelerate(_SpeedChange):
    """Speed up to ``to_speed_mps``, straight and level."""

    type: Literal["accelerate"]


class Decelerate(_SpeedChange):
    """Slow down to ``to_speed_mps``, straight and level."""

    type: Literal["decelerate"]


class Doublet(Manoeuvre):
    """A control surface to one side and to the other (``period_s`` in all), then neutral until ``duration_s``."""

    type: Literal["doublet"]
    surface: Literal["elevator", "aileron", "rudder"]
    """The control that moves."""
    amplitude: float = Field(ge=-1, le=1)
    """Fraction of full deflection; positive pitches up, rolls right, yaws right first."""
    period_s: Duration = 2.0
    """Of the whole movement, to one side and to the other."""
    duration_s: Duration
    """How long, with the response that follows."""

    @model_validator(mode="after")
    def _fits(self) -> Doublet:
        if self.period_s > self.duration_s:
            raise ValueError(f"period_s {self.period_s} is longer than duration_s {self.duration_s}")
        return self


class Waypoints(Manoeuvre):
    """Fly over a list of points, each reached when passed within ``radius_m`` (default 100 m, multirotors 2 m).

    With ``follow = "legs"`` an aeroplane keeps to the line between two points, also in wind, climbs along it, and begins each
    turn so early, up to ``radius_m`` before the point, that it ends on the next line; multirotors always follow the legs.
    """

    type: Literal["waypoints"]
    points: list[Waypoint] = Field(min_length=1)
    radius_m: float | None = Field(default=None, gt=0, le=100_000)
    """A point counts as reached when passed within this."""
    follow: Literal["direct", "legs"] = "direct"
    """Straight to each point from where it is, or along the line between two points."""


class Hover(Manoeuvre):
    """Stay at a place (multirotors), in the end at a heading if one is given."""

    type: Literal["hover"]
    duration_s: Duration
    """How long."""
    heading_deg: float | None = Field(default=None, ge=-360, le=360)
    """Heading at the end, from true north, clockwise."""


class _Grounded(Manoeuvre):
    @model_validator(mode="after")
    def _no_speed(self) -> _Grounded:
        if self.speed_mps is not None:
            raise ValueError("speed_mps has no meaning here; remove it")
        return self


class Park(_Grounded):
    """Stand on the ground, held fast: truth for an alignment at rest."""

    type: Literal["park"]
    duration_s: Duration
    """How long."""


class LineUp(_Grounded):
    """Roll on to a heading, that of the runway, and stop."""

    type: Literal["line_up"]
    to_heading_deg: float = Field(ge=-360, le=360, description="Of the runway, °")


class TakeOff(Manoeuvre):
    """Take off straight ahead, or upwards, to a height above the ground, at ``speed_mps`` or the aircraft's usual speed."""

    type: Literal["take_off"]
    to_height_m: float = Field(default=100.0, ge=1, le=1000)
    """Aeroplanes climb to 30 m at least."""


class Approach(Manoeuvre):
    """Fly to the extended centreline and down the glide path of a runway: that of the take-off, or another one."""

    type: Literal["approach"]
    glide_deg: float = Field(
        default=3.0, ge=2, le=6, description="Angle of the glide path, °; default: that of most ILS"
    )
    heading_deg: float | None = Field(default=None, ge=-360, le=360, description="Of another runway, °")
    point: Waypoint | None = None
    """Where the glide path meets the ground; default 300 m beyond the place where the take-off began."""

    @model_validator(mode="after")
    def _whole_runway(self) -> Approach:
        if (self.heading_deg is None) != (self.point is None):
            raise ValueError("another runway than that of the take-off needs both heading_deg and point")
        if self.point is not None and self.point.alt_m is not None:
            raise ValueError(
                "point.alt_m has no meaning here: the ground is level, at the height where the flight began"
            )
        return self


class Land(_Grounded):
    """Flare, touch down and brake to a stop, after an approach; a multirotor lands where it hovers."""

    type: Literal["land"]


ON_THE_GROUND = (Park, LineUp, TakeOff, Land)
"""Manoeuvres that are, at least in part, on the ground."""

AnyManoeuvre = Annotated[
    Straight
    | Turn
    | Climb
    | Descent
    | Loiter
    | STurn
    | FigureEight
    | Accelerate
    | Decelerate
    | Doublet
    | Waypoints
    | Hover
    | Park
    | LineUp
    | TakeOff
    | Approach
    | Land,
    Field(discriminator="type"),
]


def manoeuvre_name(kind: type[Manoeuvre]) -> str:
    """How a script calls a type of manoeuvre."""
    name: str = typing.get_args(kind.model_fields["type"].annotation)[0]
    return name


def manoeuvre_keys() -> dict[str, tuple[str, str]]:
    """Of each type of manoeuvre what it does, and its keys in words."""
    found = {}
    for kind in typing.get_args(typing.get_args(AnyManoeuvre)[0]):
        hidden = {"type", "speed_mps"} if issubclass(kind, _Grounded | _SpeedChange) else {"type"}
        fields = {key: field for key, field in kind.model_fields.items() if key not in hidden}
        needed = [key for key, field in fields.items() if field.is_required()]
        free = [key for key in fields if key not in needed and key not in kind.ends]
        parts = [", ".join(needed)] if needed else []
        parts += [f"exactly one of {', '.join(kind.ends)}"] if len(kind.ends) > 1 else []
        parts += [f"and if wanted {', '.join(free)}"] if free else []
        found[manoeuvre_name(kind)] = (kind.__doc__ or "").split("\n")[0], "; ".join(parts)
    return found
