"""Kernels of `ahrs-lstm`: the network step in float32, and two hooks of `ahrs_kernels.AttitudeFilter` that change its gain.

`NetworkGain` is the estimator; `TaughtGain` is what flies while lessons are written down.

Network: 90 inputs, each as asinh((input - centre) / unit), linear layer with activation, LSTM layers (gates i, f, g, o;
logistic gates, tanh cell, the convention of torch), linear layer to 72: the logarithm of what each element of the gain is
multiplied by. Matrices are (inputs, outputs), so that inner loops run over contiguous outputs. The network steps once in
``every`` samples, on the mean of its inputs since; in between its answer stands.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.core.recording import keeper
from estimators.methods.ahrs_kernels import (
    Array,
    Figures,
    Work,
    carry,
    gain_hook,
    gyro_turn,
    inflate,
    kalman_gain,
    make_work,
    weigh,
)
from testbed.kernels import njit

Single = NDArray[np.float32]

INPUTS = 90
LIMIT = 5.0
"""A gain changes by exp(5) = 148 times at most, in training and here alike; a network may set a lower limit to its growth."""


class NetworkGain(NamedTuple):
    """The gain is K exp(network(z, x, K)), by elements. The covariance follows the filter's own K."""

    network: tuple[Any, ...]
    """The fields of `ahrs_weights.Network`."""
    memory: tuple[Single, Single]
    """Output and cell of the LSTM layers, (L,H) each; overwritten."""
    work: tuple[Single, ...]
    """See `work_space`."""
    inputs: Array
    """(90,) mean since the last step of the network, overwritten."""
    out: Single
    """(72,) its last answer, overwritten."""
    every: int
    """Samples between two steps."""
    growth: float
    """The largest logarithm of a change."""
    change: Array
    """(1,) see `ahrs_kernels.OwnGain`."""


class TaughtGain(NamedTuple):
    """A network's gain, or a teacher's, and what the teacher's would be."""

    learner: NetworkGain
    figures: Figures
    """Of the teacher, whose covariance follows its own gain."""
    p: Array
    """(12,12) that covariance, overwritten."""
    told: Array
    """(N,3), (m/s²)²: what the teacher knows of the variance of linear acceleration beyond that."""
    flies: bool
    """Whether its gain is the one that corrects."""
    work: Work
    mean: Array
    """(6,12) of its gain since the last step of the network, overwritten."""


class LessonRows(NamedTuple):
    """What a lesson keeps, one row per step of the network."""

    rows: Single
    """(M,162): 90 inputs, 72 of the teacher's gain, both the mean over the step."""
    every: int


def make_network_gain(network: tuple[Any, ...], every: int, growth: float = LIMIT) -> NetworkGain:
    """A network that has seen nothing yet."""
    layers, width = len(network[5]), len(network[3])
    memory = np.zeros((layers, width), np.float32), np.zeros((layers, width), np.float32)
    return NetworkGain(
        tuple(network),
        memory,
        work_space(width),
        np.zeros(INPUTS),
        np.zeros(72, np.float32),
        every,
        growth,
        np.zeros(1),
    )


def make_taught_gain(learner: NetworkGain, figures: Figures, p: Array, told: Array, flies: bool) -> TaughtGain:
    """A teacher that starts with the covariance ``p`` (12,12), overwritten."""
    return TaughtGain(learner, figures, p, told, flies, make_work(), np.zeros((6, 12)))


@njit(cache=True, nogil=True, _nrt=False)
def affine(w, b, x, out):
    """out = b + x w, four inputs at a time."""
    n, m = len(out), len(x)
    for j in range(n):
        out[j] = b[j]
    for i in range(0, m - 3, 4):
        x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
        w0, w1, w2, w3 = w[i], w[i + 1], w[i + 2], w[i + 3]
        for j in range(n):
            out[j] += x0 * w0[j] + x1 * w1[j] + x2 * w2[j] + x3 * w3[j]
    for i in range(m - m % 4, m):
        f, row = x[i], w[i]
        for j in range(n):
            out[j] += f * row[j]


@njit(cache=True, nogil=True, _nrt=False)
def logistic(x):
    """1 / (1 + exp(-x)) in float32."""
    return np.float32(1.0) / (np.float32(1.0) + np.exp(-x))


@njit(cache=True, nogil=True, _nrt=False)
def lstm_layer(w, b, x, h, c, joined, gates):
    """One step: ``h`` and ``c`` (H,) are overwritten. ``joined`` and ``gates`` are work space."""
    n, m = len(h), len(x)
    for i in range(m):
        joined[i] = x[i]
    for i in range(n):
        joined[m + i] = h[i]
    affine(w, b, joined[: m + n], gates)
    for j in range(n):
        cell = logistic(gates[n + j]) * c[j] + logistic(gates[j]) * np.tanh(gates[2 * n + j])
        c[j] = cell
        h[j] = logistic(gates[3 * n + j]) * np.tanh(cell)


