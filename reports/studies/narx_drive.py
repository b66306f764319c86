"""NARX-UKF 2021 on a real car: fixes of a recorded drive withheld, and what filters and networks make of the windows.

The thesis's drive in Turin is not public. The drive of rtklibexplorer/GNSS_IMU (9 minutes, RTK at 4 Hz) takes its place, from the
folder that the environment variable `PLACE` names; where it is not set the table stays as it is. Networks learn on line alone:
there is no second drive. One recording is one run: there is no interval, and no claim is tested. Written: ``drive.csv``.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from jobs import Place

PLACE = "NARX_DRIVE"
HOLDOUT = {"every_s": 60.0, "first_s": 140.0, "length_s": 15.0}
"""15 s as its authors have it; between two windows the filters settle for 20 s and the networks learn for 15 s, once or twice."""
LESSONS = {
    **{"filter": "ekf", "longest_outage_s": 15.0, "settle_s": 60.0, "step_s": 0.25, "online_windows": 3},
    **{"output_lags": 1, "input_lags": 1},
}
"""Windows of an outage's length; three of them are what two gaps hold. At the receiver's 4 Hz, as 15 samples a window choose no
inputs; one lag, as the Lipschitz curves of the UAV have it."""


def make_table(place: Place) -> None:
    """RMS of the horizontal error at the end of the windows, m, by filter."""

    from jobs import Kept, write_csv

    folder = os.environ.get(PLACE)
    if folder is None:
        raise Kept(f"{PLACE} does not name the recording's folder")
    write_csv(place.target / "drive.csv", drive_table(Path(folder)))


def drive_table(folder: Path) -> pd.DataFrame:
    """filter, windows, RMS and largest horizontal error (m) at their end."""
    import drive
    import pandas as pd

    from testbed import pipeline
    from testbed.data.registry import make_estimator
    from testbed.scenario import load_scenario

    rows = []
    with tempfile.TemporaryDirectory() as work:
        overrides = {f"recording.holdout.{key}": value for key, value in HOLDOUT.items()}
        scenario = load_scenario(drive.prepared(folder, Path(work)), overrides=overrides)
        truth = pipeline.fly(scenario)
        log, _ = pipeline.sense(scenario, truth)
        for label, (name, params) in filters().items():
            solution = make_estimator(name, **params).run(log)
            scores = pipeline.score(scenario, truth, solution, log)
            ends = scores[(scores["metric"] == "final_position_2d_m") & scores["window"].str.match(r"outage_\d+$")][
                "value"
            ]
            rows.append((label, len(ends), float(np.sqrt(np.mean(ends**2))), float(ends.max())))
    return pd.DataFrame(rows, columns=["filter", "windows", "rms_end_m", "largest_m"])


def filters() -> dict[str, tuple[str, dict[str, object]]]:
    """Rows of the table: name and parameters of the estimator."""
    own = {"inputs": "since-reset", "neurons": 6, "decay": 1e-2}
    rows: dict[str, tuple[str, dict[str, object]]] = {"EKF": ("direct-ekf", {}), "UKF": ("direct-ukf", {})}
    for name in ("nnckf", "nnakf"):
        rows[name.upper()] = name, dict(LESSONS)
        rows[f"{name.upper()} since re-set"] = name, LESSONS | own
    return rows
