"""Training of `ahrs-lstm`: settings, the loop over epochs, checkpoints and what is kept.

Two methods teach the network: `ahrs_imitation`, which imitates a teacher's gain, and `ahrs_end_to_end`, which lowers the
attitude error itself through the unrolled filter. SI units, µT. Flights are objects like `testbed.training.dataset.Shard`.
"""

from __future__ import annotations

import csv
import json
import os
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from estimators.learning.ahrs_lstm_kernels import INPUTS, LIMIT
from estimators.learning.ahrs_torch import GainNetwork, device_of
from estimators.learning.ahrs_weights import ACTIVATIONS, STEP_S, Weights, assemble, solve_with
from estimators.learning.networks.tensor_file import read_arrays, write_arrays
from estimators.methods.ahrs_kf import AhrsKf
from testbed.base.errors import InputError
from testbed.base.files import from_json

DEGREES = 180.0 / np.pi
METHODS = ("imitation", "end-to-end")


@dataclass(frozen=True)
class Settings:
    """``[extra.train]`` of the scenario. The paper has SGD, rate 0.1, 100 epochs, batch 50; see ``optimiser``."""

    method: str = "imitation"
    """``imitation`` (`ahrs_imitation`) or ``end-to-end`` (`ahrs_end_to_end`)."""
    layers: int = 2
    neurons: int = 200
    activation: str = "sigmoid"
    epochs: int = 18
    rounds: int = 6
    """Imitation: the epochs are divided among so many; each begins with flights by the network as it is."""
    batch: int = 20
    window_s: float = 1200.0
    chunk_s: float = 30.0
    """Time through which the gradient runs back."""
    step_s: float = STEP_S
    optimiser: str = "adam"
    """``adam`` or ``sgd`` (the paper's)."""
    learning_rate: float = 2e-3
    final_rate: float = 0.05
    """The rate falls to this part of itself over the training, along a cosine."""
    block_weight: float = 0.1
    """Imitation: of the gain's own distance from the teacher's, beside that of its corrections; see `ahrs_torch.distance`."""
    gradient_limit: float = 1.0
    largest_factor: float = float(np.exp(LIMIT))
    """On an element of the gain. Above 2 the filter can be unstable: a scalar one has K h up to 1, and needs |1 - K h| < 1."""
    teacher: dict[str, float] = field(default_factory=dict)
    """Imitation: parameters of `ahrs-kf` in which the teacher differs from the filter; ``turn_speed_mps`` makes it adapt."""
    told_factor: float = 0.0
    """Imitation: above 0 the teacher is told the true linear acceleration; see `ahrs_lessons.Teacher`."""
    reference_noise_deg: float = 0.0
    """1 sigma of a constant error of the reference attitude per flight, per axis (the paper's reference: 0.5)."""
    seed: int = 0
    threads: int = 1
    """Of torch; 0: all cores. With 1 on a CPU training ends in the very same weights, resumed or not."""
    device: str = "auto"
    """``auto`` (a GPU where torch finds one, else the CPU), ``cpu``, or another name that torch knows. What a GPU learns
    differs from what a CPU does by the order of its sums."""

    def __post_init__(self) -> None:
        for key in ("layers", "neurons", "epochs", "rounds", "batch"):
            if getattr(self, key) < 1:
                raise InputError(f"training: {key} is {getattr(self, key)}, must be at least 1")
        if not 1.0 <= self.largest_factor <= np.exp(LIMIT):
            raise InputError(
                f"training: largest_factor = {self.largest_factor!r}, must be within 1 to {np.exp(LIMIT):.0f}"
            )
        if self.method not in METHODS:
            raise InputError(f"training: method = {self.method!r}, must be one of {METHODS}")
        if self.activation not in ACTIVATIONS or self.optimiser not in ("adam", "sgd"):
            raise InputError(f"training: activation must be one of {ACTIVATIONS}, optimiser adam or sgd")
        if not (self.window_s >= self.chunk_s >= self.step_s > 0 and self.learning_rate > 0 < self.final_rate <= 1):
            raise InputError(
                "training: window_s >= chunk_s >= step_s > 0, learning_rate > 0, final_rate within (0, 1] are needed"
            )