@njit(cache=True, nogil=True, _nrt=False)
def network_step(inputs, network, h, c, work, out):
    """Output (72,) of one time step; the memory ``h``, ``c`` (L,H) goes on. ``work``: x (90), hidden, joined, gates."""
    centre, inverse_unit, w_in, b_in, curved, w_lstm, b_lstm, w_out, b_out = network
    x, hidden, joined, gates = work
    for i in range(INPUTS):
        x[i] = np.arcsinh((np.float32(inputs[i]) - centre[i]) * inverse_unit[i])
    affine(w_in, b_in, x, hidden)
    if curved:
        for j in range(len(hidden)):
            hidden[j] = logistic(hidden[j])
    for layer in range(len(h)):
        lstm_layer(
            w_lstm[layer], b_lstm[layer], hidden if layer == 0 else h[layer - 1], h[layer], c[layer], joined, gates
        )
    affine(w_out, b_out, h[len(h) - 1], out)


def work_space(width: int) -> tuple[Single, ...]:
    """The arrays that `network_step` works in."""
    return (
        np.zeros(INPUTS, np.float32),
        np.zeros(width, np.float32),
        np.zeros(2 * width, np.float32),
        np.zeros(4 * width, np.float32),
    )


@njit(cache=True, nogil=True, _nrt=False)
def gather(z, x, state, k, share, inputs):
    """Add to the 90 inputs: z (6), x (12): the KF's attitude correction and its bias and disturbance estimates, K (72)."""
    for i in range(6):
        inputs[i] += share * z[i]
    for i in range(3):
        inputs[6 + i] += share * x[i]
    for i in range(9):
        inputs[9 + i] += share * (state[4 + i] + x[3 + i])
    for c in range(6):
        for i in range(12):
            inputs[18 + 12 * c + i] += share * k[c, i]


@njit(cache=True, nogil=True, _nrt=False)
def multiply_gain(k, out, growth):
    """Apply the network's answer to the gain; returns the root mean square of the logarithm of the change."""
    total = 0.0
    for c in range(6):
        for i in range(12):
            change = min(growth, max(-LIMIT, np.float64(out[12 * c + i])))
            total += change * change
            k[c, i] *= np.exp(change)
    return np.sqrt(total / 72.0)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def ask_network(learner, model, k):
    """Show the network the filter's own step; it answers once in ``every`` samples."""
    work, inputs = model.work, learner.inputs
    if k % learner.every == 0:
        for i in range(INPUTS):
            inputs[i] = 0.0
    weigh(work.k, work.z, work.x)
    gather(work.z, work.x, model.state, work.k, 1.0 / learner.every, inputs)
    if (k + 1) % learner.every == 0:
        network_step(inputs, learner.network, learner.memory[0], learner.memory[1], learner.work, learner.out)


def _correct_gain(gain, model, k):
    ask_network(gain, model, k)
    gain.change[0] = multiply_gain(model.work.k, gain.out, gain.growth)


def _teach(gain, model, k):
    samples, taught, figures = model.samples, gain.work, gain.figures
    for i in range(6):
        taught.seen[i] = model.work.seen[i]
    carry(gain.p, gyro_turn(model.state, samples.gyro[k], figures), figures)
    inflate(gain.p, samples.gyro[k], samples.accel[k], model.state, figures, taught)
    for i in range(3):
        gain.p[6 + i, 6 + i] += (1.0 - figures.accel_decay**2) * gain.told[k, i]
    kalman_gain(gain.p, samples.mag_row[k] >= 0, figures, taught, taught.k)
    ask_network(gain.learner, model, k)
    first = k % gain.learner.every == 0
    for c in range(6):
        for i in range(12):
            before = 0.0 if first else gain.mean[c, i]
            gain.mean[c, i] = before + taught.k[c, i] / gain.learner.every
            if gain.flies:
                model.work.k[c, i] = taught.k[c, i]
    if not gain.flies:
        multiply_gain(model.work.k, gain.learner.out, gain.learner.growth)


def _write_row(keep, model, k):
    if (k + 1) % keep.every == 0:
        row, gain = keep.rows[k // keep.every], model.gain
        for i in range(INPUTS):
            row[i] = gain.learner.inputs[i]
        for i in range(72):
            row[INPUTS + i] = gain.mean[i // 12, i % 12]


gain_hook(NetworkGain, _correct_gain)
gain_hook(TaughtGain, _teach)
keeper(LessonRows, None, _write_row)
