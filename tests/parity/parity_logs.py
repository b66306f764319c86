"""Eight recordings by seed from motion in closed form, for comparing a filter with what it answered before.

Only numpy and what stands here, so that no change of the bench changes a recording. Latitude, longitude, height and Euler
angles are sums of sines; specific force and angular rate follow by differentiation (Groves, 2nd ed., section 5.4 solved for
f), their means over an IMU interval by Gauss-Legendre quadrature. What a sensor says is rounded to a resolution far above
the last bit of sine and exponential, which differ between processors, and far below the sensor's noise: the hash of a
recording is the same everywhere. NED, SI units and radians; quaternions body-to-nav, scalar first.
"""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray
Vector = tuple[float, float, float]

A, F = 6378137.0, 1.0 / 298.257223563
E2 = F * (2.0 - F)
RATE = 7.292115e-5
GM = 3.986004418e14

# Amplitude (m, rad), angular rate (rad/s), phase; ``vigour`` of a log scales the amplitudes.
NORTH = ((260.0, 0.31, 0.0), (60.0, 0.73, 1.0))
EAST = ((300.0, 0.27, 2.0), (50.0, 0.81, 0.5))
UP = ((40.0, 0.37, 0.3), (15.0, 0.9, 1.3))
ROLL = ((0.9, 0.53, 0.0), (0.15, 1.7, 0.4))
PITCH = ((0.4, 0.41, 1.1), (0.1, 1.9, 0.2))
YAW = ((1.5, 0.23, 0.7), (0.2, 1.3, 0.9))

RESOLUTION = {
    "gyro": 1e-8,
    "accel": 1e-6,
    "lat": 1e-11,
    "lon": 1e-11,
    "h": 1e-5,
    "v_n": 1e-6,
    "q_nb": 1e-9,
    "field": 1e-5,
    "pressure": 1e-3,
}
"""rad/s, m/s², rad, m, m/s, 1, µT, Pa."""


class Plan(NamedTuple):
    """What makes one recording different from the others."""

    name: str
    seed: int
    lat_deg: float
    lon_deg: float
    rate_hz: float
    duration_s: float
    vigour: float
    gnss_hz: float
    heading_rad: float = 0.0
    start_s: float = 0.0
    lever: Vector = (0.0, 0.0, 0.0)
    latency_s: float = 0.0
    first_fix_s: float = 0.0
    """Of the moment that the first fix describes, after the start."""
    outages: tuple[tuple[float, float], ...] = ()
    stated_std: bool = False
    """Whether the receiver states a sigma of its own with every fix."""
    correlated: bool = False
    imu_gap: tuple[float, float] | None = None
    mag_hz: float = 50.0
    baro: bool = True
    bias: tuple[float, float] = (0.05, 1e-3)
    """Turn-on bias of accelerometers and gyros, 1 sigma."""
    known_bias: bool = False
    """Whether the initial state has an estimate of the biases."""
    attitude_std: Vector = (0.01, 0.01, 0.03)


PLANS = (
    Plan("north-calm", 1, 60.0, 10.0, 100.0, 40.0, 0.2, 1.0, heading_rad=0.7, first_fix_s=1.0),
    Plan("south-lever", 2, -33.0, 151.0, 100.0, 40.0, 0.6, 5.0, lever=(1.2, -0.4, -0.8), mag_hz=100.0),
    Plan("date-line", 3, -17.0, 179.9995, 50.0, 60.0, 0.5, 2.0, 3.0, latency_s=0.137, start_s=5.0, outages=((40.0, 48.0),)),
    Plan("outages", 4, 47.0, 11.0, 100.0, 60.0, 0.4, 5.0, correlated=True, outages=((30.0, 42.0), (52.0, 70.0))),
    Plan("fast", 5, 35.0, 51.0, 200.0, 20.0, 1.0, 10.0, lever=(0.5, 0.1, -1.5), latency_s=0.0512, mag_hz=20.0),
    Plan("imu-gap", 6, 47.0, -122.0, 100.0, 40.0, 0.5, 4.0, -1.5, imu_gap=(20.004, 21.3), first_fix_s=0.1237, stated_std=True),
    Plan("biased", 7, 0.01, 30.0, 50.0, 60.0, 0.7, 5.0, correlated=True, bias=(0.5, 8e-3), known_bias=True, attitude_std=(0.03, 0.03, 0.2), baro=False, outages=((38.0, 47.0),)),
    Plan("polar-still", 8, 78.0, 15.0, 100.0, 30.0, 0.0, 1.0, 2.0, lever=(1.0, 0.0, 0.0), outages=((10.5, 14.5),)),
)  # fmt: skip

