"""`ann` and `kfann`: networks that learn the INS's errors while there is GNSS and stand in for it through an outage.

Source: "Error Rate Reduction of a Low-Cost Integrated Navigation System Using Neural Networks" (2018). Both sit on the
open-loop filter of `lkf9`. NED, SI units and radians; errors are INS minus GNSS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from estimators.learning.networks.levenberg_marquardt import Training
from estimators.learning.networks.regressors import REGRESSORS, fit_regressor
from estimators.methods.lkf9 import (
    Array,
    FreeIns,
    Measurements,
    OpenLoop,
    fixes_of,
    free_ins,
    gnss_measurements,
    run_filter,
)
from testbed.base.errors import InputError, nearest
from testbed.base.streams import stable_hash
from testbed.data.records import GnssFixes, NavSolution, SensorLog
from testbed.physics import earth

TARGETS = ("v_north", "v_east", "v_down", "lat", "lon", "h")
"""One network per row of the measurement."""

# Columns of [v_north, v_east, v_down, lat, lon, h] of the INS that a network sees, now and one GNSS epoch earlier.
_INPUTS: dict[str, dict[str, tuple[tuple[int, ...], bool]]] = {
    "nn1": {"horizontal": ((3, 4), False), "vertical": ((5,), False)},
    "nn2": {"horizontal": ((3, 4), True), "vertical": ((5,), True)},
    "nn3": {"horizontal": ((3, 4, 1, 0), True), "vertical": ((5,), True)},
}


@dataclass(frozen=True)
class Learner(OpenLoop):
    """Parameters that `ann` and `kfann` share, beside those of `lkf9`."""

    inputs: Literal["nn1", "nn2", "nn3"] = "nn3"
    """``nn1``: the INS's position (height for the height error); ``nn2``: and one GNSS epoch earlier; ``nn3``: and the
    horizontal velocity at both, for the horizontal errors."""
    regressor: str = "mlp"
    """``mlp``, ``random-forest``, ``rbf`` or ``svr``."""
    neurons: int = 11
    seed: int = 0
    """Of the initial weights and of the choice of held-back rows."""
    epochs: int = 100
    patience: int = 6
    validation_share: float = 0.15
    """Share of the rows held back to stop the training early."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.inputs not in _INPUTS:
            raise InputError(f"{self.name}: no inputs '{self.inputs}': {nearest(self.inputs, _INPUTS)}")
        if self.regressor not in REGRESSORS:
            raise InputError(f"{self.name}: no regressor '{self.regressor}': {nearest(self.regressor, REGRESSORS)}")
        if self.neurons < 1:
            raise InputError(f"{self.name}: neurons is {self.neurons}, expected at least 1")
        Training(self.epochs, self.patience, self.validation_share)


@dataclass(frozen=True)
class Ann(Learner):
    """Through an outage the networks' output is subtracted from the INS position.

    With GNSS, and for velocity and attitude throughout, the answer is that of `lkf9`.
    """

    name: ClassVar[str] = "ann"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")

    def run(self, log: SensorLog) -> NavSolution:
        """Train at each outage on all fixes before it; the position in the outage is INS minus network."""
        ins, gnss = free_ins(log), fixes_of(log, self.name)
        fed = gnss_measurements(ins, gnss)
        solution = run_filter(self, log, ins, fed)
        lat, lon, h = solution.lat.copy(), solution.lon.copy(), solution.h.copy()
        outputs = []
        for start, end, times in outages_of(gnss, ins):
            known = fed.t <= start
            if not enough(known.sum(), self):
                continue
            networks = train_networks(self, ins, fed, known, TARGETS[3:])
            rows = np.flatnonzero((solution.t > start) & (solution.t < end))
            error = network_outputs(self, ins, networks, solution.t[rows], 1.0 / gnss.spec.rate_hz)
            lat[rows], lon[rows], h[rows] = (ins.lla[rows + 1] - error[:, 3:]).T
            outputs.append((times, network_outputs(self, ins, networks, times, 1.0 / gnss.spec.rate_hz)))
        return _with(solution, ins, outputs, lat=lat, lon=lon, h=h)


