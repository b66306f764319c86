"""Flights for the gain network: five kinds, each run a flight of its own, in splits that share neither flight nor noise.

``gain_flights.toml`` says what flies; its seed is the development seed of the league. Lengths and sizes of faults are drawn here, so that
no fault is that of a track. SI units.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.streams import stream
from testbed.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from testbed.data.records import SensorErrors, SensorLog, Trajectory

FILE = Path(__file__).with_suffix(".toml")
FAULTS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "outliers": {
        "sensors.gnss.outliers.duration_s": (0.5, 4.0),
        "sensors.gnss.outliers.offset_m": (15.0, 60.0),
        "sensors.gnss.outliers.offset_mps": (0.5, 3.0),
    },
    "agile": {"sensors.gnss.random_outages.duration_s": (8.0, 25.0)},
    "raw": {"sensors.gnss.random_outages.duration_s": (8.0, 25.0)},
    "airliner": {"sensors.gnss.random_outages.duration_s": (15.0, 45.0)},
    "calm": {},
}
"""Kinds, which are the variants of the file, and what of their faults is drawn, uniformly."""
APART = 10_000
"""Runs between the kinds: streams of noise follow from seed and run, and no two kinds may share them."""


@dataclass(frozen=True)
class Split:
    """``count`` runs of each kind from ``first`` on, each sensed so many times."""

    first: int
    count: int
    sensed: int = 1

    def runs(self, kind: str) -> range:
        """The runs of a kind."""
        begin = APART * (1 + list(FAULTS).index(kind)) + self.first
        return range(begin, begin + self.count)


TRAINING = Split(0, 10, sensed=2)
"""A hundred lessons, five steps of an optimiser; a second draw of the noise costs less than a flight."""
VALIDATION = Split(1000, 4)
TEST = Split(2000, 12)
"""Sixty flights: errors of runs scatter by a factor of two, so that a mean ratio is known to some ten per cent, paired to less."""
AGAIN = 5000
"""Added to the run for another draw of noise and faults on the same flight."""


@dataclass(frozen=True)
class Flight:
    """One sensed flight: the truth where the IMU sits, what is recorded, and the errors that were drawn."""

    kind: str
    scenario: Scenario
    truth: Trajectory
    log: SensorLog
    errors: SensorErrors


def scenario_of(kind: str, run: int) -> Scenario:
    """The scenario of one run, its faults drawn."""
    rng = stream(1, run, "gain-flights.faults")
    drawn: dict[str, Any] = {key: float(rng.uniform(*ends)) for key, ends in FAULTS[kind].items()}
    return load_scenario(FILE, variant=kind, overrides=drawn)


def flights(split: Split, kinds: tuple[str, ...] = tuple(FAULTS)) -> Iterator[Flight]:
    """The sensed flights of a split, kind by kind."""
    from testbed import pipeline

    for kind in kinds:
        for run in split.runs(kind):
            trajectory = pipeline.fly(scenario_of(kind, run), run)
            for draw in range(split.sensed):
                scenario = scenario_of(kind, run + AGAIN * draw)
                log, errors = pipeline.sense(scenario, trajectory, run=run + AGAIN * draw)
                assert errors is not None  # only recordings have none
                yield Flight(kind, scenario, pipeline.truth_at_imu(trajectory, log), log, errors)


def digests() -> list[str]:
    """What determines the flights: of each kind the digest of its scenario, and the drawn ends."""
    return [scenario_of(kind, APART).digest() for kind in FAULTS] + [repr(dict(FAULTS))]
