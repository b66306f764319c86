"""What is compared: estimators with parameters on the recordings of `parity_logs`, and which figures of their answers.

Everything goes by name, and the only code here that knows the bench's classes is `sensor_log`, `reference` and the readers
below them. Figures of a case are tables of columns; a column is compared within `TOLERANCE` of its natural scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from parity_logs import BARO_SIGMA, FIELD_N, GNSS_MARKOV, GNSS_SIGMA, MAG_SIGMA, NOISE, PLANS, A, Array, Plan

from testbed.data.records import (
    STATE_NAMES,
    BaroSamples,
    GnssFixes,
    ImuSamples,
    InitialState,
    MagSamples,
    NavSolution,
    SensorLog,
    Trajectory,
)
from testbed.data.registry import make_estimator
from testbed.data.specs import BaroSpec, GnssSpec, ImuSpec, MagSpec, TriadSpec
from testbed.physics.rotations import quats_to_eulers

ROWS = 20
"""Of state and sigma, spread over the run."""
FEW = 5
"""Of innovations, covariances and other figures."""
TOLERANCE = 1e-9
"""Of the scale of a column. Rounding: a latitude in radians resolves 0.7 nm, and some thousand steps add up to 1e-8 m, a
tenth of this; a constant of a filter that changes by a millionth moves its sigmas by a thousand times as much."""
LEARNED_TOLERANCE = 1e-6
"""Where a network is trained in the run: each of its iterations multiplies what rounding did to the one before, and the
library of linear algebra orders its sums by processor (an input off by its last bit moves ``nnakf`` by 3e-8). ``ahrs-lstm`` steps its network in single precision (6e-8)."""
UNSCENTED_TOLERANCE = 1e-8
"""A sigma point whose latitude rounds the other way, by 0.7 nm, moves a position sigma of 0.2 m by 5e-10 of itself: some
hundred of them, a random walk, by ten times that."""
EULER_TOLERANCE = 1e-7
"""Filters whose state are Euler angles: the start of a recording is a quaternion rounded to its tenth digit, and the angles of
0.1 took its norm for part of the pitch, by up to 1e-10 rad; today's do not depend on it. Times 40 m/s² over a second that is
1e-7 of a velocity sigma of 0.05 m/s in the first innovation, and fades from there."""
TAUGHT_TOLERANCE = 5e-6
"""The same difference after a network has learned from it in the run."""
SCALES = {"lat": 100.0 / A, "lon": 100.0 / A, "h": 100.0, "v": 10.0, "angle": 1.0, "accel_bias": 0.1, "gyro_bias": 0.01}
"""rad, rad, m, m/s, rad, m/s², rad/s. 100 m is the way of a second: a position is not known better for being far away."""
NAVIGATION, NO_BIASES = tuple(STATE_NAMES), tuple(STATE_NAMES[:9])
ATTITUDE = tuple(STATE_NAMES[6:9])


class Case(NamedTuple):
    """One estimator with parameters, and which states its answer really estimates."""

    label: str
    estimator: str
    params: Mapping[str, Any] = {}
    states: tuple[str, ...] = NAVIGATION
    tolerance: float = TOLERANCE
    position: bool = True
    rows: int = ROWS


AHRS = {"states": ATTITUDE, "position": False}
AHRS_0_1 = {
    **{"linear_accel_mps2": 10.7, "linear_accel_time_s": 0.0162, "mag_disturbance_ut": 0.61},
    **{"mag_disturbance_time_s": 12300.0, "gyro_noise_scale": 1.56, "gyro_bias_scale": 0.149},
    **{"accel_noise_scale": 0.496, "mag_noise_scale": 9.06},
    **{"gyro_scale": 0.0, "accel_noise_mps2": 0.0, "field_noise_ut": 0.0},
}
"""The defaults of `ahrs-kf` in version 0.1, which had not the last three."""
WEIGHTS_0_1 = {"weights": str(Path(__file__).parent / "recorded" / "ahrs-lstm-narrow.safetensors")}
"""The first 16 of the 200 neurons of each layer of 0.1's network, in its format, answered by the code of 0.1: 30 kB for 2.7 MB. Its
last layer is 12.5 times as large, so that it changes the gain by a factor of 2.3 (all 200: 5.2)."""
PATIENT = {"epochs": 3, "neurons": 4}
NARX = {
    **{"settle_s": 8.0, "longest_outage_s": 7.0, "step_s": 0.4, "epochs": 3, "online_epochs": 2},
    **{"neurons": 3, "output_lags": 1, "input_lags": 1},
}

EVERYWHERE = (
    Case("ins", "ins", states=()),
    Case("indirect-kf", "indirect-kf"),
    Case("update-ins", "update-ins", states=()),  # its sigmas are those of indirect-kf
    Case("lkf9", "lkf9", states=NO_BIASES),
    Case("direct-ekf", "direct-ekf", tolerance=EULER_TOLERANCE),
    Case("direct-ukf", "direct-ukf", tolerance=UNSCENTED_TOLERANCE),
    Case("stekf", "stekf", tolerance=EULER_TOLERANCE),
    Case("rstekf", "rstekf", tolerance=EULER_TOLERANCE),
    Case("imm-ekf", "imm-ekf", tolerance=EULER_TOLERANCE),
    Case("imm-rstekf", "imm-rstekf", tolerance=EULER_TOLERANCE),
    Case("ahrs-kf", "ahrs-kf", AHRS_0_1, **AHRS),
    Case("ahrs-lstm", "ahrs-lstm", WEIGHTS_0_1, tolerance=LEARNED_TOLERANCE, **AHRS),
)
IN_OUTAGES = (
    Case("ann", "ann", PATIENT, NO_BIASES, tolerance=LEARNED_TOLERANCE),
    Case("kfann", "kfann", PATIENT, NO_BIASES, tolerance=LEARNED_TOLERANCE),
)
"""Without an outage these are `lkf9`."""
MIXED_BANK = {
    "branches": (
        {"model": "cv", "filter": "rstekf", "angle_aiding": False},
        {"model": "ct", "filter": "stekf", "angle_aiding": True, "velocity_noise": 0.5},
        {"model": "accelerated", "filter": "ekf", "noise_scale": 2.0},
        {"model": "singer"},
    ),
    "transition_matrix": ((0.9, 0.1, 0.0, 0.0), (0.0, 0.8, 0.1, 0.1), (0.1, 0.1, 0.8, 0.0), (0.05, 0.05, 0.1, 0.8)),
    "initial_probability": (0.4, 0.3, 0.3, 0.0),
    "manoeuvre_time_s": 4.0,
    "gravity_tolerance": 0.2,
    "rate_limit_dps": 40.0,
}
PER_AXIS = {
    "accel_noise_scale": (1.0, 2.0, 3.0),
    "gyro_bias_scale": (0.5, 1.0, 2.0),
    "position_std_scale": (1.0, 1.5, 2.0),
    "velocity_std_scale": 0.7,
}
DENSITIES = {
    "process_noise": (*(3e-3,) * 3, *(3e-4,) * 3, *(3e-4,) * 3, *(3e-6,) * 3),
    "measurement_noise": (3.0, 3.0, 4.0, 0.2, 0.2, 0.2),
}
SOMEWHERE: dict[str, tuple[Case, ...]] = {
    "south-lever": (
        Case("direct-ekf scaled", "direct-ekf", {"accel_noise_scale": 2.0, "gyro_bias_scale": 0.5, "position_std_scale": 1.5}, tolerance=EULER_TOLERANCE),
        Case("imm-ekf mixed", "imm-ekf", MIXED_BANK, tolerance=EULER_TOLERANCE),
        Case("indirect-kf per axis", "indirect-kf", PER_AXIS),
        Case("ahrs-kf adaptive", "ahrs-kf", AHRS_0_1 | {"turn_speed_mps": 60.0, "residual_factor": 1.0}, **AHRS),
    ),
    "date-line": (Case("imm-rstekf mixed", "imm-rstekf", MIXED_BANK, tolerance=EULER_TOLERANCE), Case("direct-ukf spread", "direct-ukf", {"alpha": 0.8, "beta": 2.0, "kappa": 1.0}, tolerance=UNSCENTED_TOLERANCE)),
    "outages": (
        Case("update-ins keep biases", "update-ins", {"keep_biases": True, "outage_after_s": 1.0}),
        Case("lkf9 restart", "lkf9", {"restart": True}, NO_BIASES),
        Case("kfann velocity", "kfann", PATIENT | {"velocity": True, "pseudo_noise": "residual"}, NO_BIASES, tolerance=LEARNED_TOLERANCE),
        Case("ann rbf", "ann", {"inputs": "nn2", "neurons": 4, "regressor": "rbf"}, NO_BIASES, tolerance=LEARNED_TOLERANCE),
        Case("nnckf", "nnckf", NARX, tolerance=TAUGHT_TOLERANCE),
        Case("nnakf", "nnakf", NARX, tolerance=TAUGHT_TOLERANCE),
        Case("nnakf ekf", "nnakf", NARX | {"filter": "ekf", "inputs": "p-dp", "correlated": True}, tolerance=TAUGHT_TOLERANCE),
    ),
    "fast": (Case("indirect-kf densities", "indirect-kf", DENSITIES), Case("stekf quick", "stekf", {"forgetting": 0.3}, tolerance=EULER_TOLERANCE)),
    "imu-gap": (
        Case("imm-ekf alone", "imm-ekf", {"branches": ({"model": "singer", "filter": "stekf"},)}, tolerance=EULER_TOLERANCE),
    ),
    "biased": (
        Case("lkf9 density", "lkf9", {"process_noise": "density", "gyro_noise_scale": 3.0}, NO_BIASES),
        Case("rstekf eager", "rstekf", {"significance": 0.2}, tolerance=EULER_TOLERANCE),
        Case("nnckf ekf", "nnckf", NARX | {"filter": "ekf", "inputs": "since-reset"}, tolerance=TAUGHT_TOLERANCE),
        Case("nnakf", "nnakf", NARX, tolerance=TAUGHT_TOLERANCE),
    ),
}  # fmt: skip
CANDIDATES = (
    {},
    PER_AXIS,
    DENSITIES,
    {"accel_noise_scale": 10.0},
    {"gyro_noise_scale": 0.1, "velocity_std_scale": 3.0},
)
SEARCHED = ("south-lever", "date-line", "imu-gap")
"""Recordings on which the tuner's fast path scores `CANDIDATES`, one by one and side by side."""


