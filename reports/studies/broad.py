"""BROAD: every trial of a folder, every row of the scenario `broad`, one set of parameters: per trial and their mean.

``python reports/studies/broad.py FOLDER [--variant peers]`` prints total / heading / inclination RMSE in degrees over the rows that
the data set marks, as a table in Markdown. A mean over trials is what the data set's authors publish.
"""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import numpy as np

from testbed import pipeline
from testbed.base.errors import MissingExtra, tell_user
from testbed.data.records import Array
from testbed.data.registry import make_estimator
from testbed.scenario import load_scenario

QUANTITIES = ("attitude", "heading", "inclination")
WINDOW = "phase_1_movement"
_tell_once = cache(tell_user)


def of_trial(folder: Path, trial: str, variant: str | None) -> dict[str, Array]:
    """Row -> its three errors (3,) on a trial."""
    keys = {"recording.dir": str(folder.resolve()), "recording.files": {"trial": trial}}
    scenario = load_scenario("broad", variant=variant, overrides=keys)
    truth = pipeline.fly(scenario)
    log, _ = pipeline.sense(scenario, truth)
    out = {}
    for entry in scenario.estimators:
        try:
            solution = make_estimator(entry.name, **entry.params).run(log)
        except MissingExtra as error:
            _tell_once(f"note: {error}; its column is left out")
            continue
        table = pipeline.score(scenario, truth, solution, log).set_index(["window", "metric"])["value"]
        out[entry.row] = np.array([table[WINDOW, f"rmse_{q}_deg"] for q in QUANTITIES])
    return out


def main(arguments: list[str]) -> int:
    """Print the table."""
    variant = arguments[arguments.index("--variant") + 1] if "--variant" in arguments else None
    folder = Path(arguments[0])
    found = {path.stem: of_trial(folder, path.name, variant) for path in sorted(folder.glob("*.mat"))}
    if not found:
        print(f"{folder}: holds no .mat file; give the folder data_mat of the data set", file=sys.stderr)
        return 2
    rows = list(next(iter(found.values())))
    found["mean"] = {row: np.mean([errors[row] for errors in found.values()], axis=0) for row in rows}
    print("| trial | " + " | ".join(rows) + " |\n| :--- " * 1 + "| ---: " * len(rows) + "|")
    for trial, errors in found.items():
        print(f"| {trial} | " + " | ".join(" / ".join(f"{e:.2f}" for e in errors[row]) for row in rows) + " |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
