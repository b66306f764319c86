"""A learned gain beside the plain and the tuned classical filter: weights of the league's row `gain-gru`, and what they are worth.

Three jobs, one after the other: the classical filter is tuned and five networks are trained on the same lessons by the same
loss; then all fly the flights that were held back, by the filters that users have. ``python reports/make.py gain-network --long`` does all three. Only
development seeds are used. Errors in m; NEES over its degrees of freedom.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gain_flights
import numpy as np
from gain_flights import TEST, TRAINING, VALIDATION, Split, flights
from gain_plugin import folder, plugin
from jobs import Place, read_table, write_csv

from testbed.base.errors import tell_user

if TYPE_CHECKING:
    from gain_filter import Batch, Classical
    from gain_training import Settings, Training

PAGE = Path(__file__).resolve().parents[1] / "gain-network"
TUNED = "tuned.csv"
TRAININGS = "trainings.csv"
TESTED, KINDS = "held-back.csv", "kinds.csv"
TIMINGS = "trainings-timings.csv"
WEIGHTS = "gain-gru.safetensors"
SEEDS = (1, 2, 3, 4, 5)
"""Of the networks, by which they are called."""
EVALUATIONS = 120
"""Of the classical search: thirty for each of its numbers, and about what one training costs."""
PLAIN, CLASSICAL = "indirect-kf", "tuned eskf"
TRIAL_STEPS = 60


def lessons(split: Split, trial: bool = False) -> Batch:
    """The lessons of a split side by side; of a trial the first steps of a flight of one kind."""
    from gain_filter import batch_of
    from gain_lessons import lesson

    chosen = flights(Split(split.first, 1), ("calm",)) if trial else flights(split)
    made = [lesson(flight.truth, flight.log, flight.errors) for flight in chosen]
    return batch_of(made, TRIAL_STEPS if trial else None)


def settings_of(trial: bool) -> tuple[Settings, tuple[int, ...]]:
    """How the networks are trained, and which seeds."""
    from gain_training import Settings

    return (replace(Settings(), epochs=1), SEEDS[:2]) if trial else (Settings(), SEEDS)


def make_tuned(place: Place) -> None:
    """``tuned.csv``: the classical filter with the least loss on the training lessons."""
    import pandas as pd
    from gain_training import tune, untrained_loss

    batch = lessons(TRAINING, place.trial)
    found, loss, evaluations = tune(batch, 6 if place.trial else EVALUATIONS)
    row = found._asdict() | {"evaluations": evaluations, "loss": loss, "loss_indirect_kf": untrained_loss(batch)}
    write_csv(place.target / TUNED, pd.DataFrame([row]))


def make_trainings(place: Place) -> None:
    """The file of weights, and ``trainings.csv``: loss on the validation flights by filter, and whether a training failed."""
    import pandas as pd
    from gain_training import mean_loss, train, untrained_loss

    settings, seeds = settings_of(place.trial)
    validation = lessons(VALIDATION, place.trial)
    batch, started = lessons(TRAINING, place.trial), time.process_time()
    trained = train(seeds, batch, validation, settings)
    minutes = (time.process_time() - started) / 60.0
    classical, untrained = tuned(place.target), untrained_loss(validation)
    rows: list[dict[str, Any]] = [
        {"filter": PLAIN, "epoch": None, "loss": untrained},
        {"filter": CLASSICAL, "epoch": None, "loss": mean_loss(validation, classical.fix, classical.noise)},
    ]
    for each in trained:
        told = {"epoch": each.epoch, "loss": each.loss, "failed": int(each.failed(untrained))}
        rows.append({"filter": network_row(each.seed)} | told)
    write_weights(weights_file(place.target, place.trial), trained)
    write_csv(place.target / TRAININGS, pd.DataFrame(rows))
    timed = {"networks": len(trained), "cpu_minutes": minutes, "cpu_minutes_each": minutes / len(trained)}
    write_csv(place.target / TIMINGS, pd.DataFrame([timed]), digits=3)


def network_row(network: int) -> str:
    """The name of a network's row."""
    return f"gain-gru {network}"


def write_weights(path: Path, trained: list[Training]) -> None:
    """All networks in one file, the first axis of every array by network."""
    from estimators.learning.networks.tensor_file import write_arrays

    arrays = {name: np.stack([each.weights[name] for each in trained]) for name in plugin().SHAPES}
    write_arrays(path, arrays, {"licence": "MIT", "made by": "reports/studies/gain_network.py"})
    tell_user(f"{path}: {path.stat().st_size} bytes")


def weights_file(target: Path, trial: bool) -> Path:
    """The shipped file, beside its plug-in; a trial's lies with its tables."""
    return (target if trial else folder()) / WEIGHTS


def tuned(place: Path) -> Classical:
    """The classical filter that ``tuned.csv`` tells of."""
    from gain_filter import Classical

    row = read_table(place / TUNED).iloc[0]
    return Classical(*(float(row[key]) for key in Classical._fields))


