"""NARX-UKF 2021: which inputs and how many lags the thesis's method gives the networks of the tables.

MRMR scores and Lipschitz indices on the windows that the networks learn from, as `fit` has them (every third is kept back).
Written: ``selection.csv`` (one row per network), ``ranking.csv``, ``lags.csv`` and the figure ``lags``. Scores are nats.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pandas as pd
from jobs import Place, write_csv

if TYPE_CHECKING:
    from testbed.features.lipschitz import LagCurve

SCENARIO = "narx-ukf-2021"
READINGS = ("Q of the data sheet", "gyro noise x 300")
ROWS = ("NNCKF", "NNAKF")
"""Those whose inputs are selected."""


def make_tables(place: Place) -> None:
    """Rank, choose and draw, for every row under both readings; a trial takes one."""
    from testbed.features.command import plot_lags

    selection, ranking, lags = [], [], []
    for reading in READINGS[:1] if place.trial else READINGS:
        for row, student, known in students(reading):
            ranked, curves = chosen_of(student, known)
            key = {"reading": reading, "networks": row}
            selection += list(selected(key, student.input_count, ranked, curves))
            ranking += list(scores(key, ranked))
            lags += list(indices(key, curves))
            if (reading, row) == (READINGS[0], ROWS[0]):
                (place.target / "figures").mkdir(parents=True, exist_ok=True)
                plot_lags(curves, place.target / "figures" / "lags.png")
    for name, rows in {"selection": selection, "ranking": ranking, "lags": lags}.items():
        write_csv(place.target / f"{name}.csv", pd.DataFrame(rows), digits=4)


def students(reading: str) -> Iterator[tuple[str, Any, list[Any]]]:
    """Label, estimator and the windows that it learns from, of every row with selected inputs."""
    from estimators.learning.narx_aiding import split_windows
    from testbed.data.registry import make_estimator
    from testbed.scenario import load_scenario
    from testbed.training.flights import training_flights

    scenario = load_scenario(SCENARIO, reading=reading)
    flights = training_flights(scenario)
    for entry in scenario.estimators:
        if entry.row in ROWS:
            student: Any = make_estimator(entry.name, **entry.params)
            drifts = [drift for log, _ in flights for drift in student.lessons(log)]
            yield entry.row, student, split_windows(drifts)[0]


def chosen_of(student: Any, known: list[Any]) -> tuple[dict[str, Any], dict[str, LagCurve]]:
    """The ranking and the lag curve of every target, as `fit` makes them."""
    from estimators.learning.narx_networks import lag_curves, rankings

    structure = student.structure(known)
    return rankings(known), lag_curves(known, structure.inputs)


def selected(
    key: dict[str, str], count: int, ranked: dict[str, Any], curves: dict[str, LagCurve]
) -> Iterator[dict[str, Any]]:
    """One row per network: its inputs with their scores, best first, the best that was left out, and its lags."""
    for target, order in ranked.items():
        told = [f"{r.name} {r.score:+.2f}" for r in order]
        row = {"target": target, "inputs": ", ".join(told[:count]), "next": told[count]}
        yield key | row | {"lags": curves[target].order()}


def scores(key: dict[str, str], ranked: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """One row per candidate of every network."""
    for target, order in ranked.items():
        for k, r in enumerate(order, 1):
            row = {"target": target, "rank": k, "input": r.name}
            yield key | row | {"score": r.score, "relevance": r.relevance, "redundancy": r.redundancy}


def indices(key: dict[str, str], curves: dict[str, LagCurve]) -> Iterator[dict[str, Any]]:
    """One row per point of every lag curve."""
    for target, curve in curves.items():
        for lag, index in zip(curve.lags, curve.index, strict=True):
            yield key | {"target": target, "lags": int(lag), "index": index, "chosen": int(lag) == curve.order()}
