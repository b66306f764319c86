"""The sky of run 0: where the satellites stood, which of them the receiver used, how well they fitted its own fixes.

Table and paper figures; the page's plots are in `testbed.report.sky_charts`. Source: ``details/satellites.parquet``
(`testbed.gnss.overview`). Degrees, dB-Hz, metres, seconds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from testbed.base.figure_style import COLOURS, new_figure
from testbed.report.labels import number, percent
from testbed.report.panels import Phases, Spans, legend, panels, shade
from testbed.report.results import Result
from testbed.report.tables import Cell, Column, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SKY_CAPTION = "Sky of run 0: azimuth around, elevation inwards; a name stands where a satellite was last received."
TIME_CAPTION = "Satellites of run 0: how many, dilution of precision, C/N0 of each, residuals of the receiver's fixes."
RESIDUALS_CAPTION = "Residuals of the receiver's fixes of run 0: median, quartiles, 5 and 95 % of each satellite."
USED, EXCLUDED = 1, 2
SYSTEMS = {"G": "GPS", "E": "Galileo"}
GAP = 1.5
"""Steps of time beyond which a satellite was lost meanwhile."""
WRONG = COLOURS[1][0]


def system_of(satellite: str) -> str:
    """Name of a satellite's system by its letter."""
    return SYSTEMS.get(satellite[:1], satellite[:1])


def epochs(frame: pd.DataFrame) -> pd.DataFrame:
    """A row per epoch: ``time_s``, satellites ``tracked`` and ``used``, ``hdop`` and ``vdop``."""
    groups = frame.groupby("time_s")
    used = (frame["used"] == USED).groupby(frame["time_s"]).sum()
    columns = {"tracked": groups.size(), "used": used, "hdop": groups["hdop"].first(), "vdop": groups["vdop"].first()}
    return pd.DataFrame(columns).reset_index()


def with_gaps(frame: pd.DataFrame, step: float) -> pd.DataFrame:
    """One satellite's rows with an empty one wherever it was lost, so that lines stop there; ``step`` of the times, s."""
    lost = np.flatnonzero(np.diff(frame["time_s"]) > GAP * step)
    if not len(lost):
        return frame
    empty = pd.DataFrame({"time_s": frame["time_s"].to_numpy()[lost] + 0.5 * step}).reindex(columns=frame.columns)
    empty["satellite"] = frame["satellite"].iloc[0]
    return pd.concat([frame, empty], ignore_index=True).sort_values("time_s")


def step_of(frame: pd.DataFrame) -> float:
    """Usual time from epoch to epoch, s."""
    times = np.unique(frame["time_s"])
    return float(np.median(np.diff(times))) if len(times) > 1 else 1.0


def table(result: Result) -> Table | None:
    """A row per satellite; None where the receiver was not simulated down to them."""
    frame = result.satellites
    if not len(frame):
        return None
    count = frame["time_s"].nunique()
    rows = []
    for name, own in frame.groupby("satellite"):
        fitted, excluded = own.loc[own["used"] == USED, "residual_m"], int((own["used"] == EXCLUDED).sum())
        values = (
            100.0 * len(own) / count,
            own["elevation_deg"].median(),
            own["cn0_dbhz"].median(),
            float(np.sqrt(np.mean(fitted**2))) if len(fitted) else np.nan,
        )
        texts = (percent(values[0]), *(number(v) for v in values[1:]))
        cells = [Cell(text, value) for text, value in zip(texts, values, strict=True)]
        rows.append((str(name), [*cells, Cell(str(excluded), float(excluded))]))
    columns = [
        Column("received", "%", title="Share of the epochs"),
        Column("elevation", "°", title="Median elevation"),
        Column("C/N0", "dB-Hz", title="Median carrier-to-noise density"),
        Column("residual", "m", title="Root mean square residual of the receiver's own fixes"),
        Column("excluded", "", title="Epochs in which the receiver's test left it out"),
    ]
    note = f"Run 0, {count} epochs; residuals are those of the receiver's own fixes."
    return Table("satellites", "Satellites", columns, rows, note, corner="Satellite")


def sky(frame: pd.DataFrame) -> Figure:
    """Tracks seen from below the zenith, north up and east to the right."""
    figure, step = new_figure(4.3), step_of(frame)
    ax: Any = figure.add_axes((0.2, 0.07, 0.6, 0.83), projection="polar")
    ax.set_theta_zero_location("N")
    ax.set_theta_direction(-1)
    ax.set(rlim=(0.0, 90.0))
    ax.set_rgrids([30, 60, 90], ["60°", "30°", "0°"], fontsize=6, angle=135, color="#666666")
    ax.set_thetagrids(range(0, 360, 45), ["N", "NE", "E", "SE", "S", "SW", "W", "NW"])
    for name, own in frame.groupby("satellite"):
        line = with_gaps(own, step)
        system = system_of(str(name))
        colour = COLOURS[0][0] if system == "GPS" else COLOURS[2][0]
        ax.plot(np.radians(line["azimuth_deg"]), 90.0 - line["elevation_deg"], color=colour, lw=1.4, label=system)
        last = own.iloc[-1]
        place = np.radians(last["azimuth_deg"]), 90.0 - last["elevation_deg"]
        ax.plot(*place, ".", color=colour, ms=5)
        ax.annotate(str(name), place, xytext=(3, 2), textcoords="offset points", fontsize=6)
    _mark(ax, frame[frame["used"] == EXCLUDED], lambda rows: np.radians(rows["azimuth_deg"]), _from_zenith)
    legend(figure, ax)
    return figure