NOISE = {"accel": 2e-3, "gyro": 2e-4, "accel_drive": 2e-4, "gyro_drive": 2e-6}
"""Root spectral densities: white, and of the random walk of the biases (SI)."""
GNSS_SIGMA = (2.0, 2.0, 3.0, 0.1, 0.1, 0.1)
GNSS_MARKOV = (1.5, 60.0)
"""Correlated position error, m, and its time, s."""
MAG_SIGMA, BARO_SIGMA = 0.3, 5.0
INITIAL_STD = (3.0, 3.0, 5.0, 0.3, 0.3, 0.3)


def _series(terms: tuple[Vector, ...], t: Array) -> tuple[Array, Array, Array]:
    """Value, first and second derivative of a sum of sines."""
    value = sum(a * np.sin(w * t + p) for a, w, p in terms)
    first = sum(a * w * np.cos(w * t + p) for a, w, p in terms)
    second = sum(-a * w * w * np.sin(w * t + p) for a, w, p in terms)
    return value, first, second


def _radii(lat: Array) -> tuple[Array, Array]:
    w2 = 1.0 - E2 * np.sin(lat) ** 2
    rn = A / np.sqrt(w2)
    return rn * (1.0 - E2) / w2, rn


def _gravity(lat: Array, h: Array) -> Array:
    """Somigliana's normal gravity at height (Groves eq. 2.134, 2.139)."""
    s2, m = np.sin(lat) ** 2, RATE**2 * A**3 * (1.0 - F) / GM
    surface = 9.7803253359 * (1.0 + 0.00193185265241 * s2) / np.sqrt(1.0 - E2 * s2)
    return surface * (1.0 - 2.0 / A * (1.0 + F * (1.0 - 2.0 * s2) + m) * h + 3.0 / A**2 * h * h)


def _quaternions(euler: Array) -> Array:
    (cr, cp, cy), (sr, sp, sy) = np.cos(0.5 * euler).T, np.sin(0.5 * euler).T
    return np.column_stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def _matrices(euler: Array) -> Array:
    """(N,3,3) C_nb."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(euler).T, np.sin(euler).T
    rows = [
        [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
        [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
        [-sp, sr * cp, cr * cp],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


class Motion(NamedTuple):
    """Truth at times (N,)."""

    lat: Array
    lon: Array
    h: Array
    v_n: Array
    euler: Array
    f_b: Array
    w_ib_b: Array


def motion(plan: Plan, t: Array) -> Motion:
    """Truth at times ``t`` (N,) since the start of the clock."""
    t = t - plan.start_s
    lat0, lon0, h0 = np.radians(plan.lat_deg), np.radians(plan.lon_deg), 500.0
    scale = (1.0 / A, 1.0 / (A * np.cos(lat0)), 1.0)
    (dlat, lat1, lat2), (dlon, lon1, lon2), (dh, h1, h2) = (
        tuple(plan.vigour * s * x for x in _series(terms, t)) for terms, s in zip((NORTH, EAST, UP), scale, strict=True)
    )
    (roll, roll1, _), (pitch, pitch1, _), (yaw, yaw1, _) = (
        tuple(plan.vigour * x for x in _series(terms, t)) for terms in (ROLL, PITCH, YAW)
    )
    lat, lon, h, yaw = lat0 + dlat, lon0 + dlon, h0 + dh, yaw + plan.heading_rad
    sine, cosine = np.sin(lat), np.cos(lat)
    rm, rn = _radii(lat)
    w2 = 1.0 - E2 * sine**2
    rm1, rn1 = (r * E2 * sine * cosine / w2 * lat1 for r in (3.0 * rm, rn))
    v_n = np.column_stack([(rm + h) * lat1, (rn + h) * cosine * lon1, -h1])
    east2 = (rn + h) * (cosine * lon2 - sine * lat1 * lon1) + (rn1 + h1) * cosine * lon1
    v_n1 = np.column_stack([(rm + h) * lat2 + (rm1 + h1) * lat1, east2, -h2])
    w_ie = np.column_stack([RATE * cosine, 0.0 * t, -RATE * sine])
    w_en = np.column_stack([lon1 * cosine, -lat1, -lon1 * sine])
    euler = np.column_stack([roll, pitch, yaw])
    c_nb = _matrices(euler)
    gravity = np.column_stack([0.0 * t, 0.0 * t, _gravity(lat, h)])
    f_b = np.einsum("kij,ki->kj", c_nb, v_n1 + np.cross(2.0 * w_ie + w_en, v_n) - gravity)
    w_nb = np.column_stack(
        [
            roll1 - yaw1 * np.sin(pitch),
            pitch1 * np.cos(roll) + yaw1 * np.cos(pitch) * np.sin(roll),
            -pitch1 * np.sin(roll) + yaw1 * np.cos(pitch) * np.cos(roll),
        ]
    )
    return Motion(lat, lon, h, v_n, euler, f_b, w_nb + np.einsum("kij,ki->kj", c_nb, w_ie + w_en))


def imu_times(plan: Plan) -> Array:
    """(N+1,) the start and the end of each IMU interval; a gap is one long interval."""
    t = plan.start_s + np.arange(round(plan.duration_s * plan.rate_hz) + 1) / plan.rate_hz
    if plan.imu_gap is not None:
        t = t[(t <= plan.imu_gap[0]) | (t >= plan.imu_gap[1])]
    return t


def truth(plan: Plan) -> dict[str, Array]:
    """Columns of a `testbed.data.records.Trajectory` at the start and all IMU times; means as `recording` takes them."""
    t = imu_times(plan)
    at, (f_b, w_ib_b) = motion(plan, t), _means(plan, t)
    means = {"f_b": np.vstack([f_b[:1], f_b]), "w_ib_b": np.vstack([w_ib_b[:1], w_ib_b])}
    columns = {"t": t, "lat": at.lat, "lon": _wrapped(at.lon), "h": at.h, "v_n": at.v_n, "q_nb": _quaternions(at.euler)}
    return {key: _rounded(key, value) for key, value in (columns | means).items()}


def _means(plan: Plan, t: Array) -> tuple[Array, Array]:
    """Specific force and angular rate (N,3), means over the intervals between ``t`` (N+1,)."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    f_b, w_ib_b = np.zeros((len(t) - 1, 3)), np.zeros((len(t) - 1, 3))
    for node, weight in zip(nodes, weights, strict=True):
        at = motion(plan, t[:-1] + 0.5 * (node + 1.0) * np.diff(t))
        f_b += 0.5 * weight * at.f_b
        w_ib_b += 0.5 * weight * at.w_ib_b
    return f_b, w_ib_b


