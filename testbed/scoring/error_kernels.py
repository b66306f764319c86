"""Errors of a solution in one compiled pass, and what the metrics need of them over stretches of rows.

The rows are worked through in blocks that stay in the processor's nearest cache; nothing of their number is allocated. Within
a block every loop is short and without calls and branches, so that the compiler does several rows at once. Errors are estimate minus
truth: metres and m/s along n, Euler angles in degrees, the attitude error a rotation vector in n, rad.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from testbed.data.records import Array
from testbed.kernels import njit
from testbed.physics import earth, rotations

BLOCK = 128
"""Rows: 24 columns of them take 24 of the 32 kB of a first cache."""
COLUMNS = 15
"""The quantities of `testbed.scoring.quantities.QUANTITIES`, in their order."""
PHI = 15
"""Where the three columns of the rotation vector stand, behind the quantities."""
AXES = (0, 1, 2, 5, 6, 7, 9, 10, 11)
"""Columns of the signed errors, in the order of `testbed.scoring.quantities.AXES`."""
_SCRATCH = 18
"""Six columns more, for what passes between two loops: a loop with more than a dozen arrays is not made into vector instructions."""
_WIDTH = 24
SMALL = 0.1989
"""tan 11.25°"""
CLOSE = 0.01
"""Latitudes (rad) from the first of a block, 60 km, up to which four terms of a series are exact: 0.01⁸ / 8! is 2e-21."""
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
def _arctangent(tan):
    """Of up to 0.1989: the series up to the 21st power leaves out less than a part in 1e16."""
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
    return tan - tan * z * s


@njit(inline="always")
def arctan2(y, x):
    """The angle of (x, y), as `numpy.arctan2` to 1e-15 of itself, in a form that compiles to vector instructions.

    tan(a/2) = tan a / (1 + sqrt(1 + tan² a)), twice, brings an angle of up to 45° to 11.25°; the other octants follow by symmetry.
    """
    size_y, size_x = abs(y), abs(x)
    steep = size_y > size_x
    near, far = (size_x, size_y) if steep else (size_y, size_x)
    tan = near / far if far > 0.0 else 0.0 * (near + far)
    tan = tan / (1.0 + np.sqrt(1.0 + tan * tan))
    tan = tan / (1.0 + np.sqrt(1.0 + tan * tan))
    angle = 4.0 * _arctangent(tan)
    angle = 0.5 * np.pi - angle if steep else angle
    angle = np.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@njit(cache=True, error_model="numpy")
def _angles(y, x, n, out):
    """`arctan2` of the first ``n``; where all angles are small, as errors mostly are, by the series alone."""
    wide = 0
    for k in range(n):
        wide += not abs(y[k]) < SMALL * x[k]
    if wide:
        for k in range(n):
            out[k] = arctan2(y[k], x[k])
    else:
        for k in range(n):
            out[k] = _arctangent(y[k] / x[k])


@njit(inline="always")
def _wrapped(angle):
    """`rotations.wrap` of a number, to the bit."""
    turned = angle + np.pi
    return turned - 2.0 * np.pi * np.floor(turned / (2.0 * np.pi)) - np.pi


@njit(cache=True, error_model="numpy")
def _metres_per_radian(lat, h, n, north, east):
    """`earth.metres_per_radian` of ``n`` rows; sine and cosine by the addition theorem from the first row's where all are close."""
    first, apart = lat[0], 0
    for k in range(n):
        apart += not abs(lat[k] - first) < CLOSE
    if apart:
        for k in range(n):
            north[k], east[k] = earth.metres_per_radian(lat[k], h[k])
        return
    sine, cosine = np.sin(first), np.cos(first)
    for k in range(n):
        d = lat[k] - first
        z = d * d
        s, c = d * (1.0 - z / 6.0 * (1.0 - z / 20.0 * (1.0 - z / 42.0))), z / 2.0 * (1.0 - z / 12.0 * (1.0 - z / 30.0))
        meridian, transverse = earth.radii_of_sine(sine - sine * c + cosine * s)
        north[k], east[k] = meridian + h[k], (transverse + h[k]) * (cosine - cosine * c - sine * s)


@njit(cache=True, error_model="numpy")
def _places(truth, estimate, first, n, out):
    """Position errors of rows ``first`` to ``first + n`` into columns 0 to 4 of ``out`` (24, BLOCK)."""
    lat, lon, h = truth.lat[first : first + n], truth.lon[first : first + n], truth.h[first : first + n]
    own_lat, own_lon = estimate.lat[first : first + n], estimate.lon[first : first + n]
    own_h = estimate.h[first : first + n]
    north, east, down, level, whole = out[0], out[1], out[2], out[3], out[4]
    _metres_per_radian(lat, h, n, north, east)
    for k in range(n):
        north[k] *= own_lat[k] - lat[k]
        east[k] *= _wrapped(own_lon[k] - lon[k])
        down[k] = h[k] - own_h[k]
    for k in range(n):
        level[k] = np.sqrt(north[k] * north[k] + east[k] * east[k])
        whole[k] = np.sqrt(north[k] * north[k] + east[k] * east[k] + down[k] * down[k])


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
    w, x, y, z = out[_SCRATCH], out[PHI], out[PHI + 1], out[PHI + 2]
    size, turn, level, upright = out[_SCRATCH + 1], out[_SCRATCH + 2], out[_SCRATCH + 3], out[_SCRATCH + 4]
    whole, heading, inclination = out[12], out[13], out[14]
    for k in range(n):
        inverse = (q[k, 0], -q[k, 1], -q[k, 2], -q[k, 3])
        a, b, c, d = rotations.quat_multiply((own[k, 0], own[k, 1], own[k, 2], own[k, 3]), inverse)
        sign = 1.0 if a >= 0.0 else -1.0
        w[k], x[k], y[k], z[k] = sign * a, sign * b, sign * c, sign * d
    for k in range(n):
        turn[k] = abs(z[k])
        size[k] = np.sqrt(x[k] * x[k] + y[k] * y[k] + z[k] * z[k])
        level[k] = np.sqrt(x[k] * x[k] + y[k] * y[k])
        upright[k] = np.sqrt(w[k] * w[k] + z[k] * z[k])
    _angles(size, w, n, whole)
    _angles(turn, w, n, heading)
    _angles(level, upright, n, inclination)
    for k in range(n):
        scale = 2.0 if size[k] < 1e-10 else 2.0 * whole[k] / size[k]
        x[k], y[k], z[k] = scale * x[k], scale * y[k], scale * z[k]
    for k in range(n):
        whole[k] *= 360.0 / np.pi
        heading[k] *= 360.0 / np.pi
        inclination[k] *= 360.0 / np.pi


