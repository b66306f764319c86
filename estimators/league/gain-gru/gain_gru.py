"""`indirect-kf` whose fixes a recurrent network weighs: a learned correction of the gain, in the manner of KalmanNet.

Revach, Shlezinger, Ni, Escoriza, van Sloun & Eldar, *KalmanNet*, IEEE Trans. Signal Processing 70 (2022), let recurrent networks
give the gain itself, from differences of innovations and of states; they know neither Q nor R, carry no covariance, and learn by the squared
error. Here the Kalman filter stays whole: at each fix a gated recurrent unit (Cho et al., EMNLP 2014) reads the innovation
and its covariance, and says by what the six variances of the fix, and P, are multiplied before the filter makes its
own update. So the gain is that of a Kalman filter, covariance and gain stay consistent, and Q remains the specification's.
It learned by the likelihood of the true errors under that covariance (``reports/studies/gain_network.py``).

One small network serves north, east and down, with a memory for each. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from estimators.aiding.gnss import require_gnss
from estimators.learning.networks.tensor_file import check_shapes, read_arrays
from estimators.methods.eskf import Eskf
from estimators.policies import Array, Policy, add_policy
from testbed import NavSolution
from testbed.base.errors import InputError
from testbed.data.records import SensorLog
from testbed.kernels import njit

WEIGHTS = Path(__file__).with_name("gain-gru.safetensors")
NETWORKS = 5
"""Trainings that differ in their seed alone."""
AXES, INPUTS, HIDDEN, OUTPUTS = 3, 8, 12, 3
"""Twelve units: 831 weights, which the axes share, for some fifty thousand fixes of three axes."""
GATES = 3 * HIDDEN
"""Reset, update, and what is new, in this order."""
SHAPES = {
    "weight_ih": (GATES, INPUTS),
    "weight_hh": (GATES, HIDDEN),
    "bias_ih": (GATES,),
    "bias_hh": (GATES,),
    "weight_out": (OUTPUTS, HIDDEN),
    "bias_out": (OUTPUTS,),
}
"""Of one network, in the order in which they lie in the policy's memory; its three states follow."""
PLACES = tuple(int(n) for n in np.cumsum([0, *(np.prod(shape) for shape in SHAPES.values())]))
_IH, _HH, _BI, _BH, _OUT, _BO, STATES = PLACES
LOWEST, HIGHEST = -3.0, 7.0
"""Of the logarithm of a variance's factor: no fix is taken for five times as good as it says, and one whose sigma is 1.4 m counts as
one of 46 m, more than any multipath that a receiver does not notice."""
FADING, FADING_LOWEST, FADING_HIGHEST = 0.05, -8.0, 3.0
"""P is multiplied by 1 + 0.05 exp(x): doubled at a fix where x is 3, and left alone, to 2e-5, where it is -8."""


@njit(cache=True, nogil=True)
def inputs(axis, residual, s, r, x):
    """What the network reads of an axis into ``x`` (8,).

    Of position and velocity each: innovation in sigmas, by its inverse hyperbolic sine, and the logarithm of 1 + its square; how
    much more is expected than the noise of the fix, as a logarithm. Then the mean of the six squares so, and whether the axis points down.
    """
    mean = 0.0
    for i in range(2 * AXES):
        mean += np.log1p(residual[i] * residual[i] / s[i, i]) / (2 * AXES)
    for part in range(2):
        i = AXES * part + axis
        u = residual[i] / np.sqrt(s[i, i])
        x[part] = np.arcsinh(u)
        x[2 + part] = np.log1p(u * u)
        x[4 + part] = np.log(s[i, i] / r[i])
    x[6] = mean
    x[7] = 1.0 if axis == 2 else 0.0


@njit(cache=True, nogil=True)
def rows_times(memory, weight, bias, rows, x, out):
    """``out`` (rows,) = bias + weight times ``x``, both found in the memory at their places."""
    for i in range(rows):
        total = memory[bias + i]
        for j in range(x.shape[0]):
            total += memory[weight + i * x.shape[0] + j] * x[j]
        out[i] = total


