"""`ahrs-lstm` imitates a teacher whose gain it can tell from what it sees, on flights that it flies itself.

The teacher is a Kalman filter that adapts to the linear acceleration that it sees, or is told. In round 0 it flies; in
every later round the network does, and the teacher says at each step what its gain would be there (Ross, Gordon, Bagnell
2011, *DAgger*, without keeping earlier rounds). Back-propagation runs through sequences of the network, truncated to
``chunk_s``; windows keep their memory from chunk to chunk. SI units, µT.
"""

from __future__ import annotations

import shutil
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from estimators.learning.ahrs_lessons import Lesson, Teacher, checksum_of, scales, write_lesson
from estimators.learning.ahrs_lstm_kernels import INPUTS
from estimators.learning.ahrs_torch import Memory, distance
from estimators.learning.ahrs_training import DEGREES, Training
from estimators.methods.ahrs_kf import AhrsKf
from testbed.base.errors import InputError


class Imitation(Training):
    """Lessons of the flights lie in ``folder/lessons``, those of the present round alone."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.teacher = Teacher(AhrsKf(**(asdict(self.kf) | self.settings.teacher)), self.settings.told_factor)
        self.correction = torch.ones(12, device=self.device)
        self.lessons: list[Lesson] = []
        self.checksums: list[str] = []

    def prepare(self) -> tuple[dict[str, NDArray[np.float32]], dict[str, float]]:
        """Round 0: the teacher flies; the scales of the network come from there."""
        shutil.rmtree(self.folder / "lessons", ignore_errors=True)
        self.lessons = self._record(0)
        found = scales(self.lessons)
        self.correction = torch.as_tensor(found["correction"]).to(self.device)
        return found, {"round": 0, "train_loss": float("nan")}

    def learn(self, epoch: int) -> dict[str, float]:
        """One epoch, before which a new round flies where it is due."""
        if not self.lessons or self._round(epoch) != self._round(max(0, epoch - 1)):
            self.lessons = self._record(self._round(epoch))
        return {"round": self._round(epoch), "train_loss": self._epoch(epoch)}

    def kept(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """The scale of the corrections, and the checksums of the lessons."""
        return {"correction": self.correction.cpu().numpy()}, {"lessons": self.checksums}

    def restore(self, done: int, arrays: dict[str, Any], state: dict[str, Any]) -> None:
        """Take up a round that was under way."""
        self.correction = torch.as_tensor(arrays["correction"], device=self.device)
        if self._round(done) == self._round(done - 1) and done < self.settings.epochs:
            self.lessons = self._lessons_kept(self._round(done), state["lessons"])
            self.checksums = state["lessons"]

    def _round(self, epoch: int) -> int:
        """The round to which an epoch belongs; -1 before the first."""
        return epoch * self.settings.rounds // self.settings.epochs if epoch >= 0 else -1

    def _record(self, number: int) -> list[Lesson]:
        """Fly the training flights for this round, and throw the last round's lessons away."""
        folder = self.folder / "lessons" / f"round-{number}"
        shutil.rmtree(folder, ignore_errors=True)  # what a killed call has left of this round
        folder.mkdir(parents=True, exist_ok=True)
        weights, lessons = self.weights(), []
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
            self.set_rate(epoch + b / len(parts))
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
            self.step(loss)
            losses.append(float(loss.detach()))
        return losses

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
