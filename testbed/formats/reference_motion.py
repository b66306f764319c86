"""Is a reference one motion? Its velocity against its places, its attitude against the gyros, and what it covers.

What holds in any frame is compared: ways over seconds, and turns of the body between two rows, which no fixed turn of the
navigation frame changes. What may be real is told; a ratio of units in the turns is refused. SI units, radians; n and b as
everywhere.
"""

from __future__ import annotations

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import Array, ImuSamples, SensorLog, Trajectory
from testbed.data.shapes import gaps_of
from testbed.formats.kinematics import conjugate, from_rotvec, multiply, to_rotvec
from testbed.formats.raw import Raw
from testbed.formats.recording import SLOWEST_REFERENCE, seconds
from testbed.physics import earth
from testbed.physics.rotations import quats_to_eulers

MOST_ROWS = 20_000
"""Rows that are compared: the mean or median of so many says as much as that of all."""
DISTANCE_S = 10.0
"""Over which distances are compared: a metre of position noise is then 0.1 m/s."""
LEAST_WAY_M = 5.0
"""Root mean square of the compared ways: five times the metre by which the places of a poor reference wander meanwhile."""
FURTHEST_ROWS_S = 2.0
"""Between rows the velocity is taken to be linear: in a turn of 20 °/s that makes the way of 2 s 4 % short, of 10 s anything."""
UNITS = {"km/h": 3.6, "knots": 3600.0 / 1852.0, "ft/s": 1.0 / 0.3048}
"""Units that velocities are often in, and how many of each are a metre a second."""
SHORTEST_TURN_S, TURN_S, SLOW_TURN_S = 0.1, 1.0, 10.0
"""Over which turns are compared: about a radian of the gyros', as of more than half a turn nobody knows the direction; the
longest for vehicles that turn by less than `LEAST_TURN` in a second."""
LEAST_TURN = np.radians(5.0)
"""Root mean square turn of the reference, or of the gyros in a second: a reference's noise is a degree, cheap gyros have
biases of up to 3 °/s."""
SAME_MOTION = 0.7
"""Cosine of 45° between the turns of both, within which another unit leaves them: noise and biases have no common direction."""
LEAST_AXIS = np.radians(2.0)
"""The same about one axis that is judged by its sign alone, which a bias does not turn."""
FURTHEST_TURN = 2.5
"""rad that the gyros sweep between two compared rows: below half a turn by the noise of both."""
MOST_TURNS = 400
"""Compared turns: 400 know a cosine to a few hundredths."""
FEWEST_TURNS = 5
RESETS = 0.05
"""Share of the compared pairs that is left out, the least alike: a reference that is a filter's own is reset now and then."""
SMALLEST_COSINE = 0.5
"""Between the turns of both: 60° apart in the middle, which neither noise nor mounting leaves; one axis turned the other way does."""
LARGEST_IN_RAD = 2.0 * np.pi
"""Angles in radians are within one turn: taken for degrees, all lie within 6.3°."""
COVERED = 0.95
"""Share of the log that a reference covers, from which nothing is said: what a twentieth more would add to an average is as little."""


def check(raw: Raw) -> list[str]:
    """Sentences on a reference that contradicts itself or the gyros. Raises InputError where a unit is wrong."""
    return _velocity(raw) + _turns(raw) + _gaps(raw)


def covered(reference: Trajectory, log: SensorLog, place: str) -> list[str]:
    """What part of the log can be scored, where the reference covers less than nearly all of it."""
    start, end = log.initial.t, float(log.imu.t[-1])
    first, last = float(reference.t[0]), float(reference.t[-1])
    if last - first >= COVERED * (end - start):
        return []
    return [
        f"{place}: covers {seconds(first)} to {seconds(last)} s of the {seconds(start)} to {seconds(end)} s that the IMU"
        f" records; only these {last - first:.4g} s of {end - start:.4g} s are scored"
    ]


def slope(x: Array, y: Array) -> tuple[float, float]:
    """Slope of y over x through the origin, and the cosine between them."""
    xx, yy, xy = float(x @ x), float(y @ y), float(x @ y)
    return (xy / xx, xy / np.sqrt(xx * yy)) if xx > 0.0 and yy > 0.0 else (0.0, 0.0)


