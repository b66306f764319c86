"""Training data: many drawn flights of a scenario's aircraft, sensed, and stored as Parquet shards with the truth.

`[extra.dataset]` of a scenario says how many flights, how long and how varied; scripts, payload, wind and turbulence are
drawn from the scenario's seed. One shard (`testbed.training.shards`) is one flight, so that a split is always by flight.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from testbed.base.checksums import read_json
from testbed.base.errors import FlightError, InputError, nearest
from testbed.base.schema import Table, validate
from testbed.base.streams import stream
from testbed.flight.cache import flown_by
from testbed.flight.config import FlightConfig
from testbed.montecarlo.folders import MANIFEST, Folder
from testbed.scenario import Scenario
from testbed.training.shards import ROWS_PER_GROUP as ROWS_PER_GROUP
from testbed.training.shards import WIDTHS, Shard, shard_meta, write_shard

if TYPE_CHECKING:
    from testbed.data.records import Trajectory

KIND = "testbed data set"
_SHARD = re.compile(r"flight-[0-9]{3,}\.parquet")
SPLITS = ("train", "validation", "test")
ATTEMPTS = 20
"""Scripts drawn for a flight before the aircraft is held to be unable to fly any."""


def _ascending(values: list[float]) -> list[float]:
    if values[0] > values[1]:
        raise ValueError("the low end comes first")
    return values


Interval = Annotated[list[float], Field(min_length=2, max_length=2), AfterValidator(_ascending)]
"""Low and high."""
Duration = Annotated[float, Field(ge=5.0, le=3600.0)]


class DatasetConfig(Table):
    """``[extra.dataset]``: intervals are uniform."""

    flights: int = Field(default=8, ge=2)
    """How many."""
    validation: int = Field(default=1, ge=1)
    """How many of the flights are held back to choose the best weights: the last ones, before those of ``test``."""
    test: int = Field(default=0, ge=0)
    """How many of the flights, the last ones, no training ever sees."""
    duration_s: float = Field(default=1500.0, gt=30.0, le=100_000.0)
    """Of each flight."""
    seed: int = Field(default=1, ge=0)
    """Of all that is drawn: flight k is the same whatever their number."""
    payload_kg: Interval = [0.0, 2.0]
    """Least and greatest payload."""
    wind_mps: float = Field(default=5.0, ge=0.0, le=50.0)
    """Largest steady wind, in a drawn direction."""
    turbulence: list[Literal["none", "light", "moderate", "severe"]] = ["none", "light", "moderate"]
    """One of these is drawn for each flight."""
    speed_mps: Interval = [25.0, 36.0]
    """Airspeed at the start, and what manoeuvres change it to."""
    alt_m: Interval = [800.0, 1500.0]
    """Height at the start."""
    bank_deg: Interval = [15.0, 50.0]
    """Bank of turns, to either side."""
    radius_m: Interval = [160.0, 400.0]
    """Of loiters."""
    climb_rate_mps: Interval = [1.0, 2.5]
    """Of climbs and descents."""
    manoeuvre_s: Annotated[list[Duration], Field(min_length=2, max_length=2), AfterValidator(_ascending)] = [
        20.0,
        400.0,
    ]
    """How long a manoeuvre lasts; the logarithm is uniform. Climbs and descents take an eighth, loiters half as long again."""


def dataset_config(scenario: Scenario) -> DatasetConfig:
    """The checked ``[extra.dataset]`` of a scenario."""
    return validate(DatasetConfig, scenario.extra.get("dataset", {}), f"{scenario.source_path}: extra.dataset")


def make_dataset(
    scenario: Scenario,
    out: str | Path,
    flights: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Fly, sense and store the flights; returns the folder with ``manifest.json`` and ``flight-NNN.parquet``.

    Flights that are already there for the same scenario are kept, so that a killed call goes on where it stopped.
    """
    config = dataset_config(scenario)
    count = config.flights if flights is None else flights
    if count <= (held := config.validation + config.test):
        raise InputError(
            f"{count} flights leave none to train on: {held} are for {'validation and test' if config.test else 'validation'}"
        )
    if scenario.sensors is None:
        raise InputError(f"{scenario.source_path}: a data set needs [sensors]")
    key = dataset_key(scenario)
    shards = [f"flight-{k:03d}.parquet" for k in range(count)]
    with Folder.open(out, KIND, among=_only_shards(Path(out), key)) as folder:
        if folder.manifest.get("key", key) != key:
            raise InputError(f"{folder.out}: holds the data set of another scenario; give another --out")
        adopted = [path.name for path in folder.out.glob("flight-*.parquet") if "key" not in folder.manifest]
        folder.files.update(dict.fromkeys(adopted))
        folder.save(key=key, finished=False)
        folder.claim(shards)
        entries = []
        for k, name in enumerate(shards):
            entries.append(_flight_shard(scenario, config, k, folder.out / name, key))
            entries[-1]["split"] = SPLITS[(k >= count - held) + (k >= count - config.test)]
            folder.finish(name)
            if progress is not None:
                progress(k + 1, count)
        made = {"scenario": scenario.name, "flights": entries, "config": config.model_dump(mode="json")}
        folder.save(**made, finished=True)
    return folder.out


