"""Errors of a solution in one compiled pass, and what the metrics need of them over stretches of rows.

The rows are worked through in blocks that stay in the processor's nearest cache; nothing of their number is allocated. Within
a block every loop is without calls and branches, so that the compiler does several rows at once. Errors are estimate minus
truth: metres and m/s along n, Euler angles in degrees, the attitude error a rotation vector in n, rad.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from testbed.data.records import Array
from testbed.physics import earth, rotations

BLOCK = 128
"""Rows: 21 columns of them take 21 kB of the 32 kB of a first cache."""
COLUMNS = 15
"""The quantities of `testbed.scoring.quantities.QUANTITIES`, in their order."""
PHI = 15
"""Where the three columns of the rotation vector stand, behind the quantities."""
AXES = (0, 1, 2, 5, 6, 7, 9, 10, 11)
"""Columns of the signed errors, in the order of `testbed.scoring.quantities.AXES`."""
_WIDTH = 18
_UNSIGNED = np.int64(0x7FFFFFFFFFFFFFFF)


class Motion(NamedTuple):
    """Latitude, longitude (rad) and height (N,), velocity (N,3) and attitude (N,4) of truth or estimate, row for row."""

    lat: Array
    lon: Array
    h: Array
    v_n: Array
    q_nb: Array


class Described(NamedTuple):
    """Of each stretch of rows (S,) per quantity (S,15): sum, sum of squares, largest size, last value."""

    total: Array
    squares: Array
    largest: Array
    last: Array


@njit(inline="always")
def arctan2(y, x):
    """The angle of (x, y), as `numpy.arctan2` to 1e-15 of itself, in a form that compiles to vector instructions.

    tan(a/2) = tan a / (1 + sqrt(1 + tan² a)), twice, brings an angle of up to 45° to 11.25°, where the series up to the 19th
    power leaves out less than a part in 1e15; the other octants follow by symmetry.
    """
    size_y, size_x = abs(y), abs(x)
    steep = size_y > size_x
    near, far = (size_x, size_y) if steep else (size_y, size_x)
    tan = near / far if far > 0.0 else 0.0 * (near + far)
    tan = tan / (1.0 + np.sqrt(1.0 + tan * tan))
    tan = tan / (1.0 + np.sqrt(1.0 + tan * tan))
    z = tan * tan
    s = 1.0 / 19.0 - z / 21.0
    s = 1.0 / 17.0 - z * s
    s = 1.0 / 15.0 - z * s
    s = 1.0 / 13.0 - z * s
    s = 1.0 / 11.0 - z * s
    s = 1.0 / 9.0 - z * s
    s = 1.0 / 7.0 - z * s
    s = 1.0 / 5.0 - z * s
    s = 1.0 / 3.0 - z * s
    angle = 4.0 * (tan - tan * z * s)
    angle = 0.5 * np.pi - angle if steep else angle
    angle = np.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@njit(inline="always")
def _wrapped(angle):
    """`rotations.wrap` of a number, to the bit."""
    turned = angle + np.pi
    return turned - 2.0 * np.pi * np.floor(turned / (2.0 * np.pi)) - np.pi


@njit(cache=True, error_model="numpy")
def _places(truth, estimate, first, n, out):
    """Position errors of rows ``first`` to ``first + n`` into columns 0 to 4 of ``out`` (18, BLOCK)."""
    lat, lon, h = truth.lat[first : first + n], truth.lon[first : first + n], truth.h[first : first + n]
    own_lat, own_lon = estimate.lat[first : first + n], estimate.lon[first : first + n]
    own_h = estimate.h[first : first + n]
    for k in range(n):
        out[3, k], out[4, k] = earth.metres_per_radian(lat[k], h[k])
    for k in range(n):
        north = (own_lat[k] - lat[k]) * out[3, k]
        east = _wrapped(own_lon[k] - lon[k]) * out[4, k]
        down = h[k] - own_h[k]
        out[0, k], out[1, k], out[2, k] = north, east, down
        out[3, k] = np.sqrt(north * north + east * east)
        out[4, k] = np.sqrt(north * north + east * east + down * down)


@njit(cache=True, error_model="numpy")
def _velocities(truth, estimate, first, n, out):
    """Velocity errors into columns 5 to 8."""
    v, own = truth.v_n[first : first + n], estimate.v_n[first : first + n]
    for k in range(n):
        north, east, down = own[k, 0] - v[k, 0], own[k, 1] - v[k, 1], own[k, 2] - v[k, 2]
        out[5, k], out[6, k], out[7, k] = north, east, down
        out[8, k] = np.sqrt(north * north + east * east + down * down)


@njit(cache=True, error_model="numpy")
def _turns(truth, estimate, first, n, out):
    """The rotation vector into columns 15 to 17, its size, and its parts about down and about the horizontal into 12 to 14.

    From the error's quaternion (w, x, y, z): half of the whole angle is atan2(|(x, y, z)|, |w|), of its turn about down
    atan2(|z|, |w|), and of what that leaves atan2(|(x, y)|, |(w, z)|) (Laidig et al. 2021, doi:10.3390/data6070072).
    """
    q, own = truth.q_nb[first : first + n], estimate.q_nb[first : first + n]
    for k in range(n):
        p = rotations.quat_multiply(
            (own[k, 0], own[k, 1], own[k, 2], own[k, 3]), (q[k, 0], -q[k, 1], -q[k, 2], -q[k, 3])
        )
        level = p[1] * p[1] + p[2] * p[2]
        sine = np.sqrt(level + p[3] * p[3])
        half = arctan2(sine, abs(p[0]))
        sign = 2.0 if p[0] >= 0.0 else -2.0
        scale = sign if sine < 1e-10 else sign * half / sine
        out[PHI, k], out[PHI + 1, k], out[PHI + 2, k] = scale * p[1], scale * p[2], scale * p[3]
        out[12, k] = half * (360.0 / np.pi)
        out[13, k] = arctan2(abs(p[3]), abs(p[0])) * (360.0 / np.pi)
        out[14, k] = arctan2(np.sqrt(level), np.sqrt(p[0] * p[0] + p[3] * p[3])) * (360.0 / np.pi)


@njit(inline="always")
def _halves(q):
    """Sine and cosine, up to a factor each, of half sum and half difference of yaw and roll, and the pitch's (`rotations.quat_to_euler`)."""
    up_cos, up_sin, down_cos, down_sin = q[0] - q[2], q[1] + q[3], q[0] + q[2], q[1] - q[3]
    up, down = np.sqrt(up_cos * up_cos + up_sin * up_sin), np.sqrt(down_cos * down_cos + down_sin * down_sin)
    return up_sin, up_cos, down_sin, down_cos, 2.0 * (q[0] * q[2] - q[1] * q[3]), up * down, up, down


