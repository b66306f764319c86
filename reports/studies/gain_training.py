"""Two ways to make a filter of what lessons show, by the same loss: a network learns, and a classical filter is tuned.

Training is truncated back-propagation through the filter: windows of lessons, the state carried on between them without its gradient.
One thread, one seed: the same numbers each time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from gain_filter import Batch, Classical, Fix, GainNetwork, follow, loss_of, plain

from testbed.base.errors import tell_user

PARTS = 20
"""Lessons that a filter is led over at once: more cost memory and are no faster on one core."""


@dataclass(frozen=True)
class Settings:
    """Of a training: passes over the lessons, lessons of a step, steps of 0.2 s of a window, and the optimiser's (Adam)."""

    epochs: int = 20
    batch: int = PARTS
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
    seconds: float = 0.0
    """Of one core."""
    curve: list[dict[str, float]] = field(default_factory=list)

    def failed(self, untrained: float) -> bool:
        """Whether it diverged, or is worse on the validation flights than the plain filter."""
        return not self.finite or self.loss > untrained


def train(seed: int, lessons: Batch, validation: Batch, settings: Settings, tell: Any = tell_user) -> Training:
    """Train a network from ``seed``, which draws its weights and the order of the lessons."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    rng, started = np.random.default_rng(seed), time.process_time()
    network = GainNetwork()
    found = Training(seed, network.weights())
    optimiser = torch.optim.Adam(network.parameters(), settings.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs)
    for epoch in range(1, settings.epochs + 1):
        order = rng.permutation(len(lessons.start))
        learned = [
            step(network, optimiser, lessons.taken(torch.as_tensor(rows)), settings)
            for rows in np.array_split(order, max(1, len(order) // settings.batch))
        ]
        schedule.step()
        loss = mean_loss(validation, GainNetwork().take(network.weights()).fix)
        found.curve.append({"epoch": epoch, "training": float(np.mean(learned)), "validation": loss})
        tell(f"network {seed}, epoch {epoch}: training {np.mean(learned):.3f}, validation {loss:.3f}")
        if not math.isfinite(loss) or not np.isfinite(learned).all():
            found.finite = False
            break
        if loss < found.loss:
            found.loss, found.epoch, found.weights = loss, epoch, network.weights()
    found.seconds = time.process_time() - started
    return found


def step(network: GainNetwork, optimiser: torch.optim.Optimizer, batch: Batch, settings: Settings) -> float:
    """Learn along some lessons, window by window; their mean loss. Stops where the loss is no number."""
    state, losses = None, []
    for span in windows(len(batch.phi), settings.window):
        course = follow(batch, network.fix, span, state)
        loss = loss_of(course)
        losses.append(float(loss))
        if not math.isfinite(losses[-1]):
            break
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), settings.clip)
        optimiser.step()
        state = tuple(tensor.detach() for tensor in course.state)
    return float(np.mean(losses))


def windows(steps: int, length: int) -> Iterator[slice]:
    """All steps, in parts of at most ``length``."""
    for first in range(0, steps, length):
        yield slice(first, min(first + length, steps))


def mean_loss(batch: Batch, fix: Fix, noise: float = 1.0) -> float:
    """The loss of a filter over whole lessons."""
    parts = []
    with torch.no_grad():
        for rows in torch.split(torch.arange(len(batch.start)), PARTS):
            parts.append(len(rows) * float(loss_of(follow(batch.taken(rows), fix, noise=noise))))
    return float(np.sum(parts)) / len(batch.start)


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
