"""Tables of a tuning study: its searches, the scores of every result on seen and unseen runs, and the paper's tables.

`write_tables` makes what is computed; `fitness_table`, `rmse_table` and `rank_sums` read it. Metrics in m, m/s, degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from testbed.base.csv_text import csv_text
from testbed.base.schema import read_toml
from testbed.data.records import Array
from testbed.montecarlo.folders import Folder
from testbed.scenario import Scenario
from testbed.scoring.effects import effect
from testbed.scoring.quantities import MAIN, NIS
from testbed.tuning.config import DATA_SHEET, RMSE_METRICS, Task, TuneConfig, tuned_entry
from testbed.tuning.history import per_iteration, read_evaluations
from testbed.tuning.objective import DEVIANCE, Recording, full_score, record, scenario_space

if TYPE_CHECKING:
    import pandas as pd

KEPT_METRICS = [*RMSE_METRICS, *(f"rmse_{name}" for name in MAIN[:2]), "nees_attitude", NIS, DEVIANCE]


def write_tables(
    folder: Folder, scenario: Scenario, config: TuneConfig, tasks: Sequence[Task], seen: Sequence[Recording]
) -> None:
    """``searches.csv, history.csv, timings.csv, scores.csv, heldout.csv`` of a complete study."""
    import pandas as pd

    names = scenario_space(scenario, config).names
    searches, histories, timings = [], [], []
    earlier: dict[Task, Array] = {}
    for task in tasks:
        x, f, seconds = read_evaluations(folder.out / "evaluations" / f"{task.name}.parquet", names)
        family = replace(task, iterations=0)
        shared = common_start(x, earlier.get(family, x[:0]))
        earlier[family] = x
        kind = "likelihood" if task.likelihood else "objective"
        best = int(f.argmin())
        key = {
            "search": task.name,
            "algorithm": task.algorithm,
            "iterations": task.iterations,
            "seed": task.seed,
            "kind": kind,
        }
        searches.append(
            key | {"evaluations": len(f), "shared": shared, "best": f[best]} | dict(zip(names, x[best], strict=True))
        )
        histories.append(per_iteration(f, config.population).assign(search=task.name))
        timings.append({"search": task.name, "seconds": seconds.sum(), "seconds_per_evaluation": seconds.mean()})
    scores = _scores(folder, scenario, config, tasks, seen)
    made = {"searches": pd.DataFrame(searches), "history": pd.concat(histories), "timings": pd.DataFrame(timings)}
    made |= {"scores": scores, "heldout": heldout(scores, config)}
    texts = {f"{name}.csv": csv_text(table, float_format="%.10g") for name, table in made.items()}
    folder.claim(texts)
    for name, text in texts.items():
        folder.write(name, text.encode())


def common_start(x: Array, other: Array) -> int:
    """How many candidates two searches begin with in common: the longer one takes their values from the shorter."""
    n = min(len(x), len(other))
    differ = (x[:n] != other[:n]).any(axis=1)
    return int(differ.argmax()) if differ.any() else n


def _scores(
    folder: Folder, scenario: Scenario, config: TuneConfig, tasks: Sequence[Task], seen: Sequence[Recording]
) -> pd.DataFrame:
    """Columns row, case, run, set (train, test), metric, value; a recording is made once and forgotten."""
    import pandas as pd

    entry = tuned_entry(scenario, config)
    candidates: dict[str, dict[str, Any]] = {DATA_SHEET: dict(entry.params)}
    for task in tasks:
        candidates[task.name] = read_toml(folder.check(f"best/{task.name}.toml"))["params"]
    rows: list[tuple[Any, ...]] = []

    def take(recording: Recording, which: str) -> None:
        for row, params in candidates.items():
            found = full_score(entry.name, params, recording, config.window)
            kept = dict.fromkeys([*KEPT_METRICS, *config.metrics])
            rows.extend((row, recording.case, recording.run, which, m, found.get(m, np.inf)) for m in kept)
        rows.extend(
            ("GNSS alone", recording.case, recording.run, which, m, v) for m, v in gnss_errors(recording).items()
        )

    for recording in seen:
        take(recording, "train")
    for run in config.test_runs:
        for recording in record(scenario, config, [run]):
            take(recording, "test")
    return pd.DataFrame(rows, columns=["row", "case", "run", "set", "metric", "value"])


def gnss_errors(recording: Recording) -> dict[str, float]:
    """RMSE of the fixes themselves against truth (without lever arm)."""
    from testbed.physics import earth
    from testbed.scoring.error_series import truth_at

    gnss, truth = recording.log.gnss, recording.trajectory
    if gnss is None or len(gnss.t) == 0 or any(gnss.spec.lever_arm_b):
        return {}
    t = gnss.t - gnss.spec.latency_s
    inside = (t >= truth.t[0]) & (t <= truth.t[-1])
    lat, lon, h, v_n, _ = truth_at(truth, t[inside])
    ned = earth.position_difference(gnss.lat[inside], gnss.lon[inside], gnss.h[inside], lat, lon, h)
    values = np.sqrt((np.column_stack([*ned, gnss.v_n[inside] - v_n]) ** 2).mean(axis=0))
    return dict(zip(RMSE_METRICS[:6], (float(v) for v in values), strict=True))


def objective_sums(scores: pd.DataFrame, config: TuneConfig) -> pd.DataFrame:
    """The objective of each row (index) in each run (columns): sum over metrics and cases of `scores`."""
    chosen = scores[scores["metric"].isin(config.metrics) & (scores["row"] != "GNSS alone")]
    return chosen.pivot_table(index="row", columns="run", values="value", aggfunc="sum", sort=False)


def heldout(scores: pd.DataFrame, config: TuneConfig) -> pd.DataFrame:
    """Objective on the seen and the unseen runs, and the improvement on the unseen ones over the data sheet in %.

    Paired over runs: 95 % bootstrap interval and Wilcoxon signed-rank p.
    """
    import pandas as pd

    sums = {which: objective_sums(scores[scores["set"] == which], config) for which in ("train", "test")}
    rows = []
    for row in sums["train"].index:
        entry: dict[str, Any] = {"row": row, "train": sums["train"].loc[row].mean()}
        if not sums["test"].empty:
            own, base = (sums["test"].loc[name].to_numpy() for name in (row, DATA_SHEET))
            entry |= {"test": own.mean(), "diverged": int((~np.isfinite(own)).sum())}
            gain = effect(own, base) if row != DATA_SHEET else None
            if gain is not None:
                entry |= {
                    "improvement_pct": gain.percent,
                    "ci_low": gain.low,
                    "ci_high": gain.high,
                    "p_value": gain.p_value,
                }
        rows.append(entry)
    columns = ["row", "train", "test", "diverged", "improvement_pct", "ci_low", "ci_high", "p_value"]
    return pd.DataFrame(rows).reindex(columns=columns)


STATISTICS: dict[str, Callable[[Array], Any]] = {
    "min": np.min,
    "max": np.max,
    "mean": np.mean,
    "variance": lambda v: np.var(v, ddof=1) if len(v) > 1 else np.nan,
}
"""Statistics over the searches of an algorithm, as the paper's Table 2 has them."""


