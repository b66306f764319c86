"""NARX-UKF 2021, claim 1 beyond the outages' errors: biases with GNSS (fig. 5.6), ±3 sigma with GNSS (fig. 5.7), what grows.

EKF and UKF on the same logs under each Q, and without scale factors, and from a wide start. Written: ``growth.csv``, ``biases.csv``,
``bands.csv``, ``verdicts-filters.csv``; figures ``bias-convergence`` and ``bands-with-gnss``, both of run 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from outage_growth import AXES, CONVERGED_S, GROUPS, bias_table, distance_at, growth, outside_share

if TYPE_CHECKING:
    import pandas as pd
    from jobs import Place
    from matplotlib.figure import Figure

    from testbed.data.records import NavSolution, SensorErrors, Trajectory

SCENARIO = "narx-ukf-2021"
FILTERS = ("EKF", "UKF")
RUNS = 3
"""Eight outages each; biases and bands differ between runs by little, as unit and flight are the same."""
SETTLED_S, RECOVERY_S = 100.0, 20.0
"""From when on a filter counts as settled (the thesis: about 100 s), and after an outage."""
STATES = tuple(f"{what} {axis}" for what in ("position", "velocity", "attitude") for axis in "NED")
DATA_SHEET, GYRO, BOTH = "Q of the data sheet", "gyro noise x 300", "both noises x 300"
BIAS_UNIT = dict(zip(AXES, [1e-3] * 3 + [1e-6] * 3, strict=True))
"""The table's units: mm/s² and µrad/s."""
CURVE_S = 1.0


class Case(NamedTuple):
    """A reading of the scenario, in a variant or with single settings."""

    reading: str
    variant: str | None = None
    overrides: Mapping[str, Any] = {}


CASES = {
    DATA_SHEET: Case(DATA_SHEET),
    GYRO: Case(GYRO),
    BOTH: Case(BOTH),
    "no scale factor": Case(DATA_SHEET, "no-scale-factor"),
    "wide start": Case(DATA_SHEET, None, {"initial.yaw_deg": 40.0, "initial.roll_pitch_deg": 5.0}),
}


def make_tables(place: Place) -> None:
    """Run every case, and write tables, verdicts and figures; a case that is stored is kept with ``place.resume``."""
    import pandas as pd
    from jobs import TRIAL_RUNS, write_csv

    place.work.mkdir(parents=True, exist_ok=True)
    rows, curves = [], {}
    for name, case in CASES.items():
        runs = TRIAL_RUNS if place.trial else RUNS
        stored = {kind: place.work / f"{name}-{runs}-{kind}.csv".replace(" ", "-") for kind in ("rows", "curves")}
        if not (place.resume and all(path.is_file() for path in stored.values())):
            print(f"filters: {name}")
            for kind, table in zip(stored, run_case(case, runs), strict=True):
                table.to_csv(stored[kind], index=False, float_format="%.10g", lineterminator="\n")
        rows.append(pd.read_csv(stored["rows"]).assign(case=name))
        curves[name] = pd.read_csv(stored["curves"])
    table = pd.concat(rows, ignore_index=True)
    for file, made in (("growth", growth_table), ("biases", bias_rows), ("bands", band_table)):
        write_csv(place.target / f"{file}.csv", made(table))
    write_csv(place.target / "verdicts-filters.csv", verdicts(table))
    figures = {"bias-convergence": draw_biases(curves[DATA_SHEET]), "bands-with-gnss": draw_bands(curves)}
    (place.target / "figures").mkdir(parents=True, exist_ok=True)
    for stem, figure in figures.items():
        figure.savefig(place.target / "figures" / f"{stem}.png", dpi=100, metadata={"Software": None})


