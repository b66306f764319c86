"""The ``[sensors.*]`` and ``[initial]`` tables of a scenario, checked by pydantic.

Figures of a sensor come from the catalogue; any catalogue key may stand in the table to replace the entry's figure.
Units are in the key names; times are seconds from the start of the flight.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, ValidationInfo, field_validator, model_validator

from testbed.base.errors import InputError, nearest
from testbed.base.schema import Table
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec
from testbed.gnss.config import SatellitesConfig
from testbed.sensors import catalog

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Triple = Annotated[tuple[float, float, float], Field(strict=False)]
Window = Annotated[tuple[float, float], Field(strict=False)]

ImuStep = Literal[
    "lever_arm",
    "scale_factor",
    "misalignment",
    "nonlinearity",
    "g_sensitivity",
    "turn_on_bias",
    "bias_instability",
    "rate_random_walk",
    "white_noise",
    "temperature",
    "vibration",
    "bandwidth",
    "saturation",
    "quantisation",
]
"""The steps of the IMU chain, in their order."""


class SensorTable(Table):
    """A table that names a catalogue entry and may replace its figures: every further key must be a catalogue key."""

    model_config = ConfigDict(extra="allow")
    kind: ClassVar[str]

    model: str = "ideal"
    """Entry of the catalogue, as ``testbed list sensors`` shows them; ideal has no errors."""
    file: str | None = None
    """The user's own catalogue (TOML); a relative path starts from the scenario's folder."""

    @field_validator("file")
    @classmethod
    def _from_folder(cls, value: str | None, info: ValidationInfo) -> str | None:
        folder = (info.context or {}).get("folder")
        return value if value is None or folder is None else str(folder / value)

    @model_validator(mode="after")
    def _resolvable(self) -> SensorTable:
        try:
            self._figures()
        except InputError as error:
            raise ValueError(str(error)) from None
        return self

    def _figures(self) -> Any:
        """The catalogue entry with the table's own figures, SI. Raises InputError for an unknown model, key or value."""
        extra = self.model_extra or {}
        valid = set(catalog.keys(self.kind)) | set(type(self).model_fields)
        for key in extra:
            if key not in valid:
                raise InputError(f"unknown key '{key}'; {nearest(key, valid)}")
        rate = getattr(self, "rate_hz", None)
        file = Path(self.file) if self.file is not None else None
        return catalog.specification(self.kind, self.model, extra | ({"rate_hz": rate} if rate else {}), file)


class Temperature(Table):
    """Temperature of the IMU over the flight, linear between the points and constant outside."""

    time_s: Annotated[list[float], Field(min_length=1)]
    """Times of the points, seconds of the flight."""
    celsius: Annotated[list[float], Field(min_length=1)]
    """Temperature at each, °C."""
    reference_celsius: float = 25.0
    """Where the temperature errors are zero."""

    @model_validator(mode="after")
    def _consistent(self) -> Temperature:
        if len(self.time_s) != len(self.celsius):
            raise ValueError("time_s and celsius must have the same length")
        if any(b <= a for a, b in zip(self.time_s, self.time_s[1:], strict=False)):
            raise ValueError("time_s must increase")
        return self


class Tone(Table):
    """One sinusoid of the vibration: at a multiple of the engine speed, or at a fixed frequency."""

    order: Positive | None = None
    """Multiple of the shaft frequency (needs the trajectory's column engine_rpm)."""
    frequency_hz: Positive | None = None
    """Used without an order, or where the trajectory has no engine speed."""
    accel_g: Triple = (0.0, 0.0, 0.0)
    """Amplitude along b."""
    gyro_dps: Triple = (0.0, 0.0, 0.0)
    """Amplitude of the angular rate along b."""

    @model_validator(mode="after")
    def _has_frequency(self) -> Tone:
        if self.order is None and self.frequency_hz is None:
            raise ValueError("give order (of the engine speed) or frequency_hz")
        return self


class Vibration(Table):
    """Engine vibration: sinusoids and band noise."""

    tones: list[Tone] = Field(default_factory=list)
    band_hz: Window | None = None
    """Band of the noise: from, to."""
    band_accel_g: Triple = (0.0, 0.0, 0.0)
    """RMS of the band noise along b (at rpm_nominal if the trajectory has the engine speed)."""
    band_gyro_dps: Triple = (0.0, 0.0, 0.0)
    """RMS of the angular rate in the band, along b."""
    rpm_nominal: Positive | None = None
    """Engine speed at which amplitudes are as given; they grow with its square. None: they do not change."""


