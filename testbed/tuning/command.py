"""The verb ``testbed tune``: a study with its best value and time left on the screen, then its tables and report."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from testbed.base.csv_text import read_csv
from testbed.base.errors import InputError, MissingExtra, tell_user
from testbed.base.resources import has_package

if TYPE_CHECKING:
    from testbed.scenario import Scenario
    from testbed.tuning.config import TuneConfig
    from testbed.tuning.tune import Progress

QUIET_S = 10.0
"""Time between two plain progress lines."""


def tune(
    scenario: Scenario,
    out: Path | None = None,
    algorithms: str | None = None,
    iterations: str | None = None,
    population: int | None = None,
    seeds: str | None = None,
    jobs: int | None = None,
    resume: bool = False,
    only: str | None = None,
    time_limit: float | None = None,
    plugins: Sequence[Path] = (),
) -> None:
    """Search, score, report. Lists are comma-separated; what is None comes from ``[extra.tune]``."""
    from testbed.scenario import check_once
    from testbed.tuning import tune as driver
    from testbed.tuning.config import tune_config
    from testbed.tuning.report import write_report

    given = {
        "algorithms": None if algorithms is None else [part.strip() for part in algorithms.split(",")],
        "iterations": _numbers("--iterations", iterations),
        "seeds": _numbers("--seeds", seeds),
        "population": population,
    }
    for key in (key for key, value in given.items() if value is not None):
        check_once(scenario.settings, f"extra.tune.{key}", f"--{key}")
    config = tune_config(scenario, **given)
    config = _without_extras(config, asked=algorithms is not None)
    variant = f"-{scenario.variant}" if scenario.variant else ""
    folder = out or Path("results") / f"{scenario.name}{variant}-tuning"
    with progress_line() as tell:
        driver.tune(scenario, folder, config, jobs, resume, only, time_limit, tell, plugins)
    if only is None:
        print_study(folder)
        write_report(folder)
        print(f"report: {folder / 'report.html'}; parameter files: {folder / 'best'}")


def _without_extras(config: TuneConfig, asked: bool) -> TuneConfig:
    """Leave out, with a note, what needs a package that is not there; MissingExtra where it was ``asked`` for by name."""
    from testbed.tuning.library import CMA_ES, NEEDS_CMA
    from testbed.tuning.search import least_population

    if has_package("cma"):
        return config
    left = [name for name in config.algorithms if name != CMA_ES]
    changes: dict[str, Any] = {}
    if left != config.algorithms:
        if asked or not left:
            raise MissingExtra(NEEDS_CMA)
        changes["algorithms"] = left
        tell_user(f"note: {NEEDS_CMA}; it is left out")
    if config.innovation_search == CMA_ES:
        other = "de" if config.population >= least_population("de") else "pso"
        changes["innovation_search"] = other
        tell_user(f"note: {NEEDS_CMA}; the innovations are searched by {other}")
    return config.model_copy(update=changes)


def print_study(folder: Path) -> None:
    """The held-out table on screen."""

    table = read_csv(folder / "heldout.csv").sort_values("test", kind="stable")
    print("objective on the runs of the search (train) and on unseen ones (test); improvement over the data sheet in %")
    print(table.to_string(index=False, float_format=lambda v: f"{v:.4g}", na_rep=""))


def _numbers(option: str, text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{option} {text}: expected whole numbers with commas, for example 100,200") from None


@contextmanager
def progress_line() -> Iterator[Callable[[Progress], None]]:
    """A bar with search, best value and time left on a terminal; plain lines elsewhere."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
        from rich.progress import Progress as Bar

        columns: Sequence[Any] = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[left]}"),
        )
        with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("", total=None, left="")
            yield lambda p: bar.update(
                task, completed=p.done, total=p.total, description=f"{p.search} best {p.best:.4g}", left=_left(p.left_s)
            )
        return
    told_at, told = 0.0, ""

    def tell(p: Progress) -> None:
        nonlocal told_at, told
        if time.monotonic() - told_at > QUIET_S or p.search != told or p.done == p.total:
            told_at, told = time.monotonic(), p.search
            print(
                f"{p.search}: {p.done} of {p.total}, best {p.best:.5g}, {_left(p.left_s)}", file=sys.stderr, flush=True
            )

    yield tell


def _left(seconds: float | None) -> str:
    if seconds is None:
        return "time left unknown"
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d} left"
