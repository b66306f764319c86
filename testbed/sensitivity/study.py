"""A sensitivity study: plans its points, evaluates what is missing, writes the indices.

The folder holds ``evaluations/METHOD.parquet``, and at the end ``sensitivity.csv``, ``outcomes.csv``, ``sensitivity.md`` and a figure for
each metric. The same bytes for one seed, whatever the number of workers and however often the work was interrupted.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import testbed
from testbed.base.errors import InputError, TestbedError, nearest
from testbed.montecarlo.folders import Folder, check_own
from testbed.montecarlo.runner import git_revision
from testbed.montecarlo.store import files_digest
from testbed.scenario import Scenario
from testbed.scoring.quantities import metric_names
from testbed.sensitivity.design import Design, make_design
from testbed.sensitivity.evaluate import Model, cells_of, evaluate
from testbed.sensitivity.factors import check_factors
from testbed.sensitivity.question import Question
from testbed.sensitivity.store import AGAIN, Evaluations

KIND = "testbed sensitivity"
Progress = Callable[[str, int, int], None]
"""Called with the method, the points done and the points wanted."""


class Stopped(TestbedError):
    """The study was stopped before its end; what is done is stored."""


class _Study(Folder):
    """The folder of a study, which can be resumed."""

    again = AGAIN


def sensitivity(
    scenario: Scenario,
    question: Question,
    out: str | Path,
    jobs: int | None = None,
    resume: bool = False,
    time_limit_s: float | None = None,
    progress: Progress | None = None,
    plugins: Sequence[str | Path] = (),
) -> Path:
    """Run a study and return its folder. Raises InputError before anything is written, Stopped when it is not complete.

    After ``time_limit_s`` it stops at a whole point; ``resume`` goes on, also with more samples, trajectories or methods.
    """
    from testbed.sensitivity.tables import write_tables

    jobs, out = jobs or os.cpu_count() or 1, Path(out)
    paths = tuple(str(Path(p).resolve()) for p in plugins)
    _check(scenario, question)
    designs = [
        make_design(method, len(question.factors), question.groups(method), scenario.monte_carlo.seed)
        for method in question.methods
    ]
    study = identity(scenario, question, paths)
    _check_folder(out, study, resume)
    bare = Model(scenario, question.factors, (), question.runs, paths)
    cells, notes = cells_of(bare, question.metrics, question.windows)
    model = Model(scenario, question.factors, tuple(cells), question.runs, paths)
    deadline = None if time_limit_s is None else time.monotonic() + time_limit_s
    with _Study.open(out, KIND) as folder:
        folder.write_all({"scenario.toml": scenario.to_toml().encode()})
        _describe(folder, scenario, question, study, finished=False)
        folder.claim([_stored(method) for method in question.methods])
        found = [_complete(model, design, folder, study, (jobs, deadline, progress)) for design in designs]
        write_tables(folder, scenario, question, cells, found, notes)
        _describe(folder, scenario, question, study, finished=True)
    return out


def _check(scenario: Scenario, question: Question) -> None:
    check_factors(question.factors, scenario)
    for metric in question.metrics:
        if metric not in metric_names():
            raise InputError(
                f"--metric {metric}: no such metric; {nearest(metric, metric_names())} (testbed list metrics shows all)"
            )
    if question.runs < 1:
        raise InputError(f"--runs {question.runs}: at least one")


def _check_folder(out: Path, study: str, resume: bool) -> None:
    previous = check_own(out, KIND)
    if previous is None or not any((out / "evaluations").glob("*.parquet")):
        return
    if previous.get("identity") != study:
        raise InputError(f"{out}: holds a study of another scenario or question; give another --out")
    if not resume:
        raise InputError(
            f"{out}: already holds this study; complete or lengthen it with --resume, delete the folder, or give another --out"
        )


def _stored(method: str) -> str:
    return f"evaluations/{method}.parquet"


def _complete(
    model: Model,
    design: Design,
    folder: Folder,
    study: str,
    course: tuple[int, float | None, Progress | None],
) -> tuple[Design, Evaluations]:
    """The plan with all of its points evaluated; ``course``: jobs, deadline, progress."""
    jobs, deadline, progress = course
    store = Evaluations(
        folder.out / _stored(design.method),
        [f.key for f in model.factors],
        list(map(str, model.cells)),
        model.runs,
        study,
    )
    store.take(design.points)
    missing, total = store.missing(), len(design.points)
    units = evaluate(model, design.points, missing, jobs)
    try:
        if progress is not None:
            progress(design.method, total - len(missing), total)
        for rows, found in units:
            store.add(rows, found)
            if progress is not None:
                progress(design.method, int(store.done.sum()), total)
            if deadline is not None and time.monotonic() > deadline and not store.done.all():
                raise Stopped(f"{folder.out}: time is up in {design.method}; the same command with --resume goes on")
    except KeyboardInterrupt:
        raise Stopped(f"{folder.out}: stopped in {design.method}; the same command with --resume goes on") from None
    finally:
        units.close()
        store.save()
    folder.finish(_stored(design.method))
    return design, store


def identity(scenario: Scenario, question: Question, plugins: Sequence[str]) -> str:
    """Hash of all that determines the values at a point; how many points there are is none of it."""
    asked = [list(map(str, question.factors)), question.metrics, question.windows, question.runs]
    data = [scenario.digest(), asked, testbed.__version__, files_digest(plugins)]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _describe(folder: Folder, scenario: Scenario, question: Question, study: str, finished: bool) -> None:
    folder.save(
        kind=KIND,
        identity=study,
        finished=finished,
        scenario=scenario.name,
        title=scenario.scenario.title,
        variant=scenario.variant,
        profile=scenario.profile,
        estimators=[entry.row for entry in scenario.estimators],
        figures=[str(factor) for factor in question.factors],
        metrics=list(question.metrics),
        windows=list(question.windows),
        methods={method: question.groups(method) for method in question.methods},
        runs=question.runs,
        testbed=testbed.__version__,
        git=git_revision(),
    )
