"""A result folder as data frames: what the runner wrote, read once and handed to every part of the report.

Source: the files of the folder, as the README lists them. Tables that a run did not need may be absent: they are empty here.
Columns carry their units; times are seconds from the start of the flight.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from testbed.base.checksums import read_json
from testbed.base.csv_text import read_csv
from testbed.base.errors import InputError
from testbed.montecarlo.store import Store, open_result, optional_part

CLAIMS = (
    "id text paper_pct measured_pct ci_low ci_high verdict n better than origin margin_pct p_holm median_pct "
    "lost_better lost_than runaways trimmed_pct"
)
CSV_COLUMNS = {
    "summary": "estimator window metric n mean std median p05 p95 ci_low ci_high",
    "timings": "estimator samples median_us min_us",
    "claims": CLAIMS,
    "consistency": "estimator quantity dof n_runs mean lower upper share_inside",
    "claims-timings": CLAIMS,
    "improvements": "estimator baseline window metric improvement_pct ci_low ci_high p_value",
}
PARQUET_COLUMNS = {
    "runs": "run estimator status seconds reason",
    "envelopes": "estimator time_s quantity mean p05 p95 rms sigma",
}


KEYS = ("estimator", "window", "metric", "quantity", "baseline", "status", "verdict", "samples", "median_us")
"""Columns that say what a row is about: no table that has them does without."""
COUNTS, MOST = ("run", "n", "n_runs", "dof", "samples"), 1e15
"""Columns that count, and beyond which nothing was counted: whole numbers are exact below."""
TEXT_COLUMNS = tuple(
    "estimator window metric id text verdict quantity baseline status reason better than origin runaways".split()
)


def _texts(value: Any) -> bool:
    """Whether a table maps names to texts."""
    return isinstance(value, dict) and all(isinstance(v, str) for v in value.values())


def _tables(value: Any) -> bool:
    """Whether a list holds tables."""
    return isinstance(value, list) and all(isinstance(v, dict) for v in value)


def _span(row: Any) -> bool:
    """Whether the last two entries are finite times."""
    return all(isinstance(v, int | float) and math.isfinite(v) for v in row[-2:])


MANIFEST_SHAPES: Mapping[str, Callable[[Any], bool]] = {
    "settings": lambda v: isinstance(v, dict),
    "packages": lambda v: isinstance(v, dict),
    "runs": lambda v: isinstance(v, int),
    "plugins": lambda v: isinstance(v, list),
    "estimators": lambda v: isinstance(v, list),
}
SCENARIO_SHAPES: Mapping[str, Callable[[Any], bool]] = {
    "scenario": lambda v: isinstance(v, dict),
    "estimators": _tables,
    "monte_carlo": lambda v: isinstance(v, dict),
    "flight": lambda v: isinstance(v, dict),
    "sensors": lambda v: isinstance(v, dict),
}
INFO_SHAPES: Mapping[str, Callable[[Any], bool]] = {
    "estimators": _texts,
    "phases": lambda v: all(len(row) == 3 and _span(row) for row in v),
    "outages": lambda v: all(len(row) == 2 and _span(row) for row in v),
    "components": lambda v: isinstance(v, dict) and all(isinstance(c, dict) for c in v.values()),
    "innovations": lambda v: isinstance(v, dict) and all(isinstance(c, list | dict) for c in v.values()),
    "sensors": lambda v: isinstance(v, dict) and all(isinstance(c, dict) for c in v.values()),
}


@dataclass(frozen=True, eq=False)
class Result:
    """One result folder. ``errors`` and ``extras`` map an estimator's label to run 0's table, ``innovations`` to one per aiding."""

    folder: Path
    manifest: Mapping[str, Any]
    scenario: Mapping[str, Any]
    summary: pd.DataFrame
    timings: pd.DataFrame
    claims: pd.DataFrame
    consistency: pd.DataFrame
    improvements: pd.DataFrame
    runs: pd.DataFrame
    envelopes: pd.DataFrame
    info: Mapping[str, Any] = field(default_factory=dict)
    truth: pd.DataFrame = field(default_factory=pd.DataFrame)
    errors: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    innovations: Mapping[str, Mapping[str, pd.DataFrame]] = field(default_factory=dict)
    extras: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    nees: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    """Run 0's, by estimator: ``quantity``, ``time_s``, ``value``, ``dof``."""
    biases: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    """Run 0's, by estimator, SI: ``time_s``, a column for each bias state, ``sigma_`` and ``true_`` of it."""
    gnss: pd.DataFrame = field(default_factory=pd.DataFrame)
    """Run 0's fixes."""
    satellites: pd.DataFrame = field(default_factory=pd.DataFrame)
    """Run 0's, a row per satellite and epoch; empty where the receiver was not simulated down to them."""
    findings: str = ""

    @cached_property
    def estimators(self) -> list[str]:
        """Labels in the scenario's order."""
        present = list(dict.fromkeys(self.summary["estimator"])) or list(dict.fromkeys(self.runs["estimator"]))
        listed = [str(e.get("label") or e.get("name")) for e in self.scenario.get("estimators", [])]
        return [e for e in listed if e in present] + [e for e in present if e not in listed]

    @cached_property
    def windows(self) -> list[str]:
        """Window names, ``all`` first."""
        names = list(dict.fromkeys(self.summary["window"]))
        return sorted(names, key=lambda name: name != "all")

    @cached_property
    def means(self) -> dict[tuple[str, str, str], dict[str, float]]:
        """(window, metric, estimator) -> mean, median, ci_low, ci_high."""
        keys = zip(*(self.summary[c] for c in ("window", "metric", "estimator")), strict=True)
        values: Any = self.summary[["mean", "median", "ci_low", "ci_high"]].astype(float).to_dict("records")
        return dict(zip(keys, values, strict=True))

    @property
    def head(self) -> Mapping[str, Any]:
        """The ``[scenario]`` section."""
        return self.scenario.get("scenario", {})

    @property
    def title(self) -> str:
        return str(self.info.get("title") or self.head.get("title") or self.head.get("name") or self.folder.name)

    @property
    def name(self) -> str:
        return str(self.head.get("name") or self.folder.name)

    @property
    def changed(self) -> str:
        """What the command line set in place of the scenario's own settings, in words; empty for nothing."""
        settings: Mapping[str, Any] = self.manifest.get("settings") or {}
        return ", ".join(f"{key} = {value}" for key, value in settings.items())

    @property
    def source(self) -> str:
        return str(self.info.get("source") or self.head.get("source") or "")

    @property
    def outages(self) -> list[tuple[float, float]]:
        return [(float(a), float(b)) for a, b in self.info.get("outages", [])]

    @property
    def phases(self) -> list[tuple[str, float, float]]:
        return [(str(name), float(a), float(b)) for name, a, b in self.info.get("phases", [])]

    @property
    def run_count(self) -> int:
        return int(self.runs["run"].nunique()) if len(self.runs) else int(self.manifest.get("runs", 0) or 0)

    @property
    def notes(self) -> list[str]:
        """What the scenario says without effect, in sentences."""
        return [str(note) for note in self.manifest.get("notes") or []]

    @property
    def replications(self) -> int:
        """Runs that differ from one another: copies of a run, as of a recording, count as one."""
        return int(self.summary["n"].max()) if self.summary["n"].notna().any() else self.run_count

    @property
    def flown(self) -> bool:
        """Whether the runs are of a flight, and not of a recording."""
        return "flight" in self.scenario

    @property
    def flights_vary(self) -> bool:
        """Whether each run has a flight of its own."""
        settings = self.scenario.get("monte_carlo", {})
        return self.flown and "manoeuvres" in settings.get("vary", []) and bool(settings.get("disperse"))

    def components(self, label: str) -> dict[str, list[str]]:
        """Names of the components of an estimator's extras, where ``info.json`` has them (``components``)."""
        return dict(self.info.get("components", {}).get(label, {}))

    def channels(self, label: str, aiding: str = "gnss") -> list[str]:
        """Names of the channels of an estimator's innovations, where ``info.json`` has them; else numbered."""
        count = sum(str(c).startswith("nu_") for c in self.innovations[label][aiding])
        given = self.info.get("innovations", {}).get(label, {})
        names = given if isinstance(given, list) else given.get(aiding, [])  # a list: results of version 0.1
        if len(names) < count:
            return [f"channel {k + 1}" for k in range(count)]
        return [str(name) for name in names]

    def per_run(self, metrics: list[str], window: str) -> pd.DataFrame:
        """Rows of ``metrics.parquet``: run, estimator, window, metric, value. Only what is asked for is read."""
        columns = ["run", "estimator", "window", "metric", "value"]
        chosen = [("metric", "in", metrics), ("window", "==", window)]

        def read(path: Path) -> pd.DataFrame:
            return pd.read_parquet(path, columns=columns, filters=chosen)

        frame: pd.DataFrame | None = optional_part(open_result(self.folder), "metrics.parquet", read)
        return pd.DataFrame(columns=columns) if frame is None else frame


