"""AHRS-LSTM 2022 end to end: five training seeds of the paper's method, beside every other row, on the scenario's own flight.

Five seeds with SGD at the paper's rate and five with Adam: 13 minutes of one core for the trainings and 11 for the rest; the
paper's 54 structures take about 20 minutes more. Jobs of `paper_ahrs_lstm_2022`. Units are in the headings.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ahrs_claims import (
    BASE,
    as_verdicts,
    crossed,
    judged,
    noise_ratios,
    of_errors,
    of_noise,
    of_structures,
    structure_grid,
)
from ahrs_studies import PHASES, load, new_figure, phases_of, rest_s, save, write_table
from jobs import TRIAL_RUNS, Place
from numpy.typing import NDArray

Array = NDArray[np.float64]
Folders = dict[tuple[str, int], Path]
"""Optimiser and training seed to the folder of that training."""

SCENARIO = "ahrs-lstm-2022"
OPTIMISERS = {"sgd": 0.1, "adam": 1e-3}
"""And their learning rates; the first is the paper's."""
SEEDS, NOISE_SEEDS, REST_SEEDS, ELSEWHERE_SEEDS = 5, 5, 5, 3
"""Trainings of each optimiser, runs of the flight, runs on the bench, runs of each other variant."""
ELSEWHERE = ("calm", "rough", "adis16448", "transport")
"""Variants of the scenario in which no network was trained: other air, another unit, another aircraft."""
AXES = ("roll", "pitch")
COLOURS = {"sgd": "#D55E00", "adam": "#0072B2"}


TABLES = tuple(
    f"end-to-end{end}.csv" for end in ("", "-trainings", "-elsewhere", "-noise", "-learning-curve", "-gradients")
)
READINGS = {
    "LSTM end to end, sgd": ("SGD, rate 0.1", {"optimiser": "SGD, rate 0.1"}),
    "LSTM end to end, adam": ("Adam, rate 0.001", {"optimiser": "Adam, rate 0.001"}),
}
"""Networks of the claims, as readings: the paper names the rate and no optimiser."""


def seeds_of(place: Place) -> tuple[int, int, int, int]:
    """Trainings of each optimiser, runs of the flight, runs on the bench, runs of each other variant."""
    return (TRIAL_RUNS,) * 4 if place.trial else (SEEDS, NOISE_SEEDS, REST_SEEDS, ELSEWHERE_SEEDS)


def make(place: Place) -> None:
    """Train, fly, compare, judge."""
    seeds = range(seeds_of(place)[0])
    folders = {(o, seed): train_seed(place, o, rate, seed) for o, rate in OPTIMISERS.items() for seed in seeds}
    for name in ("learning-curve", "gradients"):
        write_table(place.target / f"end-to-end-{name}.csv", list(collected(folders, f"{name}.csv")))
    squares = mean_squares(place, folders)
    write_table(place.target / "end-to-end.csv", list(comparison(squares)))
    write_table(place.target / "end-to-end-trainings.csv", list(trainings(folders, squares)))
    training_path(place, list(collected(folders, "gradients.csv")))
    write_table(place.target / "end-to-end-elsewhere.csv", list(elsewhere(place, folders)))
    claims(place, folders, squares)


def collected(folders: Folders, file: str) -> Iterator[dict[str, Any]]:
    """The rows of a table of every training, each with its optimiser and seed."""
    for (optimiser, seed), folder in folders.items():
        for row in read(folder / file):
            yield {"optimiser": optimiser, "seed": seed, **row}


def trainings(folders: Folders, squares: dict[str, Array]) -> Iterator[dict[str, Any]]:
    """One row per training. It has failed where no epoch is better than the untrained filter on the flights held back, or
    where the test flight's mean square, roll or pitch, is above the untrained filter's.
    """
    base = squares[BASE][0, :, 0].mean(0)
    for (optimiser, seed), folder in folders.items():
        curve, path = read(folder / "learning-curve.csv"), read(folder / "gradients.csv")
        own = squares[f"LSTM end to end, {optimiser}"][seed, :, 0].mean(0)
        errors = [float(row["validation_deg"]) for row in curve]
        norms = [float(row["gradient_norm"]) for row in path]
        row: dict[str, Any] = {"optimiser": optimiser, "seed": seed, "updates": len(path)}
        row |= {"untrained_deg": errors[0], "validation_deg": min(errors)}
        row |= {f"{axis}_mse_deg2": float(x) for axis, x in zip(AXES, own, strict=True)}
        row |= {"first_norm": norms[0], "largest_norm": max(norms), "last_norm": norms[-1]}
        row["lost_windows"] = sum(int(float(one["lost"])) for one in path)
        yield row | {"failed": int(min(errors[1:]) >= errors[0] or bool((own >= base).any()))}


