"""IMM-RSTEKF 2023: the claims under every reading, what the fading factor's trace and ceiling do, other flights, the modes."""

import imm_modes
from jobs import Paper, Setting, readings, runs, study

METRICS = (
    *("rmse_position_2d_m", "rmse_velocity_3d_mps", "rmse_gnss_position_2d_m", "rmse_gnss_velocity_3d_mps"),
    *("rmse_attitude_deg", "diverged"),
)
"""Of the ablation."""
ABLATION_RUNS = 60
"""The effects of trace and ceiling are tens of per cent, and a mean's interval over 60 runs some per cent."""
CORRELATED = {
    "sensors.gnss.horizontal_sigma_m": 0.3,
    "sensors.gnss.vertical_sigma_m": 0.5,
    "sensors.gnss.horizontal_markov_sigma_m": 3.0,
    "sensors.gnss.vertical_markov_sigma_m": 5.0,
    "sensors.gnss.markov_time_s": 20.0,
}
VARIED = {"monte_carlo.vary": ["noise", "turn_on", "alignment", "outages", "manoeuvres"]}
COMPARED = ("KF", "UKF", "IMM-EKF", "IMM-RSTEKF")


def fading(name: str, gnss: dict[str, float], error: str):
    """Trace and ceiling, one thing changed per row."""
    return runs(
        *(name, 1.5, ABLATION_RUNS),
        setting=Setting("fading", gnss),
        metrics=METRICS,
        claims=False,
        title=f"Trace and ceiling of the fading factor, GPS error {error}",
        note=f"One thing changed per row, {ABLATION_RUNS} runs. A ceiling is a multiple of 10 km, 1 km/s, 180°, 10 m/s² and 1 rad/s.",
    )


PAPER = Paper(
    name="imm-rstekf-2023",
    title="IMM-RSTEKF 2023: direct filtering with three interacting motion models",
    source="Amirkabir J. Mech. Eng. 54(12), 2023, doi 10.22060/mej.2023.21380.7441",
    jobs=(
        readings(
            *("readings", 14.0),
            figures=("monte_carlo",),
            of="correlated, scale factor",
            title="Under every reading",
            note="From 30 runs on, until every interval is narrower than 5 points, 200 at most. The figure is of the reading *correlated, scale factor*.",
        ),
        fading("fading", {}, "white"),
        fading("fading-correlated", CORRELATED, "correlated"),
        runs(
            *("flights", 2.5, ABLATION_RUNS),
            setting=Setting(overrides=VARIED | CORRELATED, estimators=COMPARED),
            title="Another flight in every run",
            note="Path, bank, climb and speed drawn anew in every run; GPS error correlated, no scale-factor error.",
        ),
        study(
            *("modes", imm_modes.make, 1.0, ("modes.csv",), ("modes",)),
            scenarios=(Setting(),),
            inputs=imm_modes.RUNS,
            title="Probability of the motion models",
            note=imm_modes.NOTE,
        ),
    ),
)
