"""Composed filters on several logs at once, a log per lane: the runs of a Monte Carlo, whose noise differs and not their times.

What comes out for a log does not depend on its neighbours, nor on how many there are. A filter that needs a path of its own,
by a policy that decides, an aiding that picks its samples or a heading that is unknown, goes by itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimators.core.composition import Prepared, make_lanes, make_recording, make_timeline_of, solution_of
from estimators.core.heading_bank import run_or_search
from estimators.core.recording import Recording
from estimators.core.timeline import require_one_timeline, walk
from testbed.base.errors import InputError
from testbed.data.records import NavSolution
from testbed.kernels.lanes import WIDTH
from testbed.kernels.tables import apart, of_lane


def run_side_by_side(prepared: Sequence[Prepared]) -> list[NavSolution]:
    """`estimators.core.heading_bank.run_or_search` of each. Raises InputError where those in lanes differ in their times."""
    together = [k for k, each in enumerate(prepared) if fits_lanes(each)]
    found: dict[int, NavSolution] = {}
    for first in range(0, len(together), WIDTH):
        block = together[first : first + WIDTH]
        found |= zip(block, _filter([prepared[k] for k in block]), strict=True)
    return [found[k] if k in found else run_or_search(each) for k, each in enumerate(prepared)]


def fits_lanes(prepared: Prepared) -> bool:
    """Whether every update of this filter is a plain one, at a time that the log's times tell, by parts that take lanes."""
    plain = all(prepared.composition.policy_of(aiding)[0].judge is None for aiding in prepared.aidings)
    parts = all(aiding.in_lanes for aiding in prepared.aidings) and all(
        block.in_lanes or not block.follows_imu for block in prepared.blocks
    )
    return plain and parts and not prepared.log.initial.heading_unknown


def _filter(prepared: list[Prepared]) -> list[NavSolution]:
    first = prepared[0]
    require_one_timeline([make_timeline_of(each) for each in prepared], "error-state filter")
    for each in prepared[1:]:
        same = zip(first.measurements, each.measurements, strict=True)
        if not np.array_equal(first.events, each.events) or any(
            not np.array_equal(a.parameters, b.parameters) for a, b in same
        ):
            raise InputError("error-state filter: logs that are filtered side by side need the same sensors")
    keep, line = recording_in_lanes(make_recording(first)), make_timeline_of(first)
    walk(line, make_lanes(prepared, keep), len(line.t))
    return [solution_of(each, of_lane(keep, lane)) for lane, each in enumerate(prepared)]


def recording_in_lanes(keep: Recording) -> Recording:
    """Room for what `WIDTH` runs leave behind, each as much as ``keep`` has room for."""
    innovations = [apart(part, filled=True) for part in (keep.innovation, keep.innovation_covariance, keep.fading)]
    rows = apart(keep.state), apart(keep.std)
    return Recording(keep.stride, *rows, keep.snapshot_stride, apart(keep.covariance), *innovations)
