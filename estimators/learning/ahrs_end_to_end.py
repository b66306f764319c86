"""`ahrs-lstm` learns from the attitude error itself, which runs back through the unrolled filter and the network together.

The loss is the mean square of the tilt's error, in units of the untrained filter's on the same flights: 1 at the start.
Windows fly on from chunk to chunk with their filter's and the network's state; gradients are truncated to ``chunk_s``
(Williams and Peng 1990, doi:10.1162/neco.1990.2.4.490). The filter runs at the rate of its samples, in training as in use.
SI units, µT.
"""

from __future__ import annotations

import csv
import os
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from estimators.learning.ahrs_lessons import input_scales
from estimators.learning.ahrs_torch import Memory
from estimators.learning.ahrs_training import DEGREES, Training
from estimators.learning.ahrs_unrolled import Flight, Unrolled, cut
from estimators.learning.ahrs_weights import samples_per_step
from testbed.base.errors import InputError

LOST = 1.0
"""rad²: a window whose attitude is off by 60 degrees begins anew at the next chunk."""
OF_IMITATION = ("rounds", "block_weight", "teacher", "told_factor")
"""Settings without meaning here."""


class EndToEnd(Training):
    """``gradients.csv`` beside the learning curve has loss, gradient norm and lost windows of every update."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        drawn = [np.random.default_rng((self.settings.seed, k, 7)) for k in range(len(self.flights))]
        sigma = self.settings.reference_noise_deg / DEGREES
        self.cut_from = [
            Flight(shard, self.kf, rng.normal(0.0, sigma, 3)) for shard, rng in zip(self.flights, drawn, strict=True)
        ]
        self.every = samples_per_step(self.weights(), self.cut_from[0].log)
        self.unit = 1.0
        """Mean square of the untrained filter's tilt error, rad²."""
        self.gradients: list[dict[str, float]] = []

    def prepare(self) -> tuple[dict[str, NDArray[np.float32]], dict[str, float]]:
        """The untrained filter flies every fourth window of an epoch: scales of the inputs, and its mean square error."""
        self.tell(f"end to end; settings of imitation have no meaning here: {', '.join(OF_IMITATION)}")
        seen, losses = [], []
        with torch.no_grad():
            for _, flown, steps in self._batches(-1):
                for k in range(steps):
                    _, inputs, loss = flown.step(flown.chunk(), torch.zeros(flown.batch, 72))
                    losses.append(float(loss.mean()))
                    if k >= steps // 50 and k % 5 == 0:  # as in `ahrs_lessons.scales`: without the start, every fifth
                        seen.append(inputs.numpy())
        self.unit = float(np.mean(losses))
        return input_scales(np.vstack(seen).astype(np.float64)), {"train_loss": 1.0, "gradient_norm": float("nan")}

    def learn(self, epoch: int) -> dict[str, float]:
        """One pass over all flights, cut into windows from drawn offsets."""
        before = len(self.gradients)
        for progress, flown, steps in self._batches(epoch):
            self.set_rate(epoch + progress)
            self._fly(epoch, flown, steps)
        done = self.gradients[before:]
        loss, norm = (float(np.mean([row[key] for row in done])) for key in ("loss", "gradient_norm"))
        return {"train_loss": loss, "gradient_norm": norm}

    def kept(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """The unit of the loss; the gradients go beside the learning curve."""
        if self.gradients:
            self._write_gradients()
        return {}, {"unit": self.unit, "gradients": self.gradients}

    def restore(self, done: int, arrays: dict[str, Any], state: dict[str, Any]) -> None:
        """Nothing that lies in other files."""
        self.unit, self.gradients = float(state["unit"]), state["gradients"]

    def _batches(self, epoch: int) -> Any:
        """(progress within the epoch, windows ready to fly, steps of the network) of an epoch, -1 the one before the first."""
        rng = np.random.default_rng((self.settings.seed, epoch + 1, 11))
        chunk = self.chunk * self.every
        shortest = min(flight.rows for flight in self.cut_from)
        rows = min(self.window * self.every, (shortest - 1) // chunk * chunk)
        if rows < chunk:
            raise InputError(f"training: the flights are shorter than chunk_s = {self.settings.chunk_s}")
        places = []
        for flight in self.cut_from:
            offset = int(rng.integers(0, min(rows, flight.rows - rows - 1) + 1))
            places += [(flight, first) for first in range(offset, flight.rows - rows, rows)]
        if epoch < 0:
            places = places[::4]
        parts = np.array_split(rng.permutation(len(places)), -(-len(places) // self.settings.batch))
        for b, part in enumerate(parts):
            chosen = [places[i] for i in part]
            flown = Unrolled(cut(chosen, rows, rng), chosen, self.every, self.chunk)
            yield b / len(parts), flown, rows // self.every

    def _fly(self, epoch: int, flown: Unrolled, steps: int) -> None:
        """Windows from their start to their end, one update per chunk."""
        memory: Memory | None = None
        answer = torch.zeros(flown.batch, 72, device=self.device)
        for first in range(0, steps, self.chunk):
            errors, losses = flown.chunk(), []
            for _ in range(self.chunk):
                errors, inputs, loss = flown.step(errors, answer)
                answer, memory = self.network.step(inputs, memory)
                losses.append(loss.mean())
            mean = torch.stack(losses).mean() / self.unit
            norm = self.step(mean)
            assert memory is not None
            lost = ~(loss.detach().numpy() < LOST)
            flown.restart(lost, np.random.default_rng((self.settings.seed, epoch + 1, first, 13)))
            going = torch.as_tensor(~lost, device=self.device)[:, None]
            memory = torch.where(going, memory[0].detach(), 0.0), torch.where(going, memory[1].detach(), 0.0)
            answer = torch.where(going, answer.detach(), 0.0)
            row = {"update": self.updates, "epoch": epoch + 1, "time_s": first * self.settings.step_s}
            row |= {"loss": float(mean.detach()), "gradient_norm": norm, "lost": int(lost.sum())}
            self.gradients.append(row)

    def _write_gradients(self) -> None:
        path = self.folder / "gradients.csv"
        scratch = path.with_suffix(".tmp")
        with open(scratch, "w", newline="") as file:
            writer = csv.DictWriter(file, list(self.gradients[0]))
            writer.writeheader()
            writer.writerows({k: f"{v:.6g}" for k, v in row.items()} for row in self.gradients)
        os.replace(scratch, path)
