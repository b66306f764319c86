"""AHRS-LSTM 2022 beside its runs: learning curve, Allan table, phases, other conditions, nine hours. Units are in the headings.

Each study is a job of `paper_ahrs_lstm_2022`; a trial flies ten minutes instead of an hour, with two runs.
"""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jobs import TRIAL_RUNS, Place

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from testbed.data.records import SensorLog
    from testbed.scenario import Scenario

SCENARIO = "ahrs-lstm-2022"
VARIANTS = ("adis16448", "adis16488", "adis16488-aligned", "calm", "rough", "transport")
VARIANT_RUNS = 4
METRICS = ("rmse_roll_deg", "rmse_pitch_deg")
ALLAN_S, ALLAN_SEED, SETTLED_S = 3 * 3600.0, 5, 600.0
COLOURS = {"IMU": "#000000", "KF": "#0072B2", "adaptive KF": "#009E73", "LSTM": "#D55E00"}
PHASES = ("cruise", "loiter")
"""Windows of the scenario, as the paper plots them."""
TRIAL_PHASES = {"cruise": (120.0, 350.0), "loiter": (400.0, 590.0)}
TRIAL_ALLAN_S = 3600.0
"""A trial's flight of ten minutes ends before the loiter; its rest must hold clusters of 1000 s."""


def load(place: Place, variant: str | None = None, profile: str | None = None, **overrides: Any) -> Scenario:
    """The scenario in a variant; a trial's in the profile ``smoke``."""
    from testbed.scenario import load_scenario

    if place.trial:  # its flight ends before the windows of claims and tables
        profile, overrides = "smoke", overrides | {"claims": [], "tables": []}
    return load_scenario(SCENARIO, profile=profile, variant=variant, overrides=overrides)


def phases_of(place: Place) -> dict[str, tuple[float, float]]:
    """Start and end of `PHASES`, s."""
    if place.trial:
        return TRIAL_PHASES
    windows = {window.name: (window.start, window.end) for window in load(place).windows}
    return {name: windows[name] for name in PHASES}


def rest_s(place: Place) -> float:
    """How long the sensors lie on the bench."""
    return TRIAL_ALLAN_S if place.trial else ALLAN_S


def learned(_paper: str) -> str:
    """Checksum of the shipped weights, which carry their learning curve."""
    from estimators.learning.ahrs_weights import BY_NAME

    return hashlib.sha256(BY_NAME[""].read_bytes()).hexdigest()[:16]


def learning_curve(place: Place) -> None:
    """``learning-curve.csv`` and ``.png``: the curve that the shipped weights carry with them."""
    from estimators.learning.ahrs_weights import load_weights

    metadata = load_weights("").metadata
    curve = metadata["learning_curve"]
    write_table(place.target / "learning-curve.csv", curve)
    figure, axes = new_figure(6.3, 3.2)
    epochs = [row["epoch"] for row in curve]
    label = "flights not learnt from"
    axes.plot(epochs, [row["validation_deg"] for row in curve], "o-", ms=3, color=COLOURS["LSTM"], label=label)
    axes.axhline(curve[0]["validation_deg"], color=COLOURS["KF"], lw=1, label="the KF on the same flights")
    axes.axvline(metadata["epoch"], color="black", lw=0.7, ls=":", label="kept")
    for before, row in zip(curve[1:], curve[2:], strict=False):
        if row["round"] != before["round"]:
            axes.axvline(before["epoch"] + 0.5, color="black", lw=0.4, alpha=0.4)
    axes.set(xlabel="epoch (thin lines: the network flies anew)", ylabel="roll and pitch RMSE, °")
    axes.set_xticks(epochs[::3])
    axes.legend(fontsize=7, frameon=False)
    save(place, figure, "learning-curve.png")