@dataclass(frozen=True)
class Kfann(Learner):
    """Through an outage the networks' output is the filter's measurement, at the epochs that the receiver would have had."""

    velocity: bool = True
    """Networks for the velocity errors too, and all six rows of the measurement, as the text before the paper's eq. 26 has it;
    False: position alone, the three networks that the paper describes."""
    pseudo_noise: Literal["gnss", "residual", "rehearsal"] = "gnss"
    """Standard deviation of the pseudo-measurements, which the paper does not state: the receiver's, as nothing says that R
    changes; the RMS of the networks' training residuals; or their RMS error in a rehearsal, `rehearsal_errors`."""
    rehearsal_s: float = 30.0
    """Length of the rehearsal: the paper's outage."""
    name: ClassVar[str] = "kfann"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pseudo_noise not in ("gnss", "residual", "rehearsal"):
            raise InputError(
                f"{self.name}: pseudo_noise is '{self.pseudo_noise}', expected 'gnss', 'residual' or 'rehearsal'"
            )
        if not 0.0 < self.rehearsal_s < np.inf:
            raise InputError(f"{self.name}: rehearsal_s is {self.rehearsal_s}, expected a positive number")

    def run(self, log: SensorLog) -> NavSolution:
        """Train at each outage on all fixes before it, then filter fixes and pseudo-measurements in one pass."""
        ins, gnss = free_ins(log), fixes_of(log, self.name)
        real = gnss_measurements(ins, gnss)
        parts, outputs = [real], []
        targets = TARGETS if self.velocity else TARGETS[3:]
        for start, _, times in outages_of(gnss, ins):
            known = real.t <= start
            if not enough(int(np.sum(known & (real.t <= start - self._kept_back_s))), self):
                continue
            networks = train_networks(self, ins, real, known, targets)
            value = network_outputs(self, ins, networks, times, 1.0 / gnss.spec.rate_hz)
            std = np.tile(self._std(ins, real, known, networks, 1.0 / gnss.spec.rate_hz), (len(times), 1))
            parts.append(Measurements(times, value, std, np.full(len(times), 0 if self.velocity else 3)))
            outputs.append((times, value))
        return _with(run_filter(self, log, ins, in_order(parts)), ins, outputs)

    @property
    def _kept_back_s(self) -> float:
        """Of the fixes before an outage, the last seconds that a rehearsal needs for itself."""
        return self.rehearsal_s if self.pseudo_noise == "rehearsal" else 0.0

    def _std(self, ins: FreeIns, real: Measurements, known: Mask, networks: Networks, step: float) -> Array:
        receivers = np.asarray(real.std[known][-1])
        if self.pseudo_noise == "gnss":
            return receivers
        if self.pseudo_noise == "rehearsal":
            return np.maximum(receivers, rehearsal_errors(self, ins, real, known, step))
        residual = real.value[known] - network_outputs(self, ins, networks, real.t[known], step)
        return np.asarray(np.sqrt(np.mean(residual**2, axis=0)))


Mask = NDArray[np.bool_]
Networks = dict[str, Callable[[Array], Array]]
"""A trained regressor per target."""


def outages_of(gnss: GnssFixes, ins: FreeIns) -> list[tuple[float, float, Array]]:
    """Gaps of more than one and a half epochs: (last fix, next fix or the end, epochs missed in between)."""
    t, step = gnss.t - gnss.spec.latency_s, 1.0 / gnss.spec.rate_hz
    edges = np.append(t[(t > ins.t[0]) & (t <= ins.t[-1])], ins.t[-1] + step)
    gaps = np.flatnonzero(np.diff(edges) > 1.5 * step)
    out = []
    for k in gaps:
        missed = edges[k] + step * np.arange(1, round((edges[k + 1] - edges[k]) / step))
        out.append((float(edges[k]), float(edges[k + 1]), missed[missed <= ins.t[-1]]))
    return out


