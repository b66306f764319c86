"""Six NARX networks that learn how a free-running navigation solution drifts: inputs, training, closed loop, statistics.

Source: the NARX thesis (2021). One network per target; a `Drift` is one re-set of the free copy. Targets are metres north,
east, down and m/s north, east, down; angles in rad; time in seconds since the re-set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from estimators.learning.networks.levenberg_marquardt import Training
from estimators.learning.networks.mlp import Array, load_networks, save_networks
from estimators.learning.networks.narx import Narx, train_narx
from testbed.base.errors import InputError, nearest
from testbed.base.streams import stable_hash

TARGETS = ("north", "east", "down", "v_north", "v_east", "v_down")
CANDIDATES = ("lat", "lon", "h", "v_north", "v_east", "v_down", "roll", "pitch", "yaw", "t")
"""The thesis's candidate inputs: the free copy's solution (position in metres about the start) and the time."""
SINCE_RESET = ("d_north", "d_east", "d_down", "d_v_north", "d_v_east", "d_v_down", "turned")
"""Beyond the thesis: changes since the re-set, which mean the same anywhere on the map; ``turned`` is the yaw angle."""
INPUTS = CANDIDATES + SINCE_RESET
P_DP = (("lat", "t"), ("lon", "t"), ("h", "t"), ("v_north", "t"), ("v_east", "t"), ("v_down", "t"))
"""The P-dP and V-dV networks: each sees its own channel and the time."""


@dataclass(frozen=True)
class Drift:
    """One run of the free copy. Row 0 is the re-set: ``t`` (E,) seconds since it, ``u`` (E,17) as `INPUTS`, ``y`` (E,6).

    ``y`` is what was missing to the solution, NaN where nobody knows it.
    """

    t: Array
    u: Array
    y: Array
    variance: Array
    """(E,6): what the free copy's covariance says of ``y``; NaN where it was not computed."""

    @classmethod
    def of(cls, t: Array, states: Array, y: Array, variance: Array) -> Drift:
        """From the free copy's ``states`` (E,15) at times ``t`` (E,) since the re-set."""
        yaw = np.unwrap(states[:, 8])
        u = np.column_stack([states[:, :9], t, states[:, :6] - states[0, :6], yaw - yaw[0]])
        return cls(t, u, y, variance)

    def columns(self, names: Sequence[str]) -> Array:
        """Inputs by name."""
        return self.u[:, [INPUTS.index(name) for name in names]]

    def sequence(self, target: int, names: Sequence[str], lead: int) -> tuple[Array, Array]:
        """(u, y) with ``lead`` rows of rest before the re-set, so that the lags reach back to something."""
        u, y = self.columns(names), self.y[:, target].copy()
        y[0] = 0.0
        return np.vstack([np.repeat(u[:1], lead, axis=0), u]), np.concatenate([np.zeros(lead), y])


@dataclass(frozen=True)
class Structure:
    """Which inputs each network sees, and how its memory and core are built."""

    inputs: tuple[tuple[str, ...], ...]
    lags: tuple[tuple[int, int], ...]
    """Output and input lags of each network."""
    neurons: int = 8
    seed: int = 0

    def __post_init__(self) -> None:
        for name in {name for names in self.inputs for name in names}:
            if name not in INPUTS:
                raise InputError(f"NARX: no input '{name}'; {nearest(name, INPUTS)}")