class ImuConfig(SensorTable):
    """``[sensors.imu]``"""

    kind: ClassVar[str] = "imu"
    rate_hz: Positive | None = None
    """Default: the rate of the trajectory. The trajectory's rate must be a whole multiple of it."""
    lever_arm_m: Triple = (0.0, 0.0, 0.0)
    """From the reference point of the trajectory to the IMU, in b."""
    disable: list[ImuStep] = Field(default_factory=list)
    """Steps of the error chain that are left out."""
    temperature: Temperature | None = None
    vibration: Vibration | None = None

    def spec(self, rate_hz: float) -> ImuSpec:
        """The specification at the given rate of the recording."""
        return replace(self._figures(), rate_hz=rate_hz, lever_arm_b=self.lever_arm_m)


class RandomOutages(Table):
    """Outages drawn anew in every run: they never overlap."""

    count: Annotated[int, Field(ge=0, le=10_000)]
    """At most one in 20 s of the longest flight (200,000 s); 0 for none."""
    duration_s: NonNegative
    """0 for none, where a sweep begins."""
    after_s: NonNegative = 60.0
    """Not before this time."""
    gap_s: NonNegative = 30.0
    """At least this long between two outages, and before the end of the flight."""


class OutlierBursts(Table):
    """Stretches of wrong fixes (multipath) at drawn times: each a constant offset in a drawn direction."""

    count: Annotated[int, Field(ge=0)]
    """How many; 0 for none, where a sweep begins."""
    duration_s: Positive = 1.0
    """Of each."""
    offset_m: NonNegative = 50.0
    """Size of the wrong position."""
    offset_mps: NonNegative = 0.0
    """Size of the wrong velocity."""
    after_s: NonNegative = 0.0
    """Not before this time."""


class Degraded(Table):
    """A stretch of poor geometry: errors are multiplied."""

    start_s: float
    """Beginning, seconds of the flight."""
    end_s: float
    """End, seconds of the flight."""
    factor: Positive
    """By which errors are multiplied."""
    reported: bool = True
    """Whether the receiver's stated accuracy follows."""

    @model_validator(mode="after")
    def _ordered(self) -> Degraded:
        if self.end_s <= self.start_s:
            raise ValueError(f"end_s ({self.end_s:g}) must be after start_s ({self.start_s:g})")
        return self


class GnssConfig(SensorTable):
    """``[sensors.gnss]``

    ``model`` is ``module-class`` where neither it nor a figure is given; figures alone are those of an otherwise ideal
    receiver.
    """

    kind: ClassVar[str] = "gnss"
    rate_hz: Positive | None = None
    """Fixes per second; default: the catalogue's."""
    time_offset_s: NonNegative = 0.0
    """Shift of all fixes against the start of the flight."""
    lever_arm_m: Triple = (0.0, 0.0, 0.0)
    """From the IMU to the antenna, in b."""
    start_up_s: NonNegative = 0.0
    """No fix before this time."""
    outages: list[Window] = Field(default_factory=list)
    """[from, to] of stretches without a fix, seconds of the flight."""
    random_outages: RandomOutages | None = None
    outliers: OutlierBursts | None = None
    degraded: list[Degraded] = Field(default_factory=list)
    mode: Literal["errors", "satellites"] = Field(
        default="errors",
        description="errors: noise on the true position; satellites: pseudoranges, of which the receiver makes its fixes",
    )
    satellites: SatellitesConfig | None = Field(default=None, description='The sky of mode = "satellites"')

    @model_validator(mode="before")
    @classmethod
    def _usual_receiver(cls, data: Any) -> Any:
        """Without a model and without figures of its own a receiver is a module: its errors last, as those of real ones."""
        if not isinstance(data, dict) or "model" in data:
            return data
        figures = set(data) & set(catalog.keys("gnss")) - {"rate_hz", "latency_s"}
        if figures and data.get("mode") != "satellites":
            return data
        return {"model": "module-class"} | data

    @model_validator(mode="after")
    def _keys_of_the_mode(self) -> GnssConfig:
        """A key of the other mode would be ignored."""
        extra = self.model_extra or {}
        if self.mode == "errors":
            idle = [key for key in extra if key in catalog.SIGNALS]
            idle += ["satellites"] if self.satellites is not None else []
            if idle:
                raise ValueError(f'{idle[0]} has an effect only with mode = "satellites"')
            return self
        idle = [key for key in extra if key not in catalog.SIGNALS and key not in ("latency_s", "rate_hz")]
        idle += ["outliers"] if self.outliers is not None else []
        idle += ["degraded"] if self.degraded else []
        if idle:
            instead = "; satellites.faults are wrong pseudoranges" if idle[0] == "outliers" else ""
            raise ValueError(f'{idle[0]} has no effect with mode = "satellites"{instead}')
        return self

    @model_validator(mode="after")
    def _outages_ordered(self) -> GnssConfig:
        previous = float("-inf")
        for start, end in self.outages:
            if end <= start:
                raise ValueError(f"outages: [{start:g}, {end:g}] ends before it starts")
            if start < previous:
                raise ValueError(
                    f"outages: [{start:g}, {end:g}] must come after the one before it, which ends at {previous:g} s"
                )
            previous = end
        if self.outages and self.random_outages is not None:
            raise ValueError("give outages or random_outages, not both")
        return self

    def spec(self) -> GnssSpec:
        """The specification."""
        return replace(self._figures(), lever_arm_b=self.lever_arm_m)


