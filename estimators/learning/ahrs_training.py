"""Training of `ahrs-lstm`: it imitates a teacher whose gain it can tell from what it sees, on flights that it flies itself.

The teacher is a Kalman filter that adapts to the linear acceleration that it sees, or is told. In round 0 it flies; in
every later round the network does, and the teacher says at each step what its gain would be there (Ross, Gordon, Bagnell
2011, *DAgger*, without keeping earlier rounds). Back-propagation runs through sequences of the network, truncated to
``chunk_s``; windows keep their memory from chunk to chunk. Losses on the attitude error itself were tried first and did
not teach: that error is so persistent that its chance correlation with the accelerations drowns the gradient.

SI units, µT. Flights are objects like `testbed.training.dataset.Shard`.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from estimators.learning.ahrs_lessons import Lesson, Teacher, checksum_of, scales, write_lesson
from estimators.learning.ahrs_lstm_kernels import INPUTS
from estimators.learning.ahrs_torch import GainNetwork, Memory, distance
from estimators.learning.ahrs_weights import ACTIVATIONS, STEP_S, Weights, assemble, solve_with
from estimators.learning.networks.tensor_file import read_arrays, write_arrays
from estimators.methods.ahrs_kf import AhrsKf
from testbed.base.errors import InputError
from testbed.base.files import from_json

DEGREES = 180.0 / np.pi


@dataclass(frozen=True)
class Settings:
    """``[extra.train]`` of the scenario. The paper has SGD, rate 0.1, 100 epochs, batch 50; see ``optimiser``."""

    layers: int = 2
    neurons: int = 200
    activation: str = "sigmoid"
    epochs: int = 18
    rounds: int = 6
    """The epochs are divided among so many; each begins with flights by the network as it is."""
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
    """Of the gain's own distance from the teacher's, beside that of its corrections; see `ahrs_torch.distance`."""
    gradient_limit: float = 1.0
    teacher: dict[str, float] = field(default_factory=dict)
    """Parameters of `ahrs-kf` in which the teacher differs from the filter; ``turn_speed_mps`` makes it adapt."""
    told_factor: float = 0.0
    """Above 0 the teacher is told the true linear acceleration: see `ahrs_lessons.Teacher`."""
    reference_noise_deg: float = 0.0
    """1 sigma of a constant error of the reference attitude per flight, per axis (the paper's reference: 0.5)."""
    seed: int = 0
    threads: int = 1
    """Of torch; 0: all cores. With 1 on a CPU training ends in the very same weights, resumed or not."""
    device: str = "cpu"

    def __post_init__(self) -> None:
        for key in ("layers", "neurons", "epochs", "rounds", "batch"):
            if getattr(self, key) < 1:
                raise InputError(f"training: {key} is {getattr(self, key)}, must be at least 1")
        if self.activation not in ACTIVATIONS or self.optimiser not in ("adam", "sgd"):
            raise InputError(f"training: activation must be one of {ACTIVATIONS}, optimiser adam or sgd")
        if not (self.window_s >= self.chunk_s >= self.step_s > 0 and self.learning_rate > 0 < self.final_rate <= 1):
            raise InputError(
                "training: window_s >= chunk_s >= step_s > 0, learning_rate > 0, final_rate within (0, 1] are needed"
            )


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
    return _Training(chosen, kf, training, validation, folder, tell).run(resume)


class _Training:
    """One training: data, network, optimiser, and the files in ``folder``."""

    def __init__(self, settings: Settings, kf: AhrsKf, training: Any, validation: Any, folder: Path, tell: Any) -> None:
        self.settings, self.kf, self.folder, self.tell = settings, kf, folder, tell
        self.teacher = Teacher(AhrsKf(**(asdict(kf) | settings.teacher)), settings.told_factor)
        if settings.threads:
            torch.set_num_threads(settings.threads)
        self.device = torch.device(settings.device)
        self.flights, self.validation = training, [(flight.log(), _truth(flight)) for flight in validation]
        torch.manual_seed(settings.seed)
        shape = (settings.layers, settings.neurons, settings.activation)
        self.network = GainNetwork(*shape, torch.zeros(INPUTS), torch.ones(INPUTS)).to(self.device)
        self.correction = torch.ones(12, device=self.device)
        kinds = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}
        self.optimiser = kinds[settings.optimiser](self.network.parameters(), lr=settings.learning_rate)
        self.chunk = max(1, round(settings.chunk_s / settings.step_s))
        self.window = max(1, round(settings.window_s / settings.chunk_s)) * self.chunk
        self.lessons: list[Lesson] = []
        self.checksums: list[str] = []
        self.updates, self.best = 0, (np.inf, -1)
        self.curve: list[dict[str, float]] = []

    def run(self, resume: bool) -> Path:
        """All epochs that are still to do."""
        first = self._restore() if resume and self._checkpoint.exists() else self._begin()
        started = time.monotonic()
        for epoch in range(first, self.settings.epochs):
            if not self.lessons or self._round(epoch) != self._round(max(0, epoch - 1)):
                self.lessons = self._record(self._round(epoch))
            loss = self._epoch(epoch)
            valid = self._validate()
            row = {"epoch": epoch + 1, "round": self._round(epoch), "train_loss": loss, "validation_deg": valid}
            self.curve.append(row | {"updates": self.updates})
            self._keep_best(valid, epoch)
            self._save(epoch + 1)
            left = (time.monotonic() - started) / (epoch + 1 - first) * (self.settings.epochs - epoch - 1)
            self.tell(
                f"epoch {epoch + 1} of {self.settings.epochs}: loss {loss:.4f}, validation {valid:.4f} deg, {left:.0f} s left"
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
        """Round 0: the teacher flies; the scales of the network come from there."""
        shutil.rmtree(self.folder / "lessons", ignore_errors=True)
        self._checkpoint.unlink(missing_ok=True)  # else a call that resumes this one would go on with the one before
        self.lessons = self._record(0)
        found = {key: torch.as_tensor(value) for key, value in scales(self.lessons).items()}
        self.network.centre.copy_(found["centre"])
        self.network.unit.copy_(found["unit"])
        self.correction = found["correction"].to(self.device)
        error = self._validate()
        self._keep_best(error, -1)
        first = {"epoch": 0, "round": 0, "train_loss": float("nan"), "validation_deg": error, "updates": 0}
        self.curve.append(first)
        self.tell(f"before training (the KF itself): validation {error:.4f} deg")
        return 0

    def _round(self, epoch: int) -> int:
        """The round to which an epoch belongs; -1 before the first."""
        return epoch * self.settings.rounds // self.settings.epochs if epoch >= 0 else -1

    def _record(self, number: int) -> list[Lesson]:
        """Fly the training flights for this round, and throw the last round's lessons away."""
        folder = self.folder / "lessons" / f"round-{number}"
        shutil.rmtree(folder, ignore_errors=True)  # what a killed call has left of this round
        folder.mkdir(parents=True, exist_ok=True)
        weights, lessons = self._weights(), []
        for k, flight in enumerate(self.flights):
            rng = np.random.default_rng((self.settings.seed, k, 7))
            error = rng.normal(0.0, self.settings.reference_noise_deg / DEGREES, 3)
            file = folder / f"flight-{k:03d}.f32"
            lessons.append(write_lesson(flight, self.kf, self.teacher, weights, number == 0, file, error))
        for other in folder.parent.iterdir():
            if other != folder:
                shutil.rmtree(other)
        self.checksums = [checksum_of(lesson.path) for lesson in lessons]
        self.tell(f"round {number}: {'the teacher' if number == 0 else 'the network'} has flown {len(lessons)} flights")
        return lessons

    def _epoch(self, epoch: int) -> float:
        """One pass over all flights, cut into windows from a drawn offset; mean loss."""
        rng = np.random.default_rng((self.settings.seed, epoch))
        windows = []
        for lesson in self.lessons:
            window = min(self.window, lesson.rows // self.chunk * self.chunk)
            offset = int(rng.integers(0, min(window, lesson.rows - window) + 1))
            windows += [(lesson, start) for start in range(offset, lesson.rows - window + 1, window)]
        if not windows:
            raise InputError(f"training: the flights are shorter than chunk_s = {self.settings.chunk_s}")
        length = min(self.window, min(lesson.rows for lesson, _ in windows) // self.chunk * self.chunk)
        parts = np.array_split(rng.permutation(len(windows)), -(-len(windows) // self.settings.batch))
        losses = []
        for b, part in enumerate(parts):
            self._set_rate(epoch + b / len(parts))
            losses += self._learn([windows[i] for i in part], length)
        return float(np.mean(losses))

    def _learn(self, windows: list[tuple[Lesson, int]], length: int) -> list[float]:
        """One step of the optimiser per chunk; returns the losses."""
        memory: Memory | None = None
        losses = []
        for first in range(0, length, self.chunk):
            data = np.stack([lesson.read(start + first, self.chunk) for lesson, start in windows])
            rows = torch.as_tensor(data, device=self.device)
            inputs, wanted = rows[..., :INPUTS], rows[..., INPUTS:]
            change, memory = self.network(inputs, memory)
            memory = (memory[0].detach(), memory[1].detach())
            by_correction, by_block = distance(change, inputs, wanted, self.correction)
            loss = by_correction + self.settings.block_weight * by_block
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
            norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.gradient_limit)
            if bool(torch.isfinite(norm)):
                self.optimiser.step()
                self.updates += 1
            losses.append(float(loss.detach()))
        return losses

    def _set_rate(self, progress: float) -> None:
        s = self.settings
        fall = 0.5 * (1.0 + np.cos(np.pi * min(1.0, progress / s.epochs)))
        warm = min(1.0, (self.updates + 1) / 50.0) if s.optimiser == "adam" else 1.0
        for group in self.optimiser.param_groups:
            group["lr"] = s.learning_rate * warm * (s.final_rate + (1.0 - s.final_rate) * fall)

    def _validate(self) -> float:
        """Roll and pitch RMSE (deg, both axes pooled) over the validation flights, with the compiled filter."""
        from testbed.physics.rotations import quats_to_eulers, wrap

        total, count, weights = 0.0, 0, self._weights()
        for log, truth in self.validation:
            error = wrap(quats_to_eulers(solve_with(weights, log).q_nb) - truth)[:, :2]
            total, count = total + float((error**2).sum()), count + error.size
        return float(np.sqrt(total / count) * DEGREES)

    def _weights(self) -> Weights:
        return assemble(self._arrays(), self._metadata(-1, 0.0))

    def _arrays(self) -> dict[str, NDArray[np.float32]]:
        return {key: value.detach().cpu().contiguous().numpy() for key, value in self.network.state_dict().items()}

    def _metadata(self, epoch: int, error: float) -> dict[str, Any]:
        flights = [getattr(flight, "meta", {}).get("entry", {}).get("file", "") for flight in self.flights]
        return {
            "activation": self.settings.activation,
            "step_s": self.settings.step_s,
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
        arrays = {f"network.{k}": v for k, v in self._arrays().items()}
        arrays["correction"] = self.correction.cpu().numpy()
        for i, entry in self.optimiser.state_dict()["state"].items():
            arrays |= {f"optimiser.{i}.{k}": np.asarray(v.cpu()) for k, v in entry.items() if torch.is_tensor(v)}
        arrays["random"] = torch.get_rng_state().numpy()
        state = {"done": done, "updates": self.updates, "best": list(self.best), "curve": self.curve}
        state["lessons"] = self.checksums
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
        if not {"settings", "filter", "lessons"} <= state.keys():
            raise InputError(f"{self._checkpoint}: not a checkpoint of this version; train without --resume")
        if state["settings"] != asdict(self.settings) or state["filter"] != asdict(self.kf):
            raise InputError(
                f"{self._checkpoint}: was made with other settings; train without --resume, or in another folder"
            )
        self.network.load_state_dict({k[8:]: torch.as_tensor(v) for k, v in arrays.items() if k.startswith("network.")})
        self.correction = torch.as_tensor(arrays["correction"], device=self.device)
        entries: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in arrays.items():
            if key.startswith("optimiser."):
                _, index, name = key.split(".")
                entries.setdefault(int(index), {})[name] = torch.as_tensor(value)
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": entries})
        torch.set_rng_state(torch.as_tensor(arrays["random"]))
        self.updates, self.best, self.curve = state["updates"], tuple(state["best"]), state["curve"]
        done = int(state["done"])
        if self._round(done) == self._round(done - 1) and done < self.settings.epochs:
            self.lessons = self._lessons_kept(self._round(done), state["lessons"])
            self.checksums = state["lessons"]
        self.tell(f"resumed after epoch {done} of {self.settings.epochs}")
        return done

    def _lessons_kept(self, number: int, checksums: list[str]) -> list[Lesson]:
        """The flights of a round that was under way, which must be those that the checkpoint was made with."""
        paths = sorted((self.folder / "lessons" / f"round-{number}").glob("*.f32"))
        if len(paths) != len(self.flights):
            raise InputError(
                f"{self.folder / 'lessons'}: the flights of round {number} are gone; train without --resume"
            )
        for path, checksum in zip(paths, checksums, strict=True):
            if checksum_of(path) != checksum:
                raise InputError(f"{path}: damaged: not what this training has flown; train without --resume")
        return [Lesson(path) for path in paths]


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
