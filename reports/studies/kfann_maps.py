"""KFANN 2018 beyond its table: where does the method win? Outage length against gyro bias, and what the networks put out.

Lengths come from one outage of 120 s scored over its first seconds: no estimate in an outage knows when it ends. Seconds,
degrees per second, metres. Written: ``outage-map.csv``, and the figures ``outage-map``, ``network-output`` and ``network-output-matched``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from jobs import Place
    from matplotlib.figure import Figure

    from testbed.data.records import Array

SCENARIO, VARIANT = "kfann-2018", "long-outage"
BIAS_KEY = "sensors.imu.gyro_turn_on_bias_dps"
BIASES_DPS = (0.0, 0.01, 0.03, 0.1, 0.2, 0.55, 1.0)
RUNS = 20
METRIC = "rmse_position_3d_m"
PAPER = ("Update INS", "ANN NN3", "KFANN NN3")
MODERN = "15-state coasting"
COLOURS = {"Update INS": "#9ecae1", "ANN NN3": "#fdae6b", "KFANN NN3": "#a1d99b"}


def make_maps(place: Place) -> None:
    """Sweep the bias, and write map and table; the sweep itself stays in ``place.work``."""
    from jobs import TRIAL_RUNS, write_csv

    from testbed.montecarlo.sweep import sweep
    from testbed.scenario import load_scenario

    runs = TRIAL_RUNS if place.trial else RUNS

    def load(overrides: Mapping[str, Any]) -> Any:
        return load_scenario(SCENARIO, variant=VARIANT, overrides={**overrides, "monte_carlo.runs": runs})

    known = place.resume and (place.work / "manifest.json").is_file()
    sweep(load, {BIAS_KEY: BIASES_DPS}, place.work, resume=known, announce=print)
    table = map_table(read_runs(place.work))
    write_csv(place.target / "outage-map.csv", table)
    save(draw_map(table), place, "outage-map")


def make_network_output(place: Place) -> None:
    """What networks put out beside the error, of run 0 with and without a gyro bias: as a table every second, and drawn."""
    import pandas as pd
    from jobs import write_csv

    parts = []
    for reading, stem in (("as stated", "network-output"), ("matched", "network-output-matched")):
        found = network_output(reading)
        save(draw_network_output(found), place, stem)
        parts.append(found.table().assign(reading=reading))
    write_csv(place.target / "network-output.csv", pd.concat(parts, ignore_index=True))


def save(figure: Figure, place: Place, stem: str) -> None:
    """A figure where the page looks for it."""
    (place.target / "figures").mkdir(parents=True, exist_ok=True)
    figure.savefig(place.target / "figures" / f"{stem}.png", dpi=120, metadata={"Software": None})


def read_runs(results: Path) -> pd.DataFrame:
    """Of the sweep's points: gyro_bias_dps, run, estimator, outage_s, value (3-D position RMSE, m)."""
    import pandas as pd

    parts = []
    for number, bias in enumerate(BIASES_DPS, 1):
        rows = pd.read_parquet(results / f"point_{number:03d}" / "metrics.parquet", filters=[("metric", "==", METRIC)])
        rows = rows[rows["window"].str.startswith("first_")]
        lengths = rows["window"].str.extract(r"first_(\d+)_s", expand=False).astype(int)
        parts.append(rows.assign(gyro_bias_dps=bias, outage_s=lengths))
    return pd.concat(parts, ignore_index=True)[["gyro_bias_dps", "run", "estimator", "outage_s", "value"]]


def map_table(rows: pd.DataFrame) -> pd.DataFrame:
    """gyro_bias_dps, outage_s, estimator, mean_m, median_m, runs: over the runs that every estimator finished.

    The networks lose the aircraft in some runs; without the pairing their means would be those of the easier runs.
    """
    keys = ["gyro_bias_dps", "outage_s"]
    paired = rows.pivot(index=[*keys, "run"], columns="estimator", values="value").dropna()
    paired = paired[list(dict.fromkeys(rows["estimator"]))]
    groups = paired.stack().rename("value").groupby([*keys, "estimator"], sort=False)
    return groups.agg(mean_m="mean", median_m="median", runs="size").reset_index().sort_values(keys, kind="stable")


