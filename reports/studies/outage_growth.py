"""What position error at the end of a GNSS outage is made of, and how well a filter knew the biases: for findings.

Each part is a free run of the strapdown through the outage from the truth with one group of the filter's errors put in: what
a network would have to foretell. Metres, m/s², rad/s. Written: ``outage-growth.md``, ``outage-bands.png``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from testbed.data.records import NavSolution, SensorErrors, SensorLog, Trajectory
from testbed.physics import earth
from testbed.physics.rotations import quat_multiply, rotvec_to_quat

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCENARIO = "narx-ukf-2021"
FILTERS = {"EKF": "direct-ekf", "UKF": "direct-ukf"}
CONVERGED_S = 249.0
"""Just before the first outage."""
RUNS = 5
AXES = ("accel x", "accel y", "accel z", "gyro x", "gyro y", "gyro z")
BIAS_UNIT = np.array([1e-3] * 3 + [1e-6] * 3)
"""The table's units: mm/s² and µrad/s."""
GROUPS = ("position and velocity", "attitude", "biases", "sensor errors in the outage", "all of it")


class Found(NamedTuple):
    """Of one filter on one run: `growth` (outages, groups), `bias_table`, `outside_share` (9,)."""

    growth: np.ndarray
    biases: dict[str, Any]
    outside: np.ndarray


def write_growth(
    target: Path,
    variant: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    name: str = "",
    runs: int = RUNS,
) -> Path:
    """Fly the scenario, run both filters on ``runs`` logs, and write the tables and the figure of run 0.

    With a ``name`` the tables alone, as ``outage-growth-NAME.md``.
    """
    from testbed import pipeline
    from testbed.data.registry import make_estimator
    from testbed.scenario import load_scenario

    scenario = load_scenario(SCENARIO, variant=variant, overrides=overrides)
    trajectory = pipeline.fly(scenario)
    parts: dict[str, list[Found]] = {label: [] for label in FILTERS}
    ends: list[np.ndarray] = []
    target.mkdir(parents=True, exist_ok=True)
    for run in range(runs):
        log, errors = pipeline.sense(scenario, trajectory, run=run)
        assert log.gnss is not None and errors is not None
        outages = log.gnss.outages
        solutions = {label: make_estimator(known_as).run(log) for label, known_as in FILTERS.items()}
        ends.append(distance_at(solutions["EKF"], solutions["UKF"], [end for _, end in outages]))
        for label, solution in solutions.items():
            outside = outside_share(trajectory, solution, outages)
            grown = growth(trajectory, log, errors, solution)["error_m"]
            parts[label].append(Found(grown, bias_table(solution, errors), outside))
        if run == 0 and not name:
            figure = draw_bands(trajectory, solutions, outages)
            figure.savefig(target / "outage-bands.png", dpi=100, metadata={"Software": None})
    path = target / f"outage-growth{f'-{name}' if name else ''}.md"
    lines = _page(parts, runs)
    apart = np.sqrt(np.mean(np.square(ends)))
    lines += ["", f"RMS distance between the two filters' positions at the end of an outage: {apart:.3f} m."]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def distance_at(one: NavSolution, other: NavSolution, times: Sequence[float]) -> np.ndarray:
    """Distance (m) between two solutions of one log at ``times``."""
    rows = np.searchsorted(one.t, np.asarray(times) + 1e-6) - 1
    place = earth.position_difference(
        *(part[rows] for part in (one.lat, one.lon, one.h, other.lat, other.lon, other.h))
    )
    return np.linalg.norm(np.column_stack(place), axis=1)


