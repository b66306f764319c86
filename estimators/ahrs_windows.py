"""Windows of flights as batches for training: the KF's states where they start, samples, truth, and the teacher's sigma.

A flight is run through the KF once; after that any of its windows loads from the shard alone. SI units, µT. Flights are
objects like `testbed.dataset.Shard`: ``rows``, ``window(start, rows)``, ``log()``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from estimators.ahrs_kf import AhrsKf, prepare
from estimators.ahrs_torch import Batch, BatchFilter


@dataclass
class Prepared:
    """A flight with the KF's own states at every ``stride``-th row, where windows may start."""

    flight: Any
    stride: int
    states: NDArray[np.float64]
    covariances: NDArray[np.float64]
    field_n: NDArray[np.float64]
    model: NDArray[np.float64]
    accel_bias: NDArray[np.float64]
    features: NDArray[np.float64]


def prepare_flight(flight: Any, filter_: AhrsKf, stride: int) -> Prepared:
    """Run the KF over a flight once, and keep its states and inputs at window starts."""
    from estimators.ahrs_kernels import filter_log

    log = flight.log()
    n, (state, p) = len(log.imu.t), filter_.start(log)
    kept = n // stride
    first, first_p = state.copy(), p.copy()
    states, std = np.empty((n, 13)), np.empty((n, 3))
    snapshots, z, s = np.empty((kept, 12, 12)), np.empty((kept, 6)), np.empty((kept, 6, 6))
    recording, model = prepare(log, filter_.name), filter_.model(log)
    filter_log(*recording, model, state, p, stride, states, std, snapshots, z, s)
    at = states[stride - 1 :: stride]
    features = _features(snapshots, z, at, model, recording.field_n)
    return Prepared(
        flight,
        stride,
        np.vstack([first, at]),
        np.concatenate([first_p[None], snapshots]),
        recording.field_n,
        model,
        log.initial.accel_bias,
        features,
    )


def _features(p: Any, z: Any, states: Any, model: Any, field_n: Any) -> NDArray[np.float64]:
    """The network's inputs at the snapshots, to a good approximation (P after the update), for their mean and spread."""
    from testbed.rotations import quats_to_matrices

    matrices = quats_to_matrices(np.ascontiguousarray(states[:, :4]))
    filter_ = BatchFilter(model, torch.device("cpu"), torch.float64)
    c_nb = torch.as_tensor(matrices)
    seen = torch.cat([c_nb[:, 2] * model[10], torch.einsum("bij,i->bj", c_nb, torch.as_tensor(field_n))], 1)
    k, _ = filter_.gain(torch.as_tensor(p), filter_.eye.expand(len(p), 3, 3), seen)
    known = torch.as_tensor(states[:, 4:])
    inputs = filter_.inputs(torch.as_tensor(z), k, known[:, :3], known[:, 3:])
    return inputs.numpy()


def normalisation(flights: Sequence[Prepared]) -> dict[str, NDArray[np.float32]]:
    """Mean and spread of the inputs and the unit of each gain element (its root mean square), from the KF's own runs."""
    rows = np.vstack([f.features[len(f.features) // 50 :] for f in flights])
    mean, std = rows.mean(0), rows.std(0)
    for block in (slice(first, first + 3) for first in range(0, 90, 3)):
        std[block] = np.maximum(std[block], 0.1 * std[block].max() + 1e-9)
    scale = np.sqrt((rows[:, 18:] ** 2).mean(0))
    scale = np.repeat(scale.reshape(-1, 3).max(1) + 1e-9, 3)
    return {key: v.astype(np.float32) for key, v in {"mean": mean, "std": std, "scale": scale}.items()}


def teacher_sigma(
    accel: NDArray[Any], gravity_b: NDArray[Any], rate: float, floor: float, factor: float
) -> NDArray[Any]:
    """(N,3) sigma (m/s²) for a filter that knows the linear acceleration, from specific force and true gravity in b."""
    half = max(1, round(0.5 * rate))
    padded = np.pad(np.cumsum(accel + gravity_b, axis=0), ((half + 1, half), (0, 0)), mode="edge")
    padded[: half + 1] = 0.0
    n = len(accel)
    first, last = np.maximum(np.arange(n) - half, 0), np.minimum(np.arange(n) + half, n - 1)
    mean = (padded[2 * half + 1 :] - padded[:n]) / (last - first + 1)[:, None]
    return np.hypot(floor, factor * mean)


def make_batch(
    windows: Sequence[tuple[Prepared, int]],
    rows: int,
    device: torch.device,
    dtype: torch.dtype = torch.float32,
    teacher: tuple[float, float] = (1.5, 5.0),
    reference_error: NDArray[np.float64] | None = None,
) -> Batch:
    """Load windows that start at rows that are multiples of the stride; none starts at row 0, which has no truth before it.

    ``teacher``: floor (m/s²) and factor of `teacher_sigma`; ``reference_error`` (B,3), rad, turns the true attitude in b.
    """
    from testbed.rotations import quats_to_matrices, rotvec_to_quat

    before = [prepared.flight.window(start - 1, rows + 1) for prepared, start in windows]
    data = [{key: values[1:] for key, values in d.items()} for d in before]
    at = [start // prepared.stride for prepared, start in windows]
    states = np.stack([prepared.states[k] for (prepared, _), k in zip(windows, at, strict=True)])

    def tensor(values: Any) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(values)).to(device, dtype)

    truth = np.stack([quats_to_matrices(d["q_nb"].astype(np.float64)) for d in before])
    if reference_error is not None:
        errors = quats_to_matrices(np.array([rotvec_to_quat(error) for error in reference_error]))
        truth = truth @ errors[:, None]
    accel = [d["accel"] - prepared.accel_bias for d, (prepared, _) in zip(data, windows, strict=True)]
    gravity_b = [c[1:, 2] * prepared.model[10] for c, (prepared, _) in zip(truth, windows, strict=True)]
    rate = 1.0 / float(windows[0][0].model[9])
    return Batch(
        accel_sigma=tensor(
            np.stack([teacher_sigma(f, g, rate, *teacher) for f, g in zip(accel, gravity_b, strict=True)])
        ),
        gyro=tensor(np.stack([d["gyro"] for d in data])),
        accel=tensor(np.stack(accel)),
        mag=tensor(np.stack([d["mag"] for d in data])),
        truth=tensor(truth),
        field_n=tensor(np.stack([prepared.field_n for prepared, _ in windows])),
        gravity=tensor([prepared.model[10] for prepared, _ in windows]),
        c_nb=tensor(quats_to_matrices(np.ascontiguousarray(states[:, :4]))),
        bias=tensor(states[:, 4:7]),
        disturbance=tensor(states[:, 7:]),
        p=tensor(np.stack([prepared.covariances[k] for (prepared, _), k in zip(windows, at, strict=True)])),
    )
