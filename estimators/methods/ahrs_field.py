"""Whether a measured magnetic field can be that of the place: by its norm and dip, against a reference that follows slowly.

After the rejection of disturbances of VQF (Laidig and Seel 2023, doi:10.1016/j.inffus.2022.10.014, section 3.4): a field
is taken where norm and dip have been those of the reference for a while; one that stays steady while the sensor turns
becomes the new reference; and after a long rejection it is taken with doubt, because a heading must come from somewhere.
Kernels only; fields in µT, angles in rad, times in s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.kernels import njit

NORM, DIP, REFERENCE_NORM, REFERENCE_DIP, OTHER_NORM, OTHER_DIP, OTHER_TIME, CLEAN_TIME, REJECTED_TIME, AGE = range(10)
"""Places in ``FieldWatch.memory``."""
DOUBTED = 4.0
"""Factor on the variance of a field that is taken though it was rejected for long."""


class FieldWatch(NamedTuple):
    """The rule's settings, and what it remembers. ``norm_share`` 0: every field is taken."""

    norm_share: float
    dip: float  # rad
    averaging: float
    """s: of norm and dip."""
    start: float
    """s: the mean of this time at the start becomes the first reference."""
    reference: float
    """s: with which the reference follows an undisturbed field."""
    clean: float
    """s: a field must agree for so long before it is taken."""
    renewal: float
    """s: a steady field becomes the reference after so much turning."""
    turning: float
    """rad/s: slower than this a steady field tells nothing of the place."""
    patience: float
    """s: after so long a rejected field is taken with doubt; the time is given back at twice the speed."""
    memory: NDArray[np.float64]
    """(10,) overwritten."""


@njit(cache=True, nogil=True, _nrt=False)
def doubt_of_field(watch, m, rate, dt):
    """Factor on the variance of the field ``m`` (3, in n), the mean of ``dt`` (s), at a turn rate; 0: it is not to be used."""
    if watch.norm_share <= 0.0:
        return 1.0
    memory = watch.memory
    horizontal = np.hypot(m[0], m[1])
    norm, dip = np.hypot(horizontal, m[2]), np.arctan2(m[2], horizontal)
    memory[AGE] += dt
    if memory[AGE] <= watch.start + 0.5 * dt:
        share = dt / memory[AGE]
        memory[REFERENCE_NORM] += share * (norm - memory[REFERENCE_NORM])
        memory[REFERENCE_DIP] += share * (dip - memory[REFERENCE_DIP])
        memory[NORM], memory[DIP], memory[CLEAN_TIME] = norm, dip, watch.clean
        memory[OTHER_NORM], memory[OTHER_DIP] = norm, dip
        return 1.0
    share = 1.0 - np.exp(-dt / watch.averaging)
    memory[NORM] += share * (norm - memory[NORM])
    memory[DIP] += share * (dip - memory[DIP])
    disturbed = _compare_with_reference(watch, dt)
    if _is_new_reference(watch, rate, dt) and disturbed:
        memory[REFERENCE_NORM], memory[REFERENCE_DIP] = memory[OTHER_NORM], memory[OTHER_DIP]
        memory[CLEAN_TIME], disturbed = watch.clean, False
    if not disturbed:
        memory[REJECTED_TIME] = max(0.0, memory[REJECTED_TIME] - 2.0 * dt)
        return 1.0
    if memory[REJECTED_TIME] <= watch.patience:
        memory[REJECTED_TIME] += dt
        return 0.0
    return DOUBTED


@njit(cache=True, nogil=True, _nrt=False)
def _alike(watch, norm, dip):
    memory = watch.memory
    return abs(memory[NORM] - norm) < watch.norm_share * norm and abs(memory[DIP] - dip) < watch.dip


@njit(cache=True, nogil=True, _nrt=False)
def _compare_with_reference(watch, dt):
    """Whether the field is disturbed; a reference that it agrees with follows it."""
    memory = watch.memory
    if not _alike(watch, memory[REFERENCE_NORM], memory[REFERENCE_DIP]):
        memory[CLEAN_TIME] = 0.0
        return True
    memory[CLEAN_TIME] += dt
    if memory[CLEAN_TIME] < watch.clean:
        return True
    share = 1.0 - np.exp(-dt / watch.reference)
    memory[REFERENCE_NORM] += share * (memory[NORM] - memory[REFERENCE_NORM])
    memory[REFERENCE_DIP] += share * (memory[DIP] - memory[REFERENCE_DIP])
    return False


@njit(cache=True, nogil=True, _nrt=False)
def _is_new_reference(watch, rate, dt):
    """Whether another field than the reference has been steady through enough of turning."""
    memory = watch.memory
    if not _alike(watch, memory[OTHER_NORM], memory[OTHER_DIP]):
        memory[OTHER_NORM], memory[OTHER_DIP], memory[OTHER_TIME] = memory[NORM], memory[DIP], 0.0
        return False
    if rate >= watch.turning:
        memory[OTHER_TIME] += dt
    share = 1.0 - np.exp(-dt / watch.reference)
    memory[OTHER_NORM] += share * (memory[NORM] - memory[OTHER_NORM])
    memory[OTHER_DIP] += share * (memory[DIP] - memory[OTHER_DIP])
    return memory[OTHER_TIME] >= watch.renewal