def _page(parts: Mapping[str, list[Found]], runs: int) -> list[str]:
    """The tables in Markdown."""
    lines = [f"# What grows in an outage ({runs} runs)", ""]
    lines += ["RMS position error (m) at the end of an outage, from the truth with one group of errors put in:", ""]
    rms = {k: np.sqrt(np.mean([f.growth**2 for f in v], axis=(0, 1))) for k, v in parts.items()}
    lines += _rows("filter", GROUPS, rms)
    lines += ["", f"Bias estimates at {CONVERGED_S:g} s, mean over the runs (accelerometers mm/s², gyros µrad/s):", ""]
    first = next(iter(parts.values()))
    biases = {"true": np.mean([f.biases["truth"] for f in first], axis=0) / BIAS_UNIT}
    biases |= {k: np.mean([f.biases["estimate"] for f in v], axis=0) / BIAS_UNIT for k, v in parts.items()}
    lines += _rows("", AXES, biases)
    for title, key in (
        ("Per cent right at that time, mean over the runs:", "right_pct"),
        ("Settled within a tenth of the bias after (s), mean over the runs:", "convergence_s"),
    ):
        lines += ["", title, ""]
        lines += _rows("filter", AXES, {k: np.mean([f.biases[key] for f in v], axis=0) for k, v in parts.items()})
    lines += ["", "Share of the time in outages (%) outside of +-3 sigma:", ""]
    states = [f"{what} {axis}" for what in ("position", "velocity", "attitude") for axis in ("N", "E", "D")]
    return lines + _rows(
        "filter", states, {k: 100.0 * np.mean([f.outside for f in v], axis=0) for k, v in parts.items()}
    )


def _rows(corner: str, columns: Any, rows: dict[str, Any]) -> list[str]:
    """A Markdown table of numbers."""
    head = [f"| {corner} | " + " | ".join(columns) + " |", "| --- |" + " ---: |" * len(columns)]
    return head + [
        f"| {label} | " + " | ".join(_one_decimal(value) for value in row) + " |" for label, row in rows.items()
    ]


def _one_decimal(value: float) -> str:
    return f"{round(float(value), 1) + 0.0:.1f}"  # + 0.0: no minus sign before a zero


def growth(trajectory: Trajectory, log: SensorLog, errors: SensorErrors, solution: NavSolution) -> dict[str, Any]:
    """Position error (outages, groups) in m at the end of each outage, by what it came from (`GROUPS`)."""
    assert log.gnss is not None
    table = [[_coast(trajectory, log, errors, solution, a, b, group) for group in GROUPS] for a, b in log.gnss.outages]
    return {"groups": GROUPS, "outages": log.gnss.outages, "error_m": np.array(table)}


def _coast(
    truth: Trajectory, log: SensorLog, errors: SensorErrors, solution: NavSolution, start: float, end: float, group: str
) -> float:
    """Position error at ``end`` of a free run from the truth at ``start`` with the errors of one group."""
    from estimators.core.strapdown import integrate
    from testbed.physics.rotations import attitude_errors

    imu = log.imu
    rows = slice(int(np.searchsorted(imu.t, start + 1e-6)), int(np.searchsorted(imu.t, end + 1e-6)))
    k = rows.start - 1  # row of the solution; the truth has one row more before it
    j = k + 1
    assert solution.accel_bias is not None and solution.gyro_bias is not None
    whole = group == "all of it"
    take = {name: whole or group == name for name in GROUPS}
    lat, lon, h = (float(x) for x in (truth.lat[j], truth.lon[j], truth.h[j]))
    v, q = truth.v_n[j].copy(), truth.q_nb[j].copy()
    if take["position and velocity"]:
        lat, lon, h = float(solution.lat[k]), float(solution.lon[k]), float(solution.h[k])
        v = solution.v_n[k].copy()
    if take["attitude"]:
        phi = attitude_errors(solution.q_nb[k : k + 1], truth.q_nb[j : j + 1])[0]
        q = np.array(quat_multiply(rotvec_to_quat(phi), q))
    accel_bias, gyro_bias = np.zeros(3), np.zeros(3)
    gyro, accel = truth.w_ib_b[1:][rows], truth.f_b[1:][rows]
    if take["biases"]:
        accel_bias = solution.accel_bias[k] - errors.accel_bias[k]
        gyro_bias = solution.gyro_bias[k] - errors.gyro_bias[k]
    if take["sensor errors in the outage"]:
        gyro = imu.gyro[rows] - errors.gyro_bias[k]
        accel = imu.accel[rows] - errors.accel_bias[k]
    n = rows.stop - rows.start
    lla, velocity, quaternion = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    gyro, accel = np.ascontiguousarray(gyro), np.ascontiguousarray(accel)
    integrate(imu.t[k], imu.t[rows], gyro, accel, lat, lon, h, v, q, accel_bias, gyro_bias, lla, velocity, quaternion)
    last = rows.stop
    place = earth.position_difference(*lla[-1], truth.lat[last], truth.lon[last], truth.h[last])
    return float(np.linalg.norm(place))


