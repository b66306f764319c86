"""AHRS-LSTM 2022: what its page is made of."""

from __future__ import annotations

import ahrs_end_to_end as end_to_end
import ahrs_filters
import ahrs_studies
from jobs import Job, Paper, Setting, runs, study

METRICS = ("rmse_roll_deg", "rmse_pitch_deg", "nees_attitude")
TRAININGS = [end_to_end.SEEDS, end_to_end.NOISE_SEEDS, end_to_end.REST_SEEDS, end_to_end.ELSEWHERE_SEEDS]

PAPER = Paper(
    name="ahrs-lstm-2022",
    title="AHRS-LSTM 2022: a learned Kalman gain for attitude without GPS",
    source="AHRS with LSTM-corrected Kalman gain (2022)",
    jobs=(
        study(
            *("end-to-end", end_to_end.make, 60.0, (*end_to_end.TABLES, "verdicts-end-to-end.csv"), ("training-path",)),
            scenarios=(Setting("end-to-end"), Setting("speed")),
            inputs=TRAININGS,
            linked=tuple(f"end-to-end-{name}.csv" for name in ("learning-curve", "gradients")),
            title="End to end, on a filter that errs as the paper's does",
            note="RMSE in degrees, MSE in square degrees; per cent below the paper's KF with 95 % intervals over training seeds and noise seeds.",
            long=True,
        ),
        study(
            *("structures", end_to_end.make_structures, 60.0),
            tables=("end-to-end-structures.csv", "verdicts-structures.csv"),
            scenarios=(Setting("end-to-end"),),
            title="The paper's 54 structures",
            note="Each trained once; main effects on the logarithm of the mean square, errors from the residuals of all.",
            long=True,
        ),
        runs(
            *("flight", 5.0, 10),
            metrics=METRICS,
            title="The network that imitates the adaptive KF",
            note="Its claims are the paper's, against a KF whose constants are tuned.",
        ),
        study(
            *("phases", ahrs_studies.phases, 2.0, ("phases.csv",), ("phases",)),
            scenarios=(Setting(),),
            title="Cruise and loiter of one run",
        ),
        Job(
            *("learning-curve", 1.0, ahrs_studies.learning_curve, ("learning-curve.csv",), ("learning-curve",)),
            inputs=ahrs_studies.learned,
            linked=("learning-curve.csv",),
            title="Learning curve of the shipped weights",
        ),
        study(
            *("allan", ahrs_studies.allan, 3.0, ("allan.csv",), ("allan",)),
            scenarios=(Setting(),),
            inputs=[ahrs_studies.ALLAN_S, ahrs_studies.ALLAN_SEED, ahrs_studies.SETTLED_S],
            title="Noise of the attitude's rate at rest",
            note="In degrees per hour and per root hour; three hours at rest, one run.",
        ),
        runs(
            *("speed", 5.0, 10),
            setting=Setting("speed"),
            metrics=METRICS,
            claims=False,
            title="Filters without a network, with a speed",
        ),
        study(
            *("generalisation", ahrs_studies.generalisation, 30.0, ("generalisation.csv",)),
            scenarios=tuple(Setting(variant) for variant in ahrs_studies.VARIANTS),
            inputs=ahrs_studies.VARIANT_RUNS,
            title="The imitating network where it was not trained",
            note="RMSE in degrees; per cent below the KF there, 95 % interval over the runs.",
            long=True,
        ),
        study(
            *("nine-hours", ahrs_studies.nine_hours, 40.0, ("nine-hours.csv",)),
            title="Nine hours, one run",
            long=True,
        ),
        runs(
            *("peers", 20.0, 2),
            setting=Setting("peers"),
            metrics=METRICS,
            claims=False,
            title="Filters of other people, with their gains and with tuned ones",
            long=True,
        ),
        *(
            study(f"filters-{name}", function, minutes, (f"filters-{name}.csv",), title=title, long=True)
            for name, function, minutes, title in (
                ("kf", ahrs_filters.kf, 60.0, "Search for the constants of the row KF"),
                ("adaptive", ahrs_filters.adaptive, 30.0, "Grid of the row adaptive KF"),
                ("peers", ahrs_filters.peers, 60.0, "Grids of the peers' gains"),
            )
        ),
    ),
)
