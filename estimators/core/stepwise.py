"""The error-state filter step by step in plain Python: the kernels of `estimators.core.filter`, called one at a time::

    f = make_estimator("eskf", aiding=["gnss", "baro"]).start(log)
    for k in range(len(log.imu.t)):
        while event := f.predict(k):
            f.update(*event)
    solution = f.solution()

gives the same numbers as ``run(log)``, bit for bit. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import typeof
from numpy.typing import ArrayLike, NDArray

from estimators.core.composition import Prepared, make_model, make_recording, make_timeline_of, solution_of
from estimators.core.filter import begin, correct, observe, predict, record
from estimators.core.model import AUX, REJECTED, put_triple, triple
from estimators.core.postponed import catch_up
from estimators.core.propagate import NAV
from estimators.core.timeline import SAME_TIME
from estimators.core.update import innovation_covariance
from testbed.base.errors import InputError, nearest
from testbed.data.records import NavSolution
from testbed.kernels import njit

Array = NDArray[np.float64]

AT_END = -1
"""What `go_on` returns when no event is left in the sample."""


@njit(cache=True, nogil=True)
def go_on(line, model, whole, k):
    """Carry the filter on to the next event within IMU sample ``k``, or to its end.

    A sample before ``k`` that is at its end is recorded. ``whole`` (1,) is the length of the open sample (s), 0 before the
    first is opened. Returns the event, or `AT_END`.
    """
    t, event_t, e = line.t, line.event_t, line.place[1]
    if k > line.place[0]:
        record(model, line.place[0])
        line.now[0] = t[line.place[0]]
        line.place[0] = k
        whole[0] = 0.0
    if whole[0] == 0.0:
        whole[0] = t[k] - line.now[0]
        begin(model, k, whole[0])
    has_event = e < event_t.shape[0] and event_t[e] <= t[k] + SAME_TIME
    target = min(event_t[e], t[k]) if has_event else t[k]
    dt = target - line.now[0]
    if dt > SAME_TIME:
        predict(model, k, dt, dt / whole[0])
        line.now[0] = target
    if not has_event:
        return AT_END
    line.place[1] = e + 1
    return e


@njit(cache=True, nogil=True)
def look(line, model, e):
    """Innovation and its covariance of event ``e`` into the model's work arrays; returns their size.

    What the filter goes on with stays as it is.
    """
    work = model.work
    catch_up(model)
    rate, force = triple(work.clean, 0), triple(work.clean, 3)
    count = observe(model, line.place[0], e)
    put_triple(work.clean, 0, rate)
    put_triple(work.clean, 3, force)
    s = work.s[: count * count].reshape((count, count))
    innovation_covariance(model.p, work.h[:count], work.r[:count], s, work.scratch)
    return count


@njit(cache=True, nogil=True)
def use(line, model, e):
    """Correct the filter by event ``e``."""
    correct(model, line.place[0], e)


@njit(cache=True, nogil=True)
def up_to_now(model):
    """Bring the covariance up to the time of the state."""
    catch_up(model)


@njit(cache=True, nogil=True)
def finish(model, k):
    """Keep the state at the end of ``k``, the last IMU sample."""
    record(model, k)


def _compiled(kernel: Any, *arguments: Any) -> Any:
    """A kernel for arguments of these types. Called by itself it takes 2 µs where numba's dispatcher, which looks at the
    type of every array in a model, takes 20."""
    return kernel.compile(tuple(typeof(argument) for argument in arguments))


class State:
    """The filter's present state by name: lat, lon, h, v_n, q_nb and the sensor-error states. Values may be set."""

    def __init__(self, values: Array, names: Sequence[str]) -> None:
        places: dict[str, Any] = {"lat": 0, "lon": 1, "h": 2, "v_n": slice(3, 6), "q_nb": slice(6, AUX)}
        places |= {name: AUX + k for k, name in enumerate(names)}
        object.__setattr__(self, "_values", values)
        object.__setattr__(self, "_places", places)

    def _place(self, name: str) -> Any:
        if name not in self._places:
            raise AttributeError(f"the filter has no state '{name}'; {nearest(name, self._places)}")
        return self._places[name]

    def __getattr__(self, name: str) -> Any:
        value = self._values[self._place(name)]
        return value if isinstance(value, np.ndarray) else float(value)

    def __setattr__(self, name: str, value: Any) -> None:
        self._values[self._place(name)] = value

    def __dir__(self) -> list[str]:
        return list(self._places)

    def __repr__(self) -> str:
        return "\n".join(f"{name} = {getattr(self, name)}" for name in self._places)


