"""The third noun of the bench, an estimator's answer: `NavSolution`, its innovations, and the names of error states.

SI units and radians; frames n north-east-down, b forward-right-down. Errors are estimate minus truth.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.columns import Array, columns, exact_columns, pva_columns, read_pva, read_table, stack, write_table
from testbed.data.shapes import check_arrays, check_real
from testbed.data.shown import Shown

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

POSITION_STATES = ("position_north_m", "position_east_m", "position_down_m")
VELOCITY_STATES = ("velocity_north_mps", "velocity_east_mps", "velocity_down_mps")
ATTITUDE_STATES = ("attitude_north_rad", "attitude_east_rad", "attitude_down_rad")
ACCEL_BIAS_STATES = ("accel_bias_x_mps2", "accel_bias_y_mps2", "accel_bias_z_mps2")
GYRO_BIAS_STATES = ("gyro_bias_x_radps", "gyro_bias_y_radps", "gyro_bias_z_radps")
NAVIGATION_STATES = POSITION_STATES + VELOCITY_STATES + ATTITUDE_STATES
STATE_NAMES = NAVIGATION_STATES + ACCEL_BIAS_STATES + GYRO_BIAS_STATES
"""The error states that the bench knows the truth of: position (m), velocity and attitude (rotation vector) in n,
accelerometer and gyro bias in b; the order of `InitialState.std`. A filter may name others as it likes, with the unit last."""


UNIT_TOLERANCE = 1e-3
"""Of a quaternion's norm: far above rounding, also that of single precision, and far below what an angle would notice."""
GNSS_CHANNELS = ("north, m", "east, m", "down, m", "north, m/s", "east, m/s", "down, m/s")
"""Names of the six channels of a loosely coupled filter's innovation."""


@dataclass(frozen=True, repr=False)
class Innovations(Shown):
    """A filter's innovations at one aiding: ``t`` (M,), ``value`` (M,m), ``covariance`` (M,m,m), in SI units of the measurement.

    ``names`` of the m channels, for plots; six unnamed channels are position and velocity of a GNSS fix. ``rejected`` (M,)
    marks updates that the filter's policy refused: they are shown, and do not count in NIS.
    """

    t: Array
    value: Array
    covariance: Array
    names: tuple[str, ...] = ()
    rejected: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        shapes: dict[str, tuple[int | None, ...]] = {"value": (None,), "covariance": (None, None)}
        # satellites of one epoch are measurements of one time
        check_arrays(self, "NavSolution.innovations", shapes, minimum=0, finite=False, repeats=True)
        m = self.value.shape[1]
        if self.covariance.shape[1:] != (m, m):
            raise InputError(
                f"NavSolution.innovations: 'covariance' has shape {self.covariance.shape}, expected {(len(self.t), m, m)}"
            )
        if self.rejected is not None:
            rejected = np.asarray(self.rejected)
            if rejected.shape != self.t.shape or rejected.dtype != np.bool_:
                raise InputError(
                    f"NavSolution.innovations: 'rejected' is {rejected.dtype} of shape {rejected.shape}, expected true or "
                    f"false for each of {len(self.t)} updates"
                )
            object.__setattr__(self, "rejected", rejected)

    @property
    def channels(self) -> tuple[str, ...]:
        """Name of every channel: those given, a GNSS fix's for six unnamed ones, else numbers."""
        m = self.value.shape[1]
        if len(self.names) >= m:
            return self.names
        return GNSS_CHANNELS if m == len(GNSS_CHANNELS) else tuple(f"channel {k + 1}" for k in range(m))

    def taken(self) -> Innovations:
        """Those that the filter used: without the rejected ones."""
        if self.rejected is None:
            return self
        keep = ~self.rejected
        return Innovations(self.t[keep], self.value[keep], self.covariance[keep], self.names)


