"""Training of `ahrs-lstm`: truncated back-propagation in batches of windows, through filters that run (torch).

The filter runs with the corrected gain. The loss compares its corrections with those of a teacher: the same filter told
the true linear acceleration, which it takes, axis by axis, for its sigma. The network is not told; it must see from its
90 inputs which axis to believe. What counts is the attitude and bias by which the corrections of a chunk differ in all.
Losses on the attitude error itself were tried first and did not teach: that error is so persistent that its chance
correlation with the accelerations drowns the gradient. SI units, µT. Flights are objects like `testbed.dataset.Shard`.
"""

from __future__ import annotations

import csv
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from estimators.ahrs_kf import AhrsKf
from estimators.ahrs_lstm import ACTIVATIONS, assemble
from estimators.ahrs_torch import Batch, BatchFilter, GainNetwork
from estimators.ahrs_windows import Prepared, make_batch, normalisation, prepare_flight
from testbed.errors import InputError

DEGREES = 180.0 / np.pi


@dataclass(frozen=True)
class Settings:
    """``[extra.train]`` of the scenario. The paper has SGD, rate 0.1, 100 epochs, batch 50; see ``optimiser``."""

    layers: int = 2
    neurons: int = 200
    activation: str = "sigmoid"
    epochs: int = 4
    batch: int = 50
    interleave: int = 2
    """Batches that take turns, a chunk each, so that one update after another sees other windows."""
    window_s: float = 300.0
    chunk: int = 50
    """Samples through which the gradient runs back."""
    optimiser: str = "adam"
    """``adam`` or ``sgd`` (the paper's)."""
    learning_rate: float = 2e-3
    final_rate: float = 0.1
    """The rate falls to this part of itself over the training, along a cosine."""
    teacher_floor_mps2: float = 1.5
    """The teacher's sigma of linear acceleration where there is none; found on training flights, as is the next."""
    teacher_factor: float = 5.0
    """The teacher's sigma of linear acceleration over the true one (its mean over a second)."""
    gradient_limit: float = 1.0
    reference_noise_deg: float = 0.0
    """1 sigma of a constant error of the reference attitude per window, per axis (the paper's reference: 0.5)."""
    seed: int = 0
    threads: int = 0
    """Of torch; 0: all cores. With 1 on a CPU a resumed training ends in the very same weights."""
    device: str = "auto"

    def __post_init__(self) -> None:
        for key in ("layers", "neurons", "epochs", "batch", "chunk"):
            if getattr(self, key) < 1:
                raise InputError(f"training: {key} is {getattr(self, key)}, must be at least 1")
        if self.activation not in ACTIVATIONS or self.optimiser not in ("adam", "sgd"):
            raise InputError(f"training: activation must be one of {ACTIVATIONS}, optimiser adam or sgd")
        if not (self.window_s > 0 and self.learning_rate > 0 and 0 < self.final_rate <= 1):
            raise InputError("training: window_s and learning_rate must be positive, final_rate within (0, 1]")


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
    chosen = Settings(**(settings or {}))
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    return _Training(chosen, AhrsKf(**(filter_params or {})), training, validation, folder, tell).run(resume)


