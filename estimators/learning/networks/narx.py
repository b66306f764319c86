"""NARX: y(t) = f(y(t-1)..y(t-ny), u(t), u(t-1)..u(t-nu)) with a feed-forward core.

Trained in open loop (series-parallel: measured outputs as inputs), used in closed loop (parallel: its own outputs).
Source: Chen, Billings & Grant (1990), *Non-linear system identification using neural networks*, Int. J. Control 51(6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from estimators.learning.networks.levenberg_marquardt import Trained, Training
from estimators.learning.networks.levenberg_marquardt import train as train_mlp
from estimators.learning.networks.mlp import Array, Mlp, load_networks, new_mlp, save_networks
from testbed.base.errors import InputError


@dataclass(frozen=True)
class Narx:
    """A network with its lags. ``guard``: in closed loop an output stays within the range of the training targets
    widened by this factor about its centre; what the limit changes is counted."""

    network: Mlp
    output_lags: int
    input_lags: int
    guard: float = 2.0

    @property
    def lead(self) -> int:
        """Rows that must precede the first output."""
        return max(self.output_lags, self.input_lags)

    def open_loop(self, u: Array, y: Array) -> Array:
        """One-step predictions (N-lead,) of y[lead:] from the measured ``u`` (N,m) and ``y`` (N,)."""
        return self.network.predict(lagged(u, y, self.output_lags, self.input_lags)[0])

    def closed_loop(self, u: Array, history: Array) -> tuple[Array, int]:
        """Outputs of the network on its own, and how many of them the guard limited.

        ``u`` (input_lags + N, m) holds the inputs of the N outputs with the ``input_lags`` rows before them;
        ``history`` (>= output_lags,) the last known outputs before the first one, oldest first.
        """
        from estimators.learning.networks import mlp_kernels

        ny, nu, net = self.output_lags, self.input_lags, self.network
        u = np.asarray(u, dtype=float)
        u = u[:, None] if u.ndim == 1 else u
        if len(history) < ny or len(u) < nu or (nu + 1) * u.shape[1] + ny != net.inputs:
            raise InputError(
                f"NARX with lags ({ny}, {nu}) cannot run on inputs {u.shape} and {len(history)} past outputs"
            )
        channels = slice(ny, ny + u.shape[1])
        inputs = np.ascontiguousarray((u - net.input_centre[channels]) / net.input_span[channels])
        past = net.normalise_outputs(np.asarray(history, dtype=float)[len(history) - ny :])
        y, clipped = mlp_kernels.closed_loop(net.weights, net.neurons, inputs, past, ny, nu, -self.guard, self.guard)
        return net.restore_outputs(y), clipped

    def save(self, path: str | Path, meta: dict[str, Any] | None = None) -> None:
        """Write safetensors."""
        lags = {"output_lags": self.output_lags, "input_lags": self.input_lags, "guard": self.guard}
        save_networks(path, {"narx": self.network}, {"narx": lags} | (meta or {}))

    @classmethod
    def load(cls, path: str | Path) -> Narx:
        """Read what `save` wrote."""
        networks, meta = load_networks(path)
        if "narx" not in meta or "narx" not in networks:
            raise InputError(f"{path}: holds networks without lags, expected a NARX network")
        return cls(networks["narx"], **meta["narx"])


def lagged(u: Array, y: Array, output_lags: int, input_lags: int) -> tuple[Array, Array]:
    """Input rows (N-lead, ny + (nu+1) m) and targets (N-lead,) of one unbroken sequence ``u`` (N,m), ``y`` (N,).

    Row for y(t): y(t-1)..y(t-ny), then the m inputs at t, at t-1, .. t-nu.
    """
    u, y = np.asarray(u, dtype=float), np.asarray(y, dtype=float)
    u = u[:, None] if u.ndim == 1 else u
    if len(u) != len(y) or output_lags < 0 or input_lags < 0:
        raise InputError(f"NARX: {len(u)} inputs, {len(y)} outputs, lags ({output_lags}, {input_lags})")
    lead, count = max(output_lags, input_lags), len(y)
    past = [y[lead - i : count - i, None] for i in range(1, output_lags + 1)]
    drive = [u[lead - i : count - i] for i in range(input_lags + 1)]
    return np.hstack(past + drive), y[lead:]


def train_narx(
    sequences: Sequence[tuple[Array, Array]],
    output_lags: int,
    input_lags: int,
    neurons: int = 11,
    seed: int = 0,
    how: Training | None = None,
    start: Narx | None = None,
    guard: float = 2.0,
) -> tuple[Narx, Trained]:
    """Train in open loop on (u, y) sequences; lags never reach from one sequence into another. ``start``: train on.

    A sequence is a group of rows in the sense of ``how.whole_groups``.
    """
    rows = [lagged(u, y, output_lags, input_lags) for u, y in sequences]
    x, target = np.vstack([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
    network = start.network if start else _tied(new_mlp(x, target, neurons, seed), output_lags, input_lags)
    groups = np.repeat(np.arange(len(rows)), [len(r[1]) for r in rows])
    result = train_mlp(x, target, neurons, seed, how, network, groups)
    return Narx(result.network, output_lags, input_lags, start.guard if start else guard), result


def _tied(network: Mlp, output_lags: int, input_lags: int) -> Mlp:
    """One scale per signal whatever its lag: past outputs take that of the target, past inputs that of u(t)."""
    channels = slice(output_lags, output_lags + (network.inputs - output_lags) // (input_lags + 1))
    centre, span = (
        np.concatenate([np.full(output_lags, scale), np.tile(values[channels], input_lags + 1)])
        for scale, values in zip(network.output_scaling, (network.input_centre, network.input_span), strict=True)
    )
    return replace(network, input_centre=centre, input_span=span)