@dataclass(frozen=True, repr=False)
class NavSolution(Shown):
    """An estimator's answer, usually at the IMU times.

    ``t`` (N,), ``lat``, ``lon``, ``h``, ``v_n``, ``q_nb`` as in `Trajectory`; ``accel_bias``, ``gyro_bias`` (N,3) in b;
    ``estimates`` maps the names of further states to (N,) values.
    ``states`` names the n error states that the estimator has: of `STATE_NAMES` those that it estimates, and any of its own
    (``accel_scale_x``). What is named is scored, what is not named is not; without names, or with none of position, velocity
    and attitude among them, all of the navigation is. ``std`` (N,n) is 1 sigma in their order; ``covariance_t`` (K,) and
    ``covariance`` (K,n,n) are snapshots for consistency tests (about 1 Hz).
    ``innovations`` maps an aiding to its `Innovations`; one alone counts as ``gnss``. ``extras`` maps names to (time (J,),
    values (J,) or (J,c)) pairs: mode probabilities, fading factors, network outputs. Non-finite values are allowed: the
    scorer counts them as divergence. Raises InputError for a wrong shape, complex numbers, times that do not increase, a
    negative ``std``, or a quaternion that is not of unit length.
    """

    t: Array
    lat: Array
    lon: Array
    h: Array
    v_n: Array
    q_nb: Array
    accel_bias: Array | None = None
    gyro_bias: Array | None = None
    std: Array | None = None
    covariance_t: Array | None = None
    covariance: Array | None = None
    innovations: Mapping[str, Innovations] = field(default_factory=dict)
    extras: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    extra_names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of the columns of an extra, for legends."""
    states: tuple[str, ...] = ()
    estimates: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", _named_states(self))
        if isinstance(self.innovations, Innovations):
            object.__setattr__(self, "innovations", {"gnss": self.innovations})
        elif self.innovations is None:
            object.__setattr__(self, "innovations", {})
        shapes: dict[str, tuple[int | None, ...]] = {"lat": (), "lon": (), "h": (), "v_n": (3,), "q_nb": (4,)}
        optional = {"accel_bias": (3,), "gyro_bias": (3,), "std": (len(self.states),)}
        shapes |= {key: shape for key, shape in optional.items() if getattr(self, key) is not None}
        check_arrays(self, "NavSolution", shapes, finite=False)
        _check_std(self)
        _check_snapshots(self)
        for name, values in self.estimates.items():
            check_real(values, "NavSolution", f"estimates.{name}")
            if np.shape(values) != self.t.shape:
                raise InputError(f"NavSolution: estimate '{name}' has shape {np.shape(values)}, not {self.t.shape}")
        for name, extra in self.extras.items():
            check_real(extra[-1], "NavSolution", f"extras.{name}")
        norm = np.sqrt(np.einsum("ij,ij->i", self.q_nb, self.q_nb))
        if (off := np.abs(norm - 1.0) > UNIT_TOLERANCE).any():  # False where the norm is not finite: divergence
            k = int(np.argmax(off))
            raise InputError(
                f"NavSolution: 'q_nb' must be unit quaternions, but has norm {norm[k]:.6g} at sample {k} (t = {self.t[k]:.6g} s)"
            )

    def plot(self) -> Figure:
        """A figure (matplotlib): estimated ground track, height, speed and attitude; errors: `testbed.plot_errors`."""
        from testbed.data import plots

        return plots.motion(self.t, (self.lat, self.lon, self.h), self.v_n, self.q_nb)

    def to_frame(self) -> pd.DataFrame:
        """Columns as in `Trajectory`, then biases, estimates, and ``std_`` + state name, as far as the estimator gives them."""
        import pandas as pd

        table = pva_columns(self.t, self.lat, self.lon, self.h, self.v_n, self.q_nb)
        if self.accel_bias is not None:
            table |= columns("accel_bias_{}_mps2", "xyz", self.accel_bias)
        if self.gyro_bias is not None:
            table |= columns("gyro_bias_{}_radps", "xyz", self.gyro_bias)
        table |= {f"estimate_{name}": np.asarray(values) for name, values in self.estimates.items()}
        if self.std is not None:
            table |= columns("std_{}", self.states, self.std)
        return pd.DataFrame(table)

    def save(self, path: str | Path) -> None:
        """Write Parquet: the table of `to_frame` (innovations, snapshots and extras are not kept)."""
        frame = self.to_frame().assign(**exact_columns(self.lat, self.lon, self.q_nb))
        write_table(frame, path, "NavSolution", {"states": list(self.states), "estimates": list(self.estimates)})

    @classmethod
    def load(cls, path: str | Path) -> NavSolution:
        """Read what `save` wrote, now or in version 0.1, where the states were always the 15 of `STATE_NAMES`."""
        table, meta = read_table(path, "NavSolution")
        known = "std_" + STATE_NAMES[0] in table
        states = tuple(meta.get("states", STATE_NAMES if known else ()))
        return cls(
            **read_pva(table),
            accel_bias=stack(table, "accel_bias_{}_mps2", "xyz") if "accel_bias_x_mps2" in table else None,
            gyro_bias=stack(table, "gyro_bias_{}_radps", "xyz") if "gyro_bias_x_radps" in table else None,
            std=stack(table, "std_{}", states) if states and "std_" + states[0] in table else None,
            states=states,
            estimates={name: table[f"estimate_{name}"] for name in meta.get("estimates", ())},
        )


def _named_states(solution: NavSolution) -> tuple[str, ...]:
    """The states' names, checked; a solution of version 0.1 gives none and has the 15 of `STATE_NAMES`."""
    states = tuple(solution.states)
    if twice := sorted({name for name in states if states.count(name) > 1}):
        raise InputError(f"NavSolution: 'states' names {', '.join(twice)} twice")
    if states or (solution.std is None and solution.covariance is None):
        return states
    widths = {np.shape(values)[-1] for values in (solution.std, solution.covariance) if values is not None}
    width = widths.pop()
    if width != len(STATE_NAMES):
        raise InputError(
            f"NavSolution: 'std' or 'covariance' is of {width} states; name them: states=('position_north_m', ...), of "
            "testbed.data.records.STATE_NAMES those that are estimated, and your own"
        )
    warnings.warn(
        "a NavSolution with 'std' or 'covariance' of 15 states names them from version 0.3 on: "
        "NavSolution(..., states=testbed.data.records.STATE_NAMES), or only those that the filter estimates",
        FutureWarning,
        stacklevel=4,
    )
    return STATE_NAMES


def _check_std(solution: NavSolution) -> None:
    if solution.std is not None and (negative := solution.std < 0.0).any():
        k, n = (int(i) for i in np.argwhere(negative)[0])
        raise InputError(
            f"NavSolution: 'std' is 1 sigma and must not be negative, but that of {solution.states[n]} is "
            f"{solution.std[k, n]:.6g} at sample {k} (t = {solution.t[k]:.6g} s)"
        )


def _check_snapshots(solution: NavSolution) -> None:
    if solution.covariance is None and solution.covariance_t is None:
        return
    for name in ("covariance", "covariance_t"):
        check_real(getattr(solution, name), "NavSolution", name)
    n = len(solution.states)
    found = np.shape(np.asarray(solution.covariance)), np.shape(np.asarray(solution.covariance_t))
    if len(found[0]) != 3 or found[0] != (*found[1], n, n):
        raise InputError(
            f"NavSolution: 'covariance' has shape {found[0]} and 'covariance_t' {found[1]}, expected (K, {n}, {n}) and (K,)"
        )
