"""The gain network of the league: what its page is made of."""

from __future__ import annotations

import gain_network
from jobs import Job, Paper

PAPER = Paper(
    name="gain-network",
    title="A learned gain beside the tuned classical filter",
    source="In the manner of Revach et al., KalmanNet: Neural Network Aided Kalman Filtering for Partially Known Dynamics, IEEE Trans. Signal Processing 70, 2022",
    jobs=(
        Job(
            *("tuned", 20.0, gain_network.make_tuned, (gain_network.TUNED,)),
            title="The classical filter, tuned",
            note="`eskf` with position and velocity apart: factors on the sigmas of the fixes and on the roots of Q, and the chi-square "
            "threshold of the gate of each, by Nelder and Mead on the training lessons; loss as below.",
            long=True,
            inputs=lambda _paper: gain_network.learned_from(),
        ),
        Job(
            *("trainings", 90.0, gain_network.make_trainings, (gain_network.TRAININGS,)),
            title="Five trainings",
            note="Loss on the validation flights: mean negative log likelihood (nats, less a constant) of the true errors of position, "
            "velocity and attitude before each fix. epoch: the one that is kept. failed: 1 where the loss was no number, or is above "
            "that of `indirect-kf`.",
            long=True,
            inputs=lambda _paper: gain_network.learned_from(),
        ),
        Job(
            *("held-back", 20.0, gain_network.make_held_back, (gain_network.TESTED, gain_network.KINDS)),
            title="Flights that were held back",
            note="rmse_m: geometric mean over the flights of the RMS position error (3D, m) of the whole flight; of_indirect_kf, of_tuned: its ratio to "
            "those filters, paired by flight; low, high: 95 % (bootstrap over the flights). nees: of the position, over its three degrees of "
            "freedom, settled; 1 is honest, above it is over-confident.",
            long=True,
            inputs=lambda _paper: gain_network.tested_on(),
        ),
    ),
)
