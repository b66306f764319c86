"""Readings: one Monte Carlo for each way to read what a source leaves open, and what becomes of its claims under them.

Each reading is a result folder of its own below ``readings/``, so that the whole resumes as its parts do. All share the seed, and
a random stream depends on seed, run and name alone: where two readings draw the same thing, their runs are paired.
``verdicts.csv`` has a row per claim and reading (effects in per cent); claims on computation time stand apart in
``verdicts-timings.csv``, as they are no function of scenario and seed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.errors import InputError
from testbed.runner import Auto, plan, prepare, run
from testbed.scenario import Scenario
from testbed.store import read_manifest as read_result_manifest
from testbed.store import write_atomic, write_json

if TYPE_CHECKING:
    import pandas as pd

KIND = "testbed readings"
MANIFEST = "manifest.json"
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
    `testbed.runner.run`. All readings are flown and sensed once, and so checked, before any is run.
    """
    out, base = Path(out), load(None)
    check_folder(out, base)
    runs = runs if runs is not None else Auto(cap=CAP, first=FIRST)
    scenarios = [load(reading.name) for reading in base.readings]
    planned = {key: value for key, value in options.items() if key in signature(plan).parameters}
    for scenario in scenarios:
        prepare(plan(scenario, runs, **planned))
    write_json(out / MANIFEST, _manifest(base, runs, finished=False))
    found: dict[str, pd.DataFrame] = {}
    for number, (reading, scenario) in enumerate(zip(base.readings, scenarios, strict=True), 1):
        if announce is not None:
            announce(f"reading {number} of {len(scenarios)}: {reading.name}")
        folder = out / "readings" / slug(reading.name)
        known = resume and read_result_manifest(folder) is not None
        found[reading.name] = run(scenario, folder, runs=runs, resume=known, **options).claims
    table = verdict_table(base, found)
    timed = table.pop("timed")
    _write(out / "verdicts.csv", table[~timed])
    if timed.any():
        _write(out / "verdicts-timings.csv", table[timed])
    else:
        (out / "verdicts-timings.csv").unlink(missing_ok=True)
    write_json(out / MANIFEST, _manifest(base, runs, finished=True))
    return table


def command(load: Load, out: Path | None, runs: int | Auto | None, report: bool, **options: Any) -> None:
    """``testbed run --readings``: run them, tell the class of each claim, write the page and each reading's own report."""
    from testbed.report import render
    from testbed.report.readings import write_page
    from testbed.screen import tell_user

    base = load(None)
    folder = out or Path("results") / f"{base.name}-readings"
    table = run_readings(load, folder, runs, announce=tell_user, **options)
    for claim, rows in table.groupby("claim", sort=False):
        print(f"{claim}: {rows['class'].iloc[0]}")
    if report:
        for reading in base.readings:
            render(folder / "readings" / slug(reading.name), svg=False)
        print(f"report: {write_page(folder)}")
    else:
        print(f"tables: {folder}; the report: testbed report {folder}")


def verdict_table(scenario: Scenario, found: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """`COLUMNS` and ``timed``, claim by claim. ``found`` maps a reading to the ``claims`` of its result."""
    import pandas as pd

    from testbed.metrics import TIME_METRIC
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
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, not a folder for results")
    if out.is_dir() and any(out.iterdir()) and read_manifest(out) is None:
        raise InputError(f"{out}: is not empty and holds no readings of the testbed; give another --out")


def read_manifest(out: Path) -> dict[str, Any] | None:
    """The manifest of a folder with readings, or None where there is none."""
    try:
        manifest = json.loads((out / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return manifest if isinstance(manifest, dict) and manifest.get("kind") == KIND else None


def slug(name: str) -> str:
    """A folder's name for a reading."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def _manifest(scenario: Scenario, runs: int | Auto, finished: bool) -> dict[str, Any]:
    return {
        "kind": KIND,
        "finished": finished,
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


def _write(path: Path, table: pd.DataFrame) -> None:
    write_atomic(path, table.to_csv(index=False, float_format="%.10g", lineterminator="\n").encode())