@njit(inline="always")
def _between(sine, cosine, sine_ref, cosine_ref):
    """Difference of two angles that are known by multiples of their sines and cosines."""
    return arctan2(sine * cosine_ref - cosine * sine_ref, cosine * cosine_ref + sine * sine_ref)


@njit(cache=True, error_model="numpy")
def _eulers(truth, estimate, first, n, out):
    """Differences of the Euler angles, degrees, into columns 9 to 11: by one arctangent each, not as differences of six."""
    q, own = truth.q_nb[first : first + n], estimate.q_nb[first : first + n]
    poles = 0
    for k in range(n):
        ys, yc, zs, zc, ps, pc, up, down = _halves((q[k, 0], q[k, 1], q[k, 2], q[k, 3]))
        a, b, c, d, e, f, own_up, own_down = _halves((own[k, 0], own[k, 1], own[k, 2], own[k, 3]))
        half_sum, half_difference = _between(a, b, ys, yc), _between(c, d, zs, zc)
        out[9, k] = _wrapped(half_sum + half_difference) * (180.0 / np.pi)
        out[10, k] = _between(e, f, ps, pc) * (180.0 / np.pi)
        out[11, k] = _wrapped(half_sum - half_difference) * (180.0 / np.pi)
        level = rotations.EULER_POLE
        poles += (up < level * down) | (down < level * up) | (own_up < level * own_down) | (own_down < level * own_up)
    if poles:
        for k in range(n):  # where roll and yaw are one angle, which of them has it is a convention
            euler, true = rotations.quat_to_euler(own[k]), rotations.quat_to_euler(q[k])
            for i in range(3):
                out[9 + i, k] = _wrapped(euler[i] - true[i]) * (180.0 / np.pi)


