"""Networks that are trained before a batch and loaded by its workers: where they are kept, and when they are stale.

The file name is the hash of the estimator's parameters and of the sensors' specifications, which a run can see; the
hash of the training flights, which only the scenario knows, lies inside the file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from testbed.base.errors import InputError
from testbed.data.records import SensorLog, Trajectory


class Student(Protocol):
    """A dataclass that learns by ``fit`` and can write what it learned."""

    name: str
    networks: str

    def fit(self, flights: Iterable[tuple[SensorLog, Trajectory | None]]) -> None:
        """Learn."""
        ...

    def store(self, path: Path, meta: dict[str, Any]) -> None:
        """Write what was learned as safetensors."""
        ...


AnyStudent = TypeVar("AnyStudent", bound=Student)


def weights_path(student: Any, log: SensorLog) -> Path:
    """Where the networks of these parameters and these sensors are kept."""
    from testbed.base import resources
    from testbed.data import specs

    params = {f.name: getattr(student, f.name) for f in fields(student) if f.init}
    gnss = specs.to_dict(log.gnss.spec) if log.gnss is not None else {}
    key = {"class": student.name, "params": params, "imu": specs.to_dict(log.imu.spec), "gnss": gnss}
    digest = hashlib.sha256(json.dumps(key, sort_keys=True, default=list).encode()).hexdigest()[:16]
    return resources.cache_root() / "networks" / f"{student.networks}-{digest}.safetensors"


class TrainingFlights(Protocol):
    """Flights that the bench hands to an estimator that learns before it runs."""

    @property
    def digest(self) -> str:
        """Hash of all that determines them."""
        ...

    def fly(self) -> list[tuple[SensorLog, Trajectory]]:
        """Logs and truth."""
        ...


def learn(student: Any, lessons: TrainingFlights) -> None:
    """Train on these flights and store the networks, unless that is done already."""
    digest, flights = lessons.digest, lessons.fly()
    path = weights_path(student, flights[0][0])
    if _trained_on(path) == digest:
        return
    learner = replace(student)
    learner.fit(flights)
    path.parent.mkdir(parents=True, exist_ok=True)
    learner.store(path, {"training": digest})


def _trained_on(path: Path) -> str | None:
    """What the networks in a file were trained on; None where there is none, or a damaged one, which is made again."""
    from estimators.learning.networks.mlp import load_networks

    try:
        return load_networks(path)[1].get("training")
    except InputError:
        return None


def stored(student: Any, log: SensorLog) -> Path:
    """The file of the networks that `learn` stored. Raises InputError when it did not."""
    path = weights_path(student, log)
    if not path.exists():
        raise InputError(
            f"{student.name}: no networks '{student.networks}' trained for these sensors and parameters; "
            f"call learn(flights) or fit(flights) first (testbed run does)"
        )
    return path