@njit(inline="always")
def _halves(q):
    """Sine and cosine, each up to one factor, of half sum and half difference of yaw and roll and of the pitch; whether at a pole.

    `rotations.quat_to_euler` says how they follow.
    """
    up_cos, up_sin, down_cos, down_sin = q[0] - q[2], q[1] + q[3], q[0] + q[2], q[1] - q[3]
    up, down = up_cos * up_cos + up_sin * up_sin, down_cos * down_cos + down_sin * down_sin
    pole = (up < rotations.EULER_POLE**2 * down) | (down < rotations.EULER_POLE**2 * up)
    return up_sin, up_cos, down_sin, down_cos, 2.0 * (q[0] * q[2] - q[1] * q[3]), np.sqrt(up * down), pole


@njit(cache=True, error_model="numpy")
def _eulers(truth, estimate, first, n, out):
    """Differences of the Euler angles, degrees, into columns 9 to 11: by one arctangent each, not as differences of six.

    Two angles' difference has the sine s c' - c s' and the cosine c c' + s s'.
    """
    q, own = truth.q_nb[first : first + n], estimate.q_nb[first : first + n]
    roll, pitch, yaw = out[9], out[10], out[11]
    sum_s, sum_c, diff_s, diff_c = out[_SCRATCH], out[_SCRATCH + 1], out[_SCRATCH + 2], out[_SCRATCH + 3]
    pitch_s, pitch_c = out[_SCRATCH + 4], out[_SCRATCH + 5]
    poles = 0
    for k in range(n):
        us, uc, ds, dc, ps, pc, pole = _halves((q[k, 0], q[k, 1], q[k, 2], q[k, 3]))
        us_, uc_, ds_, dc_, ps_, pc_, own_pole = _halves((own[k, 0], own[k, 1], own[k, 2], own[k, 3]))
        sum_s[k], sum_c[k] = us_ * uc - uc_ * us, uc_ * uc + us_ * us
        diff_s[k], diff_c[k] = ds_ * dc - dc_ * ds, dc_ * dc + ds_ * ds
        pitch_s[k], pitch_c[k] = ps_ * pc - pc_ * ps, pc_ * pc + ps_ * ps
        poles += pole | own_pole
    _angles(sum_s, sum_c, n, roll)
    _angles(diff_s, diff_c, n, yaw)
    _angles(pitch_s, pitch_c, n, pitch)
    for k in range(n):
        half_sum, half_difference = roll[k], yaw[k]
        pitch[k] *= 180.0 / np.pi
        roll[k] = _wrapped(half_sum + half_difference) * (180.0 / np.pi)
        yaw[k] = _wrapped(half_sum - half_difference) * (180.0 / np.pi)
    if poles:
        for k in range(n):  # where roll and yaw are one angle, which of them has it is a convention
            euler, true = rotations.quat_to_euler(own[k]), rotations.quat_to_euler(q[k])
            for i in range(3):
                out[9 + i, k] = _wrapped(euler[i] - true[i]) * (180.0 / np.pi)


@njit(cache=True)
def _errors(truth, estimate, first, n, out):
    """All columns of rows ``first`` to ``first + n`` into ``out`` (24, BLOCK)."""
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


@njit(cache=True, error_model="numpy")
def quadratic_forms(error, covariance, at, rows):
    """e' P^-1 e (K,) of errors (K,m) and the ``rows`` (m,) and columns of the covariances (C,n,n) at positions ``at`` (K,).

    Gauss's elimination, the largest pivot first. Infinite where P is singular, as an estimator that is certain of an error
    deserves.
    """
    size = rows.shape[0]
    out, p, e = np.empty(error.shape[0]), np.empty((size, size)), np.empty(size)
    for k in range(error.shape[0]):
        for i in range(size):
            e[i] = error[k, i]
            for j in range(size):
                p[i, j] = covariance[at[k], rows[i], rows[j]]
        out[k] = _solved(p, e, error[k])
    return out


@njit(cache=True, error_model="numpy")
def _solved(p, e, left):
    """left' p^-1 e; ``p`` (m,m) and ``e`` (m,) are used up."""
    size = e.shape[0]
    for i in range(size):
        best = i
        for j in range(i + 1, size):
            if abs(p[j, i]) > abs(p[best, i]):
                best = j
        if p[best, i] == 0.0:
            return np.inf
        if best != i:
            e[i], e[best] = e[best], e[i]
            for j in range(i, size):
                p[i, j], p[best, j] = p[best, j], p[i, j]
        for j in range(i + 1, size):
            factor = p[j, i] / p[i, i]
            e[j] -= factor * e[i]
            for m in range(i + 1, size):
                p[j, m] -= factor * p[i, m]
    total = 0.0
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            e[i] -= p[i, j] * e[j]
        e[i] /= p[i, i]
        total += left[i] * e[i]
    return total
