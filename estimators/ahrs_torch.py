"""The attitude filter of `ahrs_kernels` on batches of windows, and the network that corrects its gain, in torch.

`BatchFilter` is `ahrs_kernels.filter_log` on B windows at once; `GainNetwork` is `ahrs_lstm_kernels.network_step`. SI
units, µT.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from estimators.ahrs_lstm_kernels import CLIP, INPUTS

Memory = list[tuple[Tensor, Tensor]]
"""Output and cell of each LSTM layer, (B,H)."""


class GainNetwork(nn.Module):
    """90 inputs to the residual of the gain, 72, in units of ``scale``; starts at zero."""

    def __init__(self, layers: int, neurons: int, activation: str, mean: Tensor, std: Tensor, scale: Tensor) -> None:
        super().__init__()
        self.curved = activation == "sigmoid"
        self.input = nn.Linear(INPUTS, neurons)
        self.lstm = nn.ModuleList(nn.LSTMCell(neurons, neurons) for _ in range(layers))
        self.head = nn.Linear(neurons, 72)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.mean: Tensor
        self.std: Tensor
        self.scale: Tensor
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)
        self.register_buffer("scale", scale)

    def forward(self, inputs: Tensor, memory: Memory) -> tuple[Tensor, Memory]:
        """Change of the transposed gain (B,6,12), and the memory after this step."""
        x = self.input(((inputs - self.mean) / self.std).clamp(-float(CLIP), float(CLIP)))
        if self.curved:
            x = torch.sigmoid(x)
        after = []
        for cell, (h, c) in zip(self.lstm, memory, strict=True):
            x, c = cell(x, (h, c))
            after.append((x, c))
        return (self.head(x) * self.scale).view(-1, 6, 12), after

    def start(self, batch: int) -> Memory:
        """An empty memory."""
        zero = self.scale.new_zeros(batch, self.head.in_features)
        return [(zero, zero) for _ in self.lstm]


@dataclass
class Batch:
    """B windows: samples (B,T,3), true C_nb (B,T+1,3,3) from the start on, field (B,3), gravity (B,), the filter's state."""

    gyro: Tensor
    accel: Tensor
    mag: Tensor
    truth: Tensor
    field_n: Tensor
    gravity: Tensor
    c_nb: Tensor
    bias: Tensor
    disturbance: Tensor
    p: Tensor
    accel_sigma: Tensor
    """What a filter would take for the sigma of linear acceleration if it knew that acceleration, (B,T,3)."""


class BatchFilter:
    """The filter on a batch: `step` is `ahrs_kernels.filter_log`'s loop body. ``model`` are the figures of its MODEL."""

    def __init__(self, model: Sequence[float] | NDArray[np.float64], device: torch.device, dtype: torch.dtype) -> None:
        self.dt, (_, fa, fd) = float(model[9]), [float(v) for v in model[6:9]]
        as_tensor = lambda values: torch.as_tensor(np.asarray(values), device=device, dtype=dtype)  # noqa: E731
        decay = np.repeat([1.0, float(model[6]), fa, fd], 3)
        self.decay = as_tensor(np.repeat([fa, fd], 3))
        self.phi = as_tensor(np.diag(decay) - self.dt * np.eye(12, k=3) * (np.arange(12) < 3)[:, None])
        self.q = as_tensor(np.diag(np.repeat([model[0] * self.dt**2, *model[1:4]], 3)))
        self.r = as_tensor(np.diag(np.repeat(model[4:6], 3)))
        h = np.zeros((6, 12))
        h[:3, 6:9], h[3:, 9:] = -np.eye(3), np.eye(3)
        self.h = as_tensor(h)
        generators = np.zeros((3, 3, 3))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            generators[i, k, j], generators[i, j, k] = 1.0, -1.0
        self.generators = as_tensor(generators.reshape(3, 9))
        self.eye = as_tensor(np.eye(3))

    def cross(self, v: Tensor) -> Tensor:
        """[v×] (B,3,3) of (B,3)."""
        return (v @ self.generators).view(-1, 3, 3)

    def rotation(self, v: Tensor) -> Tensor:
        """exp([v×]) by its series: exact to float precision for the small turns of one sample."""
        n2 = (v * v).sum(1).clamp(max=1.0)[:, None, None]
        m = self.cross(v)
        return self.eye + (1 - n2 / 6 * (1 - n2 / 20)) * m + (0.5 - n2 / 24 * (1 - n2 / 30)) * (m @ m)

    @torch.no_grad()
    def gain(self, p: Tensor, turn: Tensor, seen: Tensor, accel_sigma: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Transposed Kalman gain (B,6,12) and updated covariance, from those before the sample.

        ``accel_sigma`` (B,3), m/s², stands for the model's one sigma of linear acceleration: see `teacher_sigma`.
        """
        phi = self.phi.expand(len(p), 12, 12).clone()
        phi[:, :3, :3] = turn.transpose(1, 2)
        p = phi @ p @ phi.transpose(1, 2) + self.q
        if accel_sigma is not None:
            grown = accel_sigma**2 * (1.0 - self.decay[0] ** 2) - self.q[6, 6]
            p = p + torch.nn.functional.pad(torch.diag_embed(grown), (6, 3, 6, 3))
        h = self.h.expand(len(p), 6, 12).clone()
        h[:, :3, :3], h[:, 3:, :3] = self.cross(seen[:, :3]), self.cross(seen[:, 3:])
        hp = h @ p
        factor = torch.linalg.cholesky(hp @ h.transpose(1, 2) + self.r)
        y = torch.linalg.solve_triangular(factor, hp, upper=False)
        k = torch.linalg.solve_triangular(factor.transpose(1, 2), y, upper=True)
        p = p - y.transpose(1, 2) @ y
        return k, 0.5 * (p + p.transpose(1, 2))

    @torch.no_grad()
    def before(self, b: Batch, n: int) -> tuple[Tensor, Tensor, Tensor]:
        """Predict sample ``n`` of every window: z (B,6), the filter's own gain (B,6,12), and the turn (B,3,3)."""
        turn = self.rotation((b.gyro[:, n] - b.bias) * self.dt)
        b.c_nb = b.c_nb @ turn
        b.disturbance = b.disturbance * self.decay
        seen = self.seen(b, b.c_nb)
        measured = torch.cat([b.disturbance[:, :3] - b.accel[:, n], b.mag[:, n] - b.disturbance[:, 3:]], 1)
        k, b.p = self.gain(b.p, turn, seen)
        return measured - seen, k, turn

    @torch.no_grad()
    def after(self, b: Batch, z: Tensor, k: Tensor) -> None:
        """Correct the state with gain ``k``."""
        x = torch.einsum("bci,bc->bi", k, z)
        b.c_nb = b.c_nb @ self.rotation(x[:, :3])
        b.bias = b.bias + x[:, 3:6]
        b.disturbance = b.disturbance + x[:, 6:]

    @staticmethod
    def seen(b: Batch, c_nb: Tensor) -> Tensor:
        """Gravity and field in b (B,6) at attitude ``c_nb``."""
        return torch.cat([c_nb[:, 2, :] * b.gravity[:, None], torch.einsum("bij,bi->bj", c_nb, b.field_n)], 1)

    @staticmethod
    def inputs(z: Tensor, k: Tensor, bias: Tensor, disturbance: Tensor) -> Tensor:
        """(B,90), as `ahrs_lstm_kernels.gather`."""
        x = torch.einsum("bci,bc->bi", k, z)
        whole = x + torch.cat([torch.zeros_like(bias), bias, disturbance], 1)
        return torch.cat([z, whole, k.flatten(1)], 1)