class Disturbance(Table):
    """A stretch of magnetic disturbance."""

    start_s: float
    """Beginning, seconds of the flight."""
    end_s: float
    """End, seconds of the flight."""
    field_ut: Triple = (0.0, 0.0, 0.0)
    """Constant, in b."""
    noise_ut: NonNegative = 0.0
    """White, 1 sigma per axis."""


class MagConfig(SensorTable):
    """``[sensors.mag]``"""

    kind: ClassVar[str] = "mag"
    rate_hz: Positive | None = None
    """Samples per second; default: the catalogue's."""
    year: Annotated[float, Field(ge=2010.0, lt=2030.0)] = 2025.0
    """Decimal year of the geomagnetic model."""
    disturbances: list[Disturbance] = Field(default_factory=list)

    def spec(self) -> MagSpec:
        """The specification, without the local field."""
        return self._figures()


class BaroConfig(SensorTable):
    """``[sensors.baro]``"""

    kind: ClassVar[str] = "baro"
    rate_hz: Positive | None = None
    """Samples per second; default: the catalogue's."""

    def spec(self) -> BaroSpec:
        """The specification."""
        return self._figures()


class InitialConfig(Table):
    """``[initial]``: how well a filter knows its start, 1 sigma per axis; the mean is drawn around truth."""

    perfect: bool = False
    """Start at the truth, with the true biases."""
    position_m: NonNegative = 5.0
    """Of each axis."""
    velocity_mps: NonNegative = 0.1
    """Of each axis."""
    roll_pitch_deg: NonNegative = 1.0
    """Of roll and of pitch."""
    yaw_deg: NonNegative = 2.0
    """Of the heading."""
    gyro_bias_dps: NonNegative | None = None
    """What a calibration before the flight left of the bias. None: nothing is known of it but the specification."""
    accel_bias_mg: NonNegative | None = None
    """The same of the accelerometer bias."""
    align_at_rest_s: Annotated[float, Field(gt=0, le=36_000)] | None = Field(
        default=None,
        description="Let the filter align while the vehicle stands, s: levelling and gyro bias from the IMU's means instead of "
        "errors drawn around the truth; the log begins after it",
    )
    align_heading: Literal["mag", "given", "unknown"] | None = Field(
        default=None,
        description="Heading after an alignment at rest: from the magnetometer, known to yaw_deg (the default), or unknown",
    )

    @model_validator(mode="after")
    def _one_way(self) -> InitialConfig:
        if self.align_at_rest_s is None:
            if self.align_heading is not None:
                raise ValueError("align_heading has no meaning without align_at_rest_s")
            return self
        sensed = ["perfect", "velocity_mps", "roll_pitch_deg", "gyro_bias_dps", "accel_bias_mg"]
        sensed += ["yaw_deg"] if self.align_heading in ("mag", "unknown") else []
        for key in sensed:
            if getattr(self, key) != type(self).model_fields[key].default:
                raise ValueError(f"{key} has no meaning beside align_at_rest_s: the sensors decide it")
        return self