def load_result(folder: str | Path) -> Result:
    """Read a result folder. Raises InputError when ``manifest.json`` or ``summary.csv`` is missing or unreadable."""
    folder = Path(folder)
    for needed in ("manifest.json", "summary.csv"):
        if not (folder / needed).is_file():
            raise InputError(
                f"{folder}: no result folder ('{needed}' is missing); `testbed run SCENARIO --out DIR` makes one"
            )
    store = open_result(folder)
    if store.manifest.get("finished") is False:
        raise InputError(f"{folder}: is not finished; complete it with the same testbed run and --resume")
    tables: dict[str, Any] = {k: _read(store, f"{k}.csv", names) for k, names in CSV_COLUMNS.items()}
    tables |= {k: _read(store, f"{k}.parquet", names) for k, names in PARQUET_COLUMNS.items()}
    timed = tables.pop("claims-timings")
    tables["claims"] = pd.concat([tables["claims"], timed], ignore_index=True) if len(timed) else tables["claims"]
    store.check("metrics.parquet")
    scenario = optional_part(store, "scenario.toml", lambda path: tomllib.loads(path.read_text("utf-8"))) or {}
    text = optional_part(store, "findings.md", lambda path: path.read_text("utf-8")) or ""
    manifest = _checked(store.manifest, folder / "manifest.json", MANIFEST_SHAPES)
    scenario = _checked(scenario, folder / "scenario.toml", SCENARIO_SHAPES)
    return Result(folder=folder, manifest=manifest, scenario=scenario, findings=text, **tables, **_load_details(store))


