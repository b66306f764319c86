"""AHRS-LSTM 2022: every claim of the paper on the network trained end to end, judged over training seeds and noise seeds.

`ahrs_end_to_end` measures errors and trains structures; noise is measured here, on the bench. Effects are
differences of logarithms, so that a ratio and its inverse weigh alike; the verdicts are those of `testbed.scoring.verdicts`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from ahrs_studies import ALLAN_S, SETTLED_S, log_at_rest, rate_of_attitude
from numpy.typing import NDArray

Array = NDArray[np.float64]

BASE, TUNED = "paper's KF", "KF tuned"
AGAINST = {"": ("", "errs by 10 degrees in loiter"), "tuned": (", tuned KF", "constants tuned")}
"""What stands behind / in a claim's name: what a reading's name gets, and its condition *KF*."""
CLUSTERS_S = {"1 s": 1.0, "400 s": 400.0, "1000 s": 1000.0}
"""Where the unit's own curve is angle random walk, where it is lowest (root of 3 N / K = 346 s of the table's figures, and a
bias beside them), and where rate random walk makes it rise."""
SEED = 31
"""Of the noise on the bench: one more for each further run."""
SPREAD_PCT = 2.9
"""Margin of "the structure matters little": the paper's 54 improvements lie between 33.5 and 35.4 %, so its largest mean
square is (1 - 0.335) / (1 - 0.354) = 1.029 times its smallest."""
BEST = {"layers": "2", "neurons": "200", "activation": "sigmoid", "learning_rate": "0.1"}
"""The paper's best structure."""
CONTRADICTION = (
    "text: noise 40 % lower than the KF's; Table 4: 14 % (in-run bias), 28 % (ARW), 24 % (RRW) lower than the KF's, "
    "40 % (bias), 37 % (ARW), 35 % (RRW) lower than the IMU's"
)


@dataclass(frozen=True)
class Measured:
    """The logarithm of a ratio of mean squares (or of Allan deviations): mean, standard error, degrees of freedom."""

    mean: float
    error: float
    dof: int


def judged(network: str, found: Sequence[tuple[Any, Measured]]) -> Iterator[dict[str, Any]]:
    """Rows of a claims table from claims and what was measured of each, corrected after Holm for all of them."""
    from testbed.scoring.verdicts import judge

    effects = [effect_of(measured) for _, measured in found]
    verdicts = judge([claim for claim, _ in found], effects)
    for (claim, _), effect, (verdict, p_value, p_holm) in zip(found, effects, verdicts, strict=True):
        row = {"network": network, "id": claim.id, "text": claim.text, "origin": claim.origin, "kind": claim.kind}
        row |= {"paper_pct": claim.paper_improvement_pct, "margin_pct": claim.margin_pct}
        row |= {"measured_pct": effect.percent, "ci_low": effect.low, "ci_high": effect.high, "verdict": verdict}
        row["runs"] = effect.n
        yield row | {"p_value": p_value, "p_holm": p_holm, "contradiction": claim.contradiction}


def as_verdicts(
    rows: Sequence[Mapping[str, Any]], readings: Mapping[str, tuple[str, Mapping[str, str]]]
) -> list[dict[str, Any]]:
    """Rows of a report's table of verdicts, each with the class of its claim.

    ``readings``: network, as `judged` names it, to the reading's name and its conditions.
    """
    from testbed.scoring.claims import ReadingConfig
    from testbed.scoring.readings import standing

    def read(row: Mapping[str, Any]) -> tuple[str, ReadingConfig]:
        claim, _, against = row["id"].partition("/")
        name, conditions = readings[row["network"]]
        more, kf = AGAINST[against]
        return claim, ReadingConfig(name=name + more, leaves_open="-", conditions={**conditions, "KF": kf})

    configs: dict[str, list[ReadingConfig]] = {}
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        claim, reading = read(row)
        configs.setdefault(claim, []).append(reading)
        found.setdefault(claim, {})[reading.name] = row["verdict"]
    out = []
    for row in rows:
        claim, reading = read(row)
        told = {"claim": claim, "text": row["text"], "origin": row["origin"], "reading": reading.name}
        told |= {"stated_pct": row["paper_pct"], "margin_pct": row["margin_pct"], "effect_pct": row["measured_pct"]}
        told |= {key: row[key] for key in ("ci_low", "ci_high", "runs", "p_value", "p_holm", "verdict")}
        out.append(told | {"class": standing(configs[claim], found[claim], row["contradiction"]).word})
    return out