def _from_zenith(rows: pd.DataFrame) -> Any:
    return 90.0 - rows["elevation_deg"]


def _mark(ax: Axes, rows: pd.DataFrame, x: Any, y: Any) -> None:
    """Crosses where the receiver's test left a satellite out."""
    if len(rows):
        ax.plot(x(rows), y(rows), "x", color=WRONG, ms=4, mew=0.9, label="excluded")


def over_time(frame: pd.DataFrame, outages: Spans = (), phases: Phases = ()) -> Figure:
    """Numbers, dilution, C/N0 satellite by satellite as a raster, residuals; crosses are exclusions."""
    from matplotlib.ticker import MaxNLocator

    names, step = sorted(frame["satellite"].unique()), step_of(frame)
    tall = max(1.3, 0.11 * len(names))
    figure = new_figure(0.8 + 1.0 + 1.0 + tall + 1.2)
    axes = panels(figure, 4, heights=[1.0, 1.0, tall, 1.2])
    figure.subplots_adjust(right=0.90)
    many = epochs(frame)
    axes[0].step(many["time_s"], many["tracked"], where="post", color="#999999", lw=0.8, label="received")
    axes[0].step(many["time_s"], many["used"], where="post", color=COLOURS[0][0], lw=1.0, label="used")
    axes[0].set(ylabel="satellites", ylim=(0, None))
    axes[0].yaxis.set_major_locator(MaxNLocator(integer=True))
    axes[1].plot(many["time_s"], many["hdop"], color=COLOURS[0][0], lw=0.9, label="HDOP")
    axes[1].plot(many["time_s"], many["vdop"], color=COLOURS[2][0], lw=0.9, ls="--", label="VDOP")
    worst = np.nanpercentile(many["vdop"], 98) if many["vdop"].notna().any() else 1.0
    axes[1].set(ylabel="dilution", ylim=(0.0, 1.3 * worst))
    rows = frame["satellite"].map({name: k for k, name in enumerate(names)})
    points = axes[2].scatter(
        frame["time_s"], rows, c=frame["cn0_dbhz"], s=4, marker="s", lw=0, cmap="viridis", rasterized=True
    )
    axes[2].set_yticks(range(len(names)), names, fontsize=6)
    axes[2].set(ylim=(len(names) - 0.5, -0.5))
    axes[2].grid(axis="y", visible=False)
    box = axes[2].get_position()
    scale = figure.add_axes((0.915, box.y0, 0.014, box.height))
    figure.colorbar(points, cax=scale).set_label("C/N0, dB-Hz", fontsize=7)
    scale.tick_params(labelsize=6)
    for k, name in enumerate(names):
        own = with_gaps(frame[frame["satellite"] == name], step)
        axes[3].plot(own["time_s"], own["residual_m"].where(own["used"] != EXCLUDED), lw=0.6, color=COLOURS[k % 8][0])
    wrong = frame[frame["used"] == EXCLUDED]
    fitted = frame.loc[frame["used"] == USED, "residual_m"]
    usual = np.percentile(np.abs(fitted), 99.5) if len(fitted) else 1.0
    limit = 1.6 * float(usual)  # an excluded one that lies farther stands at the edge
    _mark(axes[3], wrong, lambda r: r["time_s"], lambda r: r["residual_m"].clip(-limit, limit))
    axes[3].set(ylabel="residual, m", ylim=(-limit, limit))
    shade(axes, outages, phases)
    legend(figure, *axes)
    return figure


def residuals(frame: pd.DataFrame) -> Figure:
    """A box per satellite, and how often it was excluded."""
    names = sorted(frame["satellite"].unique())
    figure = new_figure(0.75 + 0.15 * len(names))
    height = figure.get_figheight()
    ax = figure.add_axes((0.09, 0.40 / height, 0.89, 1.0 - 0.65 / height))
    values = [
        frame.loc[(frame["satellite"] == name) & (frame["used"] == USED), "residual_m"].to_numpy() for name in names
    ]
    look: dict[str, Any] = {"widths": 0.6, "patch_artist": True, "showfliers": False}
    boxes = ax.boxplot(values, orientation="horizontal", whis=(5, 95), medianprops={"color": "black"}, **look)
    for name, box in zip(names, boxes["boxes"], strict=True):
        box.set(facecolor=COLOURS[0 if system_of(name) == "GPS" else 2][0], alpha=0.55, lw=0.6)
    ax.axvline(0.0, color="black", lw=0.6)
    for k, name in enumerate(names):
        if count := int(((frame["satellite"] == name) & (frame["used"] == EXCLUDED)).sum()):
            words: dict[str, Any] = {
                "transform": ax.get_yaxis_transform(),
                "ha": "right",
                "va": "center",
                "fontsize": 6,
            }
            ax.text(0.995, k + 1, f"excluded in {count}", color=WRONG, **words)
    ax.set_yticks(range(1, len(names) + 1), names, fontsize=6)
    ax.set(xlabel="residual, m")
    ax.invert_yaxis()
    return figure
