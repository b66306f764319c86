"""What a paper's report is made of: jobs, each of which leaves small text tables that stand in git, and figures.

A job runs once; its tables are what the page is made from, so that a page can be made anywhere from what git holds. No committed table
has a timing, a date, a version or a machine in it: those stand in files with ``timings`` in their name and in ``made.json``,
which are not compared. Budgets are minutes on two cores; effects are per cent, all else as the heads say.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from testbed.scenario import Scenario

LONGEST_MINUTES = 100.0
"""Of a job: what can be lost when a machine goes down."""
DIGITS = 6
"""Of a number in a committed table: more than any interval here resolves, less than where processors differ."""
TRIAL_RUNS = 2
FIRST, CAP, WIDTH_PCT = 30, 200, 5.0
"""Runs of a claim: from where the mean of skewed errors is near enough to normal, until its interval is so wide, or this many."""


class Kept(Exception):
    """What a job needs (a recording that may not be shipped) is not here: its tables stay as they are. Says what is missing."""


@dataclass(frozen=True)
class Place:
    """Where a job works: ``work`` keeps its runs and ``pages`` its HTML (both untracked), ``target`` its tables."""

    paper: str
    work: Path
    target: Path
    pages: Path
    resume: bool = False
    """Whether what stands in ``work`` may be used."""
    trial: bool = False
    """Whether the smallest size that runs is enough."""


@dataclass(frozen=True)
class Job:
    """One part of a report. ``inputs`` tells, for a paper's name, all that determines the tables but for the code."""

    name: str
    minutes: float
    make: Callable[[Place], None]
    tables: tuple[str, ...]
    figures: tuple[str, ...] = ()
    """Stems of ``figures/*.png``."""
    timings: tuple[str, ...] = ()
    """Further text files, which are not compared."""
    linked: tuple[str, ...] = ()
    """Of the tables, those that the page names and does not show."""
    title: str = ""
    note: str = ""
    long: bool = False
    inputs: Callable[[str], Any] = lambda paper: None
    setting: Setting | None = None
    """Whose claims its verdicts are on, where they are a scenario's."""

    def __post_init__(self) -> None:
        if not 0.0 < self.minutes <= LONGEST_MINUTES:
            raise ValueError(f"{self.name}: {self.minutes:g} minutes; at most {LONGEST_MINUTES:g}: make it two jobs")
        if not self.tables:
            raise ValueError(f"{self.name}: a job leaves a table")

    def files(self) -> list[str]:
        """All that the job leaves, relative to the paper's folder."""
        return [*self.tables, *self.timings, *(f"figures/{stem}.png" for stem in self.figures)]

    def digest(self, paper: str) -> str:
        """Hash of what determines the tables but for the code."""
        import testbed

        told = [self.name, testbed.__version__, self.inputs(paper)]
        return hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Paper:
    """A report: its folder is ``name``, as is the scenario of its jobs unless they say otherwise."""

    name: str
    title: str
    jobs: tuple[Job, ...]
    source: str = ""


@dataclass(frozen=True)
class Setting:
    """Which scenario a job runs: overlays, single settings, and which of its rows (labels)."""

    variant: str | None = None
    overrides: Mapping[str, Any] | None = None
    estimators: tuple[str, ...] | None = None
    scenario: str | None = None
    """Instead of the paper's."""

    def load(self, paper: str, reading: str | None = None) -> Scenario:
        """In the profile ``report`` where there is one."""
        from testbed.montecarlo.runner import with_settings
        from testbed.scenario import load_scenario, overlays_of

        name = self.scenario or paper
        profile = "report" if "report" in overlays_of(name)[0] else None
        scenario = load_scenario(name, profile, self.variant, self.overrides, reading)
        return with_settings(scenario, estimators=self.estimators)

    def inputs(self, paper: str, with_readings: bool) -> list[Any]:
        """Digests of the scenario, or of each of its readings, and what is claimed."""
        base = self.load(paper)
        names: list[str | None] = [r.name for r in base.readings] if with_readings else [None]
        claims = [
            c.model_dump(mode="json", exclude={"text", "contradiction"})
            | ({"contradicted": True} if c.contradiction else {})
            for c in base.active_claims()
        ]
        conditions = [[r.name, dict(r.conditions)] for r in base.readings] if with_readings else []
        tables = [row.metric for table in base.tables for row in table.rows]
        return [[self.load(paper, name).digest() for name in names], claims, conditions, tables]