def _only_shards(out: Path, key: str) -> bool:
    """Whether a folder holds flights of this data set and nothing else: what is left where the manifest was lost."""
    if not out.is_dir() or (out / MANIFEST).exists():
        return False
    try:
        return all(_SHARD.fullmatch(path.name) and shard_meta(path).get("key") == key for path in out.iterdir())
    except InputError:
        return False


def dataset_key(scenario: Scenario) -> str:
    """Hash of all that determines a flight of the data set: the sensors, the initial errors and ``[extra.dataset]``."""
    import hashlib

    data = scenario.to_data()
    parts = {key: data.get(key, {}) for key in ("flight", "sensors", "initial")}
    parts["flight"] = {key: parts["flight"].get(key) for key in ("aircraft", "rate_hz", "initial")}
    parts["flown_by"] = flown_by()
    settings = dataset_config(scenario).model_dump(mode="json")
    parts["dataset"] = {key: value for key, value in settings.items() if key not in ("flights", "validation", "test")}
    parts["columns"] = WIDTHS
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


def draw_flight(scenario: Scenario, config: DatasetConfig, rng: np.random.Generator) -> FlightConfig:
    """One drawn flight: script, payload, wind, turbulence and start."""
    if not isinstance(scenario.flight, FlightConfig):
        raise InputError(f"{scenario.source_path}: a data set needs a scenario with [flight] and an aircraft")
    direction, strength = rng.uniform(0.0, 2.0 * math.pi), config.wind_mps * math.sqrt(rng.uniform())
    initial = scenario.flight.initial.model_dump() | {
        "alt_m": _between(rng, config.alt_m),
        "speed_mps": _between(rng, config.speed_mps),
        "heading_deg": float(rng.uniform(-180.0, 180.0)),
    }
    data = {
        "aircraft": scenario.flight.aircraft,
        "rate_hz": scenario.flight.rate_hz,
        "duration_s": config.duration_s,
        "payload_kg": _between(rng, config.payload_kg),
        "initial": initial,
        "wind": {
            "north_mps": strength * math.cos(direction),
            "east_mps": strength * math.sin(direction),
            "turbulence": str(rng.choice(config.turbulence)),
            "seed": int(rng.integers(2**31)),
        },
        "manoeuvres": _draw_script(config, initial["alt_m"], rng),
    }
    return validate(FlightConfig, data, "drawn flight")


