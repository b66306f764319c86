"""Are a filter's innovations what it says they are: zero-mean, normal, white, and as large as sqrt(S)? Table and figure.

Tests: D'Agostino & Pearson (1973), Biometrika 60(3), on skewness and kurtosis; autocorrelation against ±1.96/sqrt(n) as in
Bar-Shalom et al. (2001), section 5.4. Of run 0, fixes outside of outages, divided by sqrt(S): dimensionless.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from testbed.base.figure_style import COLOURS
from testbed.report.labels import number, percent
from testbed.report.results import Result
from testbed.report.tables import Cell, Column, Table
from testbed.scoring.statistics import normality_p

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LAGS = 20
FEWEST = 50
"""Below this number of innovations neither test says anything."""
PREFERRED = ("north, m/s", "east, m")
"""Channels shown where a filter has them; else its first two."""
CAPTION = "Innovations of {}, run 0: ±2√S, histogram with the normal curve, autocorrelation with its bound."
INSIDE_PCT = 95.45
"""Share of a normal distribution within two sigma."""
Spans = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Channel:
    """One channel's tests. ``scaled`` (n,) innovations over sqrt(S) at ``time_s``; ``correlation`` (LAGS,) from lag 1 on."""

    name: str
    time_s: NDArray[np.float64]
    innovation: NDArray[np.float64]
    sigma: NDArray[np.float64]
    correlation: NDArray[np.float64]
    bound: float
    """Two-sided 95 % bound of a white sequence's autocorrelation."""
    normal_p: float
    """Probability of a skewness and kurtosis this far off if the innovations were independent and normal."""

    @property
    def scaled(self) -> NDArray[np.float64]:
        return self.innovation / self.sigma

    @property
    def inside_pct(self) -> float:
        return 100.0 * float(np.mean(np.abs(self.scaled) <= 2.0))

    @property
    def lags_outside(self) -> int:
        """Of `LAGS`; one is expected of a white sequence, four or more come in 1.6 % of them."""
        return int(np.sum(np.abs(self.correlation) > self.bound))


def analyse(frame: pd.DataFrame, names: Sequence[str], outages: Spans = ()) -> list[Channel]:
    """Test the shown channels of one filter's innovations (``time_s``, ``nu_k``, ``s_k``); empty where there are too few."""
    t = frame["time_s"].to_numpy(dtype=float)
    fixed = ~np.any([(t >= a) & (t <= b) for a, b in outages], axis=0) if len(outages) else np.ones(len(t), dtype=bool)
    found = []
    if "rejected" in frame:
        fixed &= ~frame["rejected"].to_numpy(dtype=bool)
    for k in shown(names):
        nu, s = frame[f"nu_{k}"].to_numpy(dtype=float), frame[f"s_{k}"].to_numpy(dtype=float)
        good = fixed & np.isfinite(nu) & (s > 0.0)
        if good.sum() < FEWEST:
            continue
        scaled = nu[good] / s[good]
        found.append(
            Channel(
                names[k],
                t[good],
                nu[good],
                s[good],
                autocorrelation(t[good], scaled),
                1.96 / float(np.sqrt(len(np.unique(t[good])))),
                normality_p(scaled),
            )
        )
    return found


def _channels_of(result: Result, label: str) -> list[Channel]:
    """The tested channels of all aidings of an estimator; those that are not of GNSS carry the aiding's name."""
    found = []
    for aiding, frame in result.innovations[label].items():
        names = result.channels(label, aiding)
        for channel in analyse(frame, names, result.outages if aiding == "gnss" else ()):
            found.append(channel if aiding == "gnss" else replace(channel, name=f"{aiding}: {channel.name}"))
    return found


def rejections(result: Result) -> list[str]:
    """In words, what part of its updates each filter's policy rejected in run 0; empty where none did."""
    told = []
    for label in result.estimators:
        for aiding, frame in result.innovations.get(label, {}).items():
            if "rejected" in frame and (count := int(frame["rejected"].sum())):
                told.append(f"{label} rejected {percent(100.0 * count / len(frame))} % of its updates with {aiding}")
    return told


