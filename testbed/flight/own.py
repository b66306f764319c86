"""A trajectory of one's own as truth: ``[flight] trajectory = "file.csv"``, what its keys mean.

What the file may hold is in `testbed.flight.track_files`, how it becomes truth in `testbed.flight.track`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from testbed.base.schema import Table

Positive = Annotated[float, Field(gt=0)]


class Origin(Table):
    """``[flight.origin]``: where north, east and down of a local track count from."""

    lat_deg: float = Field(ge=-90, le=90, description="Latitude, °")
    lon_deg: float = Field(ge=-180, le=180, description="Longitude, °")
    alt_m: float = Field(ge=-1000, le=100_000, description="Height above the ellipsoid, m")


class TrajectoryConfig(Table):
    """``[flight]`` with the key ``trajectory``: a file says how the vehicle moves."""

    type: Literal["trajectory"] = Field(default="trajectory", exclude=True, description="Who makes the motion: a file")
    trajectory: str = Field(
        min_length=1,
        description="The file: .csv, .parquet, .mat (NaveGo's ref), .gpx or .kml, from the scenario's folder on",
    )
    rate_hz: float = Field(default=100.0, ge=10, le=1000, description="Rows of the truth per second, Hz")
    row_rate_hz: Annotated[float, Field(gt=0, le=10_000)] | None = Field(
        default=None, description="Rows of the file per second, where it has no times, Hz"
    )
    columns: dict[str, str] = Field(
        default={}, description='The file\'s column -> documented column with unit: { "Latitude" = "lat_deg" }'
    )
    origin: Origin | None = Field(default=None, description="Of a local track (north_m, east_m, down_m)")
    alt_m: Annotated[float, Field(ge=-1000, le=100_000)] | None = Field(
        default=None, description="Height of a track without heights, m"
    )
    attitude: Literal["file", "level", "coordinated"] | None = Field(
        default=None,
        description="From the file; or along the track, wings level (cars, boats) or banked as turns need (aircraft). "
        "Default: the file's where it has one, else level, which assumes least",
    )
    smooth_s: Annotated[float, Field(gt=0, le=3600)] | None = Field(
        default=None,
        description="Distance of the knots of a least-squares spline, s; without it the track goes through every row",
    )
    max_gap_s: Positive | None = Field(
        default=None,
        description="Longest time between two rows, s; default: five of the file's usual intervals, in tables 5 s at most",
    )
    max_acceleration_mps2: Annotated[float, Field(gt=0, le=5000)] = Field(
        default=100.0, description="Beyond it the file is refused, m/s²: 10 g, more than people or airframes take"
    )
    max_rate_dps: Annotated[float, Field(gt=0, le=20_000)] = Field(
        default=1000.0, description="Beyond it the file is refused, °/s: more than acrobatic multirotors turn"
    )

    @field_validator("trajectory")
    @classmethod
    def _from_folder(cls, value: str, info: ValidationInfo) -> str:
        folder = (info.context or {}).get("folder")
        return str((folder / value).resolve()) if folder is not None else value