def allan(place: Place) -> None:
    """``allan.csv`` and ``.png``: the paper's Table 4, of the rate of the attitude that each puts out, at rest."""
    from testbed.sensors.allan import allan_deviation, fit_allan, pooled

    log, rows = log_at_rest(rest_s(place), ALLAN_SEED), []
    figure, axes = new_figure(6.3, 4.0)
    rate_hz = (len(log.imu.t) - 1) / float(log.imu.t[-1] - log.imu.t[0])
    first = round(SETTLED_S * rate_hz)
    for label, rates in attitude_rates(log).items():
        curve = pooled([allan_deviation(rates[first:, i], rate_hz) for i in range(3)])
        fit = fit_allan(curve, rest_s(place) - SETTLED_S, axes=3)
        at = [float(np.interp(tau, curve.tau, curve.deviation)) for tau in (1.0, 10.0, 100.0, 1000.0)]
        rows.append(
            {
                "output": label,
                "in_run_bias_dph": 3600.0 * np.degrees(fit.bias_instability),
                "arw_dprh": 60.0 * np.degrees(fit.white_noise),
                "rrw_dprh3": 3600.0**1.5 * np.degrees(fit.rate_random_walk),
            }
            | {f"deviation_{tau}_s_dph": 3600.0 * np.degrees(v) for tau, v in zip((1, 10, 100, 1000), at, strict=True)}
        )
        axes.loglog(curve.tau, 3600.0 * np.degrees(curve.deviation), color=COLOURS[label], label=label)
    write_table(place.target / "allan.csv", rows)
    axes.set(xlabel="averaging time, s", ylabel="Allan deviation of the rate, °/h")
    axes.grid(which="both", lw=0.3, alpha=0.5)
    axes.legend(fontsize=8, frameon=False)
    save(place, figure, "allan.png")


def attitude_rates(log: SensorLog) -> dict[str, Any]:
    """(N,3) rad/s: what the gyros say, and how fast the attitude of each filter turns in b."""
    from testbed.data.registry import make_estimator

    rates = {"IMU": log.imu.gyro[1:]}
    for label, (name, params) in rows_of_scenario().items():
        if label in COLOURS:
            rates[label] = rate_of_attitude(make_estimator(name, **params).run(log).q_nb, log)
    return rates


def rate_of_attitude(q_nb: Any, log: SensorLog) -> Any:
    """(N-1,3) rad/s: how fast an attitude (N,4) at the times of the IMU turns, in b."""
    from testbed.physics.rotations import attitude_errors, quats_to_matrices

    turns = np.einsum("kji,kj->ki", quats_to_matrices(q_nb[:-1]), attitude_errors(q_nb[1:], q_nb[:-1]))
    return turns / np.diff(log.imu.t)[:, None]


def rows_of_scenario() -> dict[str, tuple[str, Mapping[str, Any]]]:
    """Label to name and parameters of the scenario's estimators."""
    from testbed.scenario import load_scenario

    return {entry.row: (entry.name, entry.params) for entry in load_scenario(SCENARIO).estimators}


def log_at_rest(duration_s: float, seed: int) -> SensorLog:
    """The scenario's sensors on a bench, level, heading north."""
    from testbed.data.records import Trajectory
    from testbed.physics.earth import earth_rate_n, gravity
    from testbed.scenario import load_scenario
    from testbed.sensors import sense_flight

    scenario = load_scenario(SCENARIO)
    assert scenario.flight is not None and scenario.sensors is not None
    start, rate = scenario.flight.initial, scenario.flight.rate_hz
    n = round(duration_s * rate) + 1
    lat, lon = np.radians(start.lat_deg), np.radians(start.lon_deg)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    force = np.tile([0.0, 0.0, -gravity(lat, start.alt_m)], (n, 1))
    place = np.full(n, lat), np.full(n, lon), np.full(n, start.alt_m), np.zeros((n, 3))
    still = Trajectory(np.arange(n) / rate, *place, q, force, np.tile(earth_rate_n(lat), (n, 1)))
    return sense_flight(scenario.sensors, scenario.initial, still, seed, 0)[0]


