"""A Kalman filter on lessons in torch, many side by side: plain, classically tuned, or with a network that weighs its fixes.

What a filter does at a fix is a function ``fix(e, p, z, r, memory)`` of the predicted errors (B,15), their covariance (B,15,15), the fix
(B,6) as `gain_lessons.Lesson` has it, its variances (B,6) and what the function keeps, which is None at the start; it returns the
first two after the fix, and the memory. Errors are estimate minus truth; SI units, double precision.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from gain_lessons import UNSEEN, Lesson
from gain_plugin import plugin
from torch import Tensor, nn

gain_gru = plugin()
Fix = Callable[[Tensor, Tensor, Tensor, Tensor, Any], tuple[Tensor, Tensor, Any]]
SCORED = 9
"""Position, velocity and attitude: what of the states a user asks for."""
CEILING = 40.0
"""Squares of errors over their covariance beyond this count by their logarithm: with nine degrees of freedom a right covariance is
so wrong once in 10^5 steps, and a few that are far off should not outshout all others."""
JITTER = 1e-9
"""Added to the unit diagonal of a correlation matrix: rounding of 1e-12 of a state known a thousand times better than it began."""


class Batch(NamedTuple):
    """Lessons side by side: arrays of `Lesson` as tensors, steps before lessons."""

    phi: Tensor
    q: Tensor
    own: Tensor
    fix: Tensor
    r: Tensor
    start: Tensor
    p0: Tensor

    def taken(self, rows: Any) -> Batch:
        """Some of the lessons."""
        return Batch(*(getattr(self, key)[:, rows] for key in self._fields[:5]), self.start[rows], self.p0[rows])


def batch_of(lessons: Sequence[Lesson], steps: int | None = None) -> Batch:
    """Lessons of one length, or their first ``steps``."""
    series = [np.stack([getattr(each, key)[:steps] for each in lessons], axis=1) for key in Lesson._fields[:5]]
    single = [np.stack([getattr(each, key) for each in lessons]) for key in Lesson._fields[5:]]
    return Batch(*(torch.as_tensor(array, dtype=torch.float64) for array in (*series, *single)))


class Course(NamedTuple):
    """What a filter says before each fix: errors (n,B,15) and covariances (n,B,15,15); and the state that goes on from there."""

    e: Tensor
    p: Tensor
    state: tuple[Tensor, Tensor, Any]


def follow(batch: Batch, fix: Fix, span: slice = slice(None), state: Any = None, noise: float = 1.0) -> Course:
    """Lead filters over the steps of ``span``, from ``state`` or the lessons' start; ``noise`` multiplies the root of Q."""
    e, p, memory = (batch.start, batch.p0, None) if state is None else state
    es, ps = [], []
    steps = zip(*(getattr(batch, key)[span] for key in batch._fields[:5]), strict=True)
    for phi, q, own, z, r in steps:
        e = (phi @ e[..., None])[..., 0] + own
        p = phi @ p @ phi.transpose(1, 2) + noise**2 * q
        es.append(e)
        ps.append(p)
        e, p, memory = fix(e, p, z, r, memory)
    return Course(torch.stack(es), torch.stack(ps), (e, p, memory))


def corrected(e: Tensor, p: Tensor, z: Tensor, r: Tensor, rows: slice = slice(0, 6)) -> tuple[Tensor, Tensor]:
    """The Kalman update of states ``rows`` by their own measurements ``z`` (B,m) with variances ``r`` (B,m)."""
    reach = p[:, rows]
    gain = torch.linalg.solve_ex(reach[:, :, rows] + torch.diag_embed(r), reach)[0].transpose(1, 2)
    e = e + (gain @ (z - e[:, rows])[..., None])[..., 0]
    p = p - gain @ reach
    return e, 0.5 * (p + p.transpose(1, 2))


def plain(e: Tensor, p: Tensor, z: Tensor, r: Tensor, memory: Any) -> tuple[Tensor, Tensor, Any]:
    """The fix as it is stated: `indirect-kf`."""
    return *corrected(e, p, z, r), memory


def loss_of(course: Course) -> Tensor:
    """(B,) mean over the steps of the negative log likelihood of the true errors of position, velocity and attitude, less its constant.

    Normalised by the told sigmas, so that metres and radians may stand in one Cholesky factor. Robust beyond `CEILING`. NaN where a
    covariance is none any more.
    """
    p, x = course.p[..., :SCORED, :SCORED], course.e[..., :SCORED]
    sigma = torch.diagonal(p, dim1=-2, dim2=-1).sqrt()
    correlation = p / (sigma[..., :, None] * sigma[..., None, :]) + JITTER * torch.eye(SCORED, dtype=p.dtype)
    factor, failed = torch.linalg.cholesky_ex(correlation)
    white = torch.linalg.solve_triangular(factor, (x / sigma)[..., None], upper=False)[..., 0]
    square = (white**2).sum(-1)
    square = torch.where(square > CEILING, CEILING * (1.0 + torch.log(square.clamp(min=CEILING) / CEILING)), square)
    spread = torch.log(torch.diagonal(factor, dim1=-2, dim2=-1)).sum(-1) + torch.log(sigma).sum(-1)
    return torch.where(failed == 0, 0.5 * square + spread, torch.nan).mean(0)


