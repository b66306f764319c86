"""NARX-UKF 2021: what its report is made of."""

from __future__ import annotations

import narx_drive
import narx_filters
import narx_inputs
import narx_lessons
from jobs import Paper, Setting, readings, runs, study

RUNS = 8
"""Half a minute each, and eight or nine outages in each of them; one run in each lane of the filters that go side by side."""

PAPER = Paper(
    name="narx-ukf-2021",
    title="NARX-UKF 2021: networks that carry EKF and UKF through GNSS outages",
    jobs=(
        readings("readings", minutes=14, runs=RUNS, title="The UAV"),
        runs(
            "per-outage",
            minutes=1,
            runs=RUNS,
            setting=Setting("per-outage"),
            claims=False,
            title="The UAV, outage by outage, gyro noise x 300",
        ),
        readings("car", minutes=4, runs=RUNS, setting=Setting(scenario="narx-car-2021"), title="The car, simulated"),
        study(
            "filters",
            narx_filters.make_tables,
            minutes=3,
            tables=("verdicts-filters.csv", "growth.csv", "biases.csv", "bands.csv"),
            figures=("bias-convergence", "bands-with-gnss"),
            scenarios=(Setting(), Setting("no-scale-factor")),
            inputs=[narx_filters.RUNS, list(narx_filters.CASES)],
            title="Biases, ±3σ and what grows in an outage",
            note="growth: RMS position error (m) at the end of an outage, from the truth with one group of errors put in. "
            "biases: mm/s² and µrad/s at 249 s. bands: share of the time outside of ±3σ, %.",
        ),
        study(
            "lessons",
            narx_lessons.make_table,
            minutes=3,
            tables=("lessons.md",),
            scenarios=(Setting(),),
            inputs=[narx_lessons.DRAWS, narx_lessons.SCORED, list(narx_lessons.READINGS)],
            title="What there is to learn in a window without GNSS",
        ),
        study(
            "inputs",
            narx_inputs.make_tables,
            minutes=1,
            tables=("selection.csv", "ranking.csv", "lags.csv"),
            figures=("lags",),
            scenarios=(Setting(),),
            inputs=[list(narx_inputs.READINGS), list(narx_inputs.ROWS)],
            linked=("ranking.csv", "lags.csv"),
            title="Inputs and lags that the thesis's method selects",
            note="The four inputs of each network with their scores J (nats), the best of those left out, and its lags; on the windows"
            " of the training flight that the networks learn from. Figure: NNCKF, Q of the data sheet.",
        ),
        study(
            "drive",
            narx_drive.make_table,
            minutes=0.5,
            tables=("drive.csv",),
            inputs=[narx_drive.HOLDOUT, narx_drive.LESSONS],
            title="A real car with withheld fixes",
            note="One recording is one run: no interval, no claim is tested. Horizontal error at the end of windows of 15 s.",
        ),
    ),
)