def effect_of(measured: Measured) -> Any:
    """By how many per cent lower, with the t-interval (95 %) and the p-value of the logarithm; positive where lower."""
    from scipy.stats import t

    from testbed.scoring.effects import Effect

    half = float(t.ppf(0.975, measured.dof)) * measured.error
    low, middle, high = (100.0 * (1.0 - math.exp(measured.mean + x)) for x in (half, 0.0, -half))
    # of the per cents, such that they lie as many sigmas from none as the logarithm does
    error = measured.error * (abs(middle / measured.mean) if measured.mean else 100.0)
    return Effect(middle, low, high, error, measured.dof + 1, middle, low, high)


def claim(identity: str, text: str, **settings: Any) -> Any:
    """An entry as a scenario's ``[[claims]]`` have it; the metric is what the text says."""
    from testbed.scoring.claims import ClaimConfig

    return ClaimConfig(id=identity, text=text, better="", than="", metric="", **settings)


def of_errors(squares: Mapping[str, Array], network: str) -> Iterator[tuple[Any, Measured]]:
    """Claims 1 and 2 of the paper; claim 1 also against a KF whose constants are tuned, as the paper does not say how its own were.

    ``squares``: label to mean squares (training seeds, noise seeds, windows, roll and pitch), as `ahrs_end_to_end` has them.
    """
    ours = squares[network]

    def against(label: str, window: int, axis: int) -> Measured:
        return crossed(np.log(ours[:, :, window, axis] / squares[label][:, :, window, axis]))

    def first(axis: int) -> tuple[str, str, float]:
        name, pct = (("roll", 36.6), ("pitch", 34.2))[axis]
        return (
            f"1-{name}",
            f"on an unseen flight the mean square of the {name} error is {pct} % lower than the KF's",
            pct,
        )

    for axis in range(2):
        identity, text, pct = first(axis)
        yield claim(identity, text, paper_improvement_pct=pct), against(BASE, 0, axis)
    for axis, name in enumerate(("roll", "pitch")):
        text = f"in loiter the network errs much less in {name} than the KF (mean square)"
        yield claim(f"2-loiter-{name}", text), against(BASE, 2, axis)
    for axis, name in enumerate(("roll", "pitch")):
        text = f"in cruise the KF drifts with the gyro bias and the network does not (mean square of {name})"
        yield claim(f"2-cruise-{name}", text), against(BASE, 1, axis)
    for axis in range(2):
        identity, text, pct = first(axis)
        yield claim(f"{identity}/tuned", text, paper_improvement_pct=pct), against(TUNED, 0, axis)


def of_noise(ratios: Array) -> Iterator[tuple[Any, Measured]]:
    """Claims on the Allan deviation of the attitude's rate at rest, network over KF; ``ratios`` as in `noise_ratios`."""
    figures = {"1 s": ("ARW", 28.3), "400 s": ("in-run bias", 14.3), "1000 s": ("RRW", 23.9)}
    for k, (tau, (name, pct)) in enumerate(figures.items()):
        text = f"noise of the attitude's rate, {name}: {pct} % lower than the KF's (Allan deviation at {tau}, at rest)"
        settings = {"paper_improvement_pct": pct, "contradiction": CONTRADICTION}
        yield claim(f"3-{name.split()[0].lower()}", text, **settings), crossed(np.log(ratios[:, :, k]))
    text = "noise of the attitude's rate 40 % lower than the KF's (Allan deviation at 1 s, at rest)"
    yield (
        claim("3-text", text, paper_improvement_pct=40.0, contradiction=CONTRADICTION),
        crossed(np.log(ratios[:, :, 0])),
    )


def noise_ratios(
    labels: Mapping[str, Sequence[Any]], base: Any, runs: int, seconds: float = ALLAN_S
) -> tuple[dict[str, Array], list[dict[str, Any]]]:
    """Allan deviations of the rate that the attitude of each estimator has at rest, over those of ``base``.

    ``labels``: label to its estimators, one per training seed. Returns label to ratios (training seeds, noise seeds,
    `CLUSTERS_S`), and a table of the deviations themselves, °/h.
    """
    shape = {label: np.empty((len(each), runs, len(CLUSTERS_S))) for label, each in labels.items()}
    deviations: dict[str, list[Array]] = {label: [] for label in ("IMU", BASE, *labels)}
    for run in range(runs):
        log = log_at_rest(seconds, SEED + run)
        deviations["IMU"].append(clusters_of(log.imu.gyro[1:], log))
        own = clusters_of(rate_of_attitude(base.run(log).q_nb, log), log)
        deviations[BASE].append(own)
        for label, each in labels.items():
            for seed, estimator in enumerate(each):
                found = clusters_of(rate_of_attitude(estimator.run(log).q_nb, log), log)
                deviations[label].append(found)
                shape[label][seed, run] = found / own
    table = [
        {"output": label}
        | {
            f"deviation_{tau.replace(' ', '_')}_dph": float(x)
            for tau, x in zip(CLUSTERS_S, np.mean(v, axis=0), strict=True)
        }
        for label, v in deviations.items()
    ]
    return shape, table


