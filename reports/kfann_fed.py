"""KFANN 2018: what could the filter be fed with in an outage, from the paper's networks to the positions that it hides?

Each run is sensed twice, with the outage and without: the same noise, so that the second holds the fixes that the first
hides. Position RMSE in metres over the outage and over its first seconds. Written: ``fed.csv``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

    from estimators.methods.lkf9 import Array, Measurements
    from testbed.data.records import NavSolution, SensorLog

SCENARIO = "kfann-2018"
VARIANTS = (
    *("as-stated", "as-stated-2", "as-stated-3"),
    *("magnitude-matched", "magnitude-matched-2", "magnitude-matched-3"),
)
RUNS = 100
FIRST_S = 3.0
LINE_S = 10.0
"""What the straight line is fitted to: so many seconds before the outage."""


def make_table(
    results: Path, target: Path, resume: bool = False, announce: Callable[[str], None] | None = None
) -> pd.DataFrame:
    """Run the experiment on every variant and write ``fed.csv`` to ``target``; its runs go to ``results``."""
    import pandas as pd

    results.mkdir(parents=True, exist_ok=True)
    parts = []
    for variant in VARIANTS:
        stored = results / f"{variant}.csv"
        if not (resume and stored.is_file()):
            if announce is not None:
                announce(f"fed: {variant}")
            run_variant(variant, RUNS).to_csv(stored, index=False, float_format="%.10g", lineterminator="\n")
        parts.append(pd.read_csv(stored))
    table = summarise(pd.concat(parts, ignore_index=True))
    target.mkdir(parents=True, exist_ok=True)
    table.to_csv(target / "fed.csv", index=False, float_format="%.5g", lineterminator="\n")
    return table


def run_variant(variant: str, runs: int) -> pd.DataFrame:
    """variant, run, fed, outage_m, first_m: RMSE over the outage and over its first `FIRST_S` seconds."""
    import pandas as pd

    from testbed import pipeline
    from testbed.scenario import load_scenario

    scenario = load_scenario(SCENARIO, variant=variant)
    seen = load_scenario(SCENARIO, variant=variant, overrides={"sensors.gnss.outages": []})
    trajectory = pipeline.fly(scenario)
    rows = []
    for run in range(runs):
        log, _ = pipeline.sense(scenario, trajectory, run=run)
        full, _ = pipeline.sense(seen, trajectory, run=run)
        assert log.gnss is not None
        ((start, end),) = log.gnss.outages
        for fed, solution in answers(log, full).items():
            errors = [rmse(trajectory, solution, start, until) for until in (end, start + FIRST_S)]
            rows.append((variant, run, fed, *errors))
    return pd.DataFrame(rows, columns=["variant", "run", "fed", "outage_m", "first_m"])


def answers(log: SensorLog, full: SensorLog) -> dict[str, NavSolution]:
    """What the 9-state filter answers when it is fed with this or that; ``full`` is the log with the hidden fixes in it."""
    from estimators.learning.kfann import TARGETS, Ann, Kfann, network_outputs, outages_of, train_networks
    from estimators.methods.lkf9 import Lkf9, fixes_of, free_ins, gnss_measurements

    settings, ins = Kfann(inputs="nn3"), free_ins(log)
    real, every = (gnss_measurements(ins, fixes_of(part, "fed")) for part in (log, full))
    ((start, end, times),) = outages_of(fixes_of(log, "fed"), ins)
    hidden = every.value[(every.t > start + 1e-6) & (every.t < end - 1e-6)]
    step = float(np.median(np.diff(every.t)))

    def networks(known: Measurements, until: float) -> Array:
        trained = train_networks(settings, ins, known, known.t < until + 1e-6, TARGETS[3:])
        return network_outputs(settings, ins, trained, times, step)

    def feed(value: Array, std: Array) -> NavSolution:
        return fed_with(settings, log, ins, real, times, value, std)

    receivers = real.std[real.t < start + 1e-6][-1]
    learnt = networks(real, start)
    errors = np.sqrt(np.mean((learnt - hidden) ** 2, axis=0))
    return {
        "networks (KFANN NN3)": feed(learnt, receivers),
        "networks, R their true error": feed(learnt, np.where(errors > 0.0, errors, receivers)),
        "straight line": feed(straight_line(real, start, times), receivers),
        "networks shown the outage": feed(networks(every, end), receivers),
        "hidden positions": feed(hidden, receivers),
        "nothing (LKF coasting)": Lkf9().run(log),
        "nothing (Update INS)": Lkf9(restart=True).run(log),
        "networks, no filter (ANN NN3)": Ann(inputs="nn3").run(log),
        "no outage": Lkf9().run(full),
    }


def fed_with(
    settings: Any, log: SensorLog, ins: Any, real: Measurements, times: Array, value: Array, std: Array
) -> NavSolution:
    """The filter fed with the log's fixes, and with positions ``value`` (M,6), ``std`` (6,) at ``times`` (M,)."""
    from estimators.learning.kfann import in_order
    from estimators.methods.lkf9 import Measurements, run_filter

    made_up = Measurements(times, value, np.tile(std, (len(times), 1)), np.full(len(times), 3))
    return run_filter(settings, log, ins, in_order([real, made_up]))


def straight_line(real: Measurements, start: float, times: Array) -> Array:
    """INS minus GNSS (M,6) at ``times``: the least-squares line through the `LINE_S` seconds up to ``start``."""
    last = (real.t > start - LINE_S) & (real.t < start + 1e-6)
    slope, level = np.polyfit(real.t[last] - start, real.value[last], 1)
    return np.asarray(level + np.outer(times - start, slope))


def rmse(trajectory: Any, solution: NavSolution, start: float, end: float) -> float:
    """3-D position RMSE (m) over (start, end]."""
    from testbed.scoring.metrics import error_series

    series = error_series(trajectory, solution)
    rows = (series.t > start + 1e-9) & (series.t <= end + 1e-9)
    return float(np.sqrt(np.mean(np.sum(series.values[rows, :3] ** 2, axis=1))))


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """variant, fed, runs, mean_m with its 95 % interval, median_m, and the mean over the outage's first seconds."""
    import pandas as pd

    from testbed.scoring.statistics import describe

    out = []
    for (variant, fed), part in rows.groupby(["variant", "fed"], sort=False):
        figures = {key: column[0] for key, column in describe(part[["outage_m"]].to_numpy()).items()}
        out.append(
            {
                "variant": variant,
                "fed": fed,
                "runs": int(figures["n"]),
                "mean_m": figures["mean"],
                "ci_low_m": figures["ci_low"],
                "ci_high_m": figures["ci_high"],
                "median_m": figures["median"],
                f"mean_first_{FIRST_S:g}_s_m": float(part["first_m"].mean()),
            }
        )
    return pd.DataFrame(out)