def by_algorithm(
    searches: pd.DataFrame, scores: pd.DataFrame, timings: pd.DataFrame, which: str = "train"
) -> pd.DataFrame:
    """One line per search: algorithm, fitness, seconds, and each RMSE of each case (mean over runs) as CASE:METRIC."""
    part = scores[(scores["set"] == which) & scores["metric"].isin(RMSE_METRICS)]
    wide = part.assign(key=part["case"] + ":" + part["metric"]).pivot_table(
        index="row", columns="key", values="value", sort=False
    )
    out = searches[searches["kind"] == "objective"].set_index("search")[["algorithm", "iterations", "best"]]
    return out.rename(columns={"best": "fitness"}).join(timings.set_index("search")["seconds"]).join(wide)


def statistic_rows(lines: pd.DataFrame, algorithms: Sequence[str]) -> pd.DataFrame:
    """Index (quantity, statistic), a column per algorithm: the numbers that Table 2 is made of and Table 4 ranks."""
    import pandas as pd

    quantities = [c for c in lines.columns if c not in ("algorithm", "iterations")]
    rows = {}
    for quantity in quantities:
        for name, function in STATISTICS.items():
            rows[quantity, name] = [
                float(function(lines.loc[lines["algorithm"] == a, quantity].to_numpy())) for a in algorithms
            ]
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(algorithms)).set_index(
        pd.MultiIndex.from_tuples(rows, names=["quantity", "statistic"])
    )


def rank_sums(table: pd.DataFrame) -> pd.DataFrame:
    """Sum of the ranks (1 best, ties shared) of each algorithm over the rows of `statistic_rows`; time does not count."""
    import pandas as pd

    counted = table[(table.index.get_level_values("quantity") != "seconds") & table.notna().all(axis=1)]
    ranks = counted.rank(axis=1)
    return pd.DataFrame(
        {"rank_sum": ranks.sum(), "rows": len(counted), "place": ranks.sum().rank(method="min").astype(int)}
    )
