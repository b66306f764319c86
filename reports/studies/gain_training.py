"""Two ways to make a filter of what lessons show, by the same loss: a network learns, and a classical filter is tuned.

Training is truncated back-propagation through the filter: windows of lessons, the state carried on between them without its gradient.
One thread, one seed: the same numbers each time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from gain_filter import Batch, Classical, Fix, GainNetworks, follow, loss_of, plain

from testbed.base.errors import tell_user


@dataclass(frozen=True)
class Settings:
    """Of a training: passes over the lessons, lessons of a step, steps of 0.2 s of a window, and the optimiser's (Adam)."""

    epochs: int = 24
    """A hundred and twenty passes, a quarter of an hour of one core for all networks together."""
    batch: int = 20
    window: int = 50
    """Ten seconds: several times as long as a fix acts on position and velocity."""
    rate: float = 3e-3
    """At the start; it falls to zero along a cosine."""
    clip: float = 1.0
    """Largest norm of a gradient: a window with a runaway would undo all others."""


@dataclass
class Training:
    """What a training came to. ``weights`` are those of the epoch with the least loss on the validation flights."""

    seed: int
    weights: dict[str, np.ndarray]
    epoch: int = 0
    loss: float = math.inf
    """On the validation flights, of the weights in the precision in which they ship."""
    finite: bool = True
    """Whether the loss stayed a number."""

    def failed(self, untrained: float) -> bool:
        """Whether it diverged, or is worse on the validation flights than the plain filter."""
        return not self.finite or self.loss > untrained

    def note(self, epoch: int, learned: float, loss: float, weights: dict[str, np.ndarray]) -> None:
        """Keep what an epoch made, where its loss is the least so far."""
        self.finite = self.finite and math.isfinite(learned) and math.isfinite(loss)
        if self.finite and loss < self.loss:
            self.loss, self.epoch, self.weights = loss, epoch, weights


def train(
    seeds: Sequence[int],
    lessons: Batch,
    validation: Batch,
    settings: Settings,
    tell: Callable[[str], None] = tell_user,
) -> list[Training]:
    """Train a network from each seed, which draws its weights and the order of the lessons; they share passes and nothing else."""
    torch.set_num_threads(1)
    networks, rngs = GainNetworks(seeds), [np.random.default_rng(seed) for seed in seeds]
    found = [Training(seed, of_network(networks.weights(), k)) for k, seed in enumerate(seeds)]
    optimiser = torch.optim.Adam(networks.parameters(), settings.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs)
    count = len(lessons.start)
    for epoch in range(1, settings.epochs + 1):
        orders = np.stack([rng.permutation(count) for rng in rngs])
        parts = [orders[:, k : k + settings.batch] for k in range(0, count, settings.batch)]
        learned = np.mean([step(networks, optimiser, lessons, rows, settings) for rows in parts], axis=0)
        schedule.step()
        weights = networks.weights()
        losses = losses_of(GainNetworks(seeds).take(weights), validation)
        for k, training in enumerate(found):
            training.note(epoch, learned[k], losses[k], of_network(weights, k))
        tell(f"epoch {epoch}: training {np.round(learned, 3)}, validation {np.round(losses, 3)}")
    return found


def of_network(weights: dict[str, np.ndarray], k: int) -> dict[str, np.ndarray]:
    """The weights of one of several networks."""
    return {name: array[k].copy() for name, array in weights.items()}


def step(
    networks: GainNetworks, optimiser: torch.optim.Optimizer, lessons: Batch, rows: np.ndarray, settings: Settings
) -> np.ndarray:
    """Learn along lessons, ``rows`` (K,B) for each network, window by window; the mean loss (K,) of each."""
    batch = lessons.taken(torch.as_tensor(rows.ravel()))
    state, losses = None, []
    for first in range(0, len(batch.phi), settings.window):
        course = follow(batch, networks.fix, slice(first, first + settings.window), state)
        loss = loss_of(course).reshape(len(rows), -1).mean(1)
        losses.append(loss.detach().numpy())
        optimiser.zero_grad()
        loss.sum().backward()
        clip(networks, settings.clip)
        optimiser.step()
        state = tuple(tensor.detach() for tensor in course.state)
    return np.mean(losses, axis=0)


def clip(networks: GainNetworks, largest: float) -> None:
    """Shorten the gradient of each network by itself."""
    gradients = [parameter.grad for parameter in networks.parameters() if parameter.grad is not None]
    norm = torch.sqrt(sum((g.flatten(1) ** 2).sum(1) for g in gradients))
    factor = torch.clamp(largest / norm, max=1.0)
    for gradient in gradients:
        gradient *= factor.reshape(-1, *[1] * (gradient.dim() - 1))


def losses_of(networks: GainNetworks, batch: Batch) -> np.ndarray:
    """The loss (K,) of each network over whole lessons."""
    count = len(batch.start)
    with torch.no_grad():
        course = follow(batch.taken(torch.arange(count).repeat(networks.count)), networks.fix)
        return loss_of(course).reshape(networks.count, count).mean(1).numpy()


def mean_loss(batch: Batch, fix: Fix, noise: float = 1.0) -> float:
    """The loss of a filter over whole lessons."""
    with torch.no_grad():
        return float(loss_of(follow(batch, fix, noise=noise)).mean())


START = Classical(1.0, 1.0, 1.0, 16.27)
"""The data sheet, and a gate that one good fix in a thousand does not pass (chi-square, three degrees of freedom)."""
WIDEST_GATE = 60.0
"""Of a good fix one in 10^12 is beyond: no gate at all, and still a probability that a float can tell from 1."""


def tune(lessons: Batch, evaluations: int, tell: Callable[[str], None] = tell_user) -> tuple[Classical, float, int]:
    """The classical filter with the least loss on the lessons: Nelder and Mead's simplex over the logarithms of its four numbers.

    Nelder & Mead, *Computer Journal* 7 (1965). Returns it with its loss and the number of evaluations.
    """
    from scipy.optimize import minimize

    torch.set_num_threads(1)

    def of(x: np.ndarray) -> Classical:
        position, velocity, noise, gate = np.exp(x).tolist()
        return Classical(position, velocity, noise, min(gate, WIDEST_GATE))

    def loss(x: np.ndarray) -> float:
        tried = of(x)
        value = mean_loss(lessons, tried.fix, tried.noise)
        tell(f"{', '.join(f'{v:.3g}' for v in tried)}: {value:.4f}")
        return value if math.isfinite(value) else 1e6

    first = np.log(START)
    corners = np.vstack([first, first + 0.7 * np.eye(len(first))])  # a factor of two each way
    options = {"maxfev": evaluations, "xatol": 0.02, "fatol": 1e-3, "initial_simplex": corners}
    found = minimize(loss, first, method="Nelder-Mead", options=options)
    return of(found.x), float(found.fun), int(found.nfev)


def untrained_loss(batch: Batch) -> float:
    """The loss of `indirect-kf`."""
    return mean_loss(batch, plain)