@dataclass(frozen=True)
class DriftNetworks:
    """Six trained networks, or none yet, and what simulated outages say of their errors.

    ``mean`` and ``std`` (6,) of (target - network); ``growth`` is how much larger the squared drift was than the filter's
    covariance said: 1 where the free copy has no covariance.
    """

    structure: Structure
    networks: tuple[Narx, ...] = ()
    mean: Array = field(default_factory=lambda: np.zeros(6))
    std: Array = field(default_factory=lambda: np.full(6, np.inf))
    growth: float = 1.0

    def train(self, drifts: Sequence[Drift], how: Training) -> DriftNetworks:
        """All six trained on, or from new, on the one-step predictions of these drifts."""
        trained = []
        for k, (names, (ny, nu)) in enumerate(zip(self.structure.inputs, self.structure.lags, strict=True)):
            sequences = [drift.sequence(k, names, max(ny, nu)) for drift in drifts]
            seed = stable_hash(f"{self.structure.seed} {TARGETS[k]}") % 2**32
            start = self.networks[k] if self.networks else None
            trained.append(train_narx(sequences, ny, nu, self.structure.neurons, seed, how, start)[0])
        return replace(self, networks=tuple(trained))

    def closed_loop(self, drift: Drift) -> tuple[Array, int]:
        """Outputs (E,6) over a drift from its inputs alone, and how many the guard limited. Row 0, the re-set, is zero."""
        out, limited = np.zeros((len(drift.t), 6)), 0
        if self.networks and len(drift.t) > 1:
            for k, (names, narx) in enumerate(zip(self.structure.inputs, self.networks, strict=True)):
                u = drift.columns(names)
                lagged = np.vstack([np.repeat(u[:1], max(narx.input_lags - 1, 0), axis=0), u[narx.input_lags == 0 :]])
                out[1:, k], count = narx.closed_loop(lagged, np.zeros(max(narx.output_lags, 1)))
                limited += count
        return out, limited

    def with_statistics(self, drifts: Sequence[Drift]) -> DriftNetworks:
        """The statistics of these simulated outages."""
        errors = np.vstack([(drift.y - self.closed_loop(drift)[0])[1:] for drift in drifts])
        growth = float(np.mean([drift.y[-1] ** 2 / drift.variance[-1] for drift in drifts]))
        growth = growth if np.isfinite(growth) else 1.0
        return replace(self, mean=errors.mean(axis=0), std=errors.std(axis=0), growth=growth)

    def save(self, path: Path, meta: dict[str, Any]) -> None:
        """Write safetensors."""
        parts = {target: narx.network for target, narx in zip(TARGETS, self.networks, strict=True)}
        own = {
            "inputs": self.structure.inputs,
            "lags": self.structure.lags,
            "neurons": self.structure.neurons,
            "seed": self.structure.seed,
            "mean": self.mean.tolist(),
            "std": self.std.tolist(),
            "growth": self.growth,
        }
        save_networks(path, parts, {"drift": own} | meta)

    @classmethod
    def load(cls, path: Path) -> tuple[DriftNetworks, dict[str, Any]]:
        """Read what `save` wrote, and its meta. Raises InputError for a file of something else."""
        parts, meta = load_networks(path)
        try:
            own = meta["drift"]
            inputs = tuple(tuple(names) for names in own["inputs"])
            lags = tuple((int(ny), int(nu)) for ny, nu in own["lags"])
            networks = tuple(Narx(parts[name], ny, nu) for name, (ny, nu) in zip(TARGETS, lags, strict=True))
            structure = Structure(inputs, lags, own["neurons"], own["seed"])
            mean, std = (np.array(own[key], dtype=float).reshape(6) for key in ("mean", "std"))
            return cls(structure, networks, mean, std, float(own["growth"])), meta
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: holds networks, but not the six of a drift ({error!r})") from None


def select_inputs(
    drifts: Sequence[Drift], count: int, candidates: Sequence[str] = CANDIDATES
) -> tuple[tuple[str, ...], ...]:
    """The ``count`` best inputs of each target by MRMR with the thesis's score."""
    return tuple(tuple(r.name for r in ranking[:count]) for ranking in rankings(drifts, candidates).values())


def rankings(drifts: Sequence[Drift], candidates: Sequence[str] = CANDIDATES) -> dict[str, Any]:
    """MRMR ranking of the candidates for each target."""
    from testbed.features import rank_mrmr

    u = np.vstack([drift.columns(candidates) for drift in drifts])
    y = np.vstack([drift.y for drift in drifts])
    return {target: rank_mrmr(u, y[:, k], candidates, method="all") for k, target in enumerate(TARGETS)}


def select_lags(drifts: Sequence[Drift], inputs: Sequence[Sequence[str]], most: int = 4) -> tuple[tuple[int, int], ...]:
    """For each target the order at which its Lipschitz curve flattens, for outputs and inputs alike."""
    orders = [curve.order() for curve in lag_curves(drifts, inputs, most).values()]
    return tuple((order, order) for order in orders)


def lag_curves(drifts: Sequence[Drift], inputs: Sequence[Sequence[str]], most: int = 4) -> dict[str, Any]:
    """Lipschitz curve of each target with its chosen inputs."""
    from testbed.features import lag_curve

    out = {}
    for k, (target, names) in enumerate(zip(TARGETS, inputs, strict=True)):
        u = np.vstack([drift.columns(names) for drift in drifts])
        y = np.concatenate([drift.y[:, k] for drift in drifts])
        out[target] = lag_curve(u, y, most, present_input=True)
    return out