def readings(
    name: str,
    minutes: float,
    runs: int | None = None,
    width: float = WIDTH_PCT,
    first: int = FIRST,
    cap: int = CAP,
    setting: Setting = Setting(),
    figures: Sequence[str] = (),
    of: str = "",
    **texts: Any,
) -> Job:
    """``testbed run PAPER --readings`` as a job, by interval width unless ``runs`` are given.

    ``figures`` are copied from the result of the reading ``of`` (the first). Leaves ``verdicts.csv`` and ``comparison.csv``, with the job's
    name in front unless it is ``readings``, and timings; ``texts`` are fields of `Job`.
    """
    before = "" if name == "readings" else f"{name}-"
    count = runs if runs is not None else {"width": width, "first": first, "cap": cap}

    def make(place: Place) -> None:
        from testbed.montecarlo.readings import run_readings, slug
        from testbed.montecarlo.runner import Auto
        from testbed.report import render
        from testbed.report.readings import write_page

        known = place.resume and (place.work / "manifest.json").is_file()
        wanted = TRIAL_RUNS if place.trial else runs or Auto(width, cap, first)
        base = setting.load(place.paper)
        run_readings(lambda reading: setting.load(place.paper, reading), place.work, wanted, known, announce=print)
        folders = {reading.name: place.work / "readings" / slug(reading.name) for reading in base.readings}
        for folder in folders.values():
            render(folder, svg=False)
            keep_page(folder, place.pages / folder.relative_to(place.work))
        write_page(place.work)
        keep_page(place.work, place.pages)
        for kind in ("verdicts", "verdicts-timings"):
            if (place.work / f"{kind}.csv").is_file():
                write_csv(place.target / f"{before}{kind}.csv", read_table(place.work / f"{kind}.csv"))
        keep_comparison(base, folders, place.target, before)
        for stem in figures:
            keep_figure(folders[of or base.readings[0].name], stem, place.target)

    return Job(
        name,
        minutes,
        make,
        (f"{before}verdicts.csv", f"{before}comparison.csv"),
        tuple(figures),
        (f"{before}timings.csv", f"{before}verdicts-timings.csv"),
        inputs=lambda paper: [count, setting.inputs(paper, True)],
        setting=setting,
        **texts,
    )


def runs(
    name: str,
    minutes: float,
    runs: int | None = None,
    setting: Setting = Setting(),
    figures: Sequence[str] = (),
    metrics: Sequence[str] = (),
    windows: Sequence[str] = (),
    claims: bool = True,
    **texts: Any,
) -> Job:
    """One Monte Carlo as a job: leaves ``NAME-comparison.csv``, ``NAME-claims.csv`` unless there are no ``claims``, and timings.

    ``metrics`` and ``windows``: to compare beside those that the scenario's claims and tables name.
    """

    def make(place: Place) -> None:
        from testbed.montecarlo.runner import run
        from testbed.report import render

        scenario = setting.load(place.paper)
        known = place.resume and (place.work / "manifest.json").is_file()
        run(scenario, place.work, runs=TRIAL_RUNS if place.trial else runs, resume=known)
        render(place.work, svg=False)
        keep_page(place.work, place.pages)
        if claims:
            write_csv(place.target / f"{name}-claims.csv", read_table(place.work / "claims.csv"))
        keep_comparison(scenario, {"": place.work}, place.target, f"{name}-", metrics, windows)
        for stem in figures:
            keep_figure(place.work, stem, place.target, f"{name}-{stem}")

    return Job(
        name,
        minutes,
        make,
        (*([f"{name}-claims.csv"] if claims else []), f"{name}-comparison.csv"),
        tuple(f"{name}-{stem}" for stem in figures),
        (f"{name}-timings.csv",),
        inputs=lambda paper: [runs, list(metrics), *([list(windows)] if windows else []), setting.inputs(paper, False)],
        setting=setting,
        **texts,
    )


