"""The scenario: one TOML file that says what flies, what is sensed, who estimates, what is scored and what is claimed.

`load_scenario` reads it, lays a profile, a variant and single settings over it, and checks it; the result is immutable
plain data. Angles are in degrees here and nowhere else; every key carries its unit.
"""

from __future__ import annotations

import copy
import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Discriminator, Field, PrivateAttr, Tag, model_validator

from testbed.base import resources
from testbed.base.errors import OWN, InputError, nearest, shown
from testbed.base.schema import (
    DEEPEST,
    JSBSIM,
    OWN_TRACK,
    Name,
    Table,
    dump_toml,
    is_file,
    parse_toml,
    read_toml,
    validate,
)
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
OWN_FILE = f"flight.{OWN_TRACK}"
PLAN = "flight.plan"
EXTERNAL = "external"
"""The estimator whose answers other programs made (`testbed.montecarlo.external`)."""
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
        for presentation in ("claims", "readings", "tables"):
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


def list_scenarios() -> dict[str, Path]:
    """Names and files of the shipped scenarios."""
    return {path.stem: path for path in sorted(resources.scenario_root().glob("*.toml"))}


def overlays_of(name_or_path: str | Path) -> tuple[list[str], list[str]]:
    """Names of the profiles and of the variants that a scenario file has."""
    path = find_scenario(name_or_path)
    overlays = _take_overlays(read_toml(path), path)
    return list(overlays["profiles"]), list(overlays["variants"])


def find_scenario(name_or_path: str | Path) -> Path:
    """The file behind a path or the name of a shipped scenario. Raises InputError with the nearest name."""
    path = Path(name_or_path)
    if path.suffix == ".toml" or is_file(path):
        if not is_file(path):
            raise InputError(f"{path}: no such scenario file")
        return path
    shipped = list_scenarios()
    if str(name_or_path) not in shipped:
        if is_file(own := Path(f"{name_or_path}.toml")):
            raise InputError(f"no shipped scenario is called '{name_or_path}'; did you mean the file {own}?")
        raise InputError(f"unknown scenario '{name_or_path}'; {nearest(str(name_or_path), shipped)}")
    return shipped[str(name_or_path)]


def load_scenario(
    name_or_path: str | Path,
    profile: str | None = None,
    variant: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    reading: str | None = None,
) -> Scenario:
    """Read and check a scenario.

    ``profile``, ``variant`` and ``reading`` name overlays of the file; ``overrides`` maps dotted keys (list positions are
    numbers) to values and stands above all. Raises InputError that names the file and the key.
    """
    path = find_scenario(name_or_path)
    data = read_toml(path)
    overlays = _take_overlays(data, path)
    for kind, chosen in (("variants", variant), ("profiles", profile)):
        if chosen is None:
            continue
        if chosen not in overlays[kind]:
            raise InputError(f"{path}: no [{kind}.{chosen}]; {nearest(chosen, overlays[kind])}")
        data = _overlay(data, overlays[kind][chosen])
    if reading is not None:
        data = _overlay(data, _reading_overlay(data, reading, path))
    if OWN_FILE in (overrides or {}) and OWN_TRACK not in data.get("flight", {}):
        data["flight"] = {}  # a file in place of what the scenario flies
    if PLAN in (overrides or {}) and isinstance(data.get("flight"), dict):
        for key in ("manoeuvres", "initial"):  # a plan in place of what the scenario flies
            data["flight"].pop(key, None)
    for key, value in (overrides or {}).items():
        set_key(data, key, value, str(path))
    _inline_parameter_files(data, path)
    _find_answers(data, path)
    if "recording" in data and "flight" not in data and "sensors" not in data:
        data = merge({"monte_carlo": {"runs": 1}}, data)  # every run of a recording is the same
    scenario = validate(Scenario, data, str(path), path.resolve().parent)
    scenario._source, scenario._variant, scenario._profile = str(path.resolve()), variant, profile
    scenario._settings, scenario._reading = dict(overrides or {}), reading
    _check_estimators(scenario)
    _check_dispersion(scenario)
    return scenario