def _wrapped(angle: Array) -> Array:
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi


def _rounded(key: str, values: Any) -> Array:
    """Multiples of the resolution of a column."""
    step = RESOLUTION.get(key)
    values = np.asarray(values, dtype=float)
    return values if step is None else np.round(values / step) * step


def recording(plan: Plan) -> dict[str, dict[str, Array]]:
    """Columns of each sensor and of the initial state: ``imu``, ``gnss``, ``mag``, ``baro``, ``initial``."""
    rng, t = np.random.default_rng(plan.seed), imu_times(plan)
    out = {"imu": _imu(plan, t, rng), "gnss": _gnss(plan, t, rng), "mag": _mag(plan, t, rng)}
    bias = out["imu"].pop("turn_on")
    if plan.baro:
        out["baro"] = _baro(plan, t, rng)
    out["initial"] = _initial(plan, bias, rng)
    return {sensor: {key: _rounded(key, value) for key, value in table.items()} for sensor, table in out.items()}


def digest(tables: dict[str, dict[str, Array]]) -> str:
    """Hash of all columns with their names."""
    total = hashlib.sha256()
    for sensor in sorted(tables):
        for key in sorted(tables[sensor]):
            column = np.ascontiguousarray(tables[sensor][key], dtype="<f8")
            total.update(f"{sensor} {key} {column.shape} ".encode() + (column + 0.0).tobytes())
    return total.hexdigest()[:16]


def _imu(plan: Plan, t: Array, rng: np.random.Generator) -> dict[str, Array]:
    f_b, w_ib_b = _means(plan, t)
    dt = np.diff(t)[:, None]
    turn_on = np.repeat(plan.bias, 3) * rng.standard_normal(6)
    out: dict[str, Array] = {"t": t[1:], "turn_on": turn_on}
    for key, true, constant in (("accel", f_b, turn_on[:3]), ("gyro", w_ib_b, turn_on[3:])):
        walk = np.cumsum(NOISE[f"{key}_drive"] * np.sqrt(dt) * rng.standard_normal(true.shape), axis=0)
        out[key] = true + constant + walk + NOISE[key] / np.sqrt(dt) * rng.standard_normal(true.shape)
    return out


