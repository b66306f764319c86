"""IMM-RSTEKF 2023: the claims under every reading, what the fading factor's trace and ceiling do, other flights, the modes."""

import imm_modes
from jobs import Paper, Setting, readings, runs, study

METRICS = (
    *("rmse_position_2d_m", "rmse_velocity_3d_mps", "rmse_gnss_position_2d_m", "rmse_gnss_velocity_3d_mps"),
    *("rmse_attitude_deg", "diverged"),
)
"""Of the ablation."""

PAPER = Paper(
    name="imm-rstekf-2023",
    title="IMM-RSTEKF 2023: direct filtering with three interacting motion models",
    source="Amirkabir J. Mech. Eng. 54(12), 2023, doi 10.22060/mej.2023.21380.7441",
    jobs=(
        readings(
            "readings", 40.0, title="Under every reading", figures=("monte_carlo",), of="correlated, scale factor"
        ),
        runs(
            *("fading", 8.0, 60),
            setting=Setting("fading"),
            metrics=METRICS,
            claims=False,
            title="Trace and ceiling of the fading factor",
            note="One thing changed per row. GPS error correlated, scale factors of 1 and 1.5 %; 60 runs: the effects are larger than a tenth.",
        ),
        study(
            *("modes", imm_modes.make, 5.0, ("modes.csv",), ("modes",)),
            scenarios=(Setting(),),
            inputs=imm_modes.RUNS,
            title="Probability of the motion models",
            note=imm_modes.NOTE,
        ),
    ),
)
