"""Kernels of `ahrs-lstm`: the network step in float32, the filter loop whose gain it corrects, and what a teacher would do.

Network: 90 inputs, each as asinh((input - centre) / unit), linear layer with activation, LSTM layers (gates i, f, g, o;
logistic gates, tanh cell, the convention of torch), linear layer to 72: the logarithm of what each element of the gain is
multiplied by. Matrices are (inputs, outputs), so that inner loops run over contiguous outputs. The network steps once in
``every`` samples, on the mean of its inputs since; in between its answer stands.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.ahrs_kernels import attitude_std_n, correct, inflate, kalman_gain, keep, observe, predict, weigh

INPUTS = 90
LIMIT = 5.0
"""A gain changes by exp(5) = 148 times at most, in training and here alike."""


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


@njit(cache=True)
def work_space(width):
    """The arrays that `network_step` works in."""
    return (
        np.zeros(INPUTS, np.float32),
        np.zeros(width, np.float32),
        np.zeros(2 * width, np.float32),
        np.zeros(4 * width, np.float32),
    )


@njit(cache=True)
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


@njit(cache=True)
def multiply_gain(k, out):
    """Apply the network's answer to the gain; returns the root mean square of the logarithm of the change."""
    total = 0.0
    for c in range(6):
        for i in range(12):
            change = min(LIMIT, max(-LIMIT, np.float64(out[12 * c + i])))
            total += change * change
            k[c, i] *= np.exp(change)
    return np.sqrt(total / 72.0)


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
    every,
    changed,
):
    """`ahrs_kernels.filter_log` with the gain K exp(network(z, x, K)), by elements, in the correction.

    The covariance follows the filter's own K. ``changed`` (M,) keeps the size of the change, see `multiply_gain`.
    """
    layers, width = len(network[5]), len(network[3])
    h, c = np.zeros((layers, width), np.float32), np.zeros((layers, width), np.float32)
    work, inputs, out = work_space(width), np.zeros(INPUTS), np.zeros(72, np.float32)
    z, seen, x, slow = np.zeros(6), np.zeros(6), np.zeros(12), np.zeros(3)
    s, y, k = np.zeros((6, 6)), np.zeros((6, 12)), np.zeros((6, 12))
    for n in range(len(gyro)):
        has_mag = mag_row[n] >= 0
        predict(state, p, gyro[n], model)
        observe(state, accel[n], mag[max(mag_row[n], 0)], has_mag, field_n, model, z, seen)
        inflate(p, gyro[n], accel[n], state, seen, model, slow)
        kalman_gain(p, seen, has_mag, model, s, y, k)
        weigh(k, z, x)
        gather(z, x, state, k, 1.0 / every, inputs)
        if (n + 1) % every == 0:
            network_step(inputs, network, h, c, work, out)
            inputs[:] = 0.0
        size = multiply_gain(k, out)
        weigh(k, z, x)
        correct(state, x)
        for i in range(13):
            states[n, i] = state[i]
        attitude_std_n(state, p, std[n])
        if (n + 1) % stride == 0:
            keep(n // stride, p, z, s, has_mag, snapshot, z_kept, s_kept)
            changed[n // stride] = size


@njit(cache=True)
def record_log(gyro, accel, mag, mag_row, field_n, model, state, p, network, every, teacher, told, teacher_flies, rows):
    """Fly the filter with the network's gain, or the teacher's, and write down what the network sees and the teacher does.

    ``teacher`` is the model of the teacher's own covariance, which follows its own gain; ``told`` (N,3), (m/s²)², is what
    it knows of the variance of linear acceleration beyond that. ``rows`` (M,162), float32: 90 inputs, 72 of the teacher's
    gain, both the mean over ``every`` samples.
    """
    layers, width = len(network[5]), len(network[3])
    h, c = np.zeros((layers, width), np.float32), np.zeros((layers, width), np.float32)
    work, inputs, out = work_space(width), np.zeros(INPUTS), np.zeros(72, np.float32)
    z, seen, x, slow, slow_taught = np.zeros(6), np.zeros(6), np.zeros(12), np.zeros(3), np.zeros(3)
    s, y, k, taught = np.zeros((6, 6)), np.zeros((6, 12)), np.zeros((6, 12)), np.zeros((6, 12))
    mean, p_taught = np.zeros((6, 12)), p.copy()
    for n in range(len(rows) * every):
        has_mag = mag_row[n] >= 0
        predict(state.copy(), p_taught, gyro[n], teacher)
        predict(state, p, gyro[n], model)
        observe(state, accel[n], mag[max(mag_row[n], 0)], has_mag, field_n, model, z, seen)
        inflate(p, gyro[n], accel[n], state, seen, model, slow)
        kalman_gain(p, seen, has_mag, model, s, y, k)
        inflate(p_taught, gyro[n], accel[n], state, seen, teacher, slow_taught)
        for i in range(3):
            p_taught[6 + i, 6 + i] += (1.0 - teacher[7] ** 2) * told[n, i]
        kalman_gain(p_taught, seen, has_mag, teacher, s, y, taught)
        weigh(k, z, x)
        gather(z, x, state, k, 1.0 / every, inputs)
        mean += taught / every
        if (n + 1) % every == 0:
            network_step(inputs, network, h, c, work, out)
            row = rows[n // every]
            for i in range(INPUTS):
                row[i] = inputs[i]
            for i in range(72):
                row[INPUTS + i] = mean[i // 12, i % 12]
            inputs[:] = 0.0
            mean[:] = 0.0
        if teacher_flies:
            k[:] = taught
        else:
            multiply_gain(k, out)
        weigh(k, z, x)
        correct(state, x)
