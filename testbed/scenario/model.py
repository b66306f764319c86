"""What a scenario is: one table per class, checked, immutable and plain data."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Discriminator, Field, PrivateAttr, Tag, model_validator

from testbed.base.errors import InputError, nearest
from testbed.base.schema import JSBSIM, OWN_TRACK, Name, Table, dump_toml
from testbed.flight.config import FlightConfig
from testbed.flight.drive import DriveConfig
from testbed.flight.own import TrajectoryConfig
from testbed.formats.config import RecordingConfig
from testbed.scoring.claims import ClaimConfig, ReadingConfig
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SENSORS, SensorsConfig

if TYPE_CHECKING:
    import numpy as np

Positive = Annotated[float, Field(gt=0)]
EXTERNAL = "external"
"""The estimator whose answers other programs made (`testbed.montecarlo.external`)."""
PRESENTED = ("claims", "readings", "tables")
"""Tables of a scenario on which no run depends."""
LONGEST_TIMEOUT_S = 1e8
"""Three years; the timers of the operating system take no infinity."""


class Header(Table):
    """``[scenario]``: what it is called and where it comes from."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$", max_length=100)
    """Names its results; letters, digits, point, hyphen and underscore."""
    title: str = ""
    """Heading of its report."""
    source: str = ""
    """The paper that it follows, or where it comes from."""
    notes: str = ""
    """Remarks that the report prints."""


class EstimatorConfig(Table):
    """``[[estimators]]``: a method under test; ``label`` names its row where one method stands in several rows."""

    name: str
    """As ``testbed list estimators`` shows it, or as a plug-in registers it."""
    label: Name = ""
    """Name of its row; needed where one method stands in several rows."""
    params: dict[str, Any] = {}
    """Its parameters; ``testbed list estimators NAME`` shows them."""
    params_file: str | None = None
    """TOML file with a table ``[params]``, as the tuner writes it; ``params`` stands above it."""

    @property
    def row(self) -> str:
        """The name of its row in every table."""
        return self.label or self.name


class Distribution(Table):
    """How a number of the flight varies from run to run: normal (mean, sigma), uniform (low, high), or times a uniform factor."""

    normal: list[float] | None = Field(default=None, min_length=2, max_length=2)
    """Mean and standard deviation."""
    uniform: list[float] | None = Field(default=None, min_length=2, max_length=2)
    """Lowest and highest value."""
    factor: list[float] | None = Field(default=None, min_length=2, max_length=2)
    """Low and high of what the scenario's own number is multiplied by: sides and signs stay."""

    @model_validator(mode="after")
    def _one_of(self) -> Distribution:
        if sum(given is not None for given in (self.normal, self.uniform, self.factor)) != 1:
            raise ValueError(
                "give exactly one of normal = [mean, sigma], uniform = [low, high] and factor = [low, high]"
            )
        if self.normal is not None and self.normal[1] < 0.0:
            raise ValueError(f"normal = [mean, sigma]: sigma must not be negative, is {self.normal[1]:g}")
        for name, ends in (("uniform", self.uniform), ("factor", self.factor)):
            if ends is not None and ends[0] > ends[1]:
                raise ValueError(f"{name} = [low, high]: low ({ends[0]:g}) must not lie above high ({ends[1]:g})")
        return self

    @property
    def marks(self) -> list[float]:
        """Values that must be possible, or the distribution means nothing: the mean, or both ends; none of a factor."""
        if self.normal is not None:
            return [self.normal[0]]
        return [float(end) for end in self.uniform or ()]

    def draw(self, rng: np.random.Generator, own: float) -> float:
        """One value in place of the scenario's ``own``."""
        if self.normal is not None:
            return float(rng.normal(self.normal[0], self.normal[1]))
        if self.uniform is not None:
            return float(rng.uniform(self.uniform[0], self.uniform[1]))
        assert self.factor is not None
        return own * float(rng.uniform(self.factor[0], self.factor[1]))


class MonteCarloConfig(Table):
    """``[monte_carlo]``: how many runs, from which seed, and what differs between them."""

    runs: int = Field(default=20, ge=1, le=999_999)
    """The files of the runs are numbered with six digits."""
    seed: int = Field(default=1, ge=0)
    """All that is drawn follows from it."""
    vary: list[Literal["noise", "turn_on", "alignment", "outages", "turbulence", "manoeuvres"]] = [
        "noise",
        "turn_on",
        "alignment",
        "outages",
    ]
    """What is drawn anew in every run; the rest is as in run 0."""
    disperse: dict[str, Distribution] = {}
    """Keys inside ``[flight]``, for example ``"manoeuvres.1.bank_deg"``, or ``"manoeuvres.*.bank_deg"`` for each manoeuvre that
    has one, drawn for itself; used where ``vary`` has ``manoeuvres``."""
    divergence_position_m: Positive = 100_000.0
    """A run whose position error passes this anywhere is counted as diverged."""
    timeout_s: Annotated[float, Field(gt=0, le=LONGEST_TIMEOUT_S)] | None = None
    """Longest time of one estimator on one run."""
    side_by_side: bool = True
    """Whether estimators that can filter eight runs at once do so; their times are then those of a run among others."""

    @model_validator(mode="after")
    def _says_how(self) -> MonteCarloConfig:
        if "manoeuvres" in self.vary and not self.disperse:
            raise ValueError("vary has 'manoeuvres', but no table [monte_carlo.disperse] says what is drawn")
        return self