def _draw_script(config: DatasetConfig, alt_m: float, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Manoeuvres until they surely last ``duration_s``."""
    script: list[dict[str, Any]] = []
    expected = 0.0
    while expected < 1.3 * config.duration_s:
        manoeuvre, seconds = _draw_manoeuvre(config, alt_m, rng)
        if manoeuvre["type"] == "accelerate":
            manoeuvre = {"type": "straight", "speed_mps": manoeuvre["to_speed_mps"], "duration_s": seconds}
        script.append(manoeuvre)
        expected += seconds
    return script


def _draw_manoeuvre(config: DatasetConfig, alt_m: float, rng: np.random.Generator) -> tuple[dict[str, Any], float]:
    """A manoeuvre and about how long it takes, s."""
    kinds = ("straight", "accelerate", "turn", "loiter", "s_turn", "figure_eight", "climb", "descent")
    kind = str(rng.choice(kinds, p=(0.3, 0.1, 0.16, 0.16, 0.08, 0.06, 0.07, 0.07)))
    bank = _between(rng, config.bank_deg) * float(rng.choice((-1.0, 1.0)))
    seconds = math.exp(_between(rng, [math.log(v) for v in config.manoeuvre_s]))
    if kind == "straight":
        return {"type": kind, "duration_s": seconds}, seconds
    if kind == "accelerate":
        return {"type": kind, "to_speed_mps": _between(rng, config.speed_mps)}, 0.5 * seconds
    if kind == "turn":
        climbing = {"climb_rate_mps": float(rng.uniform(-1.0, 1.0))} if rng.uniform() < 0.3 else {}
        return {"type": kind, "bank_deg": bank, "duration_s": seconds} | climbing, seconds
    if kind == "loiter":
        radius, side = _between(rng, config.radius_m), str(rng.choice(("left", "right")))
        return {"type": kind, "radius_m": radius, "direction": side, "duration_s": 1.5 * seconds}, 1.5 * seconds
    if kind == "s_turn":
        change = float(rng.uniform(30.0, 150.0))
        return {"type": kind, "bank_deg": bank, "heading_change_deg": change, "duration_s": seconds}, seconds
    if kind == "figure_eight":
        return {"type": kind, "bank_deg": bank, "duration_s": seconds}, seconds
    rate = _between(rng, config.climb_rate_mps)
    return {"type": kind, "climb_rate_mps": rate, "duration_s": seconds / 8.0}, seconds / 8.0


def _between(rng: np.random.Generator, interval: Sequence[float]) -> float:
    return float(rng.uniform(interval[0], interval[1]))


def fly_drawn(scenario: Scenario, config: DatasetConfig, k: int) -> tuple[Trajectory, FlightConfig, int]:
    """Flight ``k``: the first drawn script that the aircraft can fly, and how many were refused before it."""
    from testbed.flight import fly_flight

    refused = ""
    for attempt in range(ATTEMPTS):
        flight = draw_flight(scenario, config, stream(config.seed, k, f"dataset.flight.{attempt}"))
        try:
            return fly_flight(flight, use_cache=False), flight, attempt
        except FlightError as error:
            refused = str(error)
    raise FlightError(f"flight {k}: the aircraft could fly none of {ATTEMPTS} drawn scripts; the last: {refused}")


def _flight_shard(scenario: Scenario, config: DatasetConfig, k: int, path: Path, key: str) -> dict[str, Any]:
    """The entry of flight ``k``, flown and stored at ``path`` unless it is there, whole and of this data set."""
    from testbed.base.errors import tell_user
    from testbed.sensors import sense_flight

    if path.exists():
        try:
            if (stored := shard_meta(path)).get("key") == key and stored["entry"]["sensor_run"] == k:
                entry: dict[str, Any] = stored["entry"]
                return entry
            tell_user(f"{path}: holds a flight of another data set; it is flown again")
        except InputError as error:
            tell_user(f"{error}; it is flown again")
    trajectory, flight, refused = fly_drawn(scenario, config, k)
    assert scenario.sensors is not None
    log, errors = sense_flight(scenario.sensors, scenario.initial, trajectory, config.seed, k)
    entry = {
        "file": path.name,
        "flight": flight.model_dump(mode="json", exclude_none=True),
        "sensor_seed": config.seed,
        "sensor_run": k,
        "scripts_refused": refused,
        "rows": len(log.imu.t),
    }
    write_shard(path, log, trajectory, {"key": key, "entry": entry}, errors)
    return entry


def open_dataset(folder: str | Path) -> tuple[list[Shard], list[Shard]]:
    """The training and the validation flights of a data set. Raises InputError when the folder holds none."""
    return _flights(folder, "train"), _flights(folder, "validation")


def open_split(folder: str | Path, split: str) -> list[Shard]:
    """The flights of "train", "validation" or "test". Raises InputError for a data set or split that there is not."""
    if split not in SPLITS:
        raise InputError(f"there is no split '{split}'; {nearest(split, SPLITS)}")
    if not (found := _flights(folder, split)):
        raise InputError(f"{folder}: no flight is kept for '{split}'; [extra.dataset] {split} = N keeps some")
    return found


def _flights(folder: str | Path, split: str) -> list[Shard]:
    folder = Path(folder)
    manifest = folder / "manifest.json"
    if not manifest.is_file():
        raise InputError(f"{folder}: no data set (it has no manifest.json); make one with: testbed dataset SCENARIO")
    content = read_json(manifest)
    if content.get("finished") is False:
        raise InputError(f"{folder}: this data set is not finished; complete it with: testbed dataset SCENARIO")
    entries = content.get("flights")
    if not isinstance(entries, list) or not all(
        isinstance(e, dict) and isinstance(e.get("file"), str) and isinstance(e.get("split"), str) for e in entries
    ):
        raise InputError(f"{manifest}: damaged, or not of a data set ('flights' does not list them)")

    return [Shard(folder / entry["file"]) for entry in entries if entry["split"] == split]


__all__: Sequence[str] = (
    "DatasetConfig",
    "Shard",
    "dataset_config",
    "make_dataset",
    "open_dataset",
    "open_split",
    "write_shard",
)
