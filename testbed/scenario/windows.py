"""Scoring windows: the whole flight, fixed stretches, each GNSS outage, each phase of the flight. Times in seconds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from testbed.base.errors import InputError
from testbed.data.records import Trajectory

if TYPE_CHECKING:
    from testbed.scenario import WindowConfig

LEAST_CUT_S = 1.0
"""What is told of a window that is cut: recordings begin and end within a second of what a scenario rounds."""


class Window(NamedTuple):
    """A named set of intervals (start, end]; ``final_`` metrics are taken at the end of the last one."""

    name: str
    intervals: tuple[tuple[float, float], ...]


def resolve_windows(
    configs: Sequence[WindowConfig], trajectory: Trajectory, outages: Sequence[tuple[float, float]]
) -> list[Window]:
    """``all`` first, then what the scenario asks for: ``outage_1``.. and ``outages``, ``phase_1_turn``.., fixed ones.

    Raises InputError when a fixed window lies outside of the flight, or when two have one name.
    """
    start, end = float(trajectory.t[0]), float(trajectory.t[-1])
    out = [Window("all", ((start - 1.0, end),))]
    for config in configs:
        if config.kind == "outages":
            out += [Window(f"outage_{k}", (interval,)) for k, interval in enumerate(outages, 1)]
            if outages:
                out.append(Window("outages", tuple(outages)))
        elif config.kind == "phases":
            out += [Window(f"phase_{k}_{p.name}", ((p.start, p.end),)) for k, p in enumerate(trajectory.phases, 1)]
        else:
            assert config.start is not None and config.end is not None
            if config.end <= start or config.start >= end:
                raise InputError(
                    f"window '{config.name}' ({config.start} to {config.end} s) lies outside of the flight ({start:g} to {end:g} s)"
                )
            out.append(Window(config.name, ((config.start, config.end),)))
    names = [window.name for window in out]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"two windows are called '{name}'; 'all' is the whole flight, 'outages' and 'phases' name theirs"
            )
    return out


def cut_notes(configs: Sequence[WindowConfig], trajectory: Trajectory) -> list[str]:
    """A sentence for each fixed window of which a second or more lies before or after the flight."""
    start, end = float(trajectory.t[0]), float(trajectory.t[-1])
    notes = []
    for config in configs:
        if config.start is None or config.end is None:
            continue
        first, last = max(config.start, start), min(config.end, end)
        if max(first - config.start, config.end - last) >= LEAST_CUT_S:
            notes.append(
                f"window '{config.name}' ({config.start:.10g} to {config.end:.10g} s) reaches beyond the flight"
                f" ({start:.10g} to {end:.10g} s): {first:.10g} to {last:.10g} s of it are scored"
            )
    return notes