def shown(names: Sequence[str]) -> list[int]:
    """Positions of the channels that table and figure show."""
    found = [names.index(name) for name in PREFERRED if name in names]
    return found or list(range(min(2, len(names))))


def autocorrelation(t: NDArray[np.float64], values: NDArray[np.float64], lags: int = LAGS) -> NDArray[np.float64]:
    """(lags,) from lag 1 on, of the values less their mean; pairs are formed by time, so that none spans a gap.

    Values of one time, such as those of several satellites, count as one: their sum over the root of their number, which
    has their variance where they are independent.
    """
    out = np.full(lags, np.nan)
    step = np.diff(np.unique(t))
    if not len(step):
        return out
    index, which, count = np.unique(np.rint((t - t.min()) / np.median(step)), return_inverse=True, return_counts=True)
    x = np.bincount(which, values - values.mean()) / np.sqrt(count)
    power = float(np.mean(x**2))
    for lag in range(1, lags + 1):
        later = np.minimum(np.searchsorted(index, index + lag), len(index) - 1)
        pairs = index[later] == index + lag
        if pairs.any() and power > 0.0:
            out[lag - 1] = float(np.mean(x[pairs] * x[later[pairs]])) / power
    return out


def table(result: Result) -> Table | None:
    """A row per filter, those with the same innovations in one; None where no filter has any."""
    rows: list[tuple[list[str], list[Channel]]] = []
    for label in result.estimators:
        if label not in result.innovations:
            continue
        channels = _channels_of(result, label)
        if not channels:
            continue
        twin = next((row for row in rows if _same(row[1], channels)), None)
        if twin is not None:
            twin[0].append(label)
        else:
            rows.append(([label], channels))
    if not rows:
        return None
    groups = list(dict.fromkeys(channel.name for _, channels in rows for channel in channels))
    columns = [column for group in groups for column in _columns(group)]
    lines = []
    for labels, channels in rows:
        known = {channel.name: channel for channel in channels}
        lines.append((", ".join(labels), [cell for group in groups for cell in _cells(known.get(group))]))
    note = (
        f"Run 0, fixes outside of outages. Expected: mean 0, {INSIDE_PCT:.1f} % inside ±2√S, p above 0.05 (D'Agostino-Pearson, "
        f"chosen because its p-values hold at any length from {FEWEST} on and it says by skewness and tails how a histogram is "
        f"not normal), and about 1 of the {LAGS} first lags of the autocorrelation outside ±1.96/√n. p supposes independent "
        "samples: where many lags are outside, it says less than the figure."
    )
    if told := rejections(result):
        note += f" Without rejected updates: {'; '.join(told)}."
    return Table("innovations", "Innovations", columns, lines, note)


def _same(one: list[Channel], other: list[Channel]) -> bool:
    return len(one) == len(other) and all(
        a.name == b.name and np.array_equal(a.scaled, b.scaled) for a, b in zip(one, other, strict=True)
    )


def _columns(group: str) -> list[Column]:
    return [
        Column("mean", "√S", group, "Mean of innovation over √S"),
        Column("inside", "%", group, "Share inside ±2√S"),
        Column("normal, p", "", group, "D'Agostino-Pearson test of normality"),
        Column("lags outside", "", group, f"Of the first {LAGS} lags of the autocorrelation, outside of ±1.96/√n"),
    ]


def _cells(channel: Channel | None) -> list[Cell]:
    if channel is None:
        return [Cell(number(None))] * 4
    mean, p = float(channel.scaled.mean()), channel.normal_p
    return [
        Cell(f"{mean:.2f}".replace("-", "−"), mean),
        Cell(percent(channel.inside_pct), channel.inside_pct),
        Cell("< 0.001" if p < 0.001 else number(p, 2), p),
        Cell(str(channel.lags_outside), float(channel.lags_outside)),
    ]


def chosen(result: Result, winner: str) -> list[str]:
    """Filters worth a figure: the winner, and the method that the claims put forward most often."""
    claims = [str(claim.get("better")) for claim in result.scenario.get("claims", [])]
    proposed = max(reversed(claims), key=claims.count, default=winner)
    return [label for label in dict.fromkeys((proposed, winner)) if label in result.innovations]