@njit(cache=True, nogil=True)
def recur(memory, x, state, read, held):
    """One step of the unit: ``state`` (12,) is overwritten; ``read``, ``held`` (36,) are scratch.

    z = sigma(W x + U h), r likewise, n = tanh(W x + r (U h)), h = (1 - z) n + z h, with a bias in every product, as
    torch's GRUCell has it.
    """
    rows_times(memory, _IH, _BI, GATES, x, read)
    rows_times(memory, _HH, _BH, GATES, state, held)
    for j in range(HIDDEN):
        reset = 1.0 / (1.0 + np.exp(-(read[j] + held[j])))
        update = 1.0 / (1.0 + np.exp(-(read[HIDDEN + j] + held[HIDDEN + j])))
        new = np.tanh(read[2 * HIDDEN + j] + reset * held[2 * HIDDEN + j])
        state[j] = (1.0 - update) * new + update * state[j]


def judge(memory, residual, s, r, h, p):
    """Multiply the variances of a fix (6,), position and then velocity, and return the factor of P."""
    x, read, held, out = np.zeros(INPUTS), np.zeros(GATES), np.zeros(GATES), np.zeros(OUTPUTS)
    factor = np.zeros(2 * AXES)
    fading = 0.0
    for axis in range(AXES):
        inputs(axis, residual, s, r, x)
        state = memory[STATES + axis * HIDDEN : STATES + (axis + 1) * HIDDEN]
        recur(memory, x, state, read, held)
        rows_times(memory, _OUT, _BO, OUTPUTS, state, out)
        for part in range(2):
            factor[AXES * part + axis] = np.exp(min(HIGHEST, max(LOWEST, out[part])))
        fading += out[2] / AXES
    for i in range(2 * AXES):
        r[i] *= factor[i]
    return 1.0 + FADING * np.exp(min(FADING_HIGHEST, max(FADING_LOWEST, fading)))


def start(rows: int, network: int = 1, file: str = "") -> Array:
    """The policy's memory: weights of ``network`` (1 to 5) of the shipped file, or of ``file``, and states of zero. Raises InputError."""
    path = Path(file) if file else WEIGHTS
    if rows != 2 * AXES:
        raise InputError(f"policy 'gain-gru' weighs position and velocity together, six numbers, not {rows}")
    arrays, _ = read_arrays(path, "the weights of gain-gru")
    known = len(arrays.get("bias_out", ()))
    check_shapes(path, arrays, {name: (known, *shape) for name, shape in SHAPES.items()})
    if isinstance(network, bool) or not isinstance(network, int) or not 1 <= network <= known:
        raise InputError(f"network = {network!r}: must be a whole number from 1 to {known}")
    return memory_of({name: array[network - 1] for name, array in arrays.items()})


def memory_of(weights: dict[str, Any]) -> Array:
    """The memory that one network starts with; ``weights`` as `SHAPES` has them."""
    parts = [np.asarray(weights[name], dtype=np.float64).ravel() for name in SHAPES]
    return np.concatenate([*parts, np.zeros(AXES * HIDDEN)])


add_policy(Policy("gain-gru", judge, start, "a recurrent network scales the variances of a fix, and P"))


@dataclass(frozen=True)
class GainGru:
    """``network``: which of five trainings, 1 to 5; the league's row is 1, chosen before any was scored."""

    network: int = 1

    name: ClassVar[str] = "gain-gru"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")

    @property
    def filter(self) -> Eskf:
        """The composition of `indirect-kf` with the policy. Raises InputError for a network that is not there."""
        return Eskf(policy={"gain-gru": {"network": self.network}})

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError when it has no GNSS."""
        require_gnss(log, self.name)
        return self.filter.run(log)
