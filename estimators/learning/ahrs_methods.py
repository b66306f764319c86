"""Training of `ahrs-lstm`'s network by either method: imitation of a filter that adapts, or end to end on the attitude error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from estimators.learning.ahrs_end_to_end import EndToEnd
from estimators.learning.ahrs_imitation import Imitation
from estimators.learning.ahrs_training import Settings, Training
from estimators.methods.ahrs_kf import AhrsKf


def train(
    training: Sequence[Any],
    validation: Sequence[Any],
    out: str | Path,
    settings: dict[str, Any] | None = None,
    filter_params: dict[str, Any] | None = None,
    resume: bool = False,
    tell: Callable[[str], None] = print,
) -> Path:
    """Train; returns the file of the best weights. ``out`` gets ``ahrs-lstm.safetensors``, ``checkpoint.safetensors``
    after every epoch, and ``learning-curve.csv``. ``resume`` goes on from the checkpoint.
    """
    chosen, kf = Settings(**(settings or {})), AhrsKf(**(filter_params or {}))
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    method: type[Training] = Imitation if chosen.method == "imitation" else EndToEnd
    return method(chosen, kf, training, validation, folder, tell).run(resume)
