"""NARX-UKF 2021: what the networks can learn of the drift in a window without GNSS, and whether it helps in windows not seen.

The drift is what the free copy of the filter lacks at the end of a window of 60 s: of the training flight (every third
window is kept from training) and of the scored flight with GNSS throughout. Metres. Written: ``lessons.md``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jobs import Place

SCENARIO = "narx-ukf-2021"
READINGS = ("Q of the data sheet", "gyro noise x 300")
DRAWS = 8
"""Of the training flight's noise, for the drift's own statistics; the networks learn from the first."""
SCORED = 3
"""Draws of the scored flight."""


def make_table(place: Place) -> None:
    """Train the scenario's NNCKF rows on its training flight and write what is left of the drift, seen and unseen."""
    draws = (2, 1) if place.trial else (DRAWS, SCORED)
    lines = [line for reading in READINGS for line in [f"### {reading}", "", *lessons(reading, *draws), ""]]
    (place.target / "lessons.md").write_text("\n".join(lines), encoding="utf-8")


def lessons(reading: str, draws: int, scored_draws: int) -> list[str]:
    """Both tables of a reading in Markdown."""
    from testbed import pipeline
    from testbed.data.registry import make_estimator
    from testbed.scenario import load_scenario
    from testbed.training.flights import OUTAGE_KEYS, training_flights

    clear = {f"sensors.gnss.{key}": value for key, value in OUTAGE_KEYS.items() if value is not None}
    scenario = load_scenario(SCENARIO, reading=reading, overrides={"extra.training.runs": draws} | clear)
    rows = [entry for entry in scenario.estimators if entry.name == "nnckf"]
    student: Any = make_estimator(rows[0].name, **rows[0].params)
    trajectory = pipeline.fly(scenario)
    scored = [pipeline.sense(scenario, trajectory, run=run)[0] for run in range(scored_draws)]
    flights = training_flights(scenario)
    drawn = [list(student.lessons(log)) for log, _ in flights]
    unseen = [drift for log in scored for drift in student.lessons(log)]
    lines = _drift_table({"training flight": [d for part in drawn for d in part], "scored flight": unseen})
    lines += [
        "",
        "RMS position error (m) at the end of a window: of the free copy, and with the networks added to it. Training stops by whole "
        "windows held back, or by rows drawn from all windows.",
        "",
    ]
    lines += ["| networks | stopped by | trained on: free | with networks | kept back: free | with networks "]
    lines[-1] += "| scored flight: free | with networks | outputs limited |"
    lines += ["| --- | --- |" + " ---: |" * 7]
    for entry in rows:
        for held_back in ("windows", "rows"):
            pupil: Any = make_estimator(entry.name, **entry.params | {"held_back": held_back})
            pupil.fit(flights[:1])
            lines.append(_lesson_row(f"{entry.row} | {held_back}", pupil, drawn[0], unseen))
    return lines


def _drift_table(drifts: Mapping[str, Sequence[Any]]) -> list[str]:
    """Mean and RMS of the drift at the windows' ends by axis, and what the filter's covariance says the RMS is."""
    lines = [
        "Drift at the end of a window (m), by axis: mean, root mean square, and the RMS that the covariance says.",
        "",
    ]
    lines += ["| flight | windows | mean N | mean E | mean D | RMS N | RMS E | RMS D | said N | said E | said D |"]
    lines += ["| --- |" + " ---: |" * 10]
    for name, some in drifts.items():
        ends = np.array([drift.y[-1, :3] for drift in some])
        said = np.sqrt(np.mean([drift.variance[-1, :3] for drift in some], axis=0))
        figures = [*ends.mean(axis=0), *np.sqrt(np.mean(ends**2, axis=0)), *said]
        lines.append(f"| {name} | {len(some)} | " + " | ".join(f"{value:.1f}" for value in figures) + " |")
    return lines


def _lesson_row(label: str, pupil: Any, drifts: Sequence[Any], unseen: Sequence[Any]) -> str:
    from estimators.learning.narx_aiding import split_windows

    networks = pupil.initial_networks(None)
    known, kept_back = split_windows(drifts)
    cells, limited = [], 0
    for some in (known, kept_back, unseen):
        found = [networks.closed_loop(drift) for drift in some]
        free = [drift.y[-1, :3] for drift in some]
        left = [drift.y[-1, :3] - output[-1, :3] for drift, (output, _) in zip(some, found, strict=True)]
        cells += [f"{np.sqrt(np.mean(np.sum(np.square(part), axis=1))):.1f}" for part in (free, left)]
        limited = sum(count for _, count in found)
    share = 100.0 * limited / sum(6 * (len(drift.t) - 1) for drift in unseen)
    return f"| {label} | " + " | ".join(cells) + f" | {share:.1f} % |"
