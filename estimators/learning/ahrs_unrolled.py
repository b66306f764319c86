"""`ahrs-kf` as a layer of torch: `ahrs_unrolled_kernels` on windows of flights, with gradients. SI units, µT.

Between two steps of the network the filter is a function of the network's last answer and of its own errors, which have
no numbers of their own: a tensor of zeros stands for them, and carries their gradient back from step to step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from estimators.learning.ahrs_lstm_kernels import INPUTS
from estimators.learning.ahrs_unrolled_kernels import Tape, Windows, fly, fly_back, make_tape
from estimators.methods.ahrs_kf import AhrsKf
from testbed.base.errors import InputError

ERRORS, COVARIANCE = 12, 144
"""What the tensor of zeros stands for: the errors, and the covariance's elements."""


class Flight:
    """A flight of a data set as windows are cut from it: what the filter knows of it beside the samples."""

    def __init__(self, shard: Any, kf: AhrsKf, reference_error: NDArray[np.float64]) -> None:
        self.shard, self.kf, self.rows = shard, kf, int(shard.rows)
        self.log, self.error = shard.log(), reference_error
        self.figures = kf.figures(self.log)
        if self.log.mag is None or len(self.log.mag.t) != self.rows:
            raise InputError("training: end-to-end needs a field sample with each IMU sample, and a flight has fewer")

    def start(self, row: int, rng: np.random.Generator) -> tuple[NDArray[Any], NDArray[Any]]:
        """State (13,) and covariance (12,12) as at the start of a flight in the air, with errors of its deviations, at ``row``."""
        from testbed.physics.rotations import quat_multiply, rotvec_to_quat

        initial = self.log.initial
        phi = initial.std[6:9] * rng.standard_normal(3)
        true = tuple(self.shard.window(row, 1)["q_nb"][0].astype(np.float64))
        initial = replace(initial, q_nb=np.array(quat_multiply(rotvec_to_quat(tuple(phi)), true)))
        return self.kf.start(replace(self.log, initial=initial))


Place = tuple[Flight, int]
"""A flight and the row after which a window of it begins."""


class Unrolled:
    """Windows that fly on from step to step; `chunk` says where a new truncation of the gradient begins."""

    def __init__(self, windows: Windows, places: Sequence[Place], every: int, steps: int) -> None:
        self.windows, self.places, self.every, self.sample = windows, places, every, 0
        self.batch = len(windows.state)
        self.tape: Tape = make_tape(steps, self.batch, every)
        self.place = 0

    def chunk(self) -> Tensor:
        """Begin a chunk: gradients run back to here. Returns what stands for the errors, (B,156)."""
        self.place = 0
        return torch.zeros(self.batch, ERRORS + COVARIANCE, dtype=torch.float64, requires_grad=True)

    def restart(self, lost: NDArray[np.bool_], rng: np.random.Generator) -> None:
        """Windows that are lost begin anew where they are."""
        for b in np.flatnonzero(lost):
            flight, first = self.places[int(b)]
            self.windows.state[b], self.windows.p[b] = flight.start(first + self.sample, rng)
            self.windows.slow[b] = 0.0

    def step(self, errors: Tensor, answer: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One step of the network with its last ``answer`` (B,72): errors again, inputs (B,90), loss (B) in rad²."""
        found: tuple[Tensor, Tensor, Tensor] = _Step.apply(errors, answer, self)
        return found


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, errors: Tensor, answer: Tensor, flown: Unrolled) -> tuple[Tensor, Tensor, Tensor]:
        inputs, loss = np.empty((flown.batch, INPUTS)), np.empty(flown.batch)
        ctx.flown, ctx.place, ctx.answer, ctx.device = flown, flown.place, answer.detach().cpu().numpy(), answer.device
        fly(flown.windows, flown.sample, ctx.answer, flown.tape, flown.place, inputs, loss)
        flown.sample += flown.every
        flown.place += 1
        return errors.clone(), torch.from_numpy(inputs.astype(np.float32)).to(answer.device), torch.from_numpy(loss)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        by_errors = gradients[0].numpy()
        errors = np.ascontiguousarray(by_errors[:, :ERRORS])
        covariance = np.ascontiguousarray(by_errors[:, ERRORS:]).reshape(-1, 12, 12)
        by_inputs, by_loss = (g.detach().cpu().numpy().astype(np.float64) for g in gradients[1:])
        by_answer = np.empty((len(errors), 72))
        flown = ctx.flown
        fly_back(
            flown.windows, ctx.answer, flown.tape, ctx.place, (errors, covariance), (by_inputs, by_loss, by_answer)
        )
        back = torch.from_numpy(np.hstack([errors, covariance.reshape(-1, COVARIANCE)]))
        return back, torch.from_numpy(by_answer.astype(np.float32)).to(ctx.device), None


def cut(places: Sequence[Place], rows: int, rng: np.random.Generator) -> Windows:
    """Windows of so many rows; each begins after the row that its place names."""
    from testbed.physics.rotations import quat_to_matrix, quats_to_matrices, rotvec_to_quat

    parts: dict[str, list[Any]] = {key: [] for key in ("gyro", "accel", "mag", "down", "figures", "state", "p")}
    for flight, first in places:
        data = flight.shard.window(first + 1, rows)
        for key in ("gyro", "accel", "mag"):
            parts[key].append(data[key].astype(np.float64))
        parts["accel"][-1] -= flight.log.initial.accel_bias
        turn = np.array(quat_to_matrix(rotvec_to_quat(tuple(flight.error))))
        parts["down"].append(quats_to_matrices(data["q_nb"].astype(np.float64))[:, 2] @ turn)
        parts["figures"].append([*flight.figures])
        state, p = flight.start(first, rng)
        parts["state"].append(state)
        parts["p"].append(p)
    arrays = {key: np.ascontiguousarray(np.array(value)) for key, value in parts.items()}
    field_n = np.array(places[0][0].log.mag.spec.field_n)
    return Windows(rows=np.arange(rows), field_n=field_n, slow=np.zeros((len(places), 3)), **arrays)
