"""KFANN 2018: what could the filter be fed with in an outage, from the paper's networks to the fixes that it hides?

Each run is sensed twice, with the outage and without: the same noise, so that the second holds the fixes that the first
hides. Position RMSE in metres over the outage and over its first seconds. Written: ``fed.csv``, and ``verdicts-fed.csv`` with
the claims under the one reading of R that no filter can have, the networks' true errors in the outage.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from jobs import Place

    from estimators.methods.lkf9 import Array, Measurements
    from testbed.data.records import NavSolution, SensorLog

SCENARIO = "kfann-2018"
CASES = tuple(
    (variant, reading) for reading in ("as stated", "matched") for variant in (None, "trajectory-2", "trajectory-3")
)
"""Trajectory (a variant) and reading."""
RUNS = 30
"""A second each; what is fed matters by factors."""
FIRST_S = 3.0
LINE_S = 10.0
"""What the straight line is fitted to: so many seconds before the outage."""
NETWORKS, TRUE_R = "networks (KFANN NN3)", "networks, R their true error"
ANN, UPDATE, COASTING = "networks, no filter (ANN NN3)", "nothing (Update INS)", "nothing (LKF coasting)"
STATED = {None: (72.0, 85.0), "trajectory-2": (68.0, 75.0), "trajectory-3": (46.0, 65.0)}
"""By how much the paper has KFANN NN3 below ANN and Update INS, per cent."""


def make_table(place: Place) -> None:
    """Run every case and write both tables to ``place.target``; its runs go to ``place.work``."""
    from jobs import TRIAL_RUNS, write_csv

    rows = run_cases(place.work, TRIAL_RUNS if place.trial else RUNS, place.resume, print)
    write_csv(place.target / "fed.csv", summarise(rows))
    write_csv(place.target / "verdicts-fed.csv", verdicts(rows))


def run_cases(
    results: Path, runs: int, resume: bool = False, announce: Callable[[str], None] | None = None
) -> pd.DataFrame:
    """The rows of `run_case` with ``trajectory`` and ``reading`` before them; a stored case is kept with ``resume``."""
    import pandas as pd

    results.mkdir(parents=True, exist_ok=True)
    parts = []
    for variant, reading in CASES:
        named = trajectory_of(variant)
        stored = results / f"{named}-{reading}-{runs}.csv".replace(" ", "-")
        if not (resume and stored.is_file()):
            if announce is not None:
                announce(f"fed: {named}, {reading}")
            run_case(variant, reading, runs).to_csv(stored, index=False, float_format="%.10g", lineterminator="\n")
        parts.append(pd.read_csv(stored).assign(trajectory=named, reading=reading))
    return pd.concat(parts, ignore_index=True)


def trajectory_of(variant: str | None) -> str:
    """``trajectory 1`` of the scenario as it stands."""
    return (variant or "trajectory-1").replace("-", " ")


def run_case(variant: str | None, reading: str, runs: int) -> pd.DataFrame:
    """run, fed, outage_m, first_m: RMSE over the outage and over its first `FIRST_S` seconds."""
    import pandas as pd

    from testbed import pipeline
    from testbed.scenario import load_scenario

    scenario, seen = (
        load_scenario(SCENARIO, variant=variant, reading=reading, overrides=overrides)
        for overrides in ({}, {"sensors.gnss.outages": []})
    )
    trajectory = pipeline.fly(scenario)
    rows = []
    for run in range(runs):
        log, full = (pipeline.sense(part, trajectory, run=run)[0] for part in (scenario, seen))
        assert log.gnss is not None
        ((start, end),) = log.gnss.outages
        for fed, solution in answers(log, full).items():
            errors = [rmse(trajectory, solution, start, until) for until in (end, start + FIRST_S)]
            rows.append((run, fed, *errors))
    return pd.DataFrame(rows, columns=["run", "fed", "outage_m", "first_m"])


def answers(log: SensorLog, full: SensorLog) -> dict[str, NavSolution]:
    """What the 9-state filter answers when it is fed with this or that; ``full`` is the log with the hidden fixes in it.

    All rows, velocity and position, but where the name says that it is the positions.
    """
    from estimators.learning.kfann import TARGETS, Ann, Kfann, network_outputs, outages_of, train_networks
    from estimators.methods.lkf9 import Lkf9, fixes_of, free_ins, gnss_measurements

    settings, ins = Kfann(inputs="nn3"), free_ins(log)
    real, every = (gnss_measurements(ins, fixes_of(part, "fed")) for part in (log, full))
    ((start, end, times),) = outages_of(fixes_of(log, "fed"), ins)
    hidden = every.value[(every.t > start + 1e-6) & (every.t < end - 1e-6)]
    step = float(np.median(np.diff(every.t)))

    def networks(known: Measurements, until: float) -> Array:
        trained = train_networks(settings, ins, known, known.t < until + 1e-6, TARGETS)
        return network_outputs(settings, ins, trained, times, step)

    def feed(value: Array, std: Array, first: int = 0) -> NavSolution:
        return fed_with(settings, log, ins, real, times, value, std, first)

    receivers = real.std[real.t < start + 1e-6][-1]
    learnt, shown = networks(real, start), networks(every, end)
    errors = np.sqrt(np.mean((learnt - hidden) ** 2, axis=0))
    line = straight_line(real, start, times)
    return {
        NETWORKS: feed(learnt, receivers),
        TRUE_R: feed(learnt, errors),
        "networks, positions": feed(learnt, receivers, 3),
        "networks, positions, R their true error": feed(learnt, errors, 3),
        "straight line": feed(line, receivers),
        "straight line, positions": feed(line, receivers, 3),
        "networks shown the outage": feed(shown, receivers),
        "networks shown the outage, positions": feed(shown, receivers, 3),
        "hidden fixes": feed(hidden, receivers),
        "hidden positions": feed(hidden, receivers, 3),
        COASTING: Lkf9().run(log),
        UPDATE: Lkf9(restart=True).run(log),
        ANN: Ann(inputs="nn3").run(log),
        "no outage": Lkf9().run(full),
    }


def fed_with(
    settings: Any, log: SensorLog, ins: Any, real: Measurements, times: Array, value: Array, std: Array, first: int
) -> NavSolution:
    """The filter fed with the log's fixes, and with ``value`` (M,6), ``std`` (6,), from row ``first`` on, at ``times`` (M,)."""
    from estimators.learning.kfann import in_order
    from estimators.methods.lkf9 import Measurements, run_filter

    made_up = Measurements(times, value, np.tile(std, (len(times), 1)), np.full(len(times), first))
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
    """trajectory, reading, fed, runs, mean_m with its 95 % interval, median_m, and the mean over the outage's first seconds."""
    import pandas as pd

    from testbed.scoring.statistics import describe

    out = []
    for (trajectory, reading, fed), part in rows.groupby(["trajectory", "reading", "fed"], sort=False):
        figures = {key: column[0] for key, column in describe(part[["outage_m"]].to_numpy()).items()}
        out.append(
            {
                "trajectory": trajectory,
                "reading": reading,
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


def verdicts(rows: pd.DataFrame) -> pd.DataFrame:
    """Claims of every trajectory with R set to the networks' true errors, under both readings of the IMU, as `verdict_rows` has them."""
    import pandas as pd
    from study_verdicts import verdict_rows

    from testbed.scoring.claims import ClaimConfig, ReadingConfig

    parts = []
    for variant, (than_ann, than_update) in STATED.items():
        named = trajectory_of(variant)
        own = rows[rows["trajectory"] == named]
        stated = ((ANN, than_ann), (UPDATE, than_update), (COASTING, None))
        claims = [
            ClaimConfig(
                id=f"true-R-{named[-1]}-{k}",
                better=TRUE_R,
                than=than,
                metric="rmse_position_3d_m",
                window="outages",
                paper_improvement_pct=percent,
                origin="own",  # no filter can have this R
                text=f"{named.capitalize()}: KFANN NN3 with R of its networks' true errors, against {than}",
            )
            for k, (than, percent) in enumerate(stated, 1)
        ]
        readings = [
            ReadingConfig(name=reading, leaves_open="R in the outage.", conditions={"IMU": reading})
            for reading in own["reading"].unique()
        ]
        tables = {
            reading.name: own[own["reading"] == reading.name].pivot(index="run", columns="fed", values="outage_m")
            for reading in readings
        }
        parts.append(verdict_rows(claims, readings, tables))
    return pd.concat(parts, ignore_index=True)
