"""A result folder as data frames: what the runner wrote, read once and handed to every part of the report.

Source: the files of the folder, as the README lists them. Tables that a run did not need may be absent: they are empty here.
Columns carry their units; times are seconds from the start of the flight.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from testbed.errors import InputError

CSV_COLUMNS = {
    "summary": "estimator window metric n mean std median p05 p95 ci_low ci_high",
    "timings": "estimator samples median_us min_us",
    "claims": "id text paper_pct measured_pct ci_low ci_high verdict",
    "consistency": "estimator quantity dof n_runs mean lower upper share_inside",
    "claims-timings": "id text paper_pct measured_pct ci_low ci_high verdict",
    "improvements": "estimator baseline window metric improvement_pct ci_low ci_high p_value",
}
PARQUET_COLUMNS = {
    "runs": "run estimator status seconds reason",
    "envelopes": "estimator time_s quantity mean p05 p95 rms sigma",
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
        path = self.folder / "metrics.parquet"
        if not path.exists():
            return pd.DataFrame(columns=["run", "estimator", "window", "metric", "value"])
        return pd.read_parquet(path, filters=[("metric", "in", metrics), ("window", "==", window)])


def load_result(folder: str | Path) -> Result:
    """Read a result folder. Raises InputError when ``manifest.json`` or ``summary.csv`` is missing or unreadable."""
    folder = Path(folder)
    for needed in ("manifest.json", "summary.csv"):
        if not (folder / needed).is_file():
            raise InputError(
                f"{folder}: no result folder ('{needed}' is missing); `testbed run SCENARIO --out DIR` makes one"
            )
    try:
        tables: dict[str, Any] = {k: _read(folder / f"{k}.csv", names) for k, names in CSV_COLUMNS.items()}
        tables |= {k: _read(folder / f"{k}.parquet", names) for k, names in PARQUET_COLUMNS.items()}
        timed = tables.pop("claims-timings")
        tables["claims"] = pd.concat([tables["claims"], timed], ignore_index=True) if len(timed) else tables["claims"]
        scenario_file = folder / "scenario.toml"
        scenario = tomllib.loads(scenario_file.read_text("utf-8")) if scenario_file.exists() else {}
        details = _load_details(folder / "details")
        manifest = json.loads((folder / "manifest.json").read_text("utf-8"))
    except (ValueError, OSError, KeyError) as error:
        raise InputError(f"{folder}: damaged result folder: {error}") from error
    findings = next((p for p in (folder / "findings.md",) if p.is_file()), None)
    text = findings.read_text("utf-8") if findings else ""
    return Result(folder=folder, manifest=manifest, scenario=scenario, findings=text, **tables, **details)


def thin(frame: pd.DataFrame, points: int) -> pd.DataFrame:
    """Every k-th row, so that at most ``points`` remain."""
    return frame.iloc[:: max(1, -(-len(frame) // points))]


def _read(path: Path, columns: str) -> pd.DataFrame:
    if not path.exists():
        return pd.DataFrame(columns=columns.split())
    frame = pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)
    return frame.reindex(columns=[*frame.columns, *(c for c in columns.split() if c not in frame.columns)])


def _load_details(folder: Path) -> dict[str, Any]:
    if not (folder / "info.json").is_file():
        return {}
    info = json.loads((folder / "info.json").read_text("utf-8"))
    found: dict[str, Any] = {"info": info}
    if (folder / "truth.parquet").exists():
        found["truth"] = pd.read_parquet(folder / "truth.parquet")
    for kind in ("errors", "innovations", "extras"):
        paths = {label: folder / f"{kind}-{slug}.parquet" for label, slug in info.get("estimators", {}).items()}
        found[kind] = {label: pd.read_parquet(path) for label, path in paths.items() if path.exists()}
    found["innovations"] = {label: _by_aiding(frame) for label, frame in found["innovations"].items()}
    return found


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