def draw_map(table: pd.DataFrame) -> Figure:
    """Three maps over outage length and bias: KFANN against Update INS, best of the paper's three, what 15 states gain."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    grids = {
        str(name): part.pivot(index="gyro_bias_dps", columns="outage_s", values="mean_m")
        for name, part in table.groupby("estimator", sort=False)
    }
    shape = next(iter(grids.values()))
    figure = Figure(figsize=(11.0, 3.9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3, sharey=True)
    gain = np.log10((grids["KFANN NN3"] / grids["Update INS"]).to_numpy())
    limit = float(np.ceil(np.nanmax(np.abs(gain)) * 10) / 10)
    axes[0].imshow(gain, origin="lower", aspect="auto", cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes[0].set_title("RMSE of KFANN NN3 over Update INS", fontsize=9)
    label(axes[0], 10.0**gain, np.abs(gain) > 0.6 * limit)
    best = np.argmin([grids[name].to_numpy() for name in PAPER], axis=0)
    shades = ListedColormap([COLOURS[name] for name in PAPER])
    axes[1].imshow(best, origin="lower", aspect="auto", cmap=shades, vmin=-0.5, vmax=len(PAPER) - 0.5)
    axes[1].set_title("Best of the paper's three, its RMSE in m", fontsize=9)
    label(axes[1], np.min([grids[name].to_numpy() for name in PAPER], axis=0))
    for name in PAPER:
        axes[1].plot([], [], "s", color=COLOURS[name], label=name)
    axes[1].legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=3, fontsize=7, frameon=False)
    modern = np.log10((grids["Update INS"] / grids[MODERN]).to_numpy())
    top = float(max(np.nanmax(np.abs(modern)), 0.1))
    axes[2].imshow(modern, origin="lower", aspect="auto", cmap="PuOr", vmin=-top, vmax=top)
    axes[2].set_title(f"{MODERN}, its RMSE in m", fontsize=9)
    label(axes[2], grids[MODERN].to_numpy(), np.abs(modern) > 0.7 * top)
    for ax in axes:
        ax.set_xticks(range(len(shape.columns)), [str(c) for c in shape.columns])
        ax.set_xlabel("outage, s")
    runs = table.groupby("gyro_bias_dps")["runs"].min()
    lost = {bias: f"\n({n} runs)" if n < runs.max() else "" for bias, n in runs.items()}
    axes[0].set_yticks(range(len(shape.index)), [f"{b:g}{lost[b]}" for b in shape.index], fontsize=8)
    axes[0].set_ylabel("gyro bias, °/s (1σ)")
    return figure


def label(ax: Any, values: np.ndarray, dark: np.ndarray | None = None) -> None:
    """Write each cell's value into it."""
    from testbed.report.labels import number

    for (row, column), value in np.ndenumerate(values):
        colour = "white" if dark is not None and dark[row, column] else "black"
        ax.text(column, row, number(float(value), 2), ha="center", va="center", fontsize=7, color=colour)


class NetworkOutput(NamedTuple):
    """Of one run: position error of the INS (N,3) m NED at ``t`` (N,), and what the networks say it is (M,3) at ``said_t`` (M,)."""

    t: Array
    error: Array
    said_t: Array
    said: Array
    outage: tuple[float, float]

    def table(self) -> pd.DataFrame:
        """time_s, and error and output north, east, down at every whole second of the outage."""
        import pandas as pd

        whole = np.arange(np.ceil(self.said_t[0]), self.said_t[-1])
        columns: dict[str, Array] = {"time_s": whole}
        for k, axis in enumerate(("north", "east", "down")):
            columns[f"error_{axis}_m"] = np.interp(whole, self.t, self.error[:, k])
            columns[f"networks_{axis}_m"] = np.interp(whole, self.said_t, self.said[:, k])
        return pd.DataFrame(columns)


def network_output(reading: str) -> NetworkOutput:
    """Of run 0 of a reading on trajectory 1, networks NN3."""
    from estimators.learning.kfann import Kfann
    from estimators.methods.ins import Ins
    from testbed import pipeline
    from testbed.scenario import load_scenario
    from testbed.scoring.metrics import error_series

    scenario = load_scenario(SCENARIO, reading=reading)
    trajectory = pipeline.fly(scenario)
    log, _ = pipeline.sense(scenario, trajectory)
    assert log.gnss is not None
    series = error_series(trajectory, Ins().run(log))
    said_t, said = Kfann(inputs="nn3").run(log).extras["network_output"]
    return NetworkOutput(series.t, series.values[:, :3], said_t, said, log.gnss.outages[0])


def draw_network_output(found: NetworkOutput) -> Figure:
    """The INS's true error before and in the outage, and what the networks say it is."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    start, end = found.outage
    figure = Figure(figsize=(6.3, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, 1, sharex=True)
    shown, learnt = found.t <= end, found.t <= start
    for k, (ax, axis) in enumerate(zip(axes, ("north", "east", "down"), strict=True)):
        ax.plot(found.t[shown], found.error[shown, k], color="black", lw=1.0, label="true error of the INS")
        ax.plot(found.said_t, found.said[:, k], color="#D55E00", lw=1.4, label="networks of KFANN NN3")
        low, high = found.error[learnt, k].min(), found.error[learnt, k].max()
        ax.axhspan(low, high, color="#0072B2", alpha=0.12, lw=0, label="range learnt from")
        ax.axvspan(start, end, color="#000000", alpha=0.08, lw=0)
        ax.set_ylabel(f"{axis.capitalize()}, m", fontsize=8)
        ax.tick_params(labelsize=8)
        ax.margins(x=0)
    axes[0].legend(fontsize=7, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    axes[-1].set_xlabel("Time, s", fontsize=8)
    return figure