def bias_table(
    solution: NavSolution, errors: SensorErrors, until: float = CONVERGED_S, within: float = 0.1
) -> dict[str, Any]:
    """How right the bias estimates were with GNSS: truth, estimate and per cent right at ``until``, convergence times.

    An axis has converged when it stays within ``within`` of its final estimate (at ``until``), relative to the true bias.
    """
    assert solution.accel_bias is not None and solution.gyro_bias is not None
    k = int(np.searchsorted(solution.t, until)) - 1
    truth = np.hstack([errors.accel_bias, errors.gyro_bias])
    estimate = np.hstack([solution.accel_bias, solution.gyro_bias])
    right = 100.0 * (1.0 - np.abs(estimate[k] - truth[k]) / np.abs(truth[k]))
    away = np.abs(estimate[:k] - estimate[k]) > within * np.abs(truth[k])
    last = [solution.t[np.flatnonzero(column)[-1]] if column.any() else solution.t[0] for column in away.T]
    return {"truth": truth[k], "estimate": estimate[k], "right_pct": right, "convergence_s": np.array(last)}


def outside_share(trajectory: Trajectory, solution: NavSolution, windows: Any, sigmas: float = 3.0) -> np.ndarray:
    """Share (9,) of the time within ``windows`` that each error is outside its band: position, velocity, attitude."""
    from testbed.scoring.metrics import error_series

    series = error_series(trajectory, solution)
    assert solution.std is not None
    error = np.hstack([series.values[:, :6], series.phi])
    inside = np.zeros(len(series.t), dtype=bool)
    for a, b in windows:
        inside |= (series.t > a) & (series.t <= b)
    return np.mean(np.abs(error[inside]) > sigmas * solution.std[: len(error)][inside][:, :9], axis=0)


def draw_bands(trajectory: Trajectory, solutions: Mapping[str, NavSolution], outages: Any) -> Figure:
    """Position errors through each outage with +-3 sigma of each filter; heads: share of the time outside, any axis."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from testbed.scoring.metrics import error_series

    figure = Figure(figsize=(13.0, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(3, len(outages), sharex=True, sharey="row", squeeze=False)
    styles = dict(zip(solutions, (("#0072B2", "-"), ("#D55E00", "--")), strict=True))
    for column, (start, end) in enumerate(outages):
        heads = [f"outage {column + 1}"]
        for label, solution in solutions.items():
            colour, dash = styles[label]
            series = error_series(trajectory, solution)
            assert solution.std is not None
            rows = np.flatnonzero((series.t > start - 5.0) & (series.t <= end + 5.0))
            inside = (series.t[rows] > start) & (series.t[rows] <= end)
            error, band = series.values[rows, :3], 3.0 * solution.std[rows, :3]
            heads.append(f"{label} {100.0 * np.mean(np.any(np.abs(error) > band, axis=1)[inside]):.0f} %")
            t, thin = series.t[rows] - start, slice(None, None, 40)
            for ax, e, b in zip(panels[:, column], error.T, band.T, strict=True):
                ax.plot(t[thin], e[thin], dash, color=colour, lw=1.2, label=label)
                ax.plot(t[thin], b[thin], dash, color=colour, lw=0.6, alpha=0.6, label=f"{label}, ±3σ")
                ax.plot(t[thin], -b[thin], dash, color=colour, lw=0.6, alpha=0.6)
        panels[0, column].set_title(heads[0] + "\noutside: " + ", ".join(heads[1:]), fontsize=7)
        for ax in panels[:, column]:
            ax.axvspan(0.0, end - start, color="#000000", alpha=0.06, lw=0)
            ax.tick_params(labelsize=7)
            ax.margins(x=0)
    for ax, axis in zip(panels[:, 0], ("North", "East", "Down"), strict=True):
        ax.set_ylabel(f"{axis}, m", fontsize=8)
    figure.supxlabel("Seconds since the loss of GNSS", fontsize=8)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=7, frameon=False)
    return figure