def run_case(case: Case, runs: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """(filter, run, kind, item, value) of every run, and the curves of run 0."""
    import pandas as pd

    from testbed import pipeline
    from testbed.data.registry import make_estimator
    from testbed.scenario import load_scenario

    scenario = load_scenario(SCENARIO, variant=case.variant, overrides=case.overrides, reading=case.reading)
    entries = {entry.row: entry for entry in scenario.estimators if entry.row in FILTERS}
    trajectory = pipeline.fly(scenario)
    rows: list[tuple[str, int, str, str, float]] = []
    curves = []
    for run in range(runs):
        log, errors = pipeline.sense(scenario, trajectory, run=run)
        assert log.gnss is not None and errors is not None
        outages, solutions = log.gnss.outages, {}
        for label in FILTERS:
            solution = make_estimator(entries[label].name, **entries[label].params).run(log)
            solutions[label] = solution
            grown = growth(trajectory, log, errors, solution)["error_m"]
            parts = {"growth": dict(zip(GROUPS, np.mean(grown**2, axis=0), strict=True))}
            known = bias_table(solution, errors)
            for key in ("truth", "estimate", "right_pct", "convergence_s"):
                parts[key] = dict(zip(AXES, known[key], strict=True))
            for where, windows in (("with GNSS", with_gnss(outages, float(solution.t[-1]))), ("in outages", outages)):
                parts[where] = dict(zip(STATES, outside_share(trajectory, solution, windows), strict=True))
            rows += [(label, run, kind, item, float(v)) for kind, part in parts.items() for item, v in part.items()]
            if run == 0:
                curves.append(curve(trajectory, solution, errors).assign(filter=label))
        apart = distance_at(*solutions.values(), [end for _, end in outages])
        rows.append(("EKF", run, "apart", "m", float(np.mean(apart**2))))
    return pd.DataFrame(rows, columns=["filter", "run", "kind", "item", "value"]), pd.concat(curves, ignore_index=True)


def with_gnss(outages: Any, end: float) -> list[tuple[float, float]]:
    """Where there is GNSS and a filter has settled: from `SETTLED_S`, and from `RECOVERY_S` after each outage."""
    starts = [SETTLED_S, *(stop + RECOVERY_S for _, stop in outages)]
    return [(a, b) for a, b in zip(starts, [*(start for start, _ in outages), end], strict=True) if b > a]


def curve(trajectory: Trajectory, solution: NavSolution, errors: SensorErrors) -> pd.DataFrame:
    """Every `CURVE_S` until `CONVERGED_S`: position errors and their sigmas (m), bias estimates and truth (`BIAS_UNIT`)."""
    import pandas as pd

    from testbed.scoring.metrics import error_series

    series = error_series(trajectory, solution)
    assert solution.std is not None and solution.accel_bias is not None and solution.gyro_bias is not None
    k = np.searchsorted(series.t, np.arange(CURVE_S, CONVERGED_S, CURVE_S) - 1e-6)
    columns = {"time_s": series.t[k]}
    for axis in range(3):
        columns |= {STATES[axis]: series.values[k, axis], f"sigma {STATES[axis]}": solution.std[k, axis]}
    estimates, truth = (np.hstack([part.accel_bias[k], part.gyro_bias[k]]) for part in (solution, errors))
    for n, axis_name in enumerate(AXES):
        unit = BIAS_UNIT[axis_name]
        columns |= {axis_name: estimates[:, n] / unit, f"true {axis_name}": truth[:, n] / unit}
    return pd.DataFrame(columns)


def growth_table(rows: pd.DataFrame) -> pd.DataFrame:
    """RMS position error (m) at the end of an outage by what it came from, and how far the two filters are apart there."""
    own = rows[rows["kind"] == "growth"]
    keys = ["case", "filter"]
    table = own.groupby([*keys, "item"], sort=False)["value"].mean().pow(0.5).unstack("item")[list(GROUPS)]
    apart = rows[rows["kind"] == "apart"].groupby("case")["value"].mean().pow(0.5)
    table = in_order(table.reset_index())
    return table.assign(ekf_to_ukf=table["case"].map(apart), runs=own["run"].nunique())


def bias_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Per axis (mm/s², µrad/s): truth and estimate at `CONVERGED_S`, per cent right, s until within a tenth; means over runs."""
    kinds = ["truth", "estimate", "right_pct", "convergence_s"]
    own = rows[rows["kind"].isin(kinds)]
    table = own.groupby(["case", "filter", "item", "kind"], sort=False)["value"].mean().unstack("kind")[kinds]
    table = in_order(table.reset_index()).rename(columns={"item": "axis"})
    unit = table["axis"].map(BIAS_UNIT)
    return table.assign(truth=table["truth"] / unit, estimate=table["estimate"] / unit)


def band_table(rows: pd.DataFrame) -> pd.DataFrame:
    """Share of the time (%) outside of ±3 sigma with GNSS and in outages, by state; means over runs."""
    own = rows[rows["kind"].isin(["with GNSS", "in outages"])]
    table = (
        100.0
        * own.groupby(["case", "filter", "kind", "item"], sort=False)["value"].mean().unstack("item")[list(STATES)]
    )
    return in_order(table.reset_index()).rename(columns={"kind": "where"})


def in_order(table: pd.DataFrame) -> pd.DataFrame:
    """Rows in the order of `CASES`, EKF before UKF."""
    order = table["case"].map(list(CASES).index)
    return (
        table.assign(order=order)
        .sort_values(["order", "filter"], kind="stable", ignore_index=True)
        .drop(columns="order")
    )


def verdicts(rows: pd.DataFrame) -> pd.DataFrame:
    """The thesis's claims on bands and biases with GNSS, under each Q."""
    import pandas as pd
    from study_verdicts import verdict_rows

    from testbed.scoring.claims import ClaimConfig, ReadingConfig

    named = {"better": "UKF", "than": "EKF", "window": "with GNSS"}
    claims = [
        ClaimConfig(id="1-bands", metric="outside", text="With GNSS the UKF leaves its ±3σ band less of the time than the EKF", **named),
        ClaimConfig(
            id="1-biases", metric="wrong", paper_improvement_pct=42.9, **named,
            text="Accelerometer biases with GNSS: the UKF's are 28, 6 and 2 % wrong, the EKF's 40, 14 and 9 %",
        ),
    ]  # fmt: skip
    readings = [
        ReadingConfig(name=q, leaves_open="How Q was set.", conditions={"Q": q}) for q in (DATA_SHEET, GYRO, BOTH)
    ]
    own = rows.assign(value=np.where(rows["kind"] == "right_pct", 100.0 - rows["value"], rows["value"]))
    outside = own[own["kind"] == "with GNSS"]
    wrong = own[(own["kind"] == "right_pct") & own["item"].str.startswith("accel")]
    parts = []
    for claim, part in zip(claims, (outside, wrong), strict=True):
        means = part.groupby(["case", "run", "filter"])["value"].mean().unstack("filter")
        parts.append(verdict_rows([claim], readings, {r.name: means.loc[r.name] for r in readings}))
    return pd.concat(parts, ignore_index=True)


COLOURS = {"EKF": ("#0072B2", "-"), "UKF": ("#D55E00", "--")}


def draw_biases(curves: pd.DataFrame) -> Figure:
    """Bias estimates over time with GNSS, EKF and UKF, and the truth: the thesis's fig. 5.6."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    for ax, axis in zip(figure.subplots(2, 3, sharex=True).flat, AXES, strict=True):
        for label, part in curves.groupby("filter"):
            colour, dash = COLOURS[str(label)]
            ax.plot(part["time_s"], part[axis], dash, color=colour, lw=1.2, label=label)
            truth = part
        ax.plot(truth["time_s"], truth[f"true {axis}"], color="black", lw=0.8, label="truth")
        ax.set_title(f"{axis}, {'mm/s²' if axis.startswith('accel') else 'µrad/s'}", fontsize=8)
        spread = max(1.0, 3.0 * float(truth[f"true {axis}"].abs().max()))
        ax.set_ylim(-spread, spread)
        ax.tick_params(labelsize=7)
        ax.margins(x=0)
    figure.supxlabel("Time, s", fontsize=8)
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=7, frameon=False)
    return figure


def draw_bands(curves: Mapping[str, pd.DataFrame]) -> Figure:
    """Position errors with GNSS and ±3 sigma of each filter, a column per Q: the thesis's fig. 5.7."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    chosen = (DATA_SHEET, GYRO, BOTH)
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(3, len(chosen), sharex=True, sharey="row")
    for column, name in zip(panels.T, chosen, strict=True):
        for label, part in curves[name].groupby("filter"):
            colour, dash = COLOURS[str(label)]
            shown = part[part["time_s"] > SETTLED_S]
            for ax, state in zip(column, STATES[:3], strict=True):
                band = 3.0 * shown[f"sigma {state}"]
                ax.plot(shown["time_s"], shown[state], dash, color=colour, lw=1.0, label=label)
                for side in (band, -band):
                    ax.plot(shown["time_s"], side, dash, color=colour, lw=0.6, alpha=0.6)
        column[0].set_title(name, fontsize=8)
    for ax, axis in zip(panels[:, 0], ("North", "East", "Down"), strict=True):
        ax.set_ylabel(f"{axis}, m", fontsize=8)
    for ax in panels.flat:
        ax.tick_params(labelsize=7)
        ax.margins(x=0)
    figure.supxlabel("Time with GNSS, s; thin: ±3σ", fontsize=8)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=7, frameon=False)
    return figure
