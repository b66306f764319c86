"""The steps of the error-state filter as compiled functions that Python calls; the filter has them only inside of its loops."""

from numba import njit

from estimators.core import filter as error_state
from estimators.core import postponed

begin, predict, correct, record = map(
    njit, (error_state.begin, error_state.predict, error_state.correct, error_state.record)
)
move, spread, retract = map(njit, (error_state.move, error_state.spread, error_state.retract))


@njit
def catch_up(model):
    """The covariance of states that wait, brought up to the present."""
    postponed.catch_up(model)
