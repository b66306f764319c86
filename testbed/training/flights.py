"""The flights that a scenario's networks learn on before they are tested: `[extra.training]`.

A training flight has the scenario's sensors without outages; their errors come from random streams that no scored run
uses.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.base.schema import Table, validate
from testbed.data.records import SensorLog, Trajectory
from testbed.flight.cache import flown_by
from testbed.scenario import Scenario
from testbed.scenario.model import Motion

FIRST_RUN = 1_000_000
"""Runs of the training flights count from here."""
OUTAGE_KEYS: dict[str, Any] = {"outages": [], "random_outages": None, "outliers": None, "degraded": []}
"""What a training flight is spared, and its values without it."""


class TrainingConfig(Table):
    """``[extra.training]``: what flies or drives, and with how many draws of the sensors."""

    flight: Motion
    runs: int = Field(default=1, ge=1)


@dataclass(frozen=True)
class TrainingFlights:
    """The training flights of a scenario for an estimator that learns before it runs; nothing flies until it asks."""

    scenario: Scenario

    @property
    def digest(self) -> str:
        """Hash of all that determines them. Raises InputError when the scenario has none."""
        return training_digest(self.scenario)

    def fly(self) -> list[tuple[SensorLog, Trajectory]]:
        """Logs and truth. Raises InputError when the scenario has none."""
        return training_flights(self.scenario)


def training_config(scenario: Scenario) -> TrainingConfig:
    """The checked table. Raises InputError when the scenario has none."""
    where = f"{scenario.source_path}: extra.training"
    if "training" not in scenario.extra:
        raise InputError(f"{where}: an estimator here learns before it runs and needs [extra.training.flight]")
    return validate(TrainingConfig, scenario.extra["training"], where, Path(scenario.source_path).parent)


def training_scenario(scenario: Scenario) -> Scenario:
    """The scenario with the training flight in place of its own, and GNSS throughout."""
    if scenario.sensors is None:
        raise InputError(f"{scenario.source_path}: no [sensors.imu]")
    sensors = scenario.sensors
    if sensors.gnss is not None:
        sensors = sensors.model_copy(update={"gnss": sensors.gnss.model_copy(update=OUTAGE_KEYS)})
    flight = training_config(scenario).flight
    return scenario.model_copy(update={"flight": flight, "recording": None, "sensors": sensors})


def training_flights(scenario: Scenario) -> list[tuple[SensorLog, Trajectory]]:
    """Logs and truth of the training flights. Raises InputError when the scenario has none."""
    lesson, runs = training_scenario(scenario), training_config(scenario).runs
    trajectory = pipeline.fly(lesson)
    return [(pipeline.sense(lesson, trajectory, run=FIRST_RUN + k)[0], trajectory) for k in range(runs)]


def training_digest(scenario: Scenario) -> str:
    """Hash of all that determines the training flights."""
    data = training_scenario(scenario).to_data()
    parts = {key: data.get(key) for key in ("flight", "sensors", "initial")}
    parts["draws"] = {key: data["monte_carlo"].get(key) for key in ("seed", "vary")}
    parts["flown_by"] = flown_by()
    parts["runs"] = training_config(scenario).runs
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