def figures(result: Result, winner: str) -> dict[str, tuple[list[Channel], str, int]]:
    """Name -> (channels, label, number of the colour) of the filters worth a `figure`."""
    found = {}
    for label in chosen(result, winner):
        if channels := _channels_of(result, label):
            colour = result.estimators.index(label) if label in result.estimators else 0
            found[f"innovations_{result.info['estimators'][label]}"] = channels, label, colour
    return found


def figure(channels: Sequence[Channel], label: str, colour: int, outages: Spans = ()) -> Figure:
    """A row per channel: innovations in their ±2√S band, histogram over √S with the normal curve, autocorrelation."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height = 0.7 + 1.75 * len(channels)
    drawn = Figure(figsize=(6.3, height))
    FigureCanvasAgg(drawn)
    axes = drawn.subplots(len(channels), 3, squeeze=False, width_ratios=(2.2, 1.0, 1.0))
    drawn.subplots_adjust(0.10, 0.42 / height, 0.99, 1.0 - 0.25 / height, wspace=0.24, hspace=0.2)
    shade = COLOURS[colour % len(COLOURS)][0]
    for row, channel in zip(axes, channels, strict=True):
        _draw_series(row[0], channel, shade, outages)
        _draw_histogram(row[1], channel, shade)
        _draw_correlation(row[2], channel, shade)
    for ax, head in zip(axes[0], (f"{label}: innovation, ±2√S", "over √S", "autocorrelation"), strict=True):
        ax.set_title(head, fontsize=8, loc="left")
    for ax, foot in zip(axes[-1], ("Time, s", "innovation / √S", "lag"), strict=True):
        ax.set_xlabel(foot)
    return drawn


def _draw_series(ax: Axes, channel: Channel, shade: str, outages: Spans) -> None:
    t, usual = channel.time_s, float(np.percentile(np.abs(channel.innovation), 98))
    limit = 1.1 * max(4.0 * float(np.median(channel.sigma)), usual)
    breaks = np.flatnonzero(np.diff(t) > 5.0 * np.median(np.diff(t))) + 1
    for part in np.split(np.arange(len(t)), breaks):
        two = 2.0 * channel.sigma[part]
        ax.fill_between(t[part], -two, two, color="#999999", alpha=0.35, lw=0)
    ax.plot(t, np.clip(channel.innovation, -limit, limit), ".", ms=1.6, color=shade)
    for a, b in outages:
        ax.axvspan(a, b, color="#000000", alpha=0.10, lw=0)
    ax.set(ylabel=channel.name, ylim=(-limit, limit))
    ax.yaxis.set_label_coords(-0.15, 0.5)
    ax.margins(x=0)
    words: dict[str, Any] = {"transform": ax.transAxes, "fontsize": 7, "va": "top"}
    ax.text(0.02, 0.97, f"{channel.inside_pct:.0f} % inside", **words)


def _draw_histogram(ax: Axes, channel: Channel, shade: str) -> None:
    reach = max(4.0, min(30.0, float(np.percentile(np.abs(channel.scaled), 98))))
    edges = np.linspace(-reach, reach, 33)
    ax.hist(np.clip(channel.scaled, -reach, reach), bins=list(edges), density=True, color=shade, alpha=0.55)
    x = np.linspace(-reach, reach, 400)
    ax.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), color="black", lw=0.8)
    p = channel.normal_p
    ax.text(0.03, 0.97, "p < 0.001" if p < 0.001 else f"p = {p:.2g}", transform=ax.transAxes, fontsize=7, va="top")
    ax.set_yticks([])
    ax.margins(x=0)


def _draw_correlation(ax: Axes, channel: Channel, shade: str) -> None:
    lags = np.arange(1, len(channel.correlation) + 1)
    ax.axhspan(-channel.bound, channel.bound, color="#999999", alpha=0.35, lw=0)
    ax.vlines(lags, 0.0, channel.correlation, color=shade, lw=1.2)
    largest = float(np.nanmax(np.abs(channel.correlation), initial=0.0))
    top = 1.05 if largest > 0.3 else 0.35
    ax.axhline(0.0, color="black", lw=0.5)
    ax.set(xlim=(0, len(lags) + 1), ylim=(-top, top))