class Training:
    """One training: data, network, optimiser, and the files in ``folder``. A method of learning says what an epoch is."""

    def __init__(self, settings: Settings, kf: AhrsKf, training: Any, validation: Any, folder: Path, tell: Any) -> None:
        self.settings, self.kf, self.folder, self.tell = settings, kf, folder, tell
        if settings.threads:
            torch.set_num_threads(settings.threads)
        self.device = device_of(settings.device)
        self.flights, self.validation = training, [(flight.log(), _truth(flight)) for flight in validation]
        torch.manual_seed(settings.seed)
        shape = (settings.layers, settings.neurons, settings.activation)
        norm, growth = (torch.zeros(INPUTS), torch.ones(INPUTS)), float(np.log(settings.largest_factor))
        self.network = GainNetwork(*shape, *norm, growth).to(self.device)
        kinds = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}
        self.optimiser = kinds[settings.optimiser](self.network.parameters(), lr=settings.learning_rate)
        self.chunk = max(1, round(settings.chunk_s / settings.step_s))
        self.window = max(1, round(settings.window_s / settings.chunk_s)) * self.chunk
        self.updates, self.best = 0, (np.inf, -1)
        self.curve: list[dict[str, float]] = []

    def run(self, resume: bool) -> Path:
        """All epochs that are still to do."""
        first = self._restore() if resume and self._checkpoint.exists() else self._begin()
        started = time.monotonic()
        for epoch in range(first, self.settings.epochs):
            learned = self.learn(epoch)
            valid = self._validate()
            self.curve.append({"epoch": epoch + 1, **learned, "validation_deg": valid, "updates": self.updates})
            self._keep_best(valid, epoch)
            self._save(epoch + 1)
            left = (time.monotonic() - started) / (epoch + 1 - first) * (self.settings.epochs - epoch - 1)
            self.tell(
                f"epoch {epoch + 1} of {self.settings.epochs}: loss {learned['train_loss']:.4f}, "
                f"validation {valid:.4f} deg, {left:.0f} s left"
            )
        return self._finish()

    def _finish(self) -> Path:
        """Give the kept weights the whole learning curve; returns their file."""
        path = self.folder / "ahrs-lstm.safetensors"
        arrays, metadata = _read(path, "a file of weights")
        _write(path, arrays, metadata | {"learning_curve": self.curve})
        self._write_curve()
        return path

    @property
    def _checkpoint(self) -> Path:
        return self.folder / "checkpoint.safetensors"

    def _begin(self) -> int:
        """The scales of the network come from flights by the filter itself."""
        self._checkpoint.unlink(missing_ok=True)  # else a call that resumes this one would go on with the one before
        found, first = self.prepare()
        self.network.centre.copy_(torch.as_tensor(found["centre"]))
        self.network.unit.copy_(torch.as_tensor(found["unit"]))
        error = self._validate()
        self._keep_best(error, -1)
        self.curve.append({"epoch": 0, **first, "validation_deg": error, "updates": 0})
        self.tell(f"before training (the KF itself): validation {error:.4f} deg")
        return 0

    def prepare(self) -> tuple[dict[str, NDArray[np.float32]], dict[str, float]]:
        """``centre`` and ``unit`` (90) of the inputs, and what the first row of the learning curve says beside the error."""
        raise NotImplementedError

    def learn(self, epoch: int) -> dict[str, float]:
        """One epoch; returns ``train_loss`` and whatever else the learning curve is to say."""
        raise NotImplementedError

    def kept(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Arrays and facts of the method that a checkpoint has to hold."""
        raise NotImplementedError

    def restore(self, done: int, arrays: dict[str, Any], state: dict[str, Any]) -> None:
        """Take them back after ``done`` epochs. Raises InputError where files that belong to them are not what they were."""
        raise NotImplementedError

    def step(self, loss: torch.Tensor) -> float:
        """One step of the optimiser, its gradient cut to ``gradient_limit``; returns the gradient's norm before that."""
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.gradient_limit)
        if bool(torch.isfinite(norm)):
            self.optimiser.step()
            self.updates += 1
        return float(norm)

    def set_rate(self, progress: float) -> None:
        """Of the optimiser, after ``progress`` epochs."""
        s = self.settings
        fall = 0.5 * (1.0 + np.cos(np.pi * min(1.0, progress / s.epochs)))
        warm = min(1.0, (self.updates + 1) / 50.0) if s.optimiser == "adam" else 1.0
        for group in self.optimiser.param_groups:
            group["lr"] = s.learning_rate * warm * (s.final_rate + (1.0 - s.final_rate) * fall)

    def _validate(self) -> float:
        """Roll and pitch RMSE (deg, both axes pooled) over the validation flights, with the compiled filter."""
        from testbed.physics.rotations import quats_to_eulers, wrap

        total, count, weights = 0.0, 0, self.weights()
        for log, truth in self.validation:
            error = wrap(quats_to_eulers(solve_with(weights, log).q_nb) - truth)[:, :2]
            total, count = total + float((error**2).sum()), count + error.size
        return float(np.sqrt(total / count) * DEGREES)

    def weights(self) -> Weights:
        """The network as it is."""
        return assemble(self._arrays(), self._metadata(-1, 0.0))

    def _arrays(self) -> dict[str, NDArray[np.float32]]:
        return {key: value.detach().cpu().contiguous().numpy() for key, value in self.network.state_dict().items()}

    def _metadata(self, epoch: int, error: float) -> dict[str, Any]:
        flights = [getattr(flight, "meta", {}).get("entry", {}).get("file", "") for flight in self.flights]
        return {
            "activation": self.settings.activation,
            "step_s": self.settings.step_s,
            "growth": self.network.growth,
            "filter": asdict(self.kf),
            "training": asdict(self.settings),
            "epoch": epoch + 1,
            "validation_deg": error,
            "flights": flights,
            "learning_curve": self.curve,
        }

    def _keep_best(self, error: float, epoch: int) -> None:
        if error < self.best[0]:
            self.best = (error, epoch)
            _write(self.folder / "ahrs-lstm.safetensors", self._arrays(), self._metadata(epoch, error))

    def _save(self, done: int) -> None:
        """Everything that the next epoch depends on, in one file that is replaced at once."""
        own, facts = self.kept()
        arrays = {f"network.{k}": v for k, v in self._arrays().items()} | own
        for i, entry in self.optimiser.state_dict()["state"].items():
            arrays |= {f"optimiser.{i}.{k}": np.asarray(v.cpu()) for k, v in entry.items() if torch.is_tensor(v)}
        arrays["random"] = torch.get_rng_state().numpy()
        state = {"done": done, "updates": self.updates, "best": list(self.best), "curve": self.curve, **facts}
        _write(self._checkpoint, arrays, state | {"settings": asdict(self.settings), "filter": asdict(self.kf)})
        self._write_curve()

    def _write_curve(self) -> None:
        path = self.folder / "learning-curve.csv"
        scratch = path.with_suffix(".tmp")
        with open(scratch, "w", newline="") as file:
            writer = csv.DictWriter(file, list(self.curve[0]))
            writer.writeheader()
            writer.writerows({k: f"{v:.6g}" for k, v in row.items()} for row in self.curve)
        os.replace(scratch, path)

    def _restore(self) -> int:
        arrays, state = _read(self._checkpoint, "a checkpoint of a training")
        if not {"settings", "filter", "curve"} <= state.keys():
            raise InputError(f"{self._checkpoint}: not a checkpoint of this version; train without --resume")
        if state["settings"] != asdict(self.settings) or state["filter"] != asdict(self.kf):
            raise InputError(
                f"{self._checkpoint}: was made with other settings; train without --resume, or in another folder"
            )
        self.network.load_state_dict({k[8:]: torch.as_tensor(v) for k, v in arrays.items() if k.startswith("network.")})
        entries: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in arrays.items():
            if key.startswith("optimiser."):
                _, index, name = key.split(".")
                entries.setdefault(int(index), {})[name] = torch.as_tensor(value)
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": entries})
        torch.set_rng_state(torch.as_tensor(arrays["random"]))
        self.updates, self.best, self.curve = state["updates"], tuple(state["best"]), state["curve"]
        done = int(state["done"])
        self.restore(done, arrays, state)
        self.tell(f"resumed after epoch {done} of {self.settings.epochs}")
        return done


def _truth(flight: Any) -> NDArray[np.float64]:
    from testbed.physics.rotations import quats_to_eulers

    return quats_to_eulers(flight.window(0, flight.rows)["q_nb"].astype(np.float64))


def _write(path: Path, arrays: dict[str, Any], metadata: dict[str, Any]) -> None:
    write_arrays(path, arrays, {key: json.dumps(value) for key, value in metadata.items()})


def _read(path: Path, what: str) -> tuple[dict[str, Any], dict[str, Any]]:
    arrays, texts = read_arrays(path, what)
    try:
        return arrays, {key: from_json(value) for key, value in texts.items()}
    except ValueError:
        raise InputError(f"{path}: not {what}") from None
