"""The network of `ahrs_lstm_kernels.network_step` in torch, on batches of sequences, and the loss that it learns by.

Gains are kept transposed, (6,12), as in the kernels. SI units, µT.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from estimators.learning.ahrs_lstm_kernels import INPUTS, LIMIT
from testbed.base.errors import InputError

Memory = tuple[Tensor, Tensor]
"""Output and cell of all LSTM layers, (L,B,H)."""
TINY = 1e-26
"""Square of a gain that counts as none."""


def device_of(name: str) -> torch.device:
    """The device of that name; ``auto`` is a GPU where torch finds one, else the CPU. Raises InputError for none."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise InputError(
            f"training: device = {name!r}: torch has none such here ({str(error).splitlines()[0]})"
        ) from None
    return device


class GainNetwork(nn.Module):
    """90 inputs to the logarithm of what each of 72 elements of the gain is multiplied by; starts at zero."""

    def __init__(
        self, layers: int, neurons: int, activation: str, centre: Tensor, unit: Tensor, growth: float = LIMIT
    ) -> None:
        super().__init__()
        self.curved, self.growth = activation == "sigmoid", growth
        self.input = nn.Linear(INPUTS, neurons)
        self.lstm = nn.LSTM(neurons, neurons, layers, batch_first=True)
        self.head = nn.Linear(neurons, 72)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        with torch.no_grad():  # cells that remember for tens of steps from the start (Jozefowicz et al. 2015, by half)
            for k in range(layers):
                getattr(self.lstm, f"bias_hh_l{k}")[neurons : 2 * neurons] += torch.arange(neurons) % 2 * 3.0
        self.centre: Tensor
        self.unit: Tensor
        self.register_buffer("centre", centre)
        self.register_buffer("unit", unit)

    def forward(self, inputs: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:
        """Logarithm of the change (B,T,72) from inputs (B,T,90), and the memory afterwards."""
        x = self.input(torch.asinh((inputs - self.centre) / self.unit))
        x, memory = self.lstm(torch.sigmoid(x) if self.curved else x, memory)
        return self.head(x).clamp(-LIMIT, self.growth), memory

    def step(self, inputs: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:
        """The same for one step, (B,72) from (B,90): `nn.LSTM` takes twice the time of its cells for a sequence of one."""
        x = self.input(torch.asinh((inputs - self.centre) / self.unit))
        x = torch.sigmoid(x) if self.curved else x
        if memory is None:
            zero = x.new_zeros(self.lstm.num_layers, *x.shape)
            memory = zero, zero
        cells = []
        for k in range(self.lstm.num_layers):
            w = (getattr(self.lstm, f"{name}_l{k}") for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"))
            x, cell = torch.lstm_cell(x, (memory[0][k], memory[1][k]), *w)
            cells.append((x, cell))
        after = torch.stack([h for h, _ in cells]), torch.stack([c for _, c in cells])
        return self.head(x).clamp(-LIMIT, self.growth), after


def distance(change: Tensor, inputs: Tensor, wanted: Tensor, correction_scale: Tensor) -> tuple[Tensor, Tensor]:
    """How far the changed gain is from the teacher's ``wanted`` (B,T,72): by its corrections, and by itself.

    The first compares the corrections K z in units of ``correction_scale`` (12); the second the 3x3 blocks, their size by
    its logarithm, so that a gain of a hundredth, as in a turn, has to be met as well as a whole one, and their shape.
    """
    shape = (*wanted.shape[:2], 6, 12)
    gain, wanted = (inputs[..., 18:] * change.exp()).view(shape), wanted.view(shape)
    x = torch.einsum("btci,btc->bti", gain - wanted, inputs[..., :6]) / correction_scale
    ours, theirs = _blocks(gain), _blocks(wanted)
    square, square_wanted = (ours**2).sum(-1) + TINY, (theirs**2).sum(-1) + TINY
    size = (0.5 * (square / square_wanted).log()) ** 2
    shape_error = ((ours / square.sqrt()[..., None] - theirs / square_wanted.sqrt()[..., None]) ** 2).sum(-1)
    return (x**2).mean(), (size + shape_error).mean()


def _blocks(gain: Tensor) -> Tensor:
    """(B,T,6,12) as (B,T,2,4,9): the 3x3 blocks of accelerometer and magnetometer on attitude, bias, disturbances."""
    b, t = gain.shape[:2]
    return gain.view(b, t, 2, 3, 4, 3).transpose(3, 4).reshape(b, t, 2, 4, 9)
