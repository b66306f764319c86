"""Kernels of `ahrs-lstm`: the network step in float32 and the filter loop whose gain it corrects.

Network: normalise 90 inputs, linear layer with activation, LSTM layers (gates i, f, g, o; logistic gates, tanh cell, the
convention of torch), linear layer to 72. Matrices are (inputs, outputs), so that inner loops run over contiguous outputs.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.ahrs_kernels import attitude_std_n, correct, kalman_gain, keep, observe, predict, weigh

INPUTS = 90
CLIP = np.float32(8.0)
"""A normalised input farther out than this many standard deviations is cut, in training and here alike."""


@njit(cache=True)
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


@njit(cache=True)
def logistic(x):
    """1 / (1 + exp(-x)) in float32."""
    return np.float32(1.0) / (np.float32(1.0) + np.exp(-x))


@njit(cache=True)
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


@njit(cache=True)
def network_step(inputs, mean, inverse_std, w_in, b_in, curved, w_lstm, b_lstm, w_out, b_out, h, c, work, out):
    """Output (72,) of one time step; the memory ``h``, ``c`` (L,H) goes on. ``work``: x (90), hidden, joined, gates."""
    x, hidden, joined, gates = work
    for i in range(INPUTS):
        x[i] = min(CLIP, max(-CLIP, (np.float32(inputs[i]) - mean[i]) * inverse_std[i]))
    affine(w_in, b_in, x, hidden)
    if curved:
        for j in range(len(hidden)):
            hidden[j] = logistic(hidden[j])
    for layer in range(len(h)):
        lstm_layer(
            w_lstm[layer], b_lstm[layer], hidden if layer == 0 else h[layer - 1], h[layer], c[layer], joined, gates
        )
    affine(w_out, b_out, h[len(h) - 1], out)


@njit(cache=True)
def gather(z, x, state, k, inputs):
    """The 90 inputs: z (6), x (12): the KF's attitude correction and its bias and disturbance estimates, K (72)."""
    for i in range(6):
        inputs[i] = z[i]
    for i in range(3):
        inputs[6 + i] = x[i]
    for i in range(9):
        inputs[9 + i] = state[4 + i] + x[3 + i]
    for c in range(6):
        for i in range(12):
            inputs[18 + 12 * c + i] = k[c, i]


@njit(cache=True)
def filter_log_corrected(
    gyro,
    accel,
    mag,
    mag_row,
    field_n,
    model,
    state,
    p,
    stride,
    states,
    std,
    snapshot,
    z_kept,
    s_kept,
    network,
    scale,
    changed,
):
    """`ahrs_kernels.filter_log` with the gain K + scale * network(z, x, K) in the correction.

    The covariance follows the filter's own K. ``changed`` (M,) keeps the size of the correction relative to K.
    """
    mean, inverse_std, w_in, b_in, curved, w_lstm, b_lstm, w_out, b_out = network
    layers, width = len(w_lstm), len(b_in)
    h, c = np.zeros((layers, width), np.float32), np.zeros((layers, width), np.float32)
    work = (
        np.zeros(INPUTS, np.float32),
        np.zeros(width, np.float32),
        np.zeros(2 * width, np.float32),
        np.zeros(4 * width, np.float32),
    )
    inputs, out = np.zeros(INPUTS), np.zeros(72, np.float32)
    z, seen, x = np.zeros(6), np.zeros(6), np.zeros(12)
    s, y, k = np.zeros((6, 6)), np.zeros((6, 12)), np.zeros((6, 12))
    for n in range(len(gyro)):
        has_mag = mag_row[n] >= 0
        predict(state, p, gyro[n], model)
        observe(state, accel[n], mag[max(mag_row[n], 0)], has_mag, field_n, model, z, seen)
        kalman_gain(p, seen, has_mag, model, s, y, k)
        weigh(k, z, x)
        gather(z, x, state, k, inputs)
        network_step(inputs, mean, inverse_std, w_in, b_in, curved, w_lstm, b_lstm, w_out, b_out, h, c, work, out)
        size, step = 0.0, 0.0
        for i in range(6):
            for j in range(12):
                change = scale[12 * i + j] * out[12 * i + j]
                size += (k[i, j] / scale[12 * i + j]) ** 2
                step += np.float64(out[12 * i + j]) ** 2
                k[i, j] += change
        weigh(k, z, x)
        correct(state, x)
        for i in range(13):
            states[n, i] = state[i]
        attitude_std_n(state, p, std[n])
        if (n + 1) % stride == 0:
            keep(n // stride, p, z, s, has_mag, snapshot, z_kept, s_kept)
            changed[n // stride] = np.sqrt(step / size)