def velocity_doubts(t: Array, ned: Array, v_n: Array, place: str, least_m: float = LEAST_WAY_M) -> list[str]:
    """Sentences on velocities (N,3) that are not the differences of places ``ned`` (N,3), m, at the same times.

    Nothing is said of ways (root mean square over `DISTANCE_S`) below ``least_m``.
    """
    step = float(np.median(np.diff(t)))
    if step > FURTHEST_ROWS_S:
        return []
    count = max(1, min(round(DISTANCE_S / step), len(t) // 10))
    rows = np.arange(0, len(t), count)
    way = np.vstack([np.zeros(3), np.cumsum(0.5 * (v_n[1:] + v_n[:-1]) * np.diff(t)[:, None], axis=0)])
    whole = np.diff(t[rows]) < 2.0 * count * step  # none over a gap
    moved, shown = np.diff(ned[rows], axis=0)[whole], np.diff(way[rows], axis=0)[whole]
    moved, shown = _without_resets(moved, shown)
    if len(moved) < FEWEST_TURNS:
        return []
    notes = []
    ratio, similar = slope(moved[:, :2].ravel(), shown[:, :2].ravel())
    far, told = (rms(np.linalg.norm(w[:, :2], axis=1)) for w in (moved, shown))
    if far > least_m and told < 0.05 * far:
        notes.append(
            f"{place}: the velocities are next to zero, while the places move {far:.3g} m in {count * step:.3g} s"
        )
    elif max(far, told) > least_m and (similar < 0.5 or not 0.8 < ratio < 1.25):
        near = [name for name, factor in UNITS.items() if abs(ratio / factor - 1.0) < 0.05]
        asked = f"are they {near[0]} named m/s?" if near else "units, or north and east exchanged?"
        notes.append(
            f"{place}: the velocities say {ratio:.3g} times the way that the places move (similarity {similar:.2f}): {asked}"
        )
    climbed = min(rms(moved[:, 2]), rms(shown[:, 2]))
    if climbed > least_m and slope(shown[:, 2], moved[:, 2])[1] < -0.5:
        notes.append(f"{place}: the height falls when v_down is negative: is it the velocity upwards?")
    return notes


def _velocity(raw: Raw) -> list[str]:
    assert raw.motion is not None
    t, lat, lon, h, v_n, _ = raw.motion
    if len(t) < 10:
        return []
    rows = slice(None, None, max(1, len(t) // MOST_ROWS))
    t, lat, lon, h, v_n = t[rows], lat[rows], np.unwrap(lon[rows]), h[rows], v_n[rows]
    first = (np.full(len(t), x[0]) for x in (lat, lon, h))
    ned = np.column_stack(earth.position_difference(lat, lon, h, *first))
    return velocity_doubts(t, ned, v_n, raw.place("reference"))


def _unit_message(raw: Raw, ratio: float) -> str:
    """The question about a ratio of the gyros' turns to those of the reference."""
    assert raw.motion is not None
    unit = "°/s named rad/s" if ratio > 5.0 else "rad/s named °/s"
    told = f"{raw.place('imu')}: the gyros turn {ratio:.3g} times as fast as the reference's attitude: are the rates {unit}"
    q = raw.motion[5]
    angles = np.degrees(np.abs(quats_to_eulers(q[:: max(1, len(q) // MOST_ROWS)])).max())
    if ratio > 5.0 and angles < LARGEST_IN_RAD:
        told += f", or are the angles of {raw.place('reference')} (at most {angles:.3g}°) rad named deg"
    return told + "?"


def _turns(raw: Raw) -> list[str]:
    """Turns of the reference's body against those of the gyros: sizes, directions, axis by axis."""
    assert raw.imu is not None and raw.motion is not None
    rate = rms(np.linalg.norm(raw.imu.gyro[:: max(1, len(raw.imu.t) // MOST_ROWS)], axis=1))
    for span in (float(np.clip(1.0 / max(rate, 1e-9), SHORTEST_TURN_S, TURN_S)), SLOW_TURN_S):
        found = compared_turns(raw.imu, raw.motion[0], raw.motion[5], span)
        if found is None:
            continue
        turn, swept = found
        sizes = rms(np.linalg.norm(turn, axis=1)), rms(np.linalg.norm(swept, axis=1))
        if sizes[0] < LEAST_TURN and sizes[1] < LEAST_TURN * max(span, 1.0):
            continue
        ratio, cosine = _in_the_middle(turn, swept)
        if cosine > SAME_MOTION and not 0.2 < ratio < 5.0:
            raise InputError(_unit_message(raw, ratio))
        if span <= TURN_S:  # the bias of a gyro is a large part of the turns of slow vehicles
            return _doubted_turns(raw.place("reference"), turn, swept, sizes)
    return []


def _in_the_middle(turn: Array, swept: Array) -> tuple[float, float]:
    """Medians of the ratio of the lengths, gyros over reference, and of the cosine, where the one that shows more moves."""
    lengths = np.array([np.linalg.norm(turn, axis=1), np.linalg.norm(swept, axis=1)])
    larger = lengths[np.argmax(lengths.mean(axis=1))]
    moves = larger > 0.5 * rms(larger)
    turned, gone = np.maximum(lengths[:, moves], 1e-12)
    cosines = np.einsum("ki,ki->k", turn[moves], swept[moves]) / (turned * gone)
    return float(np.median(gone / turned)), float(np.median(cosines))


def _doubted_turns(place: str, turn: Array, swept: Array, sizes: tuple[float, float]) -> list[str]:
    if not 0.2 < sizes[1] / max(sizes[0], 1e-12) < 5.0:
        return [
            f"{place}: its attitude turns by {np.degrees(sizes[0]):.3g}° while the gyros turn by {np.degrees(sizes[1]):.3g}°"
            " (root mean squares): is it the attitude of this IMU, in the unit that its columns name?"
        ]
    cosine = slope(turn.ravel(), swept.ravel())[1]
    axes = [
        axis
        for i, axis in enumerate("xyz")
        if min(rms(turn[:, i]), rms(swept[:, i])) > LEAST_AXIS and slope(turn[:, i], swept[:, i])[1] < -SMALLEST_COSINE
    ]
    if not axes and cosine > SMALLEST_COSINE:
        return []
    about = f"about {' and '.join(axes)} against" if axes else "about other axes than"
    return [
        f"{place}: its attitude turns {about} the gyros (cosine between the turns {cosine:.2f}): is yaw counted from north,"
        " clockwise, are its axes those of the IMU (forward-right-down), and do the clocks agree?"
    ]


def compared_turns(imu: ImuSamples, t: Array, q_nb: Array, span: float) -> tuple[Array, Array] | None:
    """Rotation vectors (K,3) in b of an attitude and of the gyros between rows ``span`` s apart; None of too few."""
    edges = np.arange(max(t[0], imu.t[0]), min(t[-1], imu.t[-1]), span)
    first = np.unique(np.searchsorted(t, edges))
    first = first[first < len(t) - 1]
    last = np.searchsorted(t, t[first] + span - 1e-6)
    last = np.maximum(last, first + 1)
    good = last < len(t)
    first, last = first[good], last[good]
    good = (t[last] <= imu.t[-1]) & (t[last] - t[first] < 2.0 * max(span, TURN_S)) & (t[first] >= imu.t[0])
    first, last = first[good], last[good]
    step = max(1, -(-len(first) // MOST_TURNS))
    first, last = first[::step], last[::step]
    if len(first) < FEWEST_TURNS:
        return None
    swept, path = _swept(imu, t[first], t[last])
    turn = to_rotvec(multiply(conjugate(q_nb[first]), q_nb[last]))
    short = path < FURTHEST_TURN
    turn, swept = _without_resets(turn[short], swept[short])
    return (turn, swept) if len(turn) >= FEWEST_TURNS else None


def _without_resets(one: Array, other: Array) -> tuple[Array, Array]:
    """Pairs of vectors (K,3) but for the share `RESETS` whose lengths differ most."""
    apart = np.abs(np.linalg.norm(one, axis=1) - np.linalg.norm(other, axis=1))
    keep = np.sort(np.argsort(apart, kind="stable")[: len(one) - int(np.ceil(RESETS * len(one)))])
    return one[keep], other[keep]


def _swept(imu: ImuSamples, start: Array, end: Array) -> tuple[Array, Array]:
    """Rotation vectors (K,3) that the gyros make from ``start`` to ``end`` (K,), and how far they swept, rad."""
    k = np.searchsorted(imu.t, start, side="right")
    count = int((np.searchsorted(imu.t, end, side="left") - k).max()) + 1
    q, path, at = np.tile([1.0, 0.0, 0.0, 0.0], (len(start), 1)), np.zeros(len(start)), start.copy()
    for i in range(count):
        row = np.minimum(k + i, len(imu.t) - 1)
        until = np.minimum(imu.t[row], end)
        step = imu.gyro[row] * np.maximum(until - at, 0.0)[:, None]
        q, at = multiply(q, from_rotvec(step)), np.maximum(at, until)
        path += np.linalg.norm(step, axis=1)
    return to_rotvec(q), path


def _gaps(raw: Raw) -> list[str]:
    """Gaps of a reference, of which only the rows are scored; a reader that left rows out has told that itself."""
    assert raw.motion is not None and raw.imu is not None
    t = raw.motion[0]
    inside = t[(t >= raw.t_start - 1e-9) & (t <= raw.imu.t[-1] + 1e-9)]
    found = [gap for gap in gaps_of(np.unique(inside)) if gap[1] - gap[0] > SLOWEST_REFERENCE]
    if raw.own_times or not found:
        return []
    longest = max(found, key=lambda gap: gap[1] - gap[0])
    count = f"{len(found)} gaps, the longest" if len(found) > 1 else "a gap"
    total = sum(gap[1] - gap[0] for gap in found)
    return [
        f"{raw.place('reference')}: {count} from {seconds(longest[0])} to {seconds(longest[1])} s; {total:.3g} s of"
        f" {inside[-1] - inside[0]:.4g} s are not scored"
    ]


def rms(values: Array) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))