def _gnss(plan: Plan, t: Array, rng: np.random.Generator) -> dict[str, Array]:
    """Fixes at the antenna; ``t`` is stamped ``latency_s`` after the moment that a fix describes."""
    count = int((plan.duration_s - plan.first_fix_s + plan.latency_s) * plan.gnss_hz + 1e-9) + 1
    described = plan.start_s + plan.first_fix_s + np.arange(count) / plan.gnss_hz - plan.latency_s
    white = rng.standard_normal((count, 6))
    slow, keep = rng.standard_normal((count, 3)), np.exp(-1.0 / plan.gnss_hz / GNSS_MARKOV[1])
    for k in range(1, count):
        slow[k] = keep * slow[k - 1] + np.sqrt(1.0 - keep**2) * slow[k]
    at = motion(plan, described)
    c_nb, arm = _matrices(at.euler), np.array(plan.lever)
    w_ie = RATE * np.column_stack([np.cos(at.lat), 0.0 * at.lat, -np.sin(at.lat)])
    place = c_nb @ arm
    speed = np.einsum("kij,kj->ki", c_nb, np.cross(at.w_ib_b, arm)) - np.cross(w_ie, place)
    std = np.array(GNSS_SIGMA) * (1.0 + 0.5 * rng.random((count, 1)) if plan.stated_std else np.ones((count, 1)))
    error = std * white + (np.hstack([GNSS_MARKOV[0] * slow, np.zeros((count, 3))]) if plan.correlated else 0.0)
    rm, rn = _radii(at.lat)
    seen = np.ones(count, dtype=bool)
    for begin, end in plan.outages:
        seen &= (described < plan.start_s + begin) | (described > plan.start_s + end)
    out = {
        "t": described + plan.latency_s,
        "lat": at.lat + (place[:, 0] + error[:, 0]) / (rm + at.h),
        "lon": _wrapped(at.lon + (place[:, 1] + error[:, 1]) / ((rn + at.h) * np.cos(at.lat))),
        "h": at.h - place[:, 2] - error[:, 2],
        "v_n": at.v_n + speed + error[:, 3:],
    } | ({"std": np.round(std, 6)} if plan.stated_std else {})
    return {key: value[seen] for key, value in out.items()}


FIELD_N = (20.0, 1.5, 44.0)


def _mag(plan: Plan, t: Array, rng: np.random.Generator) -> dict[str, Array]:
    times = plan.start_s + np.arange(1, int(plan.duration_s * plan.mag_hz) + 1) / plan.mag_hz
    c_nb = _matrices(motion(plan, times).euler)
    field = np.einsum("kij,i->kj", c_nb, np.array(FIELD_N)) + MAG_SIGMA * rng.standard_normal((len(times), 3))
    return {"t": times, "field": field}


def _baro(plan: Plan, t: Array, rng: np.random.Generator) -> dict[str, Array]:
    times = plan.start_s + np.arange(1, int(plan.duration_s * 10.0) + 1) / 10.0
    pressure = 101325.0 * (1.0 - 2.25577e-5 * motion(plan, times).h) ** 5.25588
    return {"t": times, "pressure": pressure + BARO_SIGMA * rng.standard_normal(len(times))}


def _initial(plan: Plan, bias: Array, rng: np.random.Generator) -> dict[str, Array]:
    """Mean and sigma (15,) at the start, drawn around the truth."""
    at = motion(plan, np.array([plan.start_s]))
    known = 0.2 if plan.known_bias else 1.0
    std = np.concatenate([INITIAL_STD, plan.attitude_std, known * np.repeat(plan.bias, 3)])
    error = std * rng.standard_normal(15)
    rm, rn = _radii(at.lat)
    euler = at.euler[0] + error[6:9]
    guess = np.where(plan.known_bias, bias + error[9:], 0.0)
    return {
        "t": np.array(plan.start_s),
        "lat": at.lat[0] + error[0] / (rm[0] + at.h[0]),
        "lon": _wrapped(at.lon[0] + error[1] / ((rn[0] + at.h[0]) * np.cos(at.lat[0]))),
        "h": at.h[0] - error[2],
        "v_n": at.v_n[0] + error[3:6],
        "q_nb": _quaternions(euler[None, :])[0],
        "accel_bias": np.round(guess[:3], 6),
        "gyro_bias": np.round(guess[3:], 8),
        "std": np.round(std, 8),
    }
