"""East-north-up and forward-left-up, in which robots and optical systems write, to the bench's n and b.

n is north-east-down, b forward-right-down: REP 103 of ROS and most other conventions differ from them by half a turn each.
Quaternions are scalar first and take a vector of the body into the world.
"""

from __future__ import annotations

import numpy as np

from testbed.data.records import Array
from testbed.formats.kinematics import multiply

FLIP = np.array([1.0, -1.0, -1.0])
"""Half a turn about x: forward-left-up to forward-right-down and back."""
_ENU_TO_NED = np.array([[0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0]])
_FLIPPED = np.array([[0.0, 1.0, 0.0, 0.0]])


def ned_of(enu: Array) -> Array:
    """(N,3) of east-north-up in north-east-down."""
    return enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


def into_ned(q: Array) -> Array:
    """Quaternions (N,4) of a sensor into east-north-up, as those into north-east-down."""
    return multiply(_ENU_TO_NED, q)


def attitudes(q: Array) -> Array:
    """q_nb (N,4) of quaternions that take forward-left-up into east-north-up."""
    return multiply(into_ned(q), _FLIPPED)
