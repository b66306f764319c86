"""What an evaluation costs: one by one, side by side in vector lanes, and a population on one thread and on two.

Seconds of the objective that ``[extra.tune]`` describes; the best of several tries, since a machine has other things to do.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.errors import InputError
from testbed.base.files import write_atomic
from testbed.data.estimator import fast_path
from testbed.data.registry import estimator_class, make_estimator
from testbed.scenario import Scenario
from testbed.tuning.config import tune_config, tuned_entry
from testbed.tuning.objective import Objective, Task, record, scenario_space

if TYPE_CHECKING:
    import pandas as pd

TABLE_EVALUATIONS = 450_000
"""The paper's whole table: six algorithms, 100 to 500 iterations, a population of 50."""


def measure(scenario: Scenario, tries: int = 5) -> pd.DataFrame:
    """Columns what, threads, candidates, busiest_thread_s, wall_s, per_evaluation_s, table_h.

    The processor time of the busiest thread is what the wall time is on a machine with nothing else to do; the last two
    columns are reckoned from it. ``table_h``: the paper's whole table at that speed.
    """
    import pandas as pd

    config = tune_config(scenario)
    recordings = record(scenario, config, config.train_runs)
    threads = [n for n in (1, 2) if n <= (os.cpu_count() or 1)]
    entry = tuned_entry(scenario, config)
    arguments = (entry.name, entry.params, scenario_space(scenario, config), recordings, config.metrics)
    objectives = {n: _Clocked(*arguments, stride=config.stride, jobs=n) for n in threads}
    make_searcher = fast_path(estimator_class(entry.name), "searcher")
    if make_searcher is None:
        raise InputError(f"{scenario.source_path}: '{entry.row}' has no fast path whose speed could be measured")
    searchers = [make_searcher(r.log, r.trajectory, config.stride) for r in recordings]
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (config.population, len(objectives[1].space.names)))
    side, over = min(searchers[0].batch_size, len(x)), objectives[1].space.over
    made = [make_estimator(entry.name, **over(entry.params, row)) for row in x]
    work: dict[tuple[str, int, int], Callable[[], object]] = {
        ("one by one", 1, 2): lambda: [score(row) for row in made[:2] for score in searchers],
        ("side by side", 1, side): lambda: objectives[1](x[:side]),
    }
    for n in threads:
        work["a population", n, len(x)] = lambda n=n: objectives[n](x)  # type: ignore[misc]
    best = dict.fromkeys(work, (np.inf, np.inf))
    for _ in range(tries + 1):
        for key, task in work.items():
            objectives[key[1]].busy.clear()
            wall, own = time.perf_counter(), time.thread_time()
            task()
            own, wall = time.thread_time() - own, time.perf_counter() - wall
            busiest = max([own, *objectives[key[1]].busy.values()])
            best[key] = min(best[key][0], busiest), min(best[key][1], wall)
    for objective in objectives.values():
        objective.close()
    columns = ["what", "threads", "candidates", "busiest_thread_s", "wall_s", "per_evaluation_s", "table_h"]
    rows = [
        (*key, *seconds, seconds[0] / key[2], seconds[0] / key[2] * TABLE_EVALUATIONS / 3600.0)
        for key, seconds in best.items()
    ]
    return pd.DataFrame(rows, columns=columns)


class _Clocked(Objective):
    """An objective that adds up the processor time of each of its threads in ``busy``."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.busy: Counter[int] = Counter()
        score = self._score

        def clocked(task: Task) -> list[float]:
            start = time.thread_time()
            found = score(task)
            self.busy[threading.get_ident()] += time.thread_time() - start  # type: ignore[assignment]
            return found

        self._score = clocked


def write_speed(scenario: Scenario, folder: str | Path, tries: int = 5) -> Path:
    """`measure` into ``speed.csv``."""
    path = Path(folder) / "speed.csv"
    write_atomic(path, measure(scenario, tries).to_csv(index=False, float_format="%.4g").encode())
    return path
