"""KFANN 2018, claim 3: innovations are zero-mean, Gaussian and inside ±2 sqrt(S) while GPS is there. Over runs, not by eye.

The paper shows one run of north velocity and longitude. So each run is tested as one could test that figure, at 5 %: the mean by
Student's t, the histogram by D'Agostino and Pearson, the share within ±2 sqrt(S) by its binomial deviation. Under the claim 5 %
of the runs object. It holds where fewer than 10 % do, twice the tests' own, and fails where more do; both as an exact one-sided
binomial test over the runs, corrected for the claims of a reading (Holm). Innovations of `lkf9` over sqrt(S), fixes before the
outage. Written: ``verdicts-innovations.csv``, and ``innovations.csv`` with all six channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from jobs import Place

    from testbed.data.records import Array

SCENARIO = "kfann-2018"
BIASES_DPS = {"white noise": 0.0, "gyro bias 0.2 deg/s": 0.2, "gyro bias 0.55 deg/s": 0.55}
TRAJECTORIES = (None, "trajectory-2", "trajectory-3")
RUNS = 300
"""Where 5 % of them object, the share is found below `MOST` with a chance of 75 % by the strictest of six tests, of 95 % by the last."""
CHANNELS = ("north", "east", "down", "v_north", "v_east", "v_down")
CLAIMED = {"v_north": "north velocity", "east": "longitude"}
"""Channels that the paper shows."""
TESTS = {"mean": "zero-mean", "normal": "Gaussian", "inside": "95.4 % of them inside ±2√S"}
MOST = 0.10
INSIDE = 0.9545
"""Share of a normal distribution within two sigma."""
NORMAL_975 = 1.96


def make_tables(place: Place) -> None:
    """Run every trajectory under every bias and write both tables."""
    import pandas as pd
    from jobs import TRIAL_RUNS, write_csv

    runs = TRIAL_RUNS if place.trial else RUNS
    place.work.mkdir(parents=True, exist_ok=True)
    parts = []
    for imu, bias in BIASES_DPS.items():
        for variant in TRAJECTORIES:
            named = (variant or "trajectory-1").replace("-", " ")
            stored = place.work / f"{named}-{bias:g}-{runs}.csv".replace(" ", "-")
            if not (place.resume and stored.is_file()):
                print(f"innovations: {named}, {imu}")
                run_case(variant, bias, runs).to_csv(stored, index=False, lineterminator="\n")
            parts.append(pd.read_csv(stored).assign(trajectory=named, imu=imu))
    rows = pd.concat(parts, ignore_index=True)
    write_csv(place.target / "innovations.csv", summarise(rows))
    write_csv(place.target / "verdicts-innovations.csv", verdicts(rows))


def run_case(variant: str | None, bias_dps: float, runs: int) -> pd.DataFrame:
    """run, channel and the figures of `figures_of`, of so many runs."""
    import pandas as pd

    from estimators.methods.lkf9 import Lkf9
    from testbed import pipeline
    from testbed.scenario import load_scenario

    overrides = {"sensors.imu.gyro_turn_on_bias_dps": bias_dps} if bias_dps else {}
    scenario = load_scenario(SCENARIO, variant=variant, overrides=overrides)
    trajectory = pipeline.fly(scenario)
    rows = []
    for run in range(runs):
        log, _ = pipeline.sense(scenario, trajectory, run=run)
        assert log.gnss is not None
        found = Lkf9().run(log).innovations["gnss"]
        before = found.t < log.gnss.outages[0][0]
        sigma = np.sqrt(np.diagonal(found.covariance[before], axis1=1, axis2=2))
        for channel, scaled in zip(CHANNELS, (found.value[before] / sigma).T, strict=True):
            rows.append({"run": run, "channel": channel} | figures_of(scaled))
    return pd.DataFrame(rows)


def figures_of(scaled: Array) -> dict[str, float]:
    """Of innovations over sqrt(S) (n,): mean, standard deviation, kurtosis, share inside, and which of `TESTS` object at 5 %."""
    from testbed.scoring.statistics import normality_p

    n, mean, std = len(scaled), float(scaled.mean()), float(scaled.std(ddof=1))
    inside = float(np.mean(np.abs(scaled) <= 2.0))
    return {
        "bias": abs(mean),
        "std": std,
        "kurtosis": float(np.mean((scaled - mean) ** 4) / np.mean((scaled - mean) ** 2) ** 2),
        "share_inside": inside,
        "mean": float(abs(mean) > NORMAL_975 * std / np.sqrt(n)),  # n is hundreds: Student's t is normal to 0.3 %
        "normal": float(normality_p(scaled) < 0.05),
        "inside": float(abs(inside - INSIDE) > NORMAL_975 * np.sqrt(INSIDE * (1.0 - INSIDE) / n)),
    }


def summarise(rows: pd.DataFrame) -> pd.DataFrame:
    """Per trajectory, IMU and channel: runs, mean size of the runs' means, standard deviation, kurtosis, and shares in per cent."""
    groups = rows.groupby(["trajectory", "imu", "channel"], sort=False)
    table = groups.agg(
        runs=("run", "size"),
        mean_size=("bias", "mean"),
        std=("std", "mean"),
        kurtosis=("kurtosis", "mean"),
        inside_pct=("share_inside", "mean"),
        mean_objected_pct=("mean", "mean"),
        normal_objected_pct=("normal", "mean"),
        inside_objected_pct=("inside", "mean"),
    ).reset_index()
    shares = [name for name in table.columns if name.endswith("_pct")]
    table[shares] *= 100.0
    return table