@njit(cache=True)
def _errors(truth, estimate, first, n, out):
    """All columns of rows ``first`` to ``first + n`` into ``out`` (18, BLOCK)."""
    _places(truth, estimate, first, n, out)
    _velocities(truth, estimate, first, n, out)
    _turns(truth, estimate, first, n, out)
    _eulers(truth, estimate, first, n, out)


@njit(cache=True)
def error_rows(truth, estimate):
    """Signed errors (N,9) and rotation vectors (N,3) of all rows."""
    rows = truth.lat.shape[0]
    values, phi, out = np.empty((rows, 9)), np.empty((rows, 3)), np.empty((_WIDTH, BLOCK))
    for first in range(0, rows, BLOCK):
        n = min(BLOCK, rows - first)
        _errors(truth, estimate, first, n, out)
        for k in range(n):
            for i in range(9):
                values[first + k, i] = out[AXES[i], k]
            for i in range(3):
                phi[first + k, i] = out[PHI + i, k]
    return values, phi


@njit(cache=True)
def _sums(x, n):
    """Sum and sum of squares of the first ``n``: four sums side by side, which a processor adds four times as fast as one."""
    a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = 0.0
    fours = n // 4 * 4
    for k in range(0, fours, 4):
        p, q, r, s = x[k], x[k + 1], x[k + 2], x[k + 3]
        a0, a1, a2, a3 = a0 + p, a1 + q, a2 + r, a3 + s
        b0, b1, b2, b3 = b0 + p * p, b1 + q * q, b2 + r * r, b3 + s * s
    for k in range(fours, n):
        a0, b0 = a0 + x[k], b0 + x[k] * x[k]
    return (a0 + a1) + (a2 + a3), (b0 + b1) + (b2 + b3)


@njit(cache=True)
def _largest(bits, n, largest):
    """The largest of ``largest`` and the sizes of the first ``n``, numbers as the integers that stand for them.

    Without their signs these are in the order of the numbers, NaN above all, so that it stays once it has come.
    """
    for k in range(n):
        size = bits[k] & _UNSIGNED
        largest = size if size > largest else largest
    return largest


@njit(cache=True)
def _describe(truth, estimate, first, n, out, into, s):
    """Add rows ``first`` to ``first + n``, at most a block of them, to the stretch ``s`` of ``into``."""
    _errors(truth, estimate, first, n, out)
    bits, sizes = out.view(np.int64), into.largest.view(np.int64)
    for i in range(COLUMNS):
        total, squares = _sums(out[i], n)
        into.total[s, i] += total
        into.squares[s, i] += squares
        sizes[s, i] = _largest(bits[i], n, sizes[s, i])
        into.last[s, i] = out[i, n - 1]


@njit(cache=True)
def _nothing(stretches):
    shape = (stretches, COLUMNS)
    return Described(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.full(shape, np.nan))


@njit(cache=True)
def describe_blocks(truth, estimate):
    """`Described` of each `BLOCK` of rows (the last may be shorter): the one pass over a solution."""
    rows = truth.lat.shape[0]
    found, out = _nothing((rows + BLOCK - 1) // BLOCK), np.empty((_WIDTH, BLOCK))
    for first in range(0, rows, BLOCK):
        _describe(truth, estimate, first, min(BLOCK, rows - first), out, found, first // BLOCK)
    return found


@njit(cache=True)
def describe_spans(truth, estimate, blocks, spans):
    """`Described` of spans (S,2) of rows, none empty: of whole ``blocks`` what `describe_blocks` found, of their ends the rows."""
    found, out = _nothing(spans.shape[0]), np.empty((_WIDTH, BLOCK))
    sizes, of_blocks = found.largest.view(np.int64), blocks.largest.view(np.int64)
    for s in range(spans.shape[0]):
        start, end = spans[s, 0], spans[s, 1]
        while start < end:
            block = start // BLOCK
            stop = (block + 1) * BLOCK
            if start % BLOCK == 0 and (stop <= end or end == truth.lat.shape[0]):
                for i in range(COLUMNS):
                    found.total[s, i] += blocks.total[block, i]
                    found.squares[s, i] += blocks.squares[block, i]
                    sizes[s, i] = max(sizes[s, i], of_blocks[block, i])
                    found.last[s, i] = blocks.last[block, i]
            else:
                _describe(truth, estimate, start, min(stop, end) - start, out, found, s)
            start = stop
    return found
