"""AHRS-LSTM 2022: the searches that gave the parameters of its filters without a network, on training flights alone.

Each is a job of `paper_ahrs_lstm_2022` and leaves ``filters-NAME.csv``: every candidate that was the best so far, and for the
peers the whole grid. Roll and pitch RMSE pooled, degrees. A trial takes the first candidates on the flights of the profile ``smoke``.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from ahrs_studies import load, write_table
from jobs import Place

from testbed.data.records import Array, SensorLog
from testbed.data.registry import make_estimator
from testbed.scenario import load_scenario

EVERY = 3
"""Every third training flight: seven of twenty."""
BUDGET, POPULATION, SIGMA, SEED = 150, 10, 0.5, 1
START = {
    "linear_accel_mps2": 10.5,
    "linear_accel_time_s": 0.027,
    "mag_disturbance_ut": 0.88,
    "mag_disturbance_time_s": 12000.0,
    "gyro_noise_scale": 1.48,
    "gyro_bias_scale": 0.11,
    "accel_noise_scale": 0.33,
    "mag_noise_scale": 8.2,
}
"""Where the search begins: the result of an earlier one on other flights."""
ONLY = {"gyro_scale": 0.0, "accel_noise_mps2": 0.0, "field_noise_ut": 0.0}
"""The searches are over the filter's Gauss-Markov processes: nothing else explains acceleration and disturbances."""
ADAPTIVE = {
    "linear_accel_time_s": 0.0162,
    "mag_disturbance_time_s": 12300.0,
    "mag_disturbance_ut": 0.59,
    "gyro_noise_scale": 1.37,
    "gyro_bias_scale": 0.334,
    "accel_noise_scale": 1.17,
    "mag_noise_scale": 3.32,
    "adaption_average_s": 1.3,
}
"""What the adaptive filter has beside its grid: the result of an earlier search on ten training flights."""
ADAPTIVE_GRID = {
    "linear_accel_mps2": (2.0, 3.5, 6.0),
    "turn_speed_mps": (180.0, 370.0),
    "residual_factor": (0.0, 2.0, 4.0),
}
PEER_S = 600.0
"""The peers are interpreted: they are searched on the first ten minutes of one flight."""
GRIDS: dict[str, dict[str, Sequence[float]]] = {
    "madgwick": {"gain": (0.001, 0.002, 0.005)},
    "mahony": {"proportional": (0.01, 0.03, 0.1), "integral": (1e-5, 1e-4, 1e-3)},
    "ahrs-ekf": {"gyro_variance": (1e-4, 1e-2), "accel_variance": (0.25, 25.0)},
}
Flight = tuple[SensorLog, Array]
"""A log and the true roll, pitch and yaw (N,3), rad."""


def flights(place: Place, validation: bool = False) -> list[Flight]:
    """Every `EVERY`-th flight of the data set that the network is trained on, or its validation flights."""
    from testbed.physics.rotations import quats_to_eulers
    from testbed.training.dataset import make_dataset, open_dataset
    from testbed.training.train import dataset_folder

    scenario = load(place)
    training, held_back = open_dataset(make_dataset(scenario, dataset_folder(scenario)))
    chosen = held_back if validation else training[::EVERY]
    return [(f.log(), quats_to_eulers(f.window(0, f.rows)["q_nb"].astype(float))) for f in chosen]


def rmse(name: str, params: Mapping[str, float], given: Sequence[Flight]) -> float:
    """Roll and pitch over all flights; infinite where the filter fails."""
    from testbed.physics.rotations import quats_to_eulers, wrap

    squares = []
    for log, truth in given:
        error = wrap(quats_to_eulers(make_estimator(name, **params).run(log).q_nb) - truth)[:, :2]
        squares.append(float(np.mean(error**2)))
    found = float(np.degrees(np.sqrt(np.mean(squares))))
    return found if np.isfinite(found) else np.inf


def kf(place: Place) -> None:
    """The scenario's row "KF": CMA-ES on the logarithms; the rows of every improvement, the last one is the best."""
    import cma

    given, rows = flights(place), list[dict[str, float]]()

    def evaluate(values: Array, count: int) -> float:
        params = {k: float(f"{v:.3g}") for k, v in zip(START, np.exp(values), strict=True)}
        found = rmse("ahrs-kf", ONLY | params, given)
        if not rows or found < rows[-1]["rmse_deg"]:
            rows.append({"evaluation": count, "rmse_deg": found} | params)
            print(rows[-1], flush=True)
        return min(found, 1e3)

    x0 = np.log(list(START.values()))
    evaluate(x0, 0)
    strategy = cma.CMAEvolutionStrategy(x0, SIGMA, {"seed": SEED, "popsize": POPULATION, "verbose": -9})
    for generation in range(1 if place.trial else BUDGET // POPULATION):
        asked = strategy.ask()
        strategy.tell(asked, [evaluate(x, generation * POPULATION + k + 1) for k, x in enumerate(asked)])
    write_table(place.target / "filters-kf.csv", rows)


def adaptive(place: Place) -> None:
    """The scenario's row "adaptive KF": the least sum of both errors (a search on the training flights alone overfits)."""
    given, others, rows = flights(place), flights(place, validation=True), []
    grid = list(itertools.product(*ADAPTIVE_GRID.values()))
    for values in grid[:2] if place.trial else grid:
        point = dict(zip(ADAPTIVE_GRID, values, strict=True))
        params = ONLY | ADAPTIVE | point
        rows.append(
            point | {"rmse_deg": rmse("ahrs-kf", params, given), "validation_deg": rmse("ahrs-kf", params, others)}
        )
        print(rows[-1], flush=True)
    write_table(place.target / "filters-adaptive.csv", rows)


def peers(place: Place) -> None:
    """The scenario's tuned rows of madgwick, mahony and ahrs-ekf: the best of a grid each."""
    (log, truth), seconds = flights(place)[0], 5.0 if place.trial else PEER_S
    given, rows = [(beginning(log, seconds), truth[: np.searchsorted(log.imu.t, log.imu.t[0] + seconds)])], []
    (tuned,) = [entry.params for entry in load_scenario("ahrs-lstm-2022").estimators if entry.row == "KF"]
    for name, grid in [("ahrs-kf", {key: (value,) for key, value in tuned.items()}), *GRIDS.items()]:
        for values in itertools.product(*grid.values()):
            params = dict(zip(grid, values, strict=True))
            text = " ".join(f"{k}={v:g}" for k, v in params.items())
            rows.append({"filter": name, "parameters": text, "rmse_deg": rmse(name, params, given)})
            print(rows[-1], flush=True)
    write_table(place.target / "filters-peers.csv", rows)


def beginning(log: SensorLog, seconds: float) -> SensorLog:
    """The first part of a log whose magnetometer samples with the IMU."""
    assert log.mag is not None
    n = int(np.searchsorted(log.imu.t, log.imu.t[0] + seconds))
    imu = type(log.imu)(log.imu.t[:n], log.imu.gyro[:n], log.imu.accel[:n], log.imu.spec)
    mag = type(log.mag)(log.mag.t[:n], log.mag.field[:n], log.mag.spec)
    return SensorLog(imu, log.initial, mag=mag)
