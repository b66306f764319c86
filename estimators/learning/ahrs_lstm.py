"""`ahrs-lstm`: `ahrs-kf` with a gain that an LSTM network corrects.

"AHRS with LSTM-corrected Kalman gain" (2022): 90 inputs (z 6, x 12, K 72), a linear layer, two LSTM layers of 200, a
linear layer to the 72 elements of the gain. Here the last layer gives the logarithm of what each element is multiplied
by, and starts at zero: the untrained network is `ahrs-kf` itself. Training: `estimators.learning.ahrs_imitation` and
`estimators.learning.ahrs_end_to_end`; loop: `estimators.learning.ahrs_lstm_kernels`.

Read into the paper: its "activation" is that of the linear input layer (``sigmoid`` or ``linear``), the LSTM layers are
ordinary ones. Departures: the network steps at 5 Hz, not at each sample of 50 Hz, and its inputs are compressed (asinh).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from estimators.learning.ahrs_weights import load_weights, solve_with
from testbed.data.records import NavSolution, SensorLog


@dataclass(frozen=True)
class AhrsLstm:
    """`ahrs-kf` with a learned correction of its gain. The filter's parameters are those that the weights were made for."""

    weights: str = ""
    """A safetensors file; empty for the shipped one, ``end-to-end`` for the shipped one that learned from the attitude error
    on a KF that errs as the paper's does, ``untrained`` for a network that changes nothing."""
    name: ClassVar[str] = "ahrs-lstm"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "mag")
    needed_to_train: ClassVar[Mapping[str, str]] = {"torch": "learn"}
    """Packages that training needs and running does not, and the extra of each."""

    def prepare(self, scenario: Any) -> None:
        """Read the weights before a batch begins. Raises InputError when they are missing, damaged or something else."""
        load_weights(self.weights)

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError without magnetometer or weights."""
        return solve_with(load_weights(self.weights), log)

    @staticmethod
    def train(*arguments: Any, **settings: Any) -> Path:
        """Train on flights with truth: see `estimators.learning.ahrs_training.train`."""
        from estimators.learning.ahrs_methods import train

        return train(*arguments, **settings)