def _take_overlays(data: dict[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    """Profiles and variants, taken out of the file's tables. Raises InputError for anything but tables of tables."""
    overlays = {kind: data.pop(kind, {}) for kind in ("profiles", "variants")}
    for kind, tables in overlays.items():
        if not isinstance(tables, dict):
            raise InputError(f"{path}: '{kind}' holds tables [{kind}.NAME], got {shown(tables)}")
        for name, table in tables.items():
            if not isinstance(table, dict):
                raise InputError(f"{path}: '{kind}.{name}' should be a table of settings, got {shown(table)}")
    return overlays


def _check_dispersion(scenario: Scenario) -> None:
    """Raise InputError for a dispersed key that no flight has, or a distribution whose own marks no flight allows."""
    if scenario.flight is None or isinstance(scenario.flight, TrajectoryConfig):
        return  # a file's trajectory is the same in every run
    flight = scenario.flight.model_dump(mode="json", exclude_none=True)
    for key, distribution in scenario.monte_carlo.disperse.items():
        if "*" in key:
            continue  # each manoeuvre that has the key is checked when its value is drawn
        for mark in distribution.marks:
            data = copy.deepcopy(flight)
            where = f"{scenario.source_path}: 'monte_carlo.disperse', '{key}' = {mark:g}"
            set_key(data, key, mark, where)
            validate(type(scenario.flight), data, where)


def _reading_overlay(data: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    """The overlay of a reading. Raises InputError with the nearest name."""
    entries = {str(e["name"]): e for e in data.get("readings", []) if isinstance(e, dict) and "name" in e}
    if name not in entries:
        raise InputError(f"{path}: no [[readings]] named '{name}'; {nearest(name, entries)}")
    return validate(ReadingConfig, entries[name], f"{path}: reading '{name}'").overlay


def _overlay(data: dict[str, Any], overlay: Mapping[str, Any]) -> dict[str, Any]:
    """`merge`; a file's trajectory takes the place of the flight, ``[recording]`` that of the flight and its sensors."""
    if "recording" in overlay and "flight" in data:
        data = {key: value for key, value in data.items() if key not in ("flight", "sensors")}
    flight = overlay.get("flight")
    if isinstance(flight, Mapping) and OWN_TRACK in flight and OWN_TRACK not in data.get("flight", {}):
        data = data | {"flight": {}}
    return merge(data, overlay)


def _inline_parameter_files(data: dict[str, Any], path: Path) -> None:
    """Replace each ``params_file`` by what it says, so that a resolved scenario depends on no other file."""
    entries = data.get("estimators")
    for k, entry in enumerate(entries if isinstance(entries, list) else []):
        if not isinstance(entry, dict) or not isinstance(entry.get("params_file"), str):
            continue
        if not isinstance(entry.get("params", {}), dict):
            continue  # told when the scenario is checked
        file = path.parent / entry.pop("params_file")
        where = f"{path}: 'estimators.{k}.params_file'"
        try:
            read = read_toml(file).get("params")
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        if not isinstance(read, dict):
            raise InputError(f"{where}: {file}: a parameter file needs a table [params]")
        entry["params"] = merge(read, entry.get("params", {}))


def _find_answers(data: Mapping[str, Any], path: Path) -> None:
    """The folder of the answers of an external filter starts, like every path of a scenario, at the scenario's own folder."""
    entries = data.get("estimators")
    for entry in entries if isinstance(entries, list) else []:
        params = entry.get("params") if isinstance(entry, dict) and entry.get("name") == EXTERNAL else None
        if isinstance(params, dict) and isinstance(params.get("dir"), str):
            entry["params"] = params | {"dir": str((path.parent / params["dir"]).resolve())}


def _check_estimators(scenario: Scenario) -> None:
    from testbed.data.registry import list_estimators

    known = list_estimators()
    for k, entry in enumerate(scenario.estimators):
        if entry.name not in known:
            hint = nearest(entry.name, known)
            raise InputError(
                f"{scenario.source_path}: 'estimators.{k}.name': unknown estimator '{entry.name}'; {hint}; {OWN}"
            )


def merge(base: Mapping[str, Any], overlay: Mapping[str, Any]) -> dict[str, Any]:
    """Tables are merged key by key; every other value, lists included, is replaced."""
    out = dict(base)
    for key, value in overlay.items():
        both = isinstance(value, Mapping) and isinstance(out.get(key), Mapping)
        out[key] = merge(out[key], value) if both else value
    return out


def set_key(data: dict[str, Any], key: str, value: Any, source: str) -> None:
    """Set a dotted key in place, for example ``sensors.gnss.outages`` or ``flight.manoeuvres.0.bank_deg``.

    A row of a list is meant by its position from 0, an estimator also by its label or name (``estimators.imm.params.beta``); an
    estimator that has no row yet gets one.
    """
    *parents, last = key.split(".")
    node: Any = data
    if len(parents) >= DEEPEST:
        raise InputError(f"{source}: cannot set {shown(key)}: no key lies more than {DEEPEST} tables deep")
    for part in parents:
        node = node[_position(node, part, key, source)] if isinstance(node, list) else node.setdefault(part, {})
        if not isinstance(node, dict | list):
            raise InputError(f"{source}: cannot set '{key}': '{part}' is a single value")
    node[_position(node, last, key, source) if isinstance(node, list) else last] = value


def _position(node: list[Any], part: str, key: str, source: str) -> int:
    number = position_of(part)
    if key.startswith("estimators.") and key.split(".")[1] == part and number is None:
        rows = [str(row.get("label") or row.get("name")) for row in node if isinstance(row, dict)]
        if part not in rows:
            node.append({"name": part})
            return len(node) - 1
        return rows.index(part)
    if number is None or number >= len(node):
        raise InputError(f"{source}: cannot set '{key}': '{part}' is not a position from 0 to {len(node) - 1}")
    return number


def position_of(text: str) -> int | None:
    """The number that ``text`` writes in plain digits; None for anything else (``str.isdigit`` takes a superscript two)."""
    return int(text) if re.fullmatch("[0-9]{1,9}", text) else None


def parse_setting(text: str) -> tuple[str, Any]:
    """``KEY=VALUE`` of ``--set``, the value in TOML; a bare word counts as a string."""
    key, separator, value = text.partition("=")
    if not separator or not key:
        raise InputError(f"--set {text}: expected KEY=VALUE, for example monte_carlo.runs=50")
    return key.strip(), parse_value(value)


def parse_value(text: str) -> Any:
    """A value as TOML writes it; what is no TOML, such as a bare word, counts as a string."""
    try:
        return parse_toml(f"value = {text}", "--set")["value"]
    except InputError:
        return text.strip()
