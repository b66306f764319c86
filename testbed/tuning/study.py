"""A finished tuning study as read from its folder: every table undamaged, or a message that names it. Units as in the tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from testbed.base.csv_text import read_csv
from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.montecarlo.folders import Folder
from testbed.scenario import Scenario, load_scenario
from testbed.tuning import tables
from testbed.tuning.config import TuneConfig
from testbed.tuning.tune import read_manifest

if TYPE_CHECKING:
    import pandas as pd

TABLES = {
    "searches": "search algorithm iterations kind evaluations best",
    "history": "search iteration best",
    "timings": "search seconds",
    "scores": "row case run set metric value",
    "heldout": "row train",
}
"""What the report reads, and the columns that it cannot do without."""


def _read_csv(path: Path, columns: str) -> pd.DataFrame:
    """A table of the study. Raises InputError that names a missing or damaged one."""
    try:
        table = read_csv(path)
    except FileNotFoundError:
        raise InputError(f"{path}: is missing") from None
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: damaged ({error})") from None
    if lacking := set(columns.split()) - set(table.columns):
        raise InputError(f"{path}: damaged (it has no column '{min(lacking)}')")
    return table


class Study:
    """A finished study as read from its folder."""

    def __init__(self, folder: Path) -> None:

        manifest = read_manifest(folder)
        if manifest is None:
            raise InputError(f"{folder}: no tuning study (no manifest.json of one)")
        if not manifest["finished"]:
            raise InputError(f"{folder}: this study is not finished; complete it with testbed tune ... --resume")
        self.folder, self.manifest = folder, manifest
        self.config: TuneConfig = validate(TuneConfig, manifest["tune"], f"{folder}/manifest.json")
        listed = Folder(folder, manifest)
        self.scenario: Scenario = load_scenario(listed.check("scenario.toml"))
        read = {name: _read_csv(listed.check(f"{name}.csv"), columns) for name, columns in TABLES.items()}
        self.searches, self.history, self.timings = read["searches"], read["history"], read["timings"]
        self.scores, self.heldout = read["scores"], read["heldout"]
        self.algorithms = list(dict.fromkeys(self.searches[self.searches["kind"] == "objective"]["algorithm"]))
        self.lines = tables.by_algorithm(self.searches, self.scores, self.timings)
        self.statistics = tables.statistic_rows(self.lines, self.algorithms)

    def paper(self, quantity: str, statistic: str = "") -> dict[str, float]:
        """The printed figures of a row, by algorithm."""
        return next((r.values for r in self.config.paper if (r.quantity, r.statistic) == (quantity, statistic)), {})
