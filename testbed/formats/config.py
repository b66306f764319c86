"""The scenario's ``[recording]`` table: which files hold recorded data, and what the files do not say.

Pydantic models (strict, unknown keys refused); angles in degrees, everything else SI, as the keys say.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from testbed.base.errors import nearest
from testbed.base.schema import Table
from testbed.sensors.registry import SENSORS

PARTS = {
    "navego": ("imu", "gnss", "ref", "mag", "baro"),
    "table": ("imu", *SENSORS, "reference"),
    "ulog": ("log",),
    "broad": ("trial",),
    "kfgins": ("imu", "gnss", "reference"),
    "rtklib": ("imu", "pos", "mag", "baro", "reference"),
    "ardupilot": ("log",),
    "rosbag": ("bag",),
    "mcap": ("bag",),
    "nmea": ("imu", "nmea", "mag", "baro", "reference"),
    "ubx": ("imu", "ubx", "mag", "baro", "reference"),
    "euroc": ("imu", "reference"),
    "kitti": ("oxts",),
    "rinex": ("imu", "obs", "nav", "mag", "baro", "reference"),
}
"""Format -> names that ``files`` may use."""
TABLES = ("table", "rtklib", "nmea", "ubx", "rinex")
"""Formats whose IMU is a table."""
ROS = ("rosbag", "mcap")
TOPICS = ("imu", "gnss", "mag", "baro", "reference")
"""Parts that a topic of a bag can be."""


class AlignmentConfig(Table):
    """``[recording.initial]``: where the initial state comes from when the files state none (NaveGo's state attitude)."""

    start: Literal["auto", "gnss", "reference"] = "auto"
    """Position and velocity; auto: from GNSS where there is one, else from the reference."""
    attitude: Literal["level", "reference"] = "level"
    """Roll and pitch by levelling, or all three angles from the reference."""
    heading: Literal["auto", "course", "mag", "motion", "none"] = "auto"
    """With levelling: course over ground above 5 m/s, else magnetometer, else the first motion that shows a course, carried
    back by the gyros, else unknown."""
    level_s: float = Field(default=2.0, gt=0.0, le=600.0)
    """Averaging time of the accelerometer."""
    crab_deg: float = Field(default=10.0, ge=0.0, le=180.0)
    """1 sigma between course and heading."""
    declination_deg: float | None = Field(default=None, ge=-180.0, le=180.0)
    """Of the magnetic field, east; default: the magnetometer's specification, else the World Magnetic Model."""
    roll_deg: float | None = Field(default=None, ge=-180.0, le=180.0)
    """Roll at the start, in place of levelling."""
    pitch_deg: float | None = Field(default=None, ge=-90.0, le=90.0)
    """Pitch at the start, in place of levelling."""
    yaw_deg: float | None = Field(default=None, ge=-360.0, le=360.0)
    """Heading at the start, in place of what `heading` finds."""
    roll_pitch_std_deg: float | None = Field(default=None, gt=0.0, le=180.0)
    """1 sigma of roll and pitch; default: what the accelerometer biases imply."""
    yaw_std_deg: float | None = Field(default=None, gt=0.0, le=180.0)
    """1 sigma of the heading; default: what its source implies."""

    @model_validator(mode="after")
    def _all_act(self) -> AlignmentConfig:
        """What another key takes the effect of is refused, so that a key that is there always acts."""
        idle: dict[str, tuple[str, ...]] = {}
        if self.attitude == "reference":
            idle["attitude = 'reference'"] = ("heading", "level_s", "crab_deg")
        if self.yaw_deg is not None:
            idle["yaw_deg"] = ("heading", "crab_deg")
        if self.heading in ("mag", "none"):
            idle[f"heading = '{self.heading}'"] = ("crab_deg",)
        for reason, keys in idle.items():
            for key in keys:
                if getattr(self, key) != type(self).model_fields[key].default:
                    raise ValueError(f"{key} would have no effect beside {reason}; leave one of them out")
        return self


class HoldoutConfig(Table):
    """``[recording.holdout]``: windows whose fixes are withheld and scored against; seconds after the start of the log."""

    windows: list[Annotated[tuple[float, float], Field(strict=False)]] = Field(default_factory=list)
    """[from, to] of each."""
    every_s: float | None = Field(default=None, gt=0.0)
    """A window at every so many seconds from ``first_s`` on."""
    draw: int | None = Field(default=None, ge=1, le=1000)
    """So many windows at random, anew in every run."""
    length_s: float = Field(default=15.0, gt=0.0)
    """Of a window of ``every_s`` or ``draw``: 15 s is a tunnel or an underpass in town."""
    first_s: float = Field(default=40.0, ge=0.0)
    """Before it nothing is withheld by ``every_s`` or ``draw``: a filter needs some motion to settle."""

    @model_validator(mode="after")
    def _one_kind(self) -> HoldoutConfig:
        if sum((bool(self.windows), self.every_s is not None, self.draw is not None)) != 1:
            raise ValueError("give exactly one of windows = [[from, to], ...], every_s and draw")
        if self.every_s is not None and self.every_s <= self.length_s:
            raise ValueError(
                f"every_s = {self.every_s:g} must be above length_s = {self.length_s:g}, or no fix is left"
            )
        ends = sorted(self.windows)
        for a, b in ends:
            if not 0.0 <= a < b:
                raise ValueError(f"windows: [{a:g}, {b:g}] must rise, from 0 on")
        for (_, b), (a, _) in zip(ends, ends[1:], strict=False):
            if a < b:
                raise ValueError(f"windows: one begins at {a:g} s, before the one before it ends at {b:g} s")
        return self


class RecordingConfig(Table):
    """``[recording]``. Relative paths start at the scenario's folder."""

    format: Literal[
        "navego",
        "table",
        "ulog",
        "broad",
        "kfgins",
        "rtklib",
        "ardupilot",
        "rosbag",
        "mcap",
        "nmea",
        "ubx",
        "euroc",
        "kitti",
        "rinex",
    ]
    """How the files are written."""
    dir: str = "."
    """The recording's folder."""
    files: dict[str, str] = Field(default_factory=dict)
    """Part -> file in ``dir``; default names where a part is absent."""
    columns: dict[str, str | dict[str, str]] = Field(default_factory=dict)
    """table: the file's column -> documented column with unit (a leading minus turns the sign); a sub-table is for one part."""
    mapping: str | None = None
    """table: TOML file with such a ``[columns]`` table."""
    topics: dict[str, str] = Field(default_factory=dict)
    """rosbag, mcap: part (imu, gnss, mag, baro, reference) -> topic, where a bag has several of its type."""
    sampling: Literal["interval", "instant"] = "interval"
    """Whether an IMU sample is a mean over the interval before it or a value at its time. Not for ulog, kfgins and broad;
    ardupilot, rosbag, mcap, euroc and kitti have values at their times unless this says otherwise."""
    allow_truncated: bool = False
    """ulog: use what is there of a log that was cut off."""
    start_s: float | None = None
    """Use the recording from here on, seconds of its own time."""
    end_s: float | None = None
    """Use only this part of the recording."""
    initial: AlignmentConfig = AlignmentConfig()
    holdout: HoldoutConfig | None = None
    imu: dict[str, Any] = Field(default_factory=dict)
    """Specification in place of what the files state: ``model`` of the catalogue, single figures of it, ``file``."""
    gnss: dict[str, Any] = Field(default_factory=dict)
    """The same for the receiver."""
    mag: dict[str, Any] = Field(default_factory=dict)
    """The same for the magnetometer; ``field_n_ut`` is the local field."""
    baro: dict[str, Any] = Field(default_factory=dict)
    """Specification instead of what the files state: ``model`` of the catalogue, single figures of it, ``file``."""

    @model_validator(mode="after")
    def _consistent(self) -> RecordingConfig:
        for part in self.files:
            if part not in PARTS[self.format]:
                raise ValueError(
                    f"files: '{part}' is no part of a {self.format} recording; {nearest(part, PARTS[self.format])}"
                )
        if self.format not in TABLES and (self.columns or self.mapping):
            raise ValueError(f"columns and mapping are for the formats {', '.join(TABLES)}, not '{self.format}'")
        if self.topics and self.format not in ROS:
            raise ValueError(f"topics is for the formats {' and '.join(ROS)}, not '{self.format}'")
        for part in self.topics:
            if part not in TOPICS:
                raise ValueError(f"topics: '{part}' is no part of a bag; {nearest(part, TOPICS)}")
        if self.format == "navego" and self.start_s is not None:
            raise ValueError("start_s is not for the format 'navego', whose initial attitude holds at its first sample")
        if self.start_s is not None and self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError(f"end_s = {self.end_s:g} does not lie after start_s = {self.start_s:g}")
        return self
