"""``[sensors.gnss.satellites]``: the sky above a flight, what delays and hides signals, and what a receiver does with them.

Checked by pydantic; units are in the key names, times are seconds from the start of the flight.
"""

from __future__ import annotations

import datetime
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from testbed.base.errors import InputError
from testbed.base.schema import Table

Pair = Annotated[tuple[float, float], Field(strict=False)]
Source = Literal["orbit_clock", "iono", "tropo", "multipath", "code_noise", "rate_noise", "fading", "clock"]
"""Sources of error that can be left out."""
SLOW: tuple[Source, ...] = ("orbit_clock", "iono", "tropo", "multipath")
"""Those that last from one epoch to the next: without them errors are white."""


class Stretch(Table):
    """A stretch of the flight."""

    start_s: float = Field(description="Beginning, s from the start of the flight")
    end_s: float = Field(description="End, s from the start of the flight")

    @model_validator(mode="after")
    def _ordered(self) -> Stretch:
        if self.end_s <= self.start_s:
            raise ValueError(f"end_s ({self.end_s:g}) must be after start_s ({self.start_s:g})")
        return self


class Loss(Stretch):
    """A satellite that is not received for a while."""

    sv: str = Field(description="Satellite, such as G05")

    @field_validator("sv")
    @classmethod
    def _known(cls, value: str) -> str:
        return _satellite(value)


class Keep(Stretch):
    """A partial outage: only these satellites are received."""

    satellites: list[str] | None = Field(default=None, description="Those that stay, such as ['G05', 'G12']")
    highest: int | None = Field(
        default=None, ge=0, le=64, description="Instead: how many stay, the highest at the beginning"
    )

    @model_validator(mode="after")
    def _one(self) -> Keep:
        if (self.satellites is None) == (self.highest is None):
            raise ValueError("give satellites or highest, one of them")
        for name in self.satellites or ():
            _satellite(name)
        return self


class Street(Stretch):
    """A stretch between walls."""

    skyline: list[Pair] = Field(
        min_length=1,
        description="[azimuth deg, elevation deg] of the walls' edges, linear between the points and around",
    )

    @field_validator("skyline")
    @classmethod
    def _around(cls, value: list[tuple[float, float]]) -> list[tuple[float, float]]:
        azimuths = [azimuth for azimuth, _ in value]
        if any(b <= a for a, b in zip(azimuths, azimuths[1:], strict=False)):
            raise ValueError("azimuths must increase")
        if any(not 0.0 <= azimuth < 360.0 for azimuth in azimuths) or any(not 0.0 <= e <= 90.0 for _, e in value):
            raise ValueError("azimuths lie in 0 to 360 and elevations in 0 to 90 degrees")
        return value


class Fault(Loss):
    """A wrong pseudorange of one satellite."""

    step_m: float = Field(default=0.0, description="Added from the beginning on, m")
    ramp_mps: float = Field(default=0.0, description="Added to pseudorange and range rate, growing, m/s")