def in_order(parts: Sequence[Measurements]) -> Measurements:
    """Fixes and pseudo-measurements as one sequence in time order."""
    order = np.argsort(np.concatenate([part.t for part in parts]), kind="stable")
    return Measurements(*(np.concatenate([getattr(p, key) for p in parts])[order] for key in vars(parts[0])))


def enough(fixes: int, settings: Learner) -> bool:
    """Whether there are as many fixes as a network has neurons, at least; else the filter coasts alone."""
    return int(fixes) > 2 * settings.neurons


def network_inputs(settings: Learner, ins: FreeIns, target: str, t: Array, step: float) -> Array:
    """Input rows (M,n) at times ``t`` for one target: the INS now and, for nn2 and nn3, ``step`` seconds earlier."""
    columns, lagged = _INPUTS[settings.inputs]["vertical" if target in ("h", "v_down") else "horizontal"]
    lla, velocity = ins.at(t)
    now = np.hstack([velocity, lla])[:, columns]
    if not lagged:
        return now
    lla, velocity = ins.at(t - step)
    return np.hstack([now, np.hstack([velocity, lla])[:, columns]])


def train_networks(
    settings: Learner, ins: FreeIns, fed: Measurements, known: Mask, targets: tuple[str, ...]
) -> Networks:
    """One regressor per target, trained on the fixes ``known`` (M,) marks."""
    how, step = (
        Training(settings.epochs, settings.patience, settings.validation_share),
        float(np.median(np.diff(fed.t))),
    )
    return {
        target: fit_regressor(
            settings.regressor,
            network_inputs(settings, ins, target, fed.t[known], step),
            fed.value[known, TARGETS.index(target)],
            settings.neurons,
            stable_hash(f"{settings.seed} {target}") % 2**32,
            how,
        )
        for target in targets
    }


def rehearsal_errors(settings: Kfann, ins: FreeIns, real: Measurements, known: Mask, step: float) -> Array:
    """RMS error (6,) over the last ``rehearsal_s`` of the ``known`` fixes of networks that were trained on those before them.

    What a filter can know of its networks' errors in an outage before it begins: they grow like that where they are asked
    for what comes next. Velocities (rows 0 to 2) count as learnt only where they are fed.
    """
    begin = real.t[known][-1] - settings.rehearsal_s
    early, late = known & (real.t <= begin), known & (real.t > begin)
    networks = train_networks(settings, ins, real, early, TARGETS if settings.velocity else TARGETS[3:])
    errors = real.value[late] - network_outputs(settings, ins, networks, real.t[late], step)
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))


def network_outputs(settings: Learner, ins: FreeIns, networks: Networks, t: Array, step: float) -> Array:
    """Predicted INS errors (M,6) at times ``t`` in the order of `TARGETS`; zero where no network is."""
    out = np.zeros((len(t), len(TARGETS)))
    for target, predict in networks.items():
        out[:, TARGETS.index(target)] = predict(network_inputs(settings, ins, target, t, step))
    return out


def _with(solution: NavSolution, ins: FreeIns, outputs: list[tuple[Array, Array]], **changed: Array) -> NavSolution:
    """The solution with the networks' outputs (time, (M,6) as `TARGETS`) as an extra: INS error north, east, down in metres."""
    values = dict(vars(solution)) | changed
    if outputs:
        t, error = (np.concatenate(part) for part in zip(*outputs, strict=True))
        lla, _ = ins.at(t)
        north, east = earth.metres_per_radian(lla[:, 0], lla[:, 2])
        place = np.column_stack([error[:, 3] * north, error[:, 4] * east, -error[:, 5]])
        values["extras"] = {"network_output": (t, place)}
        values["extra_names"] = {"network_output": ("north, m", "east, m", "down, m")}
    return NavSolution(**values)