class WindowConfig(Table):
    """``[[windows]]``: where errors are scored. ``kind`` outages or phases makes one window for each of them."""

    name: Name = ""
    """Name in the tables."""
    start: float | None = None
    """Begins here, seconds of the flight."""
    end: float | None = None
    """Ends here, seconds of the flight."""
    kind: Literal["fixed", "outages", "phases"] = "fixed"
    """One stretch of time, or one window for each outage or phase."""

    @model_validator(mode="after")
    def _complete(self) -> WindowConfig:
        if self.kind == "fixed":
            if not self.name or self.start is None or self.end is None:
                raise ValueError("a window needs name, start and end (or kind = 'outages' or 'phases')")
            if self.end <= self.start:
                raise ValueError(f"window '{self.name}' ends at {self.end} s, before it starts at {self.start} s")
        return self


class TableRow(Table):
    """A row of a paper's table: a metric, how to scale it, and the paper's figure per column (nan-free; -1 = none)."""

    name: str
    """Its heading."""
    metric: str
    """As ``testbed list metrics`` shows them."""
    window: str = ""
    """Name of a window; default: the table's."""
    unit: str = ""
    """Printed beside its name."""
    paper: list[float | str]
    """The paper's figures, one per column; an empty text where it has none."""


class TableConfig(Table):
    """``[[tables]]``: a paper's table, to be set beside ours."""

    title: str
    """Heading."""
    columns: list[str]
    """Estimator rows that its columns show."""
    window: str = "all"
    """Name of the window, or all."""
    statistic: Literal["mean", "median"] = "mean"
    """Over the runs."""
    rows: list[TableRow]
    note: str = ""
    """Stands below it."""


def _maker(data: Any) -> str:
    """Tag of the maker of a motion, for data or a configuration."""
    if isinstance(data, Mapping) and "trajectory" in data and "type" not in data:
        return OWN_TRACK
    found = data.get("type", JSBSIM) if isinstance(data, Mapping) else getattr(data, "type", JSBSIM)
    return str(found)


Motion = Annotated[
    Annotated[FlightConfig, Tag(JSBSIM)]
    | Annotated[DriveConfig, Tag("drive")]
    | Annotated[TrajectoryConfig, Tag(OWN_TRACK)],
    Discriminator(_maker),
]
"""``[flight]``: a file where it names one as ``trajectory``, else flown by JSBSim where it does not say otherwise."""