class Jamming(Table):
    """Interference of one strength at all satellites."""

    js_db: list[Pair] = Field(
        min_length=1,
        description="[time s, power over that of a signal at 0 dBic dB] points, linear between them; off outside",
    )
    q: float = Field(
        default=1.5, gt=0, le=10, description="Of its spectrum: 1 narrow, 1.5 like the signal's, 2.22 wide band"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Jamming:
        if any(b[0] <= a[0] for a, b in zip(self.js_db, self.js_db[1:], strict=False)):
            raise ValueError("js_db: times must increase")
        return self


class Spoofing(Table):
    """Counterfeit signals that draw the fix away: consistent with one another, so that no test of residuals sees them."""

    start_s: float = Field(description="From here the counterfeit signals are the ones received, s")
    capture_s: float = Field(default=10.0, ge=0, description="So long they agree with the true ones, s")
    rate_mps: float = Field(default=1.0, gt=0, description="Speed that the pull-off reaches, m/s")
    acceleration_mps2: float = Field(default=0.02, gt=0, description="Of the pull-off, m/s²")
    direction_deg: float = Field(default=90.0, description="Of the pull-off from north, degrees")
    power_db: float = Field(default=2.0, ge=0, description="Of the counterfeit over the true signals, dB")


class SatellitesConfig(Table):
    """``[sensors.gnss.satellites]``"""

    systems: list[Literal["gps", "galileo"]] = Field(
        default=["gps"], min_length=1, description="Constellations that the receiver uses"
    )
    expanded: bool = Field(default=False, description="GPS with 27 satellites in place of 24")
    navigation: str | None = Field(
        default=None, description="RINEX 3 navigation file in place of the nominal constellations"
    )
    start: str = Field(default="2021-09-22T12:00:00", description="GPS time at the start of the flight, ISO")
    sky_seed: int | None = Field(
        default=None, ge=0, description="Draws the start within ten days, after which the ground tracks repeat"
    )
    walls: list[Street] = Field(default_factory=list, description="Streets, whose walls hide what lies behind them")
    losses: list[Loss] = Field(default_factory=list, description="Satellites that are lost for a while")
    keep: list[Keep] = Field(default_factory=list, description="Partial outages")
    faults: list[Fault] = Field(default_factory=list, description="Wrong pseudoranges of a satellite")
    jamming: Jamming | None = Field(default=None, description="Interference")
    spoofing: Spoofing | None = Field(default=None, description="Counterfeit signals")
    gps_sigma_m: float = Field(
        default=0.6,
        ge=0,
        description="Orbit and clock error of GPS, rms, m (Montenbruck 2018: three times Galileo's 0.2)",
    )
    galileo_sigma_m: float = Field(default=0.2, ge=0, description="Of Galileo, m (the same source)")
    iono_scale: float = Field(
        default=1.0, ge=0, description="True ionosphere over the broadcast one; 3 for solar maximum"
    )
    iono_sigma_m: float = Field(
        default=1.2,
        ge=0,
        description="Zenith delay that the broadcast model leaves, m: 0.5 night, 1.2 quiet day, 2.5 active",
    )
    tropo_sigma_m: float = Field(default=0.12, ge=0, description="Zenith delay that the model leaves, m (DO-229)")
    disable: list[Source] = Field(default_factory=list, description="Sources of error that are left out")
    false_alarm: float = Field(
        default=1e-3, ge=0, lt=0.5, description="Chance that the receiver's test rejects a good epoch; 0: no test"
    )
    accuracy_scale: float = Field(
        default=1.0, gt=0, description="Factor on the deviations that the receiver states for its fixes"
    )

    @field_validator("navigation")
    @classmethod
    def _from_folder(cls, value: str | None, info: ValidationInfo) -> str | None:
        folder = (info.context or {}).get("folder")
        return value if value is None or folder is None else str(folder / value)

    @field_validator("start")
    @classmethod
    def _a_time(cls, value: str) -> str:
        try:
            moment = datetime.datetime.fromisoformat(value)
        except ValueError:
            raise ValueError("expected a date and time such as 2021-09-22T12:00:00") from None
        if moment.tzinfo is not None or not 1981 <= moment.year < 2100:
            raise ValueError("expected GPS time without a zone, in 1981 to 2099")
        return value

    @field_validator("systems")
    @classmethod
    def _each_once(cls, value: list[str]) -> list[str]:
        if len(set(value)) < len(value):
            raise ValueError("a system is named twice")
        return value

    @model_validator(mode="after")
    def _no_double(self) -> SatellitesConfig:
        if self.navigation is not None:
            for key in ("expanded", "sky_seed"):
                if key in self.model_fields_set and getattr(self, key):
                    raise ValueError(f"{key} is of the nominal constellations; it has no effect with a navigation file")
        return self

    def moment(self) -> datetime.datetime:
        """GPS time at the start of the flight."""
        start = datetime.datetime.fromisoformat(self.start)
        if self.sky_seed is None:
            return start
        from testbed.base.streams import stream

        days = 10.0 * 86164.0905 * stream(self.sky_seed, 0, "gnss.sky").uniform()
        return start + datetime.timedelta(seconds=round(days))


def _satellite(name: str) -> str:
    from testbed.gnss.constellation import code_of

    try:
        code_of(name)
    except InputError as error:
        raise ValueError(str(error)) from None
    return name