def training_path(place: Place, rows: Sequence[dict[str, Any]]) -> None:
    """``training-path.png``: loss and norm of the gradient of every update, a line per training."""
    figure, _ = new_figure(7.5, 4.6)
    figure.clear()
    axes = figure.subplots(2, 1, sharex=True)
    for axis, key, text in zip(
        axes, ("loss", "gradient_norm"), ("loss, untrained filter 1", "norm of the gradient"), strict=True
    ):
        for optimiser, colour in COLOURS.items():
            for seed in range(seeds_of(place)[0]):
                one = [row for row in rows if (row["optimiser"], row["seed"]) == (optimiser, seed)]
                label = f"{optimiser}, rate {OPTIMISERS[optimiser]:g}" if seed == 0 else None
                updates = [int(float(row["update"])) for row in one]
                axis.semilogy(updates, [float(row[key]) for row in one], color=colour, lw=0.7, label=label)
        axis.set_ylabel(text)
        axis.grid(which="both", lw=0.3, alpha=0.5)
    axes[0].legend(fontsize=8, frameon=False)
    axes[1].axhline(1.0, color="black", lw=0.7, ls=":")
    axes[1].set_xlabel("update, each of 30 s of ten windows (others from 41 on)")
    save(place, figure, "training-path.png")


def make_structures(place: Place) -> None:
    """``end-to-end-structures.csv``, the paper's 54 structures, each trained once, and the claims on them, judged by themselves:
    ``testbed train ahrs-lstm-2022 --variant end-to-end --profile structures``; a trial trains each for seconds.
    """
    from testbed.scenario import load_scenario
    from testbed.training.train import train

    scenario = load_scenario(
        SCENARIO, variant="end-to-end", profile="structures", overrides=TINY if place.trial else None
    )
    rows = read(train(scenario, place.work / "structures", resume=True))
    assert len(rows) == len(structure_grid())
    write_table(place.target / "end-to-end-structures.csv", rows)
    verdicts = as_verdicts(told(judged("structures", list(of_structures(rows)))), {"structures": ("54 trainings", {})})
    write_table(place.target / "verdicts-structures.csv", verdicts)


TINY = {
    "extra.dataset.duration_s": 60.0,
    "extra.train.window_s": 10.0,
    "extra.train.chunk_s": 10.0,
    "extra.train.batch": 1,
    "extra.train.epochs": 1,
}
"""Of a trial's structures: one update or so."""


def elsewhere(place: Place, folders: Folders) -> Iterator[dict[str, Any]]:
    """The networks of the paper's optimiser, untouched, where they were not trained, beside the KF that they correct."""
    count = seeds_of(place)
    for variant in ELSEWHERE[:1] if place.trial else ELSEWHERE:
        logs, truth = flown(place, variant, count[3])
        base = squares_of(place, kf_of_paper(), logs, truth)[None, :, 0]
        networks = [network_of(folders["sgd", seed]) for seed in range(count[0])]
        ours = np.array([squares_of(place, network, logs, truth)[:, 0] for network in networks])
        for a, axis in enumerate(AXES):
            low, middle, high = crossed_interval(np.log(ours[..., a] / base[..., a]))
            ends = [100.0 * (1.0 - math.exp(x)) for x in (middle, high, low)]
            row: dict[str, Any] = {"variant": variant, "axis": axis, "kf_rmse_deg": float(np.sqrt(base[..., a]).mean())}
            row |= {"rmse_deg": float(np.sqrt(ours[..., a]).mean())}
            yield row | dict(zip(("mse_below_pct", "mse_low", "mse_high"), ends, strict=True))


def kf_of_paper() -> Any:
    """The filter that the networks correct."""
    from testbed.data.registry import make_estimator
    from testbed.scenario import load_scenario

    (entry,) = [e for e in load_scenario(SCENARIO, variant="end-to-end").estimators if e.row == BASE]
    return make_estimator(entry.name, **entry.params)


def claims(place: Place, folders: Folders, squares: dict[str, Array]) -> None:
    """``verdicts-end-to-end.csv`` and ``end-to-end-noise.csv``; Holm over the claims of each optimiser's networks."""
    count = seeds_of(place)
    networks = {f"LSTM end to end, {o}": [network_of(folders[o, s]) for s in range(count[0])] for o in OPTIMISERS}
    ratios, table = noise_ratios(networks, kf_of_paper(), count[2], rest_s(place))
    write_table(place.target / "end-to-end-noise.csv", table)
    rows = [row for n in networks for row in told(judged(n, [*of_errors(squares, n), *of_noise(ratios[n])]))]
    write_table(place.target / "verdicts-end-to-end.csv", as_verdicts(rows, READINGS))


