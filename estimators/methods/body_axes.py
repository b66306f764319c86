"""Two sets of body axes for filters whose states are Euler angles: b, and near the pole of its angles b', a quarter turn away.

ZYX angles are singular at a pitch of ±90°. The axes x' = z, y' = y, z' = -x of b have a pitch near 0 where b's is near ±90°, and
C_nb' = C_nb C_bb' is an attitude like any other: the same equations hold, with gyros, accelerometers, biases and lever arm in b'.
A state and its covariance change axes without loss (the map of errors is linear: the rotation vector in n is the same). So the
angles are those of the 2023 paper below `LEAVE`, and a switched sequence above. SI, rad; kernels only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from estimators.core.timeline import inner
from testbed.kernels import njit
from testbed.kernels.lanes import any_of, select
from testbed.physics.rotations import euler_error_matrix, euler_to_quat, quat_multiply, quat_to_euler

Array = NDArray[np.float64]

LEAVE = np.radians(80.0)
"""Pitch above which b' takes over: 1 / cos, the gain of the Euler kinematics, is 5.8 there."""
RETURN = np.radians(70.0)
"""Pitch below which b does again: far enough apart that noise does not switch back and forth."""
HALF = np.sqrt(0.5)
TURN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""From b to b', as `turn_triple` does it in place."""


class Axes(NamedTuple):
    """The axes that a filter is in, and the samples of the IMU in them."""

    turned: NDArray[np.uint8]
    """(1,): 1 in b', overwritten."""
    samples: Array
    """(2,6): the last sample and the present one, overwritten."""
    history: NDArray[np.uint8]
    """(N,): the axes in which each sample was recorded; empty for a filter that is to stay in its axes."""


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def load(axes, imu, k):
    """Put samples ``k`` - 1 and ``k`` of the IMU (N,6) into the filter's axes."""
    for row in range(2):
        source, target = imu[max(k - 1 + row, 0)], axes.samples[row]
        for i in range(6):
            target[i] = source[i]
        if axes.turned[0]:
            turn_triple(target, 0, 1.0)
            turn_triple(target, 3, 1.0)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def turn_triple(v, first, sign):
    """A vector in an array from b to b' (``sign`` 1) or back (-1), in place: (z, y, -x) or (-z, y, x)."""
    x, z = v[first], v[first + 2]
    v[first], v[first + 2] = sign * z, -sign * x


@njit(cache=True, nogil=True, _nrt=False)
def near_pole(turned, roll, pitch):
    """Whether the other axes should take over from those in which the angles are given."""
    if turned:  # the x axis of b is -z'
        return abs(np.cos(pitch) * np.cos(roll)) < np.sin(RETURN)
    return abs(pitch) > LEAVE


@njit(cache=True, nogil=True, _nrt=False)
def turned_angles(roll, pitch, yaw, sign):
    """Euler angles of the same attitude in b' (``sign`` 1) or in b (-1)."""
    return quat_to_euler(quat_multiply(euler_to_quat(roll, pitch, yaw), (HALF, 0.0, -sign * HALF, 0.0)))


def turn_state(x, p, sign):
    """State (15,) and covariance (15,15) from b to b' (``sign`` 1) or back (-1), in place. Kernels only, not on tables."""
    raise NotImplementedError("kernels only")


@overload(turn_state)
def _turn_state_of(x, p, sign):
    return _turn_state if isinstance(x, types.Array) else lambda x, p, sign: None


def _turn_state(x, p, sign):
    old = euler_error_matrix(x[6], x[7], x[8])
    x[6], x[7], x[8] = turned_angles(x[6], x[7], x[8], sign)
    turn_triple(x, 9, sign)
    turn_triple(x, 12, sign)
    cp, tp, cy, sy = np.cos(x[7]), np.tan(x[7]), np.cos(x[8]), np.sin(x[8])
    for axis in range(2):  # the rows, then the columns
        for j in range(15):
            v = p[:, j] if axis == 0 else p[j]
            a, b, c = v[6], v[7], v[8]
            north = old[0][0] * a + old[0][1] * b
            east = old[1][0] * a + old[1][1] * b
            down = old[2][0] * a + c
            along = cy * north + sy * east
            v[6], v[7], v[8] = along / cp, cy * east - sy * north, down + tp * along
            turn_triple(v, 9, sign)
            turn_triple(v, 12, sign)
    for i in range(15):
        for j in range(i):
            p[j, i] = p[i, j]


@njit(cache=True, nogil=True, _nrt=False)
def turn_setting(setting, sign):
    """Means of the biases and the lever arm, in place."""
    turn_triple(setting.centre, 0, sign)
    turn_triple(setting.centre, 3, sign)
    turn_triple(setting.lever, 0, sign)


@njit(cache=True, nogil=True, _nrt=False)
def turn_noise(noise):
    """Densities (13,) along the axes of the body (`motion_models.add_process_noise`), in place: x and z change places."""
    for first in (0, 3, 6, 9):
        noise[first], noise[first + 2] = noise[first + 2], noise[first]


def may_turn(x, near):
    """Whether a filter near the pole may change its axes; side by side none may, and those that are there become NaN.

    Kernels only. Whoever reads the lanes runs such a filter again by itself.
    """
    raise NotImplementedError("kernels only")


@overload(may_turn)
def _may_turn(x, near):
    if isinstance(x, types.Array):
        return lambda x, near: True

    def lose(x, near):
        for i in range(6, 9):
            x[i] = select(near, np.nan, x[i])
        return False

    return lose


@inner
def mind_the_pole(model, k):
    """Note the axes of sample ``k``, and change over where the single filter ``model`` has come near the pole of its own."""
    axes, x = model.axes, model.state
    if k >= axes.history.shape[0]:
        return
    axes.history[k] = axes.turned[0]
    near = near_pole(axes.turned[0], x[6], x[7])
    if any_of(near) and may_turn(x, near):
        sign = -1.0 if axes.turned[0] else 1.0
        turn_state(x, model.p, sign)
        turn_setting(model.motion.setting, sign)
        turn_noise(model.motion.noise)
        axes.turned[0] = 1 - axes.turned[0]
