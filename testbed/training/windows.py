"""Windows of training data for networks: a data set of `testbed.training.dataset` as pairs of inputs and labels::

    data = torch_windows("results/data", "train", length=200, inputs=("gyro", "accel", "gnss"), labels=("v_n",))
    for x, y in torch.utils.data.DataLoader(data, batch_size=32, shuffle=True):
        ...

Windows never reach over the end of a flight, and a split is by flight. SI units, float32; NaN where a sensor has no sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError, MissingExtra
from testbed.training.dataset import open_split

Window = tuple[NDArray[np.float32], NDArray[np.float32]]


class Windows:
    """A sequence of (inputs (length, n), labels (length, m)): windows of ``length`` rows, one each ``stride`` rows.

    ``folder`` is a data set, ``split`` "train", "validation" or "test"; ``inputs`` and ``labels`` name groups of columns
    (`testbed.training.shards.INPUTS`, `LABELS`). Raises InputError for a split without a flight that is long enough.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str = "train",
        length: int = 200,
        stride: int | None = None,
        inputs: Sequence[str] = ("gyro", "accel"),
        labels: Sequence[str] = ("q_nb",),
    ) -> None:
        self.length, self.stride = length, length if stride is None else stride
        if self.length < 1 or self.stride < 1:
            raise InputError(f"windows of {length} rows, one each {stride}: both must be at least 1")
        self.inputs, self.labels = tuple(inputs), tuple(labels)
        self.shards = open_split(folder, split)
        counts = [max(0, (shard.rows - length) // self.stride + 1) for shard in self.shards]
        self._ends = np.cumsum(counts)
        if not len(self):
            raise InputError(f"{folder}: no flight of the split '{split}' has {length} rows")
        for shard in self.shards:
            shard.window(0, 1, (*self.inputs, *self.labels))  # says which group is missing

    def __repr__(self) -> str:
        flights = f"{len(self.shards)} flight{'s' if len(self.shards) != 1 else ''}"
        return f"{len(self)} windows of {self.length} rows from {flights}: {', '.join(self.inputs)} -> {', '.join(self.labels)}"

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, k: int) -> Window:
        if not -len(self) <= k < len(self):
            raise IndexError(k)
        k %= len(self)
        flight = int(np.searchsorted(self._ends, k, side="right"))
        before = int(self._ends[flight - 1]) if flight else 0
        names = (*self.inputs, *self.labels)
        data = self.shards[flight].window((k - before) * self.stride, self.length, names)
        return np.hstack([data[n] for n in self.inputs]), np.hstack([data[n] for n in self.labels])


def torch_windows(*arguments: Any, **keywords: Any) -> Any:
    """`Windows` as a ``torch.utils.data.Dataset``. Raises MissingExtra without torch."""
    try:
        from torch.utils.data import Dataset
    except ImportError:
        raise MissingExtra(
            "a data set for torch needs the package torch: pip install 'navigation-testbed[learn]'"
        ) from None

    class TorchWindows(Windows, Dataset):
        pass

    return TorchWindows(*arguments, **keywords)