def cases(plan: Plan) -> Iterator[Case]:
    """Every case on a recording."""
    yield from EVERYWHERE
    yield from IN_OUTAGES if plan.outages else ()
    yield from (case._replace(rows=ROWS // 2) for case in SOMEWHERE.get(plan.name, ()))


def sensor_log(plan: Plan, tables: dict[str, dict[str, Array]]) -> SensorLog:
    """A recording as the bench's noun, with specifications that suit its noise."""
    accel = TriadSpec(plan.bias[0], None, 1e-3, 200.0, NOISE["accel"], rate_random_walk=NOISE["accel_drive"])
    gyro = TriadSpec(plan.bias[1], None, 2e-5, 200.0, NOISE["gyro"], rate_random_walk=NOISE["gyro_drive"])
    markov = GNSS_MARKOV[0] if plan.correlated else 0.0
    gnss = GnssSpec(
        "parity", plan.gnss_hz, GNSS_SIGMA[0], GNSS_SIGMA[2], markov, markov, GNSS_MARKOV[1], GNSS_SIGMA[3], plan.lever, plan.latency_s
    )  # fmt: skip
    initial = {k: float(v) if np.ndim(v) == 0 else v for k, v in tables["initial"].items()}
    outages = tuple((plan.start_s + a, plan.start_s + b) for a, b in plan.outages)
    mag = MagSpec(
        "parity", plan.mag_hz, MAG_SIGMA, declination=float(np.arctan2(FIELD_N[1], FIELD_N[0])), field_n=FIELD_N
    )
    return SensorLog(
        ImuSamples(**tables["imu"], spec=ImuSpec("parity", plan.rate_hz, gyro, accel)),
        InitialState(**initial),
        GnssFixes(**tables["gnss"], spec=gnss, outages=outages),
        MagSamples(**tables["mag"], spec=mag),
        BaroSamples(**tables["baro"], spec=BaroSpec("parity", 10.0, BARO_SIGMA)) if "baro" in tables else None,
        name=plan.name,
    )


def reference(columns: dict[str, Array]) -> Trajectory:
    """Truth as the bench's noun."""
    return Trajectory(**columns)


def answer(case: Case, log: SensorLog) -> NavSolution:
    """What the estimator says."""
    return make_estimator(case.estimator, **case.params).run(log)


def figures(case: Case, solution: NavSolution) -> dict[str, dict[str, Array]]:
    """Tables of columns of an answer: ``state`` and ``sigma`` at a few times, a few innovations, covariances, extras."""
    rows = _spread(len(solution.t), case.rows)
    out = {"state": {key: column[rows] for key, column in _states(case, solution).items()}}
    if case.states:
        sigma = _sigmas(solution)
        out["sigma"] = {name: sigma[name][rows] for name in case.states}
        out["covariance"] = _covariances(case, solution)
    if solution.innovations:
        out["innovation"] = _innovations(solution)
    for name in sorted(solution.extras):
        t, values = (np.asarray(x, dtype=float) for x in solution.extras[name])
        k = _spread(len(t), FEW)
        columns = values.reshape(len(t), -1)[k].T
        out[f"extra {name}"] = {"t": t[k]} | {f"column {i}": column for i, column in enumerate(columns)}
    return out


def scores(log: SensorLog, truth: Trajectory) -> dict[str, dict[str, Array]]:
    """What the tuner's fast path says of `CANDIDATES`: a table for one by one, and one for side by side."""
    kind = type(make_estimator("indirect-kf"))
    candidates = [make_estimator("indirect-kf", **params) for params in CANDIDATES]
    search = kind.searcher(log, truth, 10)  # type: ignore[attr-defined]
    alone = [search(candidate) for candidate in candidates]
    return {
        "alone": _scored(np.array([rmse for rmse, _ in alone]), np.array([deviance for _, deviance in alone])),
        "together": _scored(*search.batch(candidates)),
    }


def _scored(rmse: Array, deviance: Array) -> dict[str, Array]:
    names = ("h rmse north", "h rmse east", "h rmse down", "v rmse north", "v rmse east", "v rmse down", "angle rmse roll", "angle rmse pitch", "angle rmse yaw")  # fmt: skip
    return dict(zip(names, rmse.T, strict=True)) | {"deviance": deviance}


def _spread(count: int, wanted: int) -> Array:
    """Row numbers from the first to the last."""
    return np.unique(np.round(np.linspace(0, count - 1, min(count, wanted))).astype(int))


def _states(case: Case, solution: NavSolution) -> dict[str, Array]:
    q = solution.q_nb * np.where(solution.q_nb[:, :1] < 0.0, -1.0, 1.0)
    out = {"t": solution.t} | dict(zip(("angle roll", "angle pitch", "angle yaw"), quats_to_eulers(q).T, strict=True))
    if case.position:
        place = {"lat": solution.lat, "lon": solution.lon, "h": solution.h}
        out |= place | dict(zip(("v north", "v east", "v down"), solution.v_n.T, strict=True))
    for key in ("accel_bias", "gyro_bias"):
        if (bias := getattr(solution, key, None)) is not None and (case.position or key == "gyro_bias"):
            out |= {f"{key} {axis}": column for axis, column in zip("xyz", bias.T, strict=True)}
    return out


def _names(solution: NavSolution) -> tuple[str, ...]:
    """Of the columns of ``std`` and ``covariance``."""
    return tuple(getattr(solution, "states", STATE_NAMES))


def _sigmas(solution: NavSolution) -> dict[str, Array]:
    assert solution.std is not None
    return dict(zip(_names(solution), solution.std.T, strict=True))


def _covariances(case: Case, solution: NavSolution) -> dict[str, Array]:
    """At a few snapshots the sigma of each state, and that of the sum of them all, each over its own: takes in every corner."""
    assert solution.covariance is not None and solution.covariance_t is not None
    names = _names(solution)
    index = [names.index(name) for name in case.states]
    k = _spread(len(solution.covariance_t), FEW)
    p = solution.covariance[np.ix_(k, index, index)]
    sigma = np.sqrt(np.einsum("kii->ki", p))
    weights = np.arange(1, len(index) + 1) / sigma  # unequal, so that two states that change places are seen
    total = np.sqrt(np.einsum("ki,kij,kj->k", weights, p, weights))
    return {"t": solution.covariance_t[k], "sigma of the sum": total}


def _innovations(solution: NavSolution) -> dict[str, Array]:
    """Values and sigmas of each channel, and nu' S^-1 nu; NaN where a channel is not used."""
    (nu,) = solution.innovations.values()
    k = _spread(len(nu.t), FEW)
    value, covariance = nu.value[k], nu.covariance[k]
    sigma = np.sqrt(np.einsum("kii->ki", covariance))
    out = {}
    for i in range(value.shape[1]):
        out |= {f"value {i}": value[:, i] / sigma[:, i], f"sigma {i}": sigma[:, i]}
    out["squared"] = np.array([v @ np.linalg.solve(s, v) for v, s in zip(value, covariance, strict=True)])
    return out


def scale(table: str, column: str, stored: Array) -> Array | float:
    """Natural scale of a column. Sigmas are measured by themselves, innovations (over their sigma) and the rest by 1 or themselves."""
    if column == "t":
        return 1.0
    if table in ("state", "alone", "together"):
        key = column.split()[0]
        if key in SCALES:
            return SCALES[key]
    if table in ("sigma", "covariance") or column.startswith("sigma"):
        return np.abs(stored)
    return np.maximum(1.0, np.abs(stored))


def difference(table: str, column: str, stored: Any, now: Array) -> float:
    """Largest difference of a column in units of its scale; angles and longitudes on the circle; infinite where shapes or NaN differ."""
    old = (
        np.broadcast_to(np.asarray(stored, dtype=float), now.shape) if np.ndim(stored) == 0 else np.array(stored, float)
    )
    if old.shape != now.shape or (np.isfinite(old) != np.isfinite(now)).any():
        return float("inf")
    apart = now - old
    if column == "lon" or (column.startswith("angle") and table == "state"):
        apart = np.mod(apart + np.pi, 2.0 * np.pi) - np.pi
    apart = np.abs(apart) / scale(table, column, old)
    return float(np.nanmax(apart, initial=0.0))


__all__ = ["PLANS", "SEARCHED", "answer", "cases", "difference", "figures", "reference", "scores", "sensor_log"]
