"""AHRS-LSTM 2022 end to end: five training seeds of the paper's method, beside every other row, on the scenario's own flight.

``python reports/ahrs_end_to_end.py`` trains what is missing (``results/report/ahrs-lstm-2022-end-to-end``, about four minutes
of one core per seed) and writes ``end-to-end*.csv`` into ``reports/ahrs-lstm-2022/``. Units are in the headings.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ahrs_studies import RESULTS, SCENARIO, TARGET, write_table
from numpy.typing import NDArray

Array = NDArray[np.float64]

TRAINED = RESULTS / f"{SCENARIO}-end-to-end"
OPTIMISERS = {"adam": 1e-3, "sgd": 0.1}
"""And their learning rates; the second is the paper's."""
SEEDS, NOISE_SEEDS = 5, 5
AXES = ("roll", "pitch")
BASE = "paper's KF"


def main() -> None:
    """Train, fly, compare."""
    folders = {(o, seed): train_seed(o, rate, seed) for o, rate in OPTIMISERS.items() for seed in range(SEEDS)}
    for name in ("learning-curve", "gradients"):
        rows = [
            {"optimiser": o, "seed": seed, **row}
            for (o, seed), path in folders.items()
            for row in read(path / f"{name}.csv")
        ]
        write_table(TARGET / f"end-to-end-{name}.csv", rows)
    write_table(TARGET / "end-to-end.csv", list(comparison(mean_squares(folders))))


def train_seed(optimiser: str, rate: float, seed: int) -> Path:
    """The folder of one training, made or completed where it is not."""
    from testbed.scenario import load_scenario
    from testbed.training.train import train

    folder = TRAINED / f"{optimiser}-{seed}"
    settings = {"optimiser": optimiser, "learning_rate": rate, "seed": seed}
    changes = {f"extra.train.{key}": value for key, value in settings.items()}
    scenario = load_scenario(SCENARIO, variant="end-to-end", overrides=changes)
    train(scenario, folder, resume=True)
    return folder


def read(path: Path) -> list[dict[str, str]]:
    """The rows of a table."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def rows_of_estimators(folders: dict[tuple[str, int], Path]) -> Iterator[tuple[str, int, Any]]:
    """Label, training seed (-1: none) and estimator of every row."""
    from testbed.data.registry import make_estimator
    from testbed.scenario import load_scenario

    variants = {name: load_scenario(SCENARIO, variant=name) for name in ("end-to-end", "speed")}
    entries = [*variants["end-to-end"].estimators, *variants["speed"].estimators]
    for entry in entries:
        if entry.params.get("weights") != "end-to-end":  # one of those trained here
            yield entry.row, -1, make_estimator(entry.name, **entry.params)
    for (optimiser, seed), folder in folders.items():
        weights = str(folder / "ahrs-lstm.safetensors")
        yield f"LSTM end to end, {optimiser}", seed, make_estimator("ahrs-lstm", weights=weights)


def mean_squares(folders: dict[tuple[str, int], Path]) -> dict[str, Array]:
    """Label to mean square errors (training seeds, noise seeds, windows, roll and pitch), degrees²."""
    logs, truth = flown()
    found: dict[str, list[Array]] = {}
    for label, seed, estimator in rows_of_estimators(folders):
        found.setdefault(label, []).append(squares_of(estimator, logs, truth))
        print(label, seed, np.sqrt(found[label][-1].mean(0)[0]).round(3), flush=True)
    return {label: np.array(values) for label, values in found.items()}


def flown() -> tuple[list[Any], Array]:
    """The logs of the scenario's flight with airspeed and GNSS, and true Euler angles (N,3) at their times."""
    from testbed import pipeline
    from testbed.physics.rotations import quats_to_eulers
    from testbed.scenario import load_scenario
    from testbed.scoring.metrics import truth_at

    scenario = load_scenario(SCENARIO, variant="speed")
    trajectory = pipeline.fly(scenario)
    logs = [pipeline.sense(scenario, trajectory, run=k)[0] for k in range(NOISE_SEEDS)]
    return logs, quats_to_eulers(truth_at(trajectory, logs[0].imu.t)[4])


def squares_of(estimator: Any, logs: Sequence[Any], truth: Array) -> Array:
    """Mean square errors (noise seeds, windows, roll and pitch), degrees²."""
    from testbed.physics.rotations import quats_to_eulers, wrap

    t = logs[0].imu.t
    spans = [np.ones(len(t), bool)] + [(t >= w.start) & (t <= w.end) for w in windows()]
    errors = [np.degrees(wrap(quats_to_eulers(estimator.run(log).q_nb) - truth))[:, :2] for log in logs]
    return np.array([[(e[span] ** 2).mean(0) for span in spans] for e in errors])


def windows() -> Sequence[Any]:
    """Cruise and loiter, as the paper plots them."""
    from testbed.scenario import load_scenario

    return [w for w in load_scenario(SCENARIO).windows if w.name in ("cruise", "loiter")]


def comparison(squares: dict[str, Array]) -> Iterator[dict[str, Any]]:
    """Per row, window and axis: RMSE and MSE, and by how much each is below the paper's KF, with its interval."""
    base = squares[BASE]
    for label, values in squares.items():
        for w, window in enumerate(["all", *(w.name for w in windows())]):
            for a, axis in enumerate(AXES):
                ours = values[:, :, w, a]
                low, mid, high = crossed_interval(np.log(ours / base[:, :, w, a]))
                row: dict[str, Any] = {"estimator": label, "window": window, "axis": axis, "training_seeds": len(ours)}
                row |= {"rmse_deg": float(np.sqrt(ours).mean()), "mse_deg2": float(ours.mean())}
                row |= {"worse_than_base": int((ours.mean(1) > base[0, :, w, a].mean()).sum())}
                for name, power in (("rmse", 0.5), ("mse", 1.0)):
                    ends = [100.0 * (1.0 - math.exp(power * x)) for x in (mid, high, low)]
                    row |= dict(zip((f"{name}_below_pct", f"{name}_low", f"{name}_high"), ends, strict=True))
                yield row


def crossed_interval(values: Array) -> tuple[float, float, float]:
    """Low end, mean and high end (95 %) of the mean over training seeds (S) and noise seeds (N) of ``values`` (S,N).

    Both are random and crossed: the variance of the mean is (MS_seeds + MS_noise - MS_rest) / (S N), at least the larger of
    the two parts (Searle, Casella, McCulloch 1992, section 4.4); t has the smaller number of degrees of freedom.
    """
    from scipy.stats import t

    s, n = values.shape
    mean = float(values.mean())
    rows, columns = values.mean(1) - mean, values.mean(0) - mean
    of_noise = s * float((columns**2).sum()) / (n - 1)
    if s == 1:
        half = t.ppf(0.975, n - 1) * math.sqrt(of_noise / n)
        return mean - half, mean, mean + half
    of_seeds = n * float((rows**2).sum()) / (s - 1)
    rest = float(((values - mean - rows[:, None] - columns[None, :]) ** 2).sum()) / ((s - 1) * (n - 1))
    variance = max(of_seeds, of_noise, of_seeds + of_noise - rest) / (s * n)
    half = t.ppf(0.975, min(s, n) - 1) * math.sqrt(variance)
    return mean - half, mean, mean + half


if __name__ == "__main__":
    main()
