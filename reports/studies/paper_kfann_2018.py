"""KFANN 2018: what its report is made of."""

from __future__ import annotations

import kfann_fed
import kfann_innovations
import kfann_maps
from jobs import Paper, Setting, readings, runs, study

PAPER = Paper(
    name="kfann-2018",
    title="KFANN 2018: networks that keep a Kalman filter running through a GPS outage",
    jobs=(
        readings(
            "readings",
            minutes=7,
            first=30,
            cap=50,
            figures=("monte_carlo", "innovations_kfann-nn3"),
            of="as stated",
            title="Trajectory 1",
        ),
        readings("trajectory-2", minutes=2.5, first=30, cap=50, setting=Setting("trajectory-2"), title="Trajectory 2"),
        readings("trajectory-3", minutes=2.5, first=30, cap=50, setting=Setting("trajectory-3"), title="Trajectory 3"),
        study(
            "innovations",
            kfann_innovations.make_tables,
            minutes=2.5,
            tables=("verdicts-innovations.csv", "innovations.csv"),
            scenarios=(Setting(), Setting("trajectory-2"), Setting("trajectory-3")),
            inputs=[kfann_innovations.RUNS, list(kfann_innovations.BIASES_DPS.values()), kfann_innovations.MOST],
            title="Claim 3: innovations with GPS",
            note="Of innovations over √S before the outage; `objected`: share of runs in which a test at 5 % objects.",
        ),
        study(
            "fed",
            kfann_fed.make_table,
            minutes=3,
            tables=("fed.csv", "verdicts-fed.csv"),
            scenarios=(Setting(), Setting("trajectory-2"), Setting("trajectory-3")),
            inputs=[kfann_fed.RUNS, list(kfann_fed.CASES)],
            title="What else could feed the filter",
            note="Position RMSE over the outage, m, paired runs; the 95 % interval is that of the mean.",
        ),
        study(
            "network-output",
            kfann_maps.make_network_output,
            minutes=0.5,
            tables=("network-output.csv",),
            figures=("network-output", "network-output-matched"),
            scenarios=(Setting(),),
            title="What the networks put out in the outage",
            note="Run 0, networks NN3: position error of the INS and what they say it is, m.",
        ),
        study(
            "map",
            kfann_maps.make_maps,
            minutes=2,
            tables=("outage-map.csv",),
            figures=("outage-map",),
            scenarios=(Setting("long-outage"),),
            inputs=[kfann_maps.RUNS, list(kfann_maps.BIASES_DPS)],
            title="Outage length against gyro bias",
            note="Position RMSE over the outage, m; means over the runs that all four finished.",
        ),
        runs(
            "regressors",
            minutes=1,
            runs=30,
            setting=Setting("regressors"),
            metrics=("rmse_position_3d_m",),
            windows=("outages",),
            claims=False,
            title="Other regressors than the network",
        ),
    ),
)
