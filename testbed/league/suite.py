"""The suite: eight tracks, each a scenario of ``scenarios/league`` with a table ``[extra.league]``, and the seeds of its runs.

Development seeds are public. The seeds of the test follow from the hash of the suite's version (`SUITE`), so that nobody tunes
to them by accident; whoever changes a track raises the version.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from testbed.base import resources
from testbed.base.errors import InputError, nearest
from testbed.base.schema import Table, validate
from testbed.flight.drive import DriveConfig
from testbed.scenario import Scenario, load_scenario

SUITE = "2026.1"
"""Version of the suite: tracks, protocol and test seeds."""
TRACKS = (
    *("agile-outages", "uav-outliers", "raw-unit", "city-partial", "whole-flight", "real-drive", "long-flight"),
    "no-gnss",
)
"""In the order of the tables."""
DEVELOPMENT_SEED = 1
"""Of all tracks: the number that every shipped scenario has, too."""
REFERENCE = {"position": "indirect-kf", "attitude": "ahrs-kf"}
"""The estimator whose time per sample is the unit of the column of times, by class: the plainest filter that ships."""
Class = Literal["position", "attitude"]
RECORDED = ("real-drive",)
"""Tracks whose data the user brings (``--data``)."""


class TrackTable(Table):
    """``[extra.league]``: how a track is scored, and why it is there."""

    filters: Class = Field(alias="class")
    """Which filters it is for: position, attitude."""
    metric: str
    """As ``testbed list metrics`` shows them: its mean over the runs ranks."""
    window: str = "all"
    """Of the scenario's windows the one that counts."""
    length_s: float = Field(gt=0.0)
    """Length of one run, as the tables state it."""
    why: str
    """What it asks of a filter."""


@dataclass(frozen=True)
class Track:
    """A track as it is run: its scenario with the seed of the test or of development."""

    name: str
    scenario: Scenario
    table: TrackTable
    content: str = ""
    """Hash of the recording that it is made of."""

    @property
    def digest(self) -> str:
        """Hash of all that determines the logs and the scores of its runs, their number apart."""
        scenario = self.scenario
        if scenario.recording is not None:  # where a recording lies is nothing of it
            scenario = scenario.model_copy(update={"recording": scenario.recording.model_copy(update={"dir": "."})})
        data = [scenario.digest(), self.content, self.table.model_dump(mode="json")]
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def track_files() -> dict[str, Path]:
    """Name and file of every track."""
    return {name: resources.scenario_root() / "league" / f"{name}.toml" for name in TRACKS}


def released_seed(track: str, suite: str = SUITE) -> int:
    """The seed of a track's test runs: the first 32 bits of the hash of the suite's version and the track's name."""
    return int.from_bytes(hashlib.sha256(f"league {suite} {track}".encode()).digest()[:4], "big")


def load_track(
    name: str, development: bool = False, recording: Path | None = None, settings: Mapping[str, Any] | None = None
) -> Track:
    """One track. ``recording``: folder of the data of a track that is recorded. ``settings``: dotted keys of its scenario."""
    seed = DEVELOPMENT_SEED if development else released_seed(name)
    return read_track(track_files()[name], {"monte_carlo.seed": seed} | dict(settings or {}), recording)


def read_track(path: Path, settings: dict[str, Any], recording: Path | None = None) -> Track:
    """A track from its file. Raises InputError for a file that is none."""
    if recording is not None:
        settings = settings | {"recording.dir": str(recording)}
    scenario = load_scenario(path, overrides=settings)
    if "league" not in scenario.extra:
        raise InputError(f"{path}: is no track of the league: it has no table [extra.league]")
    table = validate(TrackTable, scenario.extra["league"], f"{path}: [extra.league]")
    return Track(scenario.name, scenario, table, "" if recording is None else _content_of(recording))


def chosen_tracks(names: list[str] | None, with_data: bool) -> list[str]:
    """The tracks of these names, in the suite's order; all that need no data, or all, where there are no names."""
    known = track_files()
    for name in names or ():
        if name not in known:
            raise InputError(f"--tracks: no track '{name}'; {nearest(name, known)}")
        if name in RECORDED and not with_data:
            raise InputError(f"--tracks: '{name}' is a recording: --data FOLDER says where it lies")
    if names is not None:
        return [name for name in TRACKS if name in names]
    return [name for name in TRACKS if with_data or name not in RECORDED]


def shortened(name: str) -> Track:
    """Some seconds of a track, without outages, for a first look whether a filter can work on its logs at all."""
    scenario = load_track(name, development=True).scenario
    settings: dict[str, Any] = {"windows": [], "extra.league.window": "all"}
    if isinstance(scenario.flight, DriveConfig):
        settings["flight.manoeuvres"] = scenario.to_data()["flight"]["manoeuvres"][:1]
    else:  # a flight that begins parked stands for 75 s, and is aligned in 60 of them
        settings["flight.duration_s"] = 90.0 if scenario.initial.align_at_rest_s else 30.0
    gnss = getattr(scenario.sensors, "gnss", None)
    if gnss is not None and gnss.outages:
        settings["sensors.gnss.outages"] = []
    if gnss is not None and gnss.satellites is not None:
        settings["sensors.gnss.satellites.walls"] = []
    for drawn in ("random_outages", "outliers"):
        if gnss is not None and getattr(gnss, drawn) is not None:
            settings[f"sensors.gnss.{drawn}.count"] = 0
    return load_track(name, development=True, settings=settings)


def _content_of(folder: Path) -> str:
    """Hash of the files of a recording."""
    total = hashlib.sha256()
    for path in sorted(p for p in folder.iterdir() if p.is_file()):
        total.update(path.name.encode() + b"\0" + path.read_bytes())
    return total.hexdigest()[:16]
