"""Kernels of a network with one hidden tanh layer and one linear output, and of its Levenberg-Marquardt training.

Equations: Hagan & Menhaj (1994), *Training feedforward networks with the Marquardt algorithm*, IEEE Trans. NN 5(6).
Inputs and targets are already normalised; ``weights`` is flat: per neuron its input weights and bias, then the output
weights and the output bias. Plain loops without BLAS, so that a result does not depend on the number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from testbed.kernels import njit

RUNNING, GOAL, FLAT, DAMPED_OUT, OVERFITTING = 0, 1, 2, 3, 4
"""Why training stopped: epochs used up, goal met, gradient or progress vanished, no step improves, validation grew."""

_BLOCK = 4


@njit(cache=True)
def evaluate(weights, neurons, x):
    """Output (float) for one input row ``x`` (n,)."""
    inputs = x.shape[0]
    output = weights[neurons * (inputs + 2)]
    for j in range(neurons):
        start = j * (inputs + 1)
        total = weights[start + inputs]
        for i in range(inputs):
            total += weights[start + i] * x[i]
        output += weights[neurons * (inputs + 1) + j] * np.tanh(total)
    return output


@njit(cache=True)
def evaluate_all(weights, neurons, x):
    """Outputs (N,) for input rows ``x`` (N,n)."""
    out = np.empty(x.shape[0])
    for k in range(x.shape[0]):
        out[k] = evaluate(weights, neurons, x[k])
    return out


@njit(cache=True)
def gradient_row(weights, neurons, x, row):
    """Output (float) for one input row, and its derivative with respect to the weights in ``row`` (p,)."""
    inputs = x.shape[0]
    tail = neurons * (inputs + 1)
    output = weights[tail + neurons]
    row[tail + neurons] = 1.0
    for j in range(neurons):
        start = j * (inputs + 1)
        total = weights[start + inputs]
        for i in range(inputs):
            total += weights[start + i] * x[i]
        activation = np.tanh(total)
        output += weights[tail + j] * activation
        slope = weights[tail + j] * (1.0 - activation * activation)
        row[tail + j] = activation
        for i in range(inputs):
            row[start + i] = slope * x[i]
        row[start + inputs] = slope
    return output


@njit(cache=True)
def normal_equations(weights, neurons, x, y, gram, gradient, rows):
    """Fill ``gram`` = JᵀJ (lower triangle) and ``gradient`` = Jᵀr with r = output - y; return rᵀr.

    ``rows`` (4,p) is work space: four samples are added to the Gram matrix at a time.
    """
    size = weights.shape[0]
    gram[:] = 0.0
    gradient[:] = 0.0
    total = 0.0
    count = x.shape[0]
    for first in range(0, count, _BLOCK):
        for b in range(_BLOCK):
            if first + b < count:
                residual = gradient_row(weights, neurons, x[first + b], rows[b]) - y[first + b]
                total += residual * residual
                for i in range(size):
                    gradient[i] += rows[b, i] * residual
            else:
                rows[b, :] = 0.0
        for i in range(size):
            r0, r1, r2, r3 = rows[0, i], rows[1, i], rows[2, i], rows[3, i]
            for j in range(i + 1):
                gram[i, j] += r0 * rows[0, j] + r1 * rows[1, j] + r2 * rows[2, j] + r3 * rows[3, j]
    return total


@njit(cache=True)
def squared_error(weights, neurons, x, y):
    """Sum of squared residuals."""
    total = 0.0
    for k in range(x.shape[0]):
        residual = evaluate(weights, neurons, x[k]) - y[k]
        total += residual * residual
    return total


@njit(cache=True)
def solve_damped(gram, damping, right, factor, solution):
    """Solve (gram + damping I) solution = right by Cholesky; False when the matrix is not positive definite.

    Only the lower triangle of ``gram`` is read; ``factor`` is work space of the same shape.
    """
    size = right.shape[0]
    for i in range(size):
        for j in range(i + 1):
            total = gram[i, j]
            if i == j:
                total += damping
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * solution[k]
        solution[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = solution[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * solution[k]
        solution[i] = total / factor[i, i]
    return True


class Settings(NamedTuple):
    """How `train` goes on: see `levenberg_marquardt.Training`; ``decay`` and ``goal`` as there."""

    epochs: int
    goal: float
    patience: int
    decay: float
    tolerance: float
    damping: float
    damping_max: float


@njit(cache=True)
def train(weights, neurons, x, y, x_check, y_check, how):
    """Levenberg-Marquardt from ``weights``: minimise the sum of squares plus ``decay`` times the squared weights.

    ``how`` is a `Settings`.

    After each epoch the error on (``x_check``, ``y_check``) is taken; the weights with the smallest one are returned
    and ``patience`` epochs in a row without a new best end the training (no check rows: the last weights are best).
    ``damping`` falls tenfold after a step that improves and rises tenfold after one that does not.

    Returns (weights, epochs used, mean square error of training, of the check, reason).
    """
    size = weights.shape[0]
    current = weights.copy()
    trial = weights.copy()
    best = weights.copy()
    gram, factor = np.empty((size, size)), np.zeros((size, size))
    gradient, step, rows = np.empty(size), np.empty(size), np.empty((_BLOCK, size))
    checked = x_check.shape[0] > 0
    best_check = squared_error(current, neurons, x_check, y_check)
    failures, reason, used, damping = 0, RUNNING, 0, how.damping
    error = squared_error(current, neurons, x, y)
    cost = error + how.decay * np.sum(current * current)
    while used < how.epochs and reason == RUNNING:
        normal_equations(current, neurons, x, y, gram, gradient, rows)
        largest = 0.0
        for i in range(size):
            gram[i, i] += how.decay
            gradient[i] += how.decay * current[i]
            largest = max(largest, abs(gradient[i]))
        if largest < 1e-10:
            reason = FLAT
            break
        improved = False
        while not improved and damping <= how.damping_max:
            if solve_damped(gram, damping, gradient, factor, step):
                for i in range(size):
                    trial[i] = current[i] - step[i]
                trial_error = squared_error(trial, neurons, x, y)
                trial_cost = trial_error + how.decay * np.sum(trial * trial)
                improved = trial_cost < cost
            if not improved:
                damping *= 10.0
        if not improved:
            reason = DAMPED_OUT
            break
        used += 1
        damping = max(damping * 0.1, 1e-20)
        progress = (cost - trial_cost) / cost
        current[:] = trial
        error, cost = trial_error, trial_cost
        if checked:
            check = squared_error(current, neurons, x_check, y_check)
            if check < best_check:
                best_check, failures = check, 0
                best[:] = current
            else:
                failures += 1
        if error <= how.goal * x.shape[0]:
            reason = GOAL
        elif progress < how.tolerance:
            reason = FLAT
        elif checked and failures >= how.patience:
            reason = OVERFITTING
    if not checked:
        best[:] = current
    final = squared_error(best, neurons, x, y) / max(1, x.shape[0])
    return best, used, final, best_check / max(1, x_check.shape[0]), reason


@njit(cache=True)
def closed_loop(weights, neurons, inputs, history, output_lags, input_lags, low, high):
    """Run a NARX network on its own outputs (parallel mode).

    ``inputs`` (input_lags + N, m) are normalised inputs, oldest first; ``history`` (output_lags,) the outputs before
    the first one, oldest first, in the scale of the network's *input* for outputs, which is also that of its output.
    The input row is y(t-1)..y(t-ny), then u(t), u(t-1)..u(t-nu). Outputs are kept within [low, high].
    Returns (outputs (N,), number of outputs that the limits changed).
    """
    channels = inputs.shape[1]
    count = inputs.shape[0] - input_lags
    row = np.empty(output_lags + (input_lags + 1) * channels)
    past = history.copy()
    out = np.empty(count)
    clipped = 0
    for k in range(count):
        for i in range(output_lags):
            row[i] = past[output_lags - 1 - i]
        for lag in range(input_lags + 1):
            for c in range(channels):
                row[output_lags + lag * channels + c] = inputs[input_lags + k - lag, c]
        value = evaluate(weights, neurons, row)
        if not (low <= value <= high):
            clipped += 1
            value = high if value > high else low
        out[k] = value
        for i in range(output_lags - 1):
            past[i] = past[i + 1]
        if output_lags > 0:
            past[output_lags - 1] = value
    return out, clipped
