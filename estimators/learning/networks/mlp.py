"""A feed-forward network with one hidden layer of tanh neurons and one linear output, with its normalisation.

Initial weights: Nguyen & Widrow (1990), *Improving the learning speed of 2-layer neural networks*, IJCNN, vol. 3.
Inputs and outputs are in the caller's units; inside, training data spans [-1, 1]. Stored as safetensors, never pickles.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.learning.networks.tensor_file import check_shapes, read_arrays, write_arrays
from testbed.base.errors import InputError
from testbed.base.files import from_json

Array = NDArray[np.float64]

_TENSORS = ("weights", "input_centre", "input_span", "output_scaling")


@dataclass(frozen=True)
class Mlp:
    """n inputs, ``neurons`` tanh neurons, one output.

    ``weights`` ((n+2) neurons + 1,) flat as in `mlp_kernels`; ``input_centre`` and ``input_span`` (n,): half the range
    of the training inputs; ``output_scaling`` (2,): centre and half range of the targets.
    """

    neurons: int
    weights: Array
    input_centre: Array
    input_span: Array
    output_scaling: Array

    def __post_init__(self) -> None:
        expected = (len(self.input_centre) + 2) * self.neurons + 1
        if self.weights.shape != (expected,):
            raise InputError(f"Mlp: {self.weights.shape} weights, expected ({expected},)")

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return len(self.input_centre)

    def normalise_inputs(self, x: Array) -> Array:
        """Inputs (N,n) in the caller's units to the network's."""
        return np.ascontiguousarray((x - self.input_centre) / self.input_span)

    def normalise_outputs(self, y: Array) -> Array:
        """Targets (N,) in the caller's units to the network's."""
        return np.ascontiguousarray((y - self.output_scaling[0]) / self.output_scaling[1])

    def restore_outputs(self, y: Array) -> Array:
        """Network outputs (N,) to the caller's units."""
        return y * self.output_scaling[1] + self.output_scaling[0]

    def predict(self, x: Array) -> Array:
        """Outputs (N,) for inputs ``x`` (N,n), both in the caller's units."""
        from estimators.learning.networks import mlp_kernels

        return self.restore_outputs(mlp_kernels.evaluate_all(self.weights, self.neurons, self.normalise_inputs(x)))


def centre_and_span(values: Array) -> tuple[Array, Array]:
    """Centre and half range of each column (N,n) or of a vector (N,); a constant column gets span 1."""
    low, high = values.min(axis=0), values.max(axis=0)
    span = 0.5 * (high - low)
    return 0.5 * (low + high), np.where(span > 0.0, span, 1.0)


def new_mlp(x: Array, y: Array, neurons: int, seed: int) -> Mlp:
    """An untrained network normalised to the data ``x`` (N,n), ``y`` (N,). Nguyen-Widrow weights from ``seed``."""
    x, y = np.atleast_2d(np.asarray(x, dtype=float)), np.asarray(y, dtype=float)
    if neurons < 1 or len(x) != len(y) or len(y) < 2:
        raise InputError(
            f"Mlp: needs neurons >= 1 and at least 2 rows, has {neurons}, {x.shape} inputs, {y.shape} targets"
        )
    inputs = x.shape[1]
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    direction = rng.uniform(-1.0, 1.0, (neurons, inputs))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    reach = 0.7 * neurons ** (1.0 / inputs)
    bias = reach * rng.permutation(np.linspace(-1.0, 1.0, neurons)) if neurons > 1 else np.zeros(1)
    hidden = np.column_stack([reach * direction, bias])
    weights = np.concatenate([hidden.ravel(), rng.uniform(-0.5, 0.5, neurons) / np.sqrt(neurons), np.zeros(1)])
    centre, span = centre_and_span(x)
    return Mlp(neurons, weights, centre, span, np.array(centre_and_span(y), dtype=float))


def save_networks(path: str | Path, networks: Mapping[str, Mlp], meta: Mapping[str, Any] | None = None) -> None:
    """Write networks by name to one safetensors file; ``meta`` is plain data kept beside them."""
    tensors = {f"{name}.{key}": getattr(net, key) for name, net in networks.items() for key in _TENSORS}
    header = {"neurons": {name: net.neurons for name, net in networks.items()}, "meta": dict(meta or {})}
    write_arrays(Path(path), tensors, {"testbed": json.dumps(header, sort_keys=True)})


def load_networks(path: str | Path) -> tuple[dict[str, Mlp], dict[str, Any]]:
    """Read what `save_networks` wrote: (networks by name, meta). Raises InputError when the file is something else."""
    path = Path(path)
    arrays, texts = read_arrays(path, "a network file")
    try:
        header = from_json(texts["testbed"])
        neurons, meta = dict(header["neurons"]), dict(header["meta"])
    except (KeyError, ValueError, TypeError):
        raise InputError(f"{path}: a safetensors file, but not of this bench's networks") from None
    networks = {}
    for name, count in neurons.items():
        inputs = np.size(arrays.get(f"{name}.input_centre", ()))
        sizes = ((inputs + 2) * count + 1, inputs, inputs, 2)
        check_shapes(path, arrays, {f"{name}.{key}": (size,) for key, size in zip(_TENSORS, sizes, strict=True)})
        networks[name] = Mlp(count, *(np.asarray(arrays[f"{name}.{key}"], dtype=np.float64) for key in _TENSORS))
        if not (networks[name].input_span > 0.0).all() or not networks[name].output_scaling[1] > 0.0:
            raise InputError(f"{path}: the scales of network '{name}' must be above 0")
    return networks, meta
