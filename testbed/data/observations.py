"""What a GNSS receiver measures of each satellite: `GnssObservations`, beside `testbed.data.records.GnssFixes`.

Filters need no ephemerides: each row carries what the broadcast message says of its satellite, evaluated at transmission.
Frame e of the time of reception; SI units and radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.records import Samples
from testbed.data.satellites import name_of
from testbed.data.shapes import check_arrays
from testbed.data.specs import GnssSpec

Array = NDArray[np.float64]

SCALARS = (
    "sv",
    "pseudorange",
    "range_rate",
    "cn0",
    "lock_time",
    "clock",
    "clock_rate",
    "iono",
    "tropo",
    "sigma",
    "noise",
    "rate_sigma",
    "elevation",
    "azimuth",
    "residual",
    "used",
)
VECTORS = ("x_e", "v_e")


@dataclass(frozen=True, repr=False)
class GnssObservations(Samples):
    """One row per satellite and epoch: ``t`` (M,) in order, and within an epoch ``sv`` in order.

    ``sv`` satellite, see `name_of`; ``pseudorange`` (m) and ``range_rate`` (m/s, minus wavelength times Doppler) as
    measured; ``cn0`` dB-Hz; ``lock_time`` (s) since the satellite was found. From the broadcast message: ``x_e``, ``v_e``
    (M,3) of the satellite at transmission, ``clock`` (m) and ``clock_rate`` (m/s) of its clock; from standard models
    ``iono``, ``tropo`` (m). ``sigma``: what the receiver takes for the error of the corrected pseudorange (m), ``noise``
    (m) the part of it that is new in each epoch, ``rate_sigma`` (m/s). ``elevation``, ``azimuth`` (rad). Of its own fix:
    ``residual`` (m; 0 without a fix) and ``used`` (0 no fix, 1 used, 2 excluded).
    """

    sv: Array
    pseudorange: Array
    range_rate: Array
    cn0: Array
    lock_time: Array
    x_e: Array
    v_e: Array
    clock: Array
    clock_rate: Array
    iono: Array
    tropo: Array
    sigma: Array
    noise: Array
    rate_sigma: Array
    elevation: Array
    azimuth: Array
    residual: Array
    used: Array
    spec: GnssSpec = field(default_factory=GnssSpec)
    kind: ClassVar[str] = "gnss_raw"
    shapes: ClassVar[Mapping[str, tuple[int | None, ...]]] = dict.fromkeys(SCALARS, ()) | dict.fromkeys(VECTORS, (3,))

    def __post_init__(self) -> None:
        check_arrays(self, f"SensorLog.{self.kind}", dict(self.shapes), minimum=0, repeats=True)
        same = np.diff(self.t) == 0.0
        if (wrong := same & ~(np.diff(self.sv) > 0.0)).any():
            k = int(np.argmax(wrong)) + 1
            raise InputError(
                f"SensorLog.{self.kind}: satellites of an epoch stand in order, each once; sample {k} is {self.sv[k]:g}"
                f" after {self.sv[k - 1]:g} (t = {self.t[k]:.6g} s)"
            )

    def first_rows(self) -> NDArray[np.int64]:
        """(E + 1,) first row of each epoch, and M."""
        return np.concatenate([[0], np.flatnonzero(np.diff(self.t) > 0.0) + 1, [len(self.t)]]).astype(np.int64)

    def systems(self) -> NDArray[np.int64]:
        """(M,) `GPS` or `GALILEO`."""
        return (self.sv // 100).astype(np.int64)

    def satellites(self) -> list[str]:
        """Names of all that were seen, in order."""
        return [name_of(code) for code in np.unique(self.sv)]