class Scenario(Table):
    """A checked scenario. Exactly one of ``flight`` and ``recording`` is set; a recording with ``sensors`` lends its reference
    as truth, and its own sensors are left aside."""

    scenario: Header
    flight: Motion | None = None
    recording: RecordingConfig | None = None
    sensors: SensorsConfig | None = None
    initial: InitialConfig = InitialConfig()
    estimators: list[EstimatorConfig] = Field(min_length=1)
    monte_carlo: MonteCarloConfig = MonteCarloConfig()
    windows: list[WindowConfig] = []
    claims: list[ClaimConfig] = []
    readings: list[ReadingConfig] = []
    tables: list[TableConfig] = []
    extra: dict[str, Any] = {}
    """Free tables for tools that go with a scenario: ``[extra.dataset]``, ``[extra.train]``, ``[extra.tune]``."""

    _source: str = PrivateAttr(default="")
    _settings: dict[str, Any] = PrivateAttr(default_factory=dict)
    _variant: str | None = PrivateAttr(default=None)
    _profile: str | None = PrivateAttr(default=None)
    _reading: str | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        if (self.flight is None) == (self.recording is None):
            raise ValueError("a scenario has either [flight] or [recording]")
        if self.flight is not None and self.sensors is None:
            raise ValueError("a scenario with [flight] needs [sensors.imu]")
        if self.recording is not None and self.sensors is not None:
            for kind in self.recording.model_fields_set & {"imu", *SENSORS, "initial"}:
                raise ValueError(
                    f"[recording.{kind}] has no meaning beside [sensors], which sense the recording's reference anew; "
                    f"figures go into [sensors.{kind}]"
                    if kind != "initial"
                    else "[recording.initial] has no meaning beside [sensors], which sense the reference anew; use [initial]"
                )
        if isinstance(self.flight, TrajectoryConfig) or self.recording is not None:
            for what in ("turbulence", "manoeuvres"):
                if what in self.monte_carlo.vary:
                    raise ValueError(f"monte_carlo.vary has '{what}', but recorded motion is the same in every run")
        rows = [entry.row for entry in self.estimators]
        for row in rows:
            if rows.count(row) > 1:
                raise ValueError(f"two estimators are called '{row}'; give one of them a label")
        names = [reading.name.lower() for reading in self.readings]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two readings are called '{name}'")
        for claim in self.claims:
            for row in (claim.better, claim.than):
                if row not in rows:
                    raise ValueError(f"claim '{claim.id or claim.text}' names '{row}'; {nearest(row, rows)}")
        return self

    def __repr__(self) -> str:
        flight, rows = self.flight, ", ".join(entry.row for entry in self.estimators)
        who = next((getattr(flight, key) for key in ("aircraft", "vehicle", OWN_TRACK) if hasattr(flight, key)), None)
        motion = f"{flight.type}, {who}" if flight is not None else f"recording, {self.recording.format}"  # type: ignore[union-attr]
        sensors = (
            ", ".join(k for k in type(self.sensors).model_fields if getattr(self.sensors, k) is not None)
            if self.sensors
            else "as recorded"
        )
        told = {"motion": motion, "sensors": sensors, "estimators": rows, "runs": self.monte_carlo.runs}
        return "\n".join([f"Scenario {self.name}", *(f"  {key:10s}  {value}" for key, value in told.items())])

    __str__ = __repr__

    @property
    def name(self) -> str:
        """``[scenario] name``."""
        return self.scenario.name

    @property
    def settings(self) -> dict[str, Any]:
        """Dotted keys that the caller set in place of the file's."""
        return self._settings

    @property
    def source_path(self) -> str:
        """The file that it was read from."""
        return self._source

    @property
    def folder(self) -> Path:
        """The folder that relative paths of the scenario start from."""
        return Path(self._source).parent

    @property
    def variant(self) -> str | None:
        """The variant laid over it, if any."""
        return self._variant

    @property
    def profile(self) -> str | None:
        """The profile laid over it, if any."""
        return self._profile

    @property
    def reading(self) -> str | None:
        """The reading laid over it, if any."""
        return self._reading

    def active_claims(self) -> list[ClaimConfig]:
        """The claims that this variant of the scenario tests."""
        return [claim for claim in self.claims if claim.variant in (None, self._variant)]

    def to_data(self) -> dict[str, Any]:
        """The resolved scenario as plain data, without what was left at None."""
        return self.model_dump(mode="json", exclude_none=True)

    def to_toml(self) -> str:
        """The resolved scenario as TOML text that `load_scenario` reads again."""
        return dump_toml(self.to_data())

    def digest(self) -> str:
        """Hash of all that determines the results of one run: everything but the number of runs, the claims, the readings."""
        data = self._content()
        data["monte_carlo"].pop("runs")
        for presentation in PRESENTED:
            data.pop(presentation, None)
        return _hash_of(data)

    def sensed_digests(self) -> dict[str, str]:
        """Hash of each section that determines the logs of the runs, whoever estimates on them."""
        data = self._content()
        drawn = {key: data["monte_carlo"].get(key) for key in ("seed", "vary", "disperse")}
        sections = {key: data.get(key) for key in ("flight", "flown_by", "recording", "sensors", "initial")}
        return {key: _hash_of(value) for key, value in (sections | {"monte_carlo": drawn}).items()}

    def _content(self) -> dict[str, Any]:
        """`to_data` with the content of the files that it names in place of their names."""
        data = self.to_data()
        for sensor in data.get("sensors", {}).values():
            if isinstance(sensor, dict) and "file" in sensor:
                sensor["file"] = hashlib.sha256(Path(sensor["file"]).read_bytes()).hexdigest()
        if isinstance(self.flight, FlightConfig):
            from testbed.flight.cache import flown_by

            data["flown_by"] = flown_by()
        if isinstance(self.flight, FlightConfig) and "/" in self.flight.aircraft:
            from testbed.flight.cache import content_of

            try:
                content = content_of(Path(self.flight.aircraft))
            except InputError as error:
                raise InputError(f"{self._source}: 'flight.aircraft': {error}") from None
            data["flight"]["aircraft"] = hashlib.sha256(content).hexdigest()
        if isinstance(self.flight, TrajectoryConfig):
            data["flight"]["trajectory"] = self._content_of(Path(self.flight.trajectory))
        return data

    def _content_of(self, path: Path) -> str:
        """Hash of the file of a trajectory."""
        try:
            return hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise InputError(
                f"{self._source}: 'flight.trajectory': {path}: cannot be read ({error.strerror})"
            ) from None


def _hash_of(data: Any) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]