class _Training:
    """One training: data, network, optimiser, and the files in ``folder``."""

    def __init__(self, settings: Settings, kf: AhrsKf, training: Any, validation: Any, folder: Path, tell: Any) -> None:
        self.settings, self.kf, self.folder, self.tell = settings, kf, folder, tell
        if settings.threads:
            torch.set_num_threads(settings.threads)
        name = ("cuda" if torch.cuda.is_available() else "cpu") if settings.device == "auto" else settings.device
        self.device = torch.device(name)
        rate = 1.0 / float(kf.model(training[0].log())[9])
        self.rows = max(settings.chunk, round(settings.window_s * rate) // settings.chunk * settings.chunk)
        self.stride = settings.chunk
        self.flights = [prepare_flight(flight, kf, self.stride) for flight in training]
        self.validation = [(flight.log(), _truth(flight)) for flight in validation]
        self.norm = normalisation(self.flights)
        torch.manual_seed(settings.seed)
        tensors = {key: torch.as_tensor(value) for key, value in self.norm.items()}
        shape = (settings.layers, settings.neurons, settings.activation)
        self.network = GainNetwork(*shape, tensors["mean"], tensors["std"], tensors["scale"]).to(self.device)
        self.filter = BatchFilter(self.flights[0].model, self.device, torch.float32)
        kinds = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}
        self.optimiser = kinds[settings.optimiser](self.network.parameters(), lr=settings.learning_rate)
        self._teacher = (settings.teacher_floor_mps2, settings.teacher_factor)
        scales = [torch.as_tensor(v).to(self.network.scale) for v in self._teacher_scales()]
        self.network.scale.copy_(scales[0])
        self.correction_scale = scales[1]
        self.updates = 0
        self.best = (np.inf, -1)
        self.curve: list[dict[str, float]] = []

    def _teacher_scales(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Root mean square of the teacher's gain (72) and of its corrections (12), each the largest of three axes.

        The first is the unit of the network's residual.
        """
        rows = min(self.rows, 10 * self.settings.chunk)
        windows = [window for batch in self._windows(0) for window in batch][: self.settings.batch]
        b = make_batch(windows, rows, self.device, teacher=self._teacher)
        teacher, gains, corrections = b.p.clone(), b.p.new_zeros(6, 12), b.p.new_zeros(12)
        for n in range(rows):
            z, k, turn = self.filter.before(b, n)
            wanted, teacher = self.filter.gain(teacher, turn, self.filter.seen(b, b.c_nb), b.accel_sigma[:, n])
            self.filter.after(b, z, k)
            if n >= rows // 2:
                gains += (wanted**2).mean(0) / (rows - rows // 2)
                corrections += (torch.einsum("bci,bc->bi", wanted, z) ** 2).mean(0) / (rows - rows // 2)

        def largest(square: Any) -> NDArray[np.float32]:
            rms = square.sqrt().cpu().numpy().reshape(-1, 3)
            return np.repeat(rms.max(1) + 1e-12, 3).astype(np.float32)

        return largest(gains), largest(corrections)

    def _distance(self, difference: torch.Tensor, apart: torch.Tensor) -> torch.Tensor:
        """How far a gain is from the teacher's: by attitude and bias ``apart`` (B,6), which the differing corrections of
        the chunk so far add up to (what does not average out counts), and, less, by its elements."""
        by_element = (difference / self.network.scale.view(6, 12)) ** 2
        return 0.1 * ((apart / self.correction_scale[:6]) ** 2).mean() + 0.1 * by_element.mean()

    def run(self, resume: bool) -> Path:
        """All epochs that are still to do."""
        first = self._restore() if resume and self._checkpoint.exists() else 0
        if first == 0:
            error = self._validate()
            self._keep_best(error, -1)
            self.curve.append({"epoch": 0, "train_deg": float("nan"), "validation_deg": error, "updates": 0})
            self.tell(f"before training (the KF itself): validation {error:.4f} deg")
        started = time.monotonic()
        for epoch in range(first, self.settings.epochs):
            error = self._epoch(epoch)
            valid = self._validate()
            self.curve.append(
                {"epoch": epoch + 1, "train_deg": error, "validation_deg": valid, "updates": self.updates}
            )
            self._keep_best(valid, epoch)
            self._save(epoch + 1)
            spent = time.monotonic() - started
            left = spent / (epoch + 1 - first) * (self.settings.epochs - epoch - 1)
            self.tell(
                f"epoch {epoch + 1} of {self.settings.epochs}: training {error:.4f} deg, validation {valid:.4f} deg, {left:.0f} s left"
            )
        return self.folder / "ahrs-lstm.safetensors"

    @property
    def _checkpoint(self) -> Path:
        return self.folder / "checkpoint.safetensors"

    def _windows(self, epoch: int) -> list[list[tuple[Prepared, int]]]:
        """Batches of window starts: all flights cut into windows from a drawn offset, shuffled.

        Every second time the offset is the smallest, or the start of a flight would hardly ever be seen.
        """
        rng = np.random.default_rng((self.settings.seed, epoch))
        windows = []
        for flight in self.flights:
            room = max(1, min(self.rows, flight.flight.rows - self.rows) // self.stride)
            offset = int(rng.integers(1, room + 1)) * self.stride if rng.random() < 0.5 else self.stride
            windows += [(flight, start) for start in range(offset, flight.flight.rows - self.rows + 1, self.rows)]
        parts = np.array_split(rng.permutation(len(windows)), -(-len(windows) // self.settings.batch))
        return [[windows[i] for i in part] for part in parts]

    def _epoch(self, epoch: int) -> float:
        """Root mean square tilt error (deg per axis) over the epoch, while learning."""
        batches, tilts = self._windows(epoch), []
        rng = np.random.default_rng((self.settings.seed, epoch, 1))
        groups = [batches[a : a + self.settings.interleave] for a in range(0, len(batches), self.settings.interleave)]
        chunks, told = range(0, self.rows, self.settings.chunk), time.monotonic()
        for g, group in enumerate(groups):
            loaded = [self._start(windows, rng) for windows in group]
            states = [(self.network.start(len(b.p)), b.p.clone()) for b in loaded]
            for k, chunk in enumerate(chunks):
                self._set_rate(epoch + (g + k / len(chunks)) / len(groups))
                for i, batch in enumerate(loaded):
                    states[i], tilt = self._update(batch, chunk, states[i])
                    tilts.append(tilt)
                if time.monotonic() - told > 20.0:
                    told, part = time.monotonic(), (g + (k + 1) / len(chunks)) / len(groups)
                    self.tell(f"  epoch {epoch + 1}, {100 * part:.0f} %: {np.sqrt(np.mean(tilts[-100:]) / 2):.4f} deg")
        return float(np.sqrt(np.mean(tilts) / 2.0))

    def _update(self, b: Batch, start: int, state: Any) -> tuple[Any, float]:
        """One step of the optimiser on one chunk; returns memory and teacher's covariance after it, and the mean square
        tilt error (deg²; roll and pitch together)."""
        b.c_nb = _orthonormal(b.c_nb)
        memory = [(h.detach(), c.detach()) for h, c in state[0]]
        teacher = state[1]
        tilts, losses, apart = [], [], b.bias.new_zeros(len(b.bias), 6)
        for n in range(start, start + self.settings.chunk):
            z, k, turn = self.filter.before(b, n)
            change, memory = self.network(self.filter.inputs(z, k, b.bias, b.disturbance), memory)
            wanted, teacher = self.filter.gain(teacher, turn, self.filter.seen(b, b.c_nb), b.accel_sigma[:, n])
            difference = k + change - wanted
            x = torch.einsum("bci,bc->bi", difference, z)[:, :6]
            carried = torch.einsum("bij,bi->bj", turn, apart[:, :3])
            apart = torch.cat([carried, apart[:, 3:]], 1) + x
            self.filter.after(b, z, k + change)
            tilts.append(((b.c_nb - b.truth[:, n + 1])[:, 2] ** 2).sum(1).mean())
            losses.append(self._distance(difference, apart))
        self.optimiser.zero_grad(set_to_none=True)
        torch.stack(losses).mean().backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.gradient_limit)
        if bool(torch.isfinite(norm)):
            self.optimiser.step()
            self.updates += 1
        return (memory, teacher), float(torch.stack(tilts).mean()) * DEGREES**2

    def _set_rate(self, progress: float) -> None:
        s = self.settings
        fall = 0.5 * (1.0 + np.cos(np.pi * min(1.0, progress / s.epochs)))
        warm = min(1.0, (self.updates + 1) / 50.0) if s.optimiser == "adam" else 1.0
        for group in self.optimiser.param_groups:
            group["lr"] = s.learning_rate * warm * (s.final_rate + (1.0 - s.final_rate) * fall)

    def _start(self, windows: list[tuple[Prepared, int]], rng: np.random.Generator) -> Batch:
        """Load windows, with an error of the reference attitude where one is asked for."""
        error = rng.normal(0.0, self.settings.reference_noise_deg / DEGREES, (len(windows), 3))
        return make_batch(windows, self.rows, self.device, teacher=self._teacher, reference_error=error)

    def _validate(self) -> float:
        """Roll and pitch RMSE (deg, both axes pooled) over the validation flights, with the compiled filter."""
        from testbed.rotations import quats_to_eulers, wrap

        total, count = 0.0, 0
        for log, truth in self.validation:
            solution = solve_with(self.kf, log, self._arrays(), self._metadata(-1, 0.0))
            error = wrap(quats_to_eulers(solution.q_nb) - truth)[:, :2]
            total, count = total + float((error**2).sum()), count + error.size
        return float(np.sqrt(total / count) * DEGREES)

    def _arrays(self) -> dict[str, NDArray[np.float32]]:
        return {key: value.detach().cpu().contiguous().numpy() for key, value in self.network.state_dict().items()}

    def _metadata(self, epoch: int, error: float) -> dict[str, Any]:
        flights = [getattr(f.flight, "meta", {}).get("entry", {}).get("file", "") for f in self.flights]
        return {
            "activation": self.settings.activation,
            "filter": asdict(self.kf),
            "training": asdict(self.settings) | {"device": self.device.type},
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
        for i, entry in self.optimiser.state_dict()["state"].items():
            arrays |= {f"optimiser.{i}.{k}": np.asarray(v.cpu()) for k, v in entry.items() if torch.is_tensor(v)}
        state = {"done": done, "updates": self.updates, "best": list(self.best), "curve": self.curve}
        _write(self._checkpoint, arrays, state | {"settings": asdict(self.settings), "filter": asdict(self.kf)})
        with open(self.folder / "learning-curve.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, list(self.curve[0]))
            writer.writeheader()
            writer.writerows({k: f"{v:.6g}" for k, v in row.items()} for row in self.curve)

    def _restore(self) -> int:
        from safetensors import safe_open

        with safe_open(self._checkpoint, framework="numpy") as file:
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            state = {key: json.loads(value) for key, value in file.metadata().items()}
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
        self.updates, self.best, self.curve = state["updates"], tuple(state["best"]), state["curve"]
        self.tell(f"resumed after epoch {state['done']} of {self.settings.epochs}")
        return int(state["done"])


def solve_with(kf: AhrsKf, log: Any, arrays: dict[str, Any], metadata: dict[str, Any]) -> Any:
    """The compiled filter with these arrays as network."""
    from estimators.ahrs_lstm_kernels import filter_log_corrected

    made = assemble(arrays, metadata)

    def loop(arguments: tuple[Any, ...]) -> None:
        filter_log_corrected(*arguments, tuple(made.network), made.scale, np.zeros(len(arguments[-1])))

    return kf.solve(log, loop)


def _truth(flight: Any) -> NDArray[np.float64]:
    from testbed.rotations import quats_to_eulers

    return quats_to_eulers(flight.window(0, flight.rows)["q_nb"].astype(np.float64))


def _orthonormal(c_nb: torch.Tensor) -> torch.Tensor:
    """The rotation matrix nearest to one that is off by rounding (one Newton step)."""
    return 0.5 * c_nb @ (3.0 * torch.eye(3, device=c_nb.device, dtype=c_nb.dtype) - c_nb.transpose(1, 2) @ c_nb)


def _write(path: Path, arrays: dict[str, Any], metadata: dict[str, Any]) -> None:
    from safetensors.numpy import save_file

    scratch = path.with_suffix(".tmp")
    save_file(arrays, scratch, {key: json.dumps(value) for key, value in metadata.items()})
    os.replace(scratch, path)
