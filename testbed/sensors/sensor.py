"""What the bench asks of an aiding sensor: one module in this folder that defines ``SENSOR``, a `Sensor`.

The registry (`testbed.sensors.registry`) finds it, and gives it a section of the scenario, a place in the log, catalogue,
tables in and out, and a table in the report. SI units and radians; keys carry their unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from testbed.data.specs import Vector
    from testbed.sensors.config import SensorTable
    from testbed.sensors.draws import Draws


class Sense(Protocol):
    """A pure function: the samples (or several kinds of them, by kind), and what was drawn (scored, never told to a filter).

    ``arm_b`` leads from the reference point of the trajectory to the IMU, from which lever arms count; m, in b.
    """

    def __call__(self, config: Any, trajectory: Any, draws: Draws, arm_b: Vector) -> tuple[Any, dict[str, Any]]: ...


@dataclass(frozen=True)
class Column:
    """A field of the samples in tables: its name with the unit last; a vector's with ``{}`` for each of ``axes``.

    ``quantity`` is one of `testbed.data.column_units.UNITS`.
    """

    field: str
    name: str
    quantity: str
    axes: tuple[str, ...] = ()
    factor: float = 1.0
    """From the samples' unit to the table's."""

    def names(self) -> list[str]:
        """Columns of a table."""
        return [self.name.format(axis) for axis in self.axes] if self.axes else [self.name]

    def stems(self) -> dict[str, str]:
        """Names without the unit, and their quantity."""
        return {name.rpartition("_")[0]: self.quantity for name in self.names()}


@dataclass(frozen=True)
class Sensor:
    """One kind of sensor.

    ``kind`` names the section ``[sensors.KIND]``, ``log.KIND`` and the catalogue's tables. ``spec`` is its specification,
    a dataclass in SI units whose defaults are the ideal sensor; ``figures`` maps each catalogue key, with the unit at its
    end, to the field and the factor to SI; ``catalogue`` holds entries beside those of ``catalog.toml``. ``samples`` is a
    subclass of `testbed.data.records.Samples`; without ``config`` and ``sense`` they are made by another sensor (``gnss_raw``
    by ``gnss``). ``rows`` names the specification's fields in the report: text, factor, unit.
    """

    kind: str
    title: str
    spec: type
    config: type[SensorTable] | None
    samples: type
    sense: Sense | None
    columns: tuple[Column, ...]
    rows: Mapping[str, tuple[str, float, str]]
    figures: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    catalogue: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    rank: int = 100
    """Of its place in tables; equal ranks stand in the order of the alphabet."""
    write: Callable[[Any], tuple[dict[str, Any], dict[str, Any]]] | None = None
    """Columns and header of a stored log where they are more than ``columns``; `read` is its inverse."""
    read: Callable[[Mapping[str, Any], Mapping[str, Any], Any], Any] | None = None

    def table(self, samples: Any) -> dict[str, Any]:
        """``time_s`` and the columns of some samples."""
        out = {"time_s": samples.t}
        for column in self.columns:
            values = getattr(samples, column.field)
            values = values if column.factor == 1.0 else column.factor * values
            parts = values.T if column.axes else [values]
            out |= dict(zip(column.names(), parts, strict=True))
        return out

    def from_table(self, table: Mapping[str, Any], spec: Any) -> Any:
        """`table` backwards."""
        fields: dict[str, Any] = {}
        for column in self.columns:
            parts = [table[name] for name in column.names()]
            values = np.column_stack(parts) if column.axes else parts[0]
            fields[column.field] = values if column.factor == 1.0 else values / column.factor
        make: Any = self.samples
        return make(t=table["time_s"], spec=spec, **fields)

    def from_stems(self, parts: Mapping[str, Any], spec: Any) -> Any:
        """Samples of recorded columns in the samples' units, by their names without the unit."""
        fields: dict[str, Any] = {}
        for column in self.columns:
            values = [parts[stem] for stem in column.stems()]
            fields[column.field] = np.column_stack(values) if column.axes else values[0]
        make: Any = self.samples
        return make(t=parts["time"], spec=spec, **fields)