def verdicts(rows: pd.DataFrame) -> pd.DataFrame:
    """A row per claim (test and channel) and reading (IMU and trajectory); the effect is the share of runs that object, per cent."""
    import pandas as pd

    from testbed.scoring.claims import ReadingConfig
    from testbed.scoring.readings import standing

    readings, parts = [], []
    for (imu, trajectory), own in rows.groupby(["imu", "trajectory"], sort=False):
        readings.append(
            ReadingConfig(
                name=f"{trajectory}, {imu}".replace("/", " per "),
                leaves_open="The errors of the IMU beyond white noise.",
                conditions={"IMU": str(imu), "trajectory": str(trajectory)[-1]},
            )
        )
        claims = [(test, channel) for channel in CLAIMED for test in TESTS]
        counts = [int(own.loc[own["channel"] == channel, test].sum()) for test, channel in claims]
        runs = int((own["channel"] == CHANNELS[0]).sum())
        for (test, channel), judged in zip(claims, judge(counts, runs), strict=True):
            told = {
                "claim": f"3-{test}-{channel}",
                "text": f"Innovations of {CLAIMED[channel]} with GPS are {TESTS[test]}: share of runs in which a test at 5 % objects",
                "reading": readings[-1].name,
            }
            parts.append(told | judged)
    table = pd.DataFrame(parts).assign(origin="paper", stated_pct=100.0 * 0.05, margin_pct=100.0 * MOST)
    for claim, own in table.groupby("claim"):
        found = dict(zip(own["reading"], own["verdict"], strict=True))
        table.loc[table["claim"] == claim, "class"] = standing(readings, found).word
    return table.sort_values("claim", kind="stable", ignore_index=True)


def judge(counts: Sequence[int], runs: int) -> list[dict[str, Any]]:
    """Of the runs that object to each claim of a reading: share, exact 95 % interval (Clopper and Pearson 1934), verdict."""
    from scipy.special import bdtr, bdtrc, betaincinv

    from testbed.scoring.statistics import holm
    from testbed.scoring.verdicts import ALPHA, NOT_REPRODUCED, REPRODUCED, UNDECIDED

    few = holm(np.array([float(bdtr(k, runs, MOST)) for k in counts]))
    many = holm(np.array([float(bdtrc(k - 1, runs, MOST)) if k else 1.0 for k in counts]))
    out = []
    for k, below, above in zip(counts, few, many, strict=True):
        low = float(betaincinv(k, runs - k + 1, 0.025)) if k else 0.0
        high = float(betaincinv(k + 1, runs - k, 0.975)) if k < runs else 1.0
        word = REPRODUCED if below < ALPHA else NOT_REPRODUCED if above < ALPHA else UNDECIDED
        figures = {"effect_pct": 100.0 * k / runs, "ci_low": 100.0 * low, "ci_high": 100.0 * high}
        out.append(figures | {"runs": runs, "verdict": word, "p_holm": float(min(below, above))})
    return out