def make_held_back(place: Place) -> None:
    """``held-back.csv`` and ``kinds.csv``: all filters on flights that nothing was learned, chosen or tuned on."""
    rows = filters(tuned(place.target), weights_file(place.target, place.trial), settings_of(place.trial)[1])
    chosen = flights(Split(TEST.first, 2), ("calm",)) if place.trial else flights(TEST)
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in rows}
    for flight in chosen:
        for name, estimator in rows.items():
            runs[name].append({"kind": flight.kind} | scored(estimator, flight))
    write_csv(place.target / TESTED, compared(runs))
    write_csv(place.target / KINDS, by_kind(runs), digits=4)


def filters(classical: Classical, weights: Path, networks: tuple[int, ...]) -> dict[str, Any]:
    """The rows by name: estimators as users have them."""
    from scipy.special import gammainc

    from estimators.methods.eskf import Eskf
    from testbed.data.registry import make_estimator

    gate = {"gate": float(gammainc(1.5, 0.5 * classical.gate))}
    scale = {"gnss-position": classical.position, "gnss-velocity": classical.velocity}
    noise = dict.fromkeys(("accel", "gyro", "accel-bias", "gyro-bias"), classical.noise)
    parts = {"aiding": tuple(scale), "policy": dict.fromkeys(scale, gate), "std_scale": scale, "noise_scale": noise}
    rows = {PLAIN: make_estimator(PLAIN), CLASSICAL: Eskf(**parts)}
    plugin()  # makes the policy known
    for network in networks:
        rows[network_row(network)] = Eskf(policy={"gain-gru": {"network": network, "file": str(weights)}})
    return rows


def scored(estimator: Any, flight: gain_flights.Flight) -> dict[str, Any]:
    """RMS position error (m) of a run and NEES of its position, as the league scores them; an error that is no number where it is lost."""
    from testbed import pipeline
    from testbed.league.cells import normalised
    from testbed.scoring.judged import judge

    solution = estimator.run(flight.log)
    windows = pipeline.windows_of(flight.scenario, flight.truth, flight.log)
    limit = flight.scenario.monte_carlo.divergence_position_m
    judged = judge(solution, flight.truth, flight.log, None, windows, limit)
    if judged.lost:
        return {"error": np.nan, "nees": np.nan}
    values = {(window, metric): value for window, metric, value in judged.rows}
    return {"error": values["all", "rmse_position_3d_m"], "nees": normalised(solution, judged).get("position", np.nan)}


def compared(runs: dict[str, list[dict[str, Any]]]) -> Any:
    """A row per filter: geometric mean of the runs' errors, its ratio to the plain and to the tuned filter, and NEES.

    Intervals of 95 % (bootstrap over the flights; ratios are paired by flight). A lost run counts with the error at which it is lost.
    """
    import pandas as pd

    from testbed.scoring.statistics import describe

    logs = {name: logarithms(rows) for name, rows in runs.items()}
    out = []
    for name, rows in runs.items():
        nees = np.array([row["nees"] for row in rows])
        columns = np.column_stack([logs[name], logs[name] - logs[PLAIN], logs[name] - logs[CLASSICAL], nees])
        told = describe(columns)
        ends = np.column_stack([told[key] for key in ("mean", "ci_low", "ci_high")])
        ends[:3] = np.exp(ends[:3])
        line: dict[str, Any] = {"filter": name, "flights": len(rows)}
        line["diverged_pct"] = 100.0 * float(np.mean([np.isnan(row["error"]) for row in rows]))
        for key, values in zip(("rmse_m", "of_indirect_kf", "of_tuned", "nees"), ends, strict=True):
            line |= dict(zip((key, f"{key}_low", f"{key}_high"), values.tolist(), strict=True))
        out.append(line)
    return pd.DataFrame(out)


def logarithms(rows: list[dict[str, Any]]) -> np.ndarray:
    """(n,) logarithms of the errors, a lost run with 10 km."""
    limit = gain_flights.scenario_of("calm", gain_flights.APART).monte_carlo.divergence_position_m
    return np.log([limit if np.isnan(row["error"]) else row["error"] for row in rows])


def by_kind(runs: dict[str, list[dict[str, Any]]]) -> Any:
    """Per kind of flight and filter: geometric mean of the errors, and NEES."""
    import pandas as pd

    out = []
    for kind in dict.fromkeys(row["kind"] for rows in runs.values() for row in rows):
        for name, rows in runs.items():
            mine = [row for row in rows if row["kind"] == kind]
            nees = float(np.nanmean([row["nees"] for row in mine]))
            out.append({"kind": kind, "filter": name, "rmse_m": float(np.exp(logarithms(mine).mean())), "nees": nees})
    return pd.DataFrame(out)


def learned_from() -> list[Any]:
    """What determines tuning and training but for the code."""
    return [gain_flights.digests(), [asdict(split) for split in (TRAINING, VALIDATION)], SEEDS, EVALUATIONS]


def tested_on() -> list[Any]:
    """What determines the tables of the test: flights, weights and the tuned filter as they are now."""
    files = [path for path in (folder() / WEIGHTS, PAGE / TUNED) if path.is_file()]
    return [gain_flights.digests(), asdict(TEST), [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]]
