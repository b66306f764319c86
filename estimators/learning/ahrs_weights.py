"""The network of `ahrs-lstm`: its weights as a file and as arrays, and the filter's answer with them.

A file of weights is in the safetensors format, its arrays named as torch names them; `estimators.learning.ahrs_lstm` says what the
network is, and `estimators.learning.ahrs_lstm_kernels` takes its steps. SI units, µT.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.learning.networks.tensor_file import check_shapes, read_arrays
from estimators.methods.ahrs_kf import WITHOUT, AhrsKf, interval
from testbed.base.errors import InputError
from testbed.base.files import from_json
from testbed.data.records import NavSolution, SensorLog

Single = NDArray[np.float32]

FOLDER = Path(__file__).parent / "weights"
SHIPPED = FOLDER / "ahrs-lstm.safetensors"
BY_NAME = {"": SHIPPED, "end-to-end": FOLDER / "ahrs-lstm-end-to-end.safetensors"}
"""What is shipped: the network that imitates an adaptive KF, and the one that learned from the attitude error. Their matrices are stored
in half precision, half the bytes: roll and pitch move by 5e-5° at most, their RMSE by 1e-5 of itself (ten minutes of two runs)."""
COMMANDS = {"end-to-end": "testbed train ahrs-lstm-2022 --variant end-to-end"}
"""How to make them, where it is not `testbed train ahrs-lstm-2022`."""
UNTRAINED = "untrained"
ACTIVATIONS = ("sigmoid", "linear")
STEP_S = 0.2
"""Time between two steps of the network unless its weights say otherwise."""


class Network(NamedTuple):
    """The network as the compiled step takes it (see `ahrs_lstm_kernels`); matrices are (inputs, outputs)."""

    centre: Single
    inverse_unit: Single
    w_in: Single
    b_in: Single
    curved: bool
    w_lstm: Single
    b_lstm: Single
    w_out: Single
    b_out: Single


class Weights(NamedTuple):
    """A stored network: the arrays, its step (s), the parameters of the filter that it corrects, and its history.

    The metadata's ``growth`` is the largest logarithm of a change of the gain; weights of 0.1 have none.
    """

    network: Network
    step_s: float
    filter: dict[str, float]
    metadata: dict[str, Any]


def solve_with(weights: Weights, log: SensorLog) -> NavSolution:
    """The filter's answer with this network; the extra ``gain_change`` is the size of its change, rms of the logarithm."""
    from estimators.learning.ahrs_lstm_kernels import make_network_gain

    kf = AhrsKf(**weights.filter)
    gain = make_network_gain(weights.network, samples_per_step(weights, log), growth_of(weights))
    kept = kf.filter(log, gain)
    solution = kf.solution(log, kept)
    assert solution.covariance_t is not None
    return replace(solution, extras={**solution.extras, "gain_change": (solution.covariance_t, kept.change)})


def samples_per_step(weights: Weights, log: SensorLog) -> int:
    """IMU samples between two steps of the network."""
    return max(1, round(weights.step_s / interval(log)))


def growth_of(weights: Weights) -> float:
    """The largest logarithm of a change of the gain."""
    from estimators.learning.ahrs_lstm_kernels import LIMIT

    return float(weights.metadata.get("growth", LIMIT))


@lru_cache(maxsize=4)
def load_weights(weights: str) -> Weights:
    """Read a file of weights; "" and ``end-to-end`` are shipped. Raises InputError when it is missing or is something else."""
    if weights == UNTRAINED:
        return untrained_weights()
    path = BY_NAME.get(weights, Path(weights))
    if not path.is_file():
        command = COMMANDS.get(weights, "testbed train ahrs-lstm-2022")
        raise InputError(f"ahrs-lstm: {path}: no such file; make the weights with: {command}")
    try:
        arrays, texts = read_arrays(path, "a file of its weights")
        check_shapes(path, arrays, _shapes(arrays))
        metadata = {key: from_json(value) for key, value in texts.items()}
        if metadata["activation"] not in ACTIVATIONS or not 0.0 < metadata["step_s"] < math.inf:
            raise ValueError("activation and step_s of the network are not such")
        if not (arrays["unit"] > 0.0).all():
            raise ValueError("'unit' must be above 0")
        metadata["filter"] = WITHOUT | metadata["filter"]  # weights of 0.1 know nothing of what came later
        AhrsKf(**metadata["filter"])
        return assemble(arrays, metadata)
    except InputError as error:
        raise InputError(f"ahrs-lstm: {error}") from None
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"ahrs-lstm: {path}: not a file of its weights ({error})") from None


def _shapes(arrays: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    """The shapes that a network as wide and as deep as ``arrays`` must have."""
    n = len(arrays["input.bias"]) if "input.bias" in arrays and arrays["input.bias"].ndim == 1 else 0
    layers = max(1, sum(key.startswith("lstm.weight_ih") for key in arrays))
    shapes: dict[str, tuple[int, ...]] = {"centre": (90,), "unit": (90,), "input.weight": (n, 90), "input.bias": (n,)}
    for k in range(layers):
        shapes |= {f"lstm.weight_{part}_l{k}": (4 * n, n) for part in ("ih", "hh")}
        shapes |= {f"lstm.bias_{part}_l{k}": (4 * n,) for part in ("ih", "hh")}
    return shapes | {"head.weight": (72, n), "head.bias": (72,)}


def assemble(arrays: dict[str, Any], metadata: dict[str, Any]) -> Weights:
    """Weights from arrays named as torch names them: ``input``, ``lstm``, ``head``, and ``centre``, ``unit``."""
    layers = range(sum(key.startswith("lstm.weight_ih") for key in arrays))
    joined = [np.hstack([arrays[f"lstm.weight_ih_l{k}"], arrays[f"lstm.weight_hh_l{k}"]]).T for k in layers]
    biases = [arrays[f"lstm.bias_ih_l{k}"] + arrays[f"lstm.bias_hh_l{k}"] for k in layers]

    def single(values: Any) -> Single:
        return np.ascontiguousarray(values, dtype=np.float32)

    network = Network(
        single(arrays["centre"]),
        single(1.0 / arrays["unit"]),
        single(arrays["input.weight"].T),
        single(arrays["input.bias"]),
        metadata["activation"] == "sigmoid",
        single(np.stack(joined)),
        single(np.stack(biases)),
        single(arrays["head.weight"].T),
        single(arrays["head.bias"]),
    )
    return Weights(network, float(metadata["step_s"]), metadata["filter"], metadata)


def untrained_weights(layers: int = 2, neurons: int = 200, seed: int = 0) -> Weights:
    """Random LSTM layers below a last layer of zeros: the gain stays the filter's own."""
    rng, width = np.random.default_rng(seed), neurons**-0.5

    def draw(*shape: int) -> Single:
        return rng.uniform(-width, width, shape).astype(np.float32)

    network = Network(
        np.zeros(90, np.float32),
        np.ones(90, np.float32),
        draw(90, neurons),
        draw(neurons),
        True,
        draw(layers, 2 * neurons, 4 * neurons),
        draw(layers, 4 * neurons),
        np.zeros((neurons, 72), np.float32),
        np.zeros(72, np.float32),
    )
    return Weights(network, STEP_S, {}, {})