class GainNetworks(nn.Module):
    """Networks of ``gain_gru.py`` in torch, K side by side: what costs on one core is the number of operations, not their size.

    Parameters are those of `gain_gru.SHAPES` with the network as first axis. Each starts from its own seed as the plain filter, P
    growing by 1e-4 at a fix. In a batch the lessons of the first network come first, then those of the second.
    """

    def __init__(self, seeds: Sequence[int]) -> None:
        super().__init__()
        self.count = len(seeds)
        drawn: dict[str, list[Tensor]] = {name: [] for name in gain_gru.SHAPES}
        for seed in seeds:
            generator = torch.Generator().manual_seed(seed)
            for name, shape in gain_gru.SHAPES.items():
                uniform = torch.rand(shape, generator=generator, dtype=torch.float64) * 2.0 - 1.0
                drawn[name].append(uniform / gain_gru.HIDDEN**0.5 * (0.0 if name.endswith("out") else 1.0))
        for name, tensors in drawn.items():
            setattr(self, name, nn.Parameter(torch.stack(tensors)))
        with torch.no_grad():
            self.bias_out[:, 2] = -6.0

    def fix(self, e: Tensor, p: Tensor, z: Tensor, r: Tensor, memory: Any) -> tuple[Tensor, Tensor, Any]:
        """The update as the policy makes it: variances and P scaled, then the filter's own."""
        seen = r[:, 0] < UNSEEN
        if memory is None:
            memory = r.new_zeros(self.count, gain_gru.AXES * len(r) // self.count, gain_gru.HIDDEN)
        factor, fading, after = self.judge(z - e[:, :6], torch.diagonal(p, dim1=1, dim2=2)[:, :6] + r, r, memory)
        kept = seen.repeat_interleave(gain_gru.AXES).reshape(self.count, -1, 1)
        fading = torch.where(seen, fading, torch.ones_like(fading))
        return *corrected(e, p * fading[:, None, None], z, r * factor), torch.where(kept, after, memory)

    def judge(self, residual: Tensor, s: Tensor, r: Tensor, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Factors of the variances (K B,6), factor of P (K B,), and the memory (K,3 B,12); ``s`` (K B,6) is the diagonal of H P H' + R."""
        axes = gain_gru.AXES
        u = residual / torch.sqrt(s)
        large, more = torch.log1p(u * u), torch.log(s / r)
        mean = large.mean(1, keepdim=True).expand(-1, axes)
        down = torch.zeros_like(mean)
        down[:, 2] = 1.0
        parts = [part for of in (torch.asinh(u), large, more) for part in (of[:, :axes], of[:, axes:])]
        x = torch.stack([*parts, mean, down], -1).reshape(self.count, -1, gain_gru.INPUTS)
        memory = self.recur(x, memory)
        out = torch.baddbmm(self.bias_out[:, None], memory, self.weight_out.transpose(1, 2)).reshape(-1, axes, 3)
        scale = torch.clamp(out[..., :2], gain_gru.LOWEST, gain_gru.HIGHEST).exp()
        fading = torch.clamp(out[..., 2].mean(1), gain_gru.FADING_LOWEST, gain_gru.FADING_HIGHEST).exp()
        return torch.cat([scale[..., 0], scale[..., 1]], 1), 1.0 + gain_gru.FADING * fading, memory

    def recur(self, x: Tensor, memory: Tensor) -> Tensor:
        """`torch.nn.GRUCell` of each network."""
        read = torch.baddbmm(self.bias_ih[:, None], x, self.weight_ih.transpose(1, 2)).chunk(3, dim=2)
        held = torch.baddbmm(self.bias_hh[:, None], memory, self.weight_hh.transpose(1, 2)).chunk(3, dim=2)
        reset, update = torch.sigmoid(read[0] + held[0]), torch.sigmoid(read[1] + held[1])
        new = torch.tanh(read[2] + reset * held[2])
        return new + update * (memory - new)

    def weights(self) -> dict[str, np.ndarray]:
        """In single precision, the network as first axis."""
        return {name: getattr(self, name).detach().numpy().astype(np.float32) for name in gain_gru.SHAPES}

    def take(self, weights: dict[str, np.ndarray]) -> GainNetworks:
        """Use these weights, which are of as many networks."""
        with torch.no_grad():
            for name in gain_gru.SHAPES:
                getattr(self, name).copy_(torch.as_tensor(weights[name].astype(np.float64)))
        return self


class Classical(NamedTuple):
    """A filter of known kind: factors on sigmas of position and velocity fixes and on the roots of Q, and a gate.

    ``gate``: the innovation of position, and then that of velocity, is refused where its normalised square passes this.
    """

    position: float
    velocity: float
    noise: float
    gate: float

    def fix(self, e: Tensor, p: Tensor, z: Tensor, r: Tensor, memory: Any) -> tuple[Tensor, Tensor, Any]:
        """Position first, then velocity, each by its gate, as `eskf` takes two aidings of one time."""
        for rows, scale in ((slice(0, 3), self.position), (slice(3, 6), self.velocity)):
            variances = scale**2 * r[:, rows]
            residual = z[:, rows] - e[:, rows]
            s = p[:, rows, rows] + torch.diag_embed(variances)
            square = (residual * torch.linalg.solve(s, residual[..., None])[..., 0]).sum(-1)
            passed = torch.where((square < self.gate)[:, None], variances, torch.full_like(variances, UNSEEN))
            e, p = corrected(e, p, z[:, rows], passed, rows)
        return e, p, memory