def generalisation(place: Place) -> None:
    """``generalisation.csv``: the learned gain where it was not trained, against the KF there, `VARIANT_RUNS` runs each."""
    from testbed.montecarlo.runner import run
    from testbed.scoring.effects import effect

    rows, count = [], TRIAL_RUNS if place.trial else VARIANT_RUNS
    for variant in VARIANTS[:1] if place.trial else VARIANTS:
        folder = place.work / variant
        made = run(load(place, variant), folder, runs=count, resume=known(place, folder))
        table = made.metrics[(made.metrics["window"] == "all") & made.metrics["metric"].isin(METRICS)]
        values = table.pivot_table(index=["metric", "run"], columns="estimator", values="value")
        for metric in METRICS:
            part = values.loc[metric].reindex(range(count))
            for label in [name for name in part.columns if name in ("LSTM", "adaptive KF")]:
                gain = effect(part[label].to_numpy(), part["KF"].to_numpy())
                row = {"variant": variant, "metric": metric, "estimator": label, "kf_deg": part["KF"].mean()}
                row |= {"deg": part[label].mean(), "runs": int(part[label].notna().sum())}
                found = (gain.percent, gain.low, gain.high) if gain else (np.nan,) * 3
                rows.append(row | dict(zip(("improvement_pct", "ci_low", "ci_high"), found, strict=True)))
    write_table(place.target / "generalisation.csv", rows)


def known(place: Place, folder: Path) -> bool:
    """Whether the runs of this folder were begun and may be gone on with."""
    return place.resume and (folder / "manifest.json").is_file()


def phases(place: Place) -> None:
    """``phases.csv`` and ``.png``: the paper's Figures 6 and 7, errors of run 0 in cruise and in loiter; RMSE, °."""
    from testbed.montecarlo.runner import run
    from testbed.report.results import load_result

    run(load(place), place.work / "flight", runs=1, resume=known(place, place.work / "flight"))
    result, windows = load_result(place.work / "flight"), phases_of(place)
    figure, _ = new_figure(9.0, 5.0)
    figure.clear()
    axes = figure.subplots(2, len(PHASES), sharey="row", squeeze=False)
    rows: list[dict[str, Any]] = []
    for column, phase in enumerate(windows):
        start, end = windows[phase]
        for ax, axis in zip(axes[:, column], ("roll", "pitch"), strict=True):
            for label, errors in result.errors.items():
                if label in COLOURS:
                    shown = errors[(errors["time_s"] >= start) & (errors["time_s"] <= end)]
                    ax.plot(shown["time_s"], shown[f"{axis}_deg"], color=COLOURS[label], lw=1, label=label)
                    found = float(np.sqrt(np.mean(shown[f"{axis}_deg"] ** 2)))
                    rows.append({"phase": phase, "axis": axis, "estimator": label, "rmse_deg": found})
            ax.axhline(0.0, color="black", lw=0.4)
            ax.margins(x=0)
            ax.set_ylabel(f"{axis} error, °")
        axes[0, column].set_title(phase.capitalize(), fontsize=9)
        axes[1, column].set_xlabel("Time, s")
    axes[0, 0].legend(fontsize=8, frameon=False)
    write_table(place.target / "phases.csv", rows)
    save(place, figure, "phases.png")


def nine_hours(place: Place) -> None:
    """``nine-hours.csv``: one run of the profile ``paper``, a flight of nine hours as in the paper."""
    from testbed.montecarlo.runner import run

    table = run(
        load(place, None, "paper"), place.work / "flight", runs=1, resume=known(place, place.work / "flight")
    ).summary
    table = table[table["metric"].isin(METRICS)]
    write_table(place.target / "nine-hours.csv", table[["estimator", "window", "metric", "mean"]].to_dict("records"))


def new_figure(width: float, height: float) -> tuple[Figure, Any]:
    """A figure that needs no display, and its axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots()


def save(place: Place, figure: Figure, name: str) -> None:
    """Among the figures of the report's folder."""
    (place.target / "figures").mkdir(parents=True, exist_ok=True)
    figure.savefig(place.target / "figures" / name, dpi=120, metadata={"Software": None})


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Numbers with five digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