def thin(frame: pd.DataFrame, points: int) -> pd.DataFrame:
    """Every k-th row, so that at most ``points`` remain."""
    return frame.iloc[:: max(1, -(-len(frame) // points))]


def _read(store: Store, name: str, columns: str) -> pd.DataFrame:
    wanted = columns.split()
    texts = {column: str for column in wanted if column in TEXT_COLUMNS}

    def read(path: Path) -> pd.DataFrame:
        frame = read_csv(path, dtype=texts) if path.suffix == ".csv" else pd.read_parquet(path)
        for column in wanted:
            if column not in texts and column in frame and not _numbers(frame[column]):
                raise ValueError(f"column '{column}' holds something else than numbers")
        for column in KEYS:
            if column in wanted and (column not in frame or frame[column].isna().any()):
                raise ValueError(f"column '{column}' is missing or has empty cells")
        for column in COUNTS:
            if column in wanted and column in frame and not frame[column].dropna().between(0, MOST).all():
                raise ValueError(f"column '{column}' holds what is no count")
        return frame.reindex(columns=[*frame.columns, *(c for c in wanted if c not in frame.columns)])

    frame = optional_part(store, name, read)
    return pd.DataFrame(columns=wanted) if frame is None else frame


def _load_details(store: Store) -> dict[str, Any]:
    info = optional_part(store, "details/info.json", read_json)
    if info is None:
        return {}
    info = _checked(info, store.out / "details" / "info.json", INFO_SHAPES)
    found: dict[str, Any] = {"info": info}
    if (truth := optional_part(store, "details/truth.parquet", _over_time)) is not None:
        found["truth"] = truth
    if (gnss := optional_part(store, "details/gnss.parquet", _over_time)) is not None and set(gnss) >= FIX_PLACE:
        found["gnss"] = gnss
    if (satellites := optional_part(store, "details/satellites.parquet", _of_satellites)) is not None:
        found["satellites"] = satellites
    for kind in ("errors", "innovations", "extras", "nees", "biases"):
        names = {label: f"details/{kind}-{slug}.parquet" for label, slug in info.get("estimators", {}).items()}
        tables = {label: optional_part(store, name, _over_time) for label, name in names.items()}
        found[kind] = {label: table for label, table in tables.items() if table is not None}
    found["innovations"] = {label: _by_aiding(frame) for label, frame in found["innovations"].items()}
    return found


LONGEST_S = 1e9
"""Thirty years: no run lasts so long, and its samples can still be counted."""


def _over_time(path: Path) -> pd.DataFrame:
    """A table of run 0: a column of times, and numbers or marks beside it. Raises ValueError for anything else."""
    frame = pd.read_parquet(path)
    if "time_s" not in frame or not pd.api.types.is_numeric_dtype(frame["time_s"]):
        raise ValueError("it has no column 'time_s' of numbers")
    if not (frame["time_s"].abs() < LONGEST_S).all():
        raise ValueError("its 'time_s' holds what is no time of a run")
    return frame


FIX_PLACE = {"lat_deg", "lon_deg", "alt_m"}
SATELLITE_COLUMNS = ("azimuth_deg", "elevation_deg", "cn0_dbhz", "residual_m", "used", "hdop", "vdop")


def _of_satellites(path: Path) -> pd.DataFrame:
    """Satellites over time. Raises ValueError where a column is missing or holds something else."""
    frame = _over_time(path)
    for column in SATELLITE_COLUMNS:
        if column not in frame or not _numbers(frame[column]):
            raise ValueError(f"it has no column '{column}' of numbers")
    if "satellite" not in frame or not frame["satellite"].map(lambda name: isinstance(name, str)).all():
        raise ValueError("it has no column 'satellite' of names")
    return frame


def _by_aiding(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """A file of innovations as a table per aiding, each with its own channels; version 0.1 had GNSS alone."""
    if "aiding" not in frame:
        return {"gnss": frame}
    found = {}
    for aiding, part in frame.groupby("aiding", sort=False):
        spreads = [str(c) for c in part if str(c).startswith("s_")]
        foreign = [c for c in spreads if part[c].isna().all()]  # channels of an aiding that has more of them
        part = part.drop(columns=["aiding", *foreign, *(c.replace("s_", "nu_") for c in foreign)])
        found[str(aiding)] = part.reset_index(drop=True)
    return found


def _checked(data: dict[str, Any], path: Path, shapes: Mapping[str, Callable[[Any], bool]]) -> dict[str, Any]:
    """The data, once its entries have the shape that the report reads. Raises InputError naming the first that has not."""
    for key, fits in shapes.items():
        try:
            good = data.get(key) is None or fits(data[key])
        except (TypeError, ValueError, AttributeError):
            good = False
        if not good:
            raise InputError(f"{path}: damaged ('{key}' is not what testbed run writes)")
    return {key: value for key, value in data.items() if key not in shapes or value is not None}


def _numbers(column: pd.Series) -> bool:
    """Whether a column holds numbers, or nothing at all."""
    return pd.api.types.is_numeric_dtype(column) or bool(column.isna().all())
