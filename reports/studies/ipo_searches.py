"""Searches of IPO 2022 as jobs: all seeds of some algorithms in one box at one length, and one row per search.

A job that is broken off goes on at the evaluation where it was stopped. In the box from 0 to 1 a value hangs on the last bit of
its candidate (`ipo_rounding`), so there another processor may find other numbers; tables are of the machine that made them.
Errors in m, m/s, degrees; the objective is the sum of their RMSE over both IMUs.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jobs import Job, Kept, Place, write_csv

if TYPE_CHECKING:
    import pandas as pd

    from testbed.scenario import Scenario
    from testbed.tuning.config import TuneConfig

SCENARIO = "ipo-2022"
RECORDING = "NAVEGO_DIR"
"""Environment variable: folder with the recording of the paper's toolbox, which does not ship with the bench."""
COURSE = (10, 20, 40, 80, 100, 150, 200)
"""Iterations at which a row tells the best value so far; IPO's pull to the best begins at the 80th."""
TEN, THREE = tuple(range(1, 11)), (1, 2, 3)


@dataclass(frozen=True)
class Part:
    """What one job searches. ``changes`` are keys of ``[extra.tune]``; ``variant`` is one of the scenario."""

    name: str
    algorithms: tuple[str, ...]
    variant: str | None = None
    iterations: int = 100
    seeds: tuple[int, ...] = TEN
    changes: Mapping[str, Any] = field(default_factory=dict)
    recorded: bool = False
    """Needs the recording."""

    @property
    def table(self) -> str:
        """Its file."""
        return f"searches-{self.name}.csv"

    def load(self, trial: bool = False) -> tuple[Scenario, TuneConfig]:
        """The scenario and what is searched; a trial has two seeds, few agents and a single unseen run."""
        from testbed.scenario import load_scenario
        from testbed.tuning.config import tune_config

        overrides = {"recording.dir": os.environ[RECORDING]} if self.recorded and RECORDING in os.environ else None
        scenario = load_scenario(SCENARIO, variant=self.variant, overrides=overrides)
        chosen: dict[str, Any] = {"algorithms": list(self.algorithms), "iterations": [self.iterations]}
        chosen |= {"seeds": list(self.seeds), "innovation_search": "none"} | dict(self.changes)
        if trial:
            chosen |= {"iterations": [2], "population": 4, "seeds": list(self.seeds[:2])}
            chosen |= {} if self.recorded else {"test_runs": [1]}
        return scenario, tune_config(scenario, **chosen)

    def make(self, place: Place) -> None:
        """Search, score on unseen runs, and leave the table."""
        if self.recorded and RECORDING not in os.environ:
            raise Kept(f"the environment variable {RECORDING} names no folder with the recording")
        scenario, config = self.load(place.trial)
        rows = searched(scenario, config, place.work / "study", place.resume)
        write_csv(place.target / self.table, rows)

    def inputs(self, _paper: str) -> Any:
        """What determines the table."""
        from testbed.tuning.tune import identity

        if self.recorded:
            return [self.variant, self.algorithms, self.iterations, self.seeds, dict(self.changes)]
        scenario, config = self.load()
        return [identity(scenario, config), config.algorithms, config.iterations, config.seeds, config.test_runs]

    def job(self, minutes: float, **texts: Any) -> Job:
        """As a job, which is a long one."""
        return Job(
            self.name, minutes, self.make, (self.table,), linked=(self.table,), long=True, inputs=self.inputs, **texts
        )


def searched(scenario: Scenario, config: TuneConfig, folder: Path, resume: bool) -> pd.DataFrame:
    """Run the study, going on with what ``folder`` holds where ``resume`` is said, and give its rows."""
    from testbed.tuning.study import Study
    from testbed.tuning.tune import tune

    if not resume:
        shutil.rmtree(folder, ignore_errors=True)
    tune(scenario, folder, config, resume=(folder / "manifest.json").is_file())
    return rows_of(Study(folder))


def rows_of(study: Any) -> pd.DataFrame:
    """One row per search: its course, where its best lies, its RMSE on the flight that was searched, and the unseen runs."""
    import numpy as np
    import pandas as pd

    from testbed.tuning import tables
    from testbed.tuning.objective import scenario_space

    space = scenario_space(study.scenario, study.config)
    searches = study.searches[study.searches["kind"] == "objective"].set_index("search")
    place, bounds = searches[space.names].to_numpy(), space.bounds
    # the table of a study has ten digits
    walls = np.isclose(place, bounds.low, rtol=1e-8, atol=0.0) | np.isclose(place, bounds.high, rtol=1e-8, atol=0.0)
    out = searches[["algorithm", "iterations", "seed", "evaluations", "best"]].assign(walls=walls.sum(axis=1))
    course = study.history.pivot_table(index="search", columns="iteration", values="best")
    for iteration in COURSE:
        if iteration <= max(study.config.iterations):
            out[f"best_{iteration}"] = course[iteration].reindex(out.index)
    unseen = study.heldout.set_index("row").reindex(out.index)
    kept = [
        name
        for name in ("train", "test", "improvement_pct", "ci_low", "ci_high", "diverged")
        if unseen[name].notna().any()
    ]
    lines = tables.by_algorithm(study.searches, study.scores, study.timings)
    metrics = [name for name in lines.columns if ":" in name]
    made = pd.concat([out, unseen[kept], lines.loc[out.index, metrics], searches[space.names]], axis=1)
    return made.reset_index(drop=True).sort_values(["algorithm", "iterations", "seed"], kind="stable")