def study(
    name: str,
    make: Callable[[Place], None],
    minutes: float,
    tables: Sequence[str],
    figures: Sequence[str] = (),
    scenarios: Sequence[Setting] = (),
    inputs: Any = None,
    **texts: Any,
) -> Job:
    """A function as a job. ``inputs`` is any further parameter that JSON can hold; ``texts`` are fields of `Job`."""

    def told(paper: str) -> Any:
        return [inputs, [setting.inputs(paper, False) for setting in scenarios]]

    return Job(name, minutes, make, tuple(tables), tuple(figures), inputs=told, **texts)


def keep_comparison(
    base: Scenario,
    folders: Mapping[str, Path],
    target: Path,
    before: str,
    more: Sequence[str] = (),
    more_windows: Sequence[str] = (),
) -> None:
    """``comparison.csv`` and ``timings.csv`` of results, by reading; the metrics and windows that claims and tables name, and attitude."""
    import pandas as pd

    from testbed.scoring.quantities import TIME_METRIC

    claims = base.active_claims()
    rows = [(table, row) for table in base.tables for row in table.rows]
    named = [*(row.metric for _, row in rows), *(c.metric for c in claims), *more, "rmse_attitude_deg"]
    metrics = [m for m in dict.fromkeys(named) if m not in (TIME_METRIC, "seconds")]
    windows = {"all", *more_windows, *(c.window for c in claims), *(row.window or table.window for table, row in rows)}
    compared, timed = [], []
    for reading, folder in folders.items():
        summary = read_table(folder / "summary.csv")
        chosen = summary[summary["metric"].isin(metrics) & summary["window"].isin(windows)]
        compared.append(chosen.assign(reading=reading))
        timed.append(read_table(folder / "timings.csv").assign(reading=reading))
    table = pd.concat(compared, ignore_index=True).rename(columns={"n": "runs"})
    median = ["median"] if any(table.statistic == "median" for table in base.tables) else []
    columns = ["reading", "estimator", "window", "metric", "mean", "ci_low", "ci_high", *median, "runs"]
    write_csv(target / f"{before}comparison.csv", table[columns], digits=5)
    write_csv(target / f"{before}timings.csv", pd.concat(timed, ignore_index=True), digits=3)


PAGE = ("report.html", "tables.tex", "summary.csv", "scenario.toml")


def keep_page(folder: Path, pages: Path) -> None:
    """What a reader of a result looks at, beside the tables in git."""
    import shutil

    pages.mkdir(parents=True, exist_ok=True)
    for name in PAGE:
        if (folder / name).is_file():
            shutil.copy(folder / name, pages / name)


def keep_figure(folder: Path, stem: str, target: Path, name: str = "") -> None:
    """A figure of a result's page into the paper's figures."""
    import shutil

    (target / "figures").mkdir(parents=True, exist_ok=True)
    shutil.copy(folder / "figures" / f"{stem}.png", target / "figures" / f"{name or stem}.png")


def read_table(path: Path) -> pd.DataFrame:
    """A table of the bench; names that look like numbers stay names."""
    from testbed.base.csv_text import read_csv

    return read_csv(path, dtype={"claim": str, "id": str, "runaways": str})


def write_csv(path: Path, frame: pd.DataFrame, digits: int = DIGITS) -> None:
    """A table as git keeps it."""
    from testbed.base.csv_text import csv_text
    from testbed.base.files import write_atomic

    write_atomic(path, csv_text(frame, float_format=f"%.{digits}g", lineterminator="\n").encode())