class Stepwise:
    """A filter on a log that goes a step when told. Any of its numbers may be looked at and changed between steps."""

    def __init__(self, prepared: Prepared) -> None:
        self._prepared, self._recording = prepared, make_recording(prepared)
        self._model, self._line = make_model(prepared, self._recording), make_timeline_of(prepared)
        self._whole, self._k, self._at_end = np.zeros(1), 0, False
        self._names = [aiding.name for aiding in prepared.aidings]
        self._event = {a: np.flatnonzero(prepared.events[:, 0] == k) for k, a in enumerate(self._names)}
        for places in self._event.values():
            places[:] = places[np.argsort(prepared.events[places, 1])]
        self._of_event = [(self._names[kind], int(row)) for kind, row in prepared.events]
        # R of its own, which `update` may change.
        events = self._model.events
        self._model = self._model._replace(events=events._replace(r=np.array(prepared.r), mix=np.array(events.mix)))
        filter_ = self._line, self._model
        self._go_on = _compiled(go_on, *filter_, self._whole, 0)
        self._look, self._use = (_compiled(kernel, *filter_, 0) for kernel in (look, use))
        self._catch_up = _compiled(up_to_now, self._model)
        self.state = State(self._model.state, prepared.states[NAV:])
        """See `State`; a view, always of the present."""
        self.states = prepared.states
        """Names of the rows of `P`."""

    @property
    def P(self) -> Array:
        """Covariance of the errors, a view of the present: metres, m/s, rotation vector in n, sensor-error states.

        Where states wait (`estimators.core.postponed`) it is carried on for every look; that is rounded otherwise than by `run`.
        """
        n = len(self.states)
        self._catch_up(self._model)
        return self._model.p[:n, :n]

    @property
    def t(self) -> float:
        """Time of the state (s)."""
        return float(self._line.now[0])

    def predict(self, k: int) -> tuple[str, int] | None:
        """Carry state and covariance to the end of IMU sample ``k``, or up to the next event within it.

        Returns the event as `update` takes it, to be used or passed over; call it again with the same ``k`` until it
        returns None. Samples go one after the other: raises InputError where one is left out.
        """
        if k != self._k and not (k == self._k + 1 and self._at_end and k < len(self._line.t)):
            expected = f"predict({self._k})" + ("" if self._at_end else " until it returns None")
            if self._at_end and self._k + 1 < len(self._line.t):
                expected += f" or predict({self._k + 1})"
            raise InputError(f"predict({k}): IMU samples go one after the other; expected {expected}")
        self._k = k
        e = self._go_on(self._line, self._model, self._whole, k)
        self._at_end = e == AT_END
        return None if self._at_end else self._of_event[e]

    def update(self, aiding: str, j: int, R: ArrayLike | None = None) -> bool:
        """Correct the present state by sample ``j`` of an aiding, through its policy; whether it was used.

        ``R``: noise variances (m,) in place of the stated ones, SI units.
        """
        e = self._find(aiding, j)
        if R is None:
            self._use(self._line, self._model, e)
        else:
            row = self._model.events.r[e]
            stated, row[:] = row.copy(), self._variances(aiding, R, len(row))
            mix = self._mix(e, len(row))
            as_stated, mix[:] = mix.copy(), np.eye(len(row))
            self._use(self._line, self._model, e)
            row[:], mix[:] = stated, as_stated
        return bool(self._recording.fading[e] != REJECTED)

    def innovation(self, aiding: str, j: int) -> tuple[Array, Array]:
        """What sample ``j`` of an aiding would tell: z minus its prediction (m,), and the covariance H P H' + R of it."""
        e = self._find(aiding, j)
        m = self._look(self._line, self._model, e)
        work, mix = self._model.work, self._mix(e, len(self._model.events.r[e]))[:m, :m]
        return mix @ work.residual[:m], mix @ work.s[: m * m].reshape(m, m) @ mix.T

    def R(self, aiding: str, j: int) -> Array:
        """The stated noise variances (m,) of sample ``j`` of an aiding."""
        e = self._find(aiding, j)
        m, r = self._model.events.rows[self._prepared.events[e, 0]], self._model.events.r[e]
        return (self._mix(e, len(r)) ** 2 @ r)[:m]

    def solution(self) -> NavSolution:
        """What was recorded at the end of each IMU sample. Raises InputError before the last one is done."""
        done = self._k + self._at_end
        if done < len(self._line.t):
            raise InputError(
                f"solution(): the filter has done {done} of {len(self._line.t)} IMU samples; predict the rest"
            )
        finish(self._model, self._k)
        return solution_of(self._prepared, self._recording)

    def _mix(self, e: int, width: int) -> Array:
        """How the noise of an event is correlated, see `estimators.core.model.Events`; a view where it is."""
        mix = self._model.events.mix
        return mix[e] if len(mix) else np.eye(width)

    def _find(self, aiding: str, j: int) -> int:
        """The event that is sample ``j`` of an aiding, once a sample is open."""
        if aiding not in self._event:
            raise InputError(f"'{aiding}' is no aiding of this filter; {nearest(aiding, self._names)}")
        if not 0 <= j < len(self._event[aiding]):
            raise InputError(f"'{aiding}' has samples 0 to {len(self._event[aiding]) - 1}, not {j}")
        if self._whole[0] == 0.0:
            raise InputError("predict(0) comes before the first update")
        return int(self._event[aiding][j])

    def _variances(self, aiding: str, R: ArrayLike, width: int) -> Array:
        m = self._model.events.rows[self._names.index(aiding)]
        given = np.asarray(R, dtype=float)
        if given.shape != (m,) or not np.isfinite(given).all() or given.min() <= 0.0:
            raise InputError(f"update('{aiding}'): R must be {m} positive variances, got {R!r}")
        return np.concatenate([given, np.ones(width - m)])