def told(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of a claims table, printed."""
    out = list(rows)
    for row in out:
        interval = f"{row['measured_pct']:.1f} ({row['ci_low']:.1f} to {row['ci_high']:.1f})"
        print(row["network"], row["id"], interval, row["verdict"])
    return out


def network_of(folder: Path) -> Any:
    """The estimator with the weights of a training."""
    from testbed.data.registry import make_estimator

    return make_estimator("ahrs-lstm", weights=str(folder / "ahrs-lstm.safetensors"))


def train_seed(place: Place, optimiser: str, rate: float, seed: int) -> Path:
    """The folder of one training, made or completed where it is not."""
    from testbed.training.train import train

    folder = place.work / f"{optimiser}-{seed}"
    settings = {"optimiser": optimiser, "learning_rate": rate, "seed": seed}
    changes = {f"extra.train.{key}": value for key, value in settings.items()}
    scenario = load(place, "end-to-end", **changes)
    train(scenario, folder, resume=True)
    return folder


def read(path: Path) -> list[dict[str, str]]:
    """The rows of a table."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def rows_of_estimators(folders: Folders) -> Iterator[tuple[str, int, Any]]:
    """Label, training seed (-1: none) and estimator of every row."""
    from testbed.data.registry import make_estimator
    from testbed.scenario import load_scenario

    variants = {name: load_scenario(SCENARIO, variant=name) for name in ("end-to-end", "speed")}
    entries = [*variants["end-to-end"].estimators, *variants["speed"].estimators]
    for entry in entries:
        if entry.params.get("weights") != "end-to-end":  # one of those trained here
            yield entry.row, -1, make_estimator(entry.name, **entry.params)
    for (optimiser, seed), folder in folders.items():
        yield f"LSTM end to end, {optimiser}", seed, network_of(folder)


def mean_squares(place: Place, folders: Folders) -> dict[str, Array]:
    """Label to mean square errors (training seeds, noise seeds, windows, roll and pitch), degrees²."""
    logs, truth = flown(place, "speed", seeds_of(place)[1])
    found: dict[str, list[Array]] = {}
    for label, seed, estimator in rows_of_estimators(folders):
        found.setdefault(label, []).append(squares_of(place, estimator, logs, truth))
        print(label, seed, np.sqrt(found[label][-1].mean(0)[0]).round(3), flush=True)
    return {label: np.array(values) for label, values in found.items()}


def flown(place: Place, variant: str, runs: int) -> tuple[list[Any], Array]:
    """The logs of a variant's flight (``speed``: the scenario's, with airspeed and GNSS), and true Euler angles (N,3) at their times."""
    from testbed import pipeline
    from testbed.physics.rotations import quats_to_eulers
    from testbed.scoring.metrics import truth_at

    scenario = load(place, variant)
    trajectory = pipeline.fly(scenario)
    logs = [pipeline.sense(scenario, trajectory, run=k)[0] for k in range(runs)]
    return logs, quats_to_eulers(truth_at(trajectory, logs[0].imu.t)[4])


def squares_of(place: Place, estimator: Any, logs: Sequence[Any], truth: Array) -> Array:
    """Mean square errors (noise seeds, windows, roll and pitch), degrees²."""
    from testbed.physics.rotations import quats_to_eulers, wrap

    t = logs[0].imu.t
    spans = [np.ones(len(t), bool)] + [(t >= start) & (t <= end) for start, end in phases_of(place).values()]
    errors = [np.degrees(wrap(quats_to_eulers(estimator.run(log).q_nb) - truth))[:, :2] for log in logs]
    return np.array([[(e[span] ** 2).mean(0) for span in spans] for e in errors])


def comparison(squares: dict[str, Array]) -> Iterator[dict[str, Any]]:
    """Per row, window and axis: RMSE and MSE, and by how much each is below the paper's KF, with its interval."""
    base = squares[BASE]
    for label, values in squares.items():
        for w, window in enumerate(["all", *PHASES]):
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
    """Low end, mean and high end (95 %) of the mean over training seeds (S) and noise seeds (N) of ``values`` (S,N)."""
    from scipy.stats import t

    found = crossed(values)
    half = float(t.ppf(0.975, found.dof)) * found.error
    return found.mean - half, found.mean, found.mean + half
