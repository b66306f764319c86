"""What stands beside the searches of IPO 2022: the data sheet's settings, and what the last bit of a candidate does to its value.

A candidate whose coordinates change by 1e-15 of themselves is the same to any purpose. Where its value changes by per cents the
objective is no function of the candidate that a computer can know, and a search repeated with other rounding is another search.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from ipo_searches import RECORDING, SCENARIO
from jobs import Kept, Place, write_csv

if TYPE_CHECKING:
    import pandas as pd

BOXES: dict[str, str | None] = {"0 to 1": "as-stated", "log": None}
CHANGES = (1e-15, 1e-12, 1e-9, 1e-6)
CANDIDATES = 48
REPEATS, ITERATIONS = 5, 20
"""Of the same search of IPO, seed 1, with every candidate changed by `CHANGES`[0]."""


def make_rounding(place: Place) -> None:
    """``rounding.csv``: relative change of the value of random candidates; ``rounding-search.csv``: the best of one search repeated."""
    import numpy as np
    import pandas as pd

    from testbed.tuning.search import make_search

    changes, repeats = [], []
    for box, variant in BOXES.items():
        with objective_of(variant) as objective:
            bounds, rng = objective.space.bounds, np.random.default_rng(0)
            x = bounds.draw(rng, 8 if place.trial else CANDIDATES)
            values = objective(x)
            for change in CHANGES:
                moved = objective(x * (1.0 + change * rng.uniform(-1.0, 1.0, x.shape)))
                relative = np.abs(moved / values - 1.0)
                row = {"box": box, "candidates": len(x), "change": change, "median_pct": 100.0 * np.median(relative)}
                tail = {"ninth_decile_pct": 100.0 * np.quantile(relative, 0.9), "max_pct": 100.0 * relative.max()}
                changes.append(row | tail)
            for repeat in range(2 if place.trial else REPEATS):
                search = make_search("ipo", bounds, 50, 2 if place.trial else ITERATIONS, 1)
                best = np.inf
                while not search.done:
                    asked = search.ask()
                    f = objective(asked * (1.0 + repeat * CHANGES[0] * rng.uniform(-1.0, 1.0, asked.shape)))
                    best = min(best, f.min())
                    search.tell(f)
                repeats.append({"box": box, "iterations": ITERATIONS, "repeat": repeat, "best": best})
    write_csv(place.target / "rounding.csv", pd.DataFrame(changes))
    write_csv(place.target / "rounding-search.csv", pd.DataFrame(repeats))


def objective_of(variant: str | None) -> Any:
    """The objective of the scenario in a variant, on all cores."""
    from testbed.scenario import load_scenario
    from testbed.tuning.config import tune_config
    from testbed.tuning.objective import make_objective, record

    scenario = load_scenario(SCENARIO, variant=variant)
    config = tune_config(scenario)
    return make_objective(scenario, config, record(scenario, config, config.train_runs), jobs=os.cpu_count() or 1)


def make_baseline(place: Place) -> None:
    """``data-sheet.csv``: the sensors' own settings and the fixes alone, with the errors of the searches and with unseen ones.

    ``diagonals.csv``: what the sheet has for the 18 entries that are searched, in the units of the filter.
    """
    from testbed.scenario import load_scenario

    write_csv(place.target / "diagonals.csv", diagonals(load_scenario(SCENARIO)))
    write_csv(place.target / "data-sheet.csv", scored(load_scenario(SCENARIO), [1, 2] if place.trial else None))


def make_recorded(place: Place) -> None:
    """``navego-data-sheet.csv``: the same on the toolbox's recording, where its folder is named, from two starts."""
    import pandas as pd

    from testbed.scenario import load_scenario
    from testbed.tuning.config import DATA_SHEET

    if RECORDING not in os.environ:
        raise Kept(f"the environment variable {RECORDING} names no folder with the recording")
    folder = {"recording.dir": os.environ[RECORDING]}
    fixes = folder | {"recording.initial.start": "gnss"}
    own, other = (scored(load_scenario(SCENARIO, variant="navego", overrides=o)) for o in (folder, fixes))
    other = other[other["row"] == DATA_SHEET].assign(row=f"{DATA_SHEET}, started from the fixes")
    write_csv(place.target / "navego-data-sheet.csv", pd.concat([own, other]))


def scored(scenario: Any, unseen: list[int] | None = None) -> pd.DataFrame:
    """Columns row, set (train, test), case, runs and the nine RMSE with their sum: means over the runs."""
    import pandas as pd

    from testbed.tuning.config import DATA_SHEET, RMSE_METRICS, tune_config, tuned_entry
    from testbed.tuning.objective import full_score, record
    from testbed.tuning.tables import gnss_errors

    config, entry = tune_config(scenario), tuned_entry(scenario, tune_config(scenario))
    rows = []
    for which, runs in (("train", config.train_runs), ("test", config.test_runs if unseen is None else unseen)):
        for run in runs:
            for recording in record(scenario, config, [run]):
                found = {DATA_SHEET: full_score(entry.name, dict(entry.params), recording, config.window)}
                found["GNSS alone"] = gnss_errors(recording)
                for row, values in found.items():
                    kept = {name: values[name] for name in RMSE_METRICS if name in values}
                    key = {"row": row, "set": which, "case": recording.case, "run": run}
                    rows.append(key | kept | {"sum": sum(kept.values())})
    table = pd.DataFrame(rows)
    keys = ["row", "set", "case"]
    means = table.drop(columns="run").groupby(keys, sort=False).mean()
    return means.assign(runs=table.groupby(keys, sort=False)["run"].nunique()).reset_index()


def diagonals(scenario: Any) -> pd.DataFrame:
    """Columns entry, unit and one per case: the means over the three axes of R and of the densities in Q."""
    import pandas as pd

    from testbed.data.registry import make_estimator
    from testbed.tuning.config import tune_config, tuned_entry
    from testbed.tuning.objective import record

    config, entry = tune_config(scenario), tuned_entry(scenario, tune_config(scenario))
    names = ("R, position", "R, velocity", "Q, accelerometers", "Q, gyros", "Q, accelerometers' bias", "Q, gyros' bias")
    units = ("m2", "m2/s2", "m2/s3", "rad2/s", "m2/s5", "rad2/s3")
    table = pd.DataFrame({"entry": names, "unit": units})
    for recording in record(scenario, config, [0]):
        prepared = make_estimator(entry.name, **entry.params).prepared(recording.log)  # type: ignore[attr-defined]
        rows = [prepared.r[0], prepared.white, prepared.drive]
        table[recording.case] = [float(part.mean()) for row in rows for part in (row[:3], row[3:6])]
    return table
