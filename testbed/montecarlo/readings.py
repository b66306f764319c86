"""Readings: one Monte Carlo for each way to read what a source leaves open, and what becomes of its claims under them.

Each reading is a result folder of its own below ``readings/``, so that the whole resumes as its parts do. All share the seed, and
a random stream depends on seed, run and name alone: where two readings draw the same thing, their runs are paired.
``verdicts.csv`` has a row per claim and reading (effects in per cent); claims on computation time stand apart in
``verdicts-timings.csv``, as they are no function of scenario and seed.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.csv_text import csv_text
from testbed.base.errors import InputError
from testbed.montecarlo.folders import Folder, check_own, read_manifest
from testbed.montecarlo.runner import Auto, plan, prepare, run
from testbed.montecarlo.store import KIND as RESULT
from testbed.scenario import Scenario

if TYPE_CHECKING:
    import pandas as pd

KIND = "testbed readings"
FIRST, CAP = 30, 200
"""Runs per reading: from where a mean of skewed errors is near enough to normal for its interval, to what an evening affords."""
COLUMNS = (
    "claim reading effect_pct ci_low ci_high runs verdict class origin stated_pct margin_pct p_holm "
    "median_pct median_low median_high lost_better lost_than runaways trimmed_pct"
).split()

Load = Callable[[str | None], Scenario]
"""Makes the scenario of a reading; of None as it stands."""


def run_readings(
    load: Load,
    out: str | Path,
    runs: int | Auto | None = None,
    resume: bool = False,
    announce: Callable[[str], None] | None = None,
    **options: Any,
) -> pd.DataFrame:
    """Run every reading of a scenario and write ``verdicts.csv``; returns its rows, those on computation time behind.

    ``runs`` defaults to what `Auto` finds enough between `FIRST` and `CAP`; ``announce`` is told each reading; ``options`` go to
    `testbed.montecarlo.runner.run`. All readings are flown and sensed once, and so checked, before any is run.
    """
    out, base = Path(out), load(None)
    check_folder(out, base)
    runs = runs if runs is not None else Auto(cap=CAP, first=FIRST)
    scenarios = [load(reading.name) for reading in base.readings]
    planned = {key: value for key, value in options.items() if key in signature(plan).parameters}
    for scenario in scenarios:
        prepare(plan(scenario, runs, **planned))
    with Folder.open(out, KIND) as own:
        own.save(**_manifest(base, runs), finished=False)
        found: dict[str, pd.DataFrame] = {}
        for number, (reading, scenario) in enumerate(zip(base.readings, scenarios, strict=True), 1):
            if announce is not None:
                announce(f"reading {number} of {len(scenarios)}: {reading.name}")
            folder = out / "readings" / slug(reading.name)
            known = resume and read_manifest(folder, RESULT) is not None
            found[reading.name] = run(scenario, folder, runs=runs, resume=known, **options).claims
        table = verdict_table(base, found)
        timed = table.pop("timed")
        written = {"verdicts.csv": table[~timed]} | ({"verdicts-timings.csv": table[timed]} if timed.any() else {})
        own.forget({"verdicts-timings.csv"} - set(written))
        own.write_all({name: _csv(rows) for name, rows in written.items()})
        own.save(finished=True)
    return table


def verdict_table(scenario: Scenario, found: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """`COLUMNS` and ``timed``, claim by claim. ``found`` maps a reading to the ``claims`` of its result."""
    import pandas as pd

    from testbed.scoring.quantities import TIME_METRIC
    from testbed.scoring.readings import standing

    renamed = {"id": "claim", "measured_pct": "effect_pct", "paper_pct": "stated_pct", "n": "runs"}
    parts = []
    for k, claim in enumerate(scenario.active_claims()):
        rows = pd.DataFrame([table.iloc[k] for table in found.values()]).rename(columns=renamed)
        verdicts = dict(zip(found, rows["verdict"], strict=True))
        word = standing(scenario.readings, verdicts, claim.contradiction).word
        parts.append(rows.assign(reading=list(found), **{"class": word}, timed=claim.metric == TIME_METRIC))
    return pd.concat(parts, ignore_index=True)[[*COLUMNS, "timed"]]


def check_folder(out: Path, scenario: Scenario) -> None:
    """Raise InputError for a scenario without readings or claims, and for a folder that holds anything else."""
    where = scenario.source_path or scenario.name
    if not scenario.readings:
        raise InputError(f"{where}: --readings: the scenario has no [[readings]]")
    if not scenario.active_claims():
        raise InputError(f"{where}: --readings: no [[claims]] to judge under them")
    check_own(out, KIND)


def slug(name: str) -> str:
    """A folder's name for a reading."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def _manifest(scenario: Scenario, runs: int | Auto) -> dict[str, Any]:
    return {
        "scenario": scenario.name,
        "variant": scenario.variant,
        "profile": scenario.profile,
        "seed": scenario.monte_carlo.seed,
        "runs": runs if isinstance(runs, int) else None,
        "auto": None if isinstance(runs, int) else vars(runs),
        "title": scenario.scenario.title or scenario.name,
        "source": scenario.scenario.source,
        "readings": [reading.model_dump(mode="json", exclude={"overlay"}) for reading in scenario.readings],
        "claims": [claim.model_dump(mode="json") for claim in scenario.active_claims()],
    }


def _csv(table: pd.DataFrame) -> bytes:
    return csv_text(table, float_format="%.10g", lineterminator="\n").encode()