def clusters_of(rates: Array, log: Any) -> Array:
    """Allan deviations (°/h, mean of the axes' variances) of rates (N,3), rad/s, at `CLUSTERS_S`, once settled."""
    import allantools

    rate_hz = (len(log.imu.t) - 1) / float(log.imu.t[-1] - log.imu.t[0])
    settled = rates[round(SETTLED_S * rate_hz) :]
    taus = list(CLUSTERS_S.values())
    each = [allantools.oadev(axis - axis.mean(), rate=rate_hz, data_type="freq", taus=taus)[1] for axis in settled.T]
    return np.asarray(3600.0 * np.degrees(np.sqrt(np.mean(np.square(each), axis=0))))


def of_structures(rows: Sequence[Mapping[str, str]]) -> Iterator[tuple[Any, Measured]]:
    """Each level of each factor against the paper's best one, from a main-effects model of the logarithm of the mean square.

    The residual of the 54 trainings (one seed each) is the error; what factors do together is part of it.
    """
    y = np.array([2.0 * math.log(float(row["validation_deg"])) for row in rows])
    levels = {key: sorted({row[key] for row in rows} - {best}) for key, best in BEST.items()}
    terms = [(key, level) for key, others in levels.items() for level in others]
    design = np.column_stack([np.ones(len(y)), *([float(row[k] == level) for row in rows] for k, level in terms)])
    fit = np.linalg.lstsq(design, y, rcond=None)[0]
    dof = len(y) - design.shape[1]
    variance = float(((y - design @ fit) ** 2).sum()) / dof
    spread = np.linalg.inv(design.T @ design)
    for k, (key, level) in enumerate(terms, start=1):
        text = f"the structure matters little: {key} {level} errs as {BEST[key]} does (mean square, main effect)"
        settings = {"kind": "equal", "margin_pct": SPREAD_PCT}
        yield (
            claim(f"4-{key}-{level}", text, **settings),
            Measured(float(fit[k]), math.sqrt(variance * spread[k, k]), dof),
        )
    best = np.array([all(row[key] == level for key, level in BEST.items()) for row in rows])
    text = "two layers of 200, sigmoid, rate 0.1 are best: below the mean of all others (mean square)"
    gap = float(y[best].mean() - y[~best].mean())
    yield claim("4-best", text), Measured(gap, math.sqrt(variance * (1.0 / best.sum() + 1.0 / (~best).sum())), dof)


def crossed(values: Array) -> Measured:
    """Mean of ``values`` (S,N) over training seeds and noise seeds, both random and crossed.

    The variance of the mean is (MS_seeds + MS_noise - MS_rest) / (S N), at least the larger of the two parts (Searle,
    Casella, McCulloch 1992, section 4.4); t has the smaller number of degrees of freedom.
    """
    s, n = values.shape
    mean = float(values.mean())
    rows, columns = values.mean(1) - mean, values.mean(0) - mean
    of_noise = s * float((columns**2).sum()) / (n - 1)
    if s == 1:
        return Measured(mean, math.sqrt(of_noise / n), n - 1)
    of_seeds = n * float((rows**2).sum()) / (s - 1)
    rest = float(((values - mean - rows[:, None] - columns[None, :]) ** 2).sum()) / ((s - 1) * (n - 1))
    variance = max(of_seeds, of_noise, of_seeds + of_noise - rest) / (s * n)
    return Measured(mean, math.sqrt(variance), min(s, n) - 1)


def structure_grid() -> list[dict[str, Any]]:
    """The paper's 54 structures."""
    keys = {
        "layers": (1, 2, 3),
        "neurons": (150, 200, 250),
        "activation": ("linear", "sigmoid"),
        "learning_rate": (0.05, 0.1, 0.15),
    }
    return [dict(zip(keys, values, strict=True)) for values in itertools.product(*keys.values())]
