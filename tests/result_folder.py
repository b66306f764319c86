"""A made-up result folder in the runner's layout, so that the report can be tested without flying.

Errors are first-order Gauss-Markov with a known size per estimator; a figure-eight-like track near Zurich; outages and phases.
Units as in the column names.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd

from testbed.data import specs
from testbed.data.specs import GnssSpec, ImuSpec, TriadSpec

AXES = "north_m east_m down_m v_north_mps v_east_mps v_down_mps roll_deg pitch_deg yaw_deg".split()
SIZES = np.array([1.2, 1.4, 2.0, 0.06, 0.07, 0.05, 0.20, 0.21, 0.9])
FACTORS = {"kf": 1.0, "direct-ukf": 1.12, "imm-ekf": 1.25, "imm-rstekf": 0.8}
OUTAGES = [[60.0, 80.0], [110.0, 125.0]]
DURATION = 150.0
GYRO = TriadSpec(turn_on_bias=np.radians(3.0), white_noise=np.radians(2.0) / 60.0, range=np.radians(350.0))
ACCEL = TriadSpec(turn_on_bias=0.05 * 9.80665, white_noise=0.2 / 60.0)


def make_result(
    folder: Path,
    factors: dict[str, float] | None = None,
    runs: int = 20,
    seed: int = 1,
    diverged: int = 1,
    name: str = "synthetic",
) -> Path:
    """Write a full result folder and return it. ``factors`` scale each estimator's errors."""
    factors = FACTORS if factors is None else factors
    rng = np.random.default_rng(seed)
    (folder / "details").mkdir(parents=True, exist_ok=True)
    metrics = _metrics(rng, factors, runs)
    metrics.to_parquet(folder / "metrics.parquet")
    _summary(metrics, rng).to_csv(folder / "summary.csv", index=False)
    status = [(r, e, "ok", 0.3 * f) for r in range(runs) for e, f in factors.items()]
    table = pd.DataFrame(status, columns=["run", "estimator", "status", "seconds"])
    table["reason"] = ""
    table.loc[table.index[-1:] if diverged else [], ["status", "reason"]] = [
        "diverged",
        "position error passed 100 km at 81.2 s",
    ]
    table.to_parquet(folder / "runs.parquet")
    times = [(e, 15000, 3.1 * (k + 1), 2.9 * (k + 1)) for k, e in enumerate(factors)]
    pd.DataFrame(times, columns=["estimator", "samples", "median_us", "min_us"]).to_csv(
        folder / "timings.csv", index=False
    )
    _claims(list(factors)).to_csv(folder / "claims.csv", index=False)
    _consistency(factors, runs).to_csv(folder / "consistency.csv", index=False)
    _envelopes(factors).to_parquet(folder / "envelopes.parquet")
    _details(folder / "details", rng, factors)
    manifest = {
        "kind": "testbed result",
        "identity": {"scenario": "0123"},
        "runs": runs,
        "seed": 1,
        "git": "0123abc",
        "variant": None,
    }
    manifest |= {"testbed": "0.1.0", "packages": {"numpy": np.__version__}, "finished": True}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "scenario.toml").write_text(_scenario(name, list(factors)))
    (folder / "findings.md").write_text(
        "## What came out\n\nThe proposed method wins **in position**, not in velocity.\n\n- reason one\n- <b>no</b> markup of others\n"
    )
    return folder


def _metrics(rng: np.random.Generator, factors: dict[str, float], runs: int) -> pd.DataFrame:
    rows = []
    for run in range(runs):
        luck = np.exp(0.15 * rng.standard_normal(9))
        for label, factor in factors.items():
            for window, grow in (
                ("all", 1.0),
                ("outages", 6.0),
                ("outage_1", 7.0),
                ("outage_2", 5.0),
                ("phase_2_turn", 1.2),
            ):
                e = SIZES * luck * factor * grow * np.exp(0.05 * rng.standard_normal(9))
                values = {f"rmse_{a}": v for a, v in zip(AXES, e, strict=True)}
                values |= {
                    "rmse_position_2d_m": np.hypot(*e[:2]),
                    "rmse_position_3d_m": np.linalg.norm(e[:3]),
                    "rmse_velocity_3d_mps": np.linalg.norm(e[3:6]),
                    "rmse_attitude_deg": np.linalg.norm(e[6:]),
                    "max_position_3d_m": 3 * np.linalg.norm(e[:3]),
                    "final_position_3d_m": np.linalg.norm(e[:3]),
                    "nees_position": 3.0 * factor,
                }
                rows += [(run, label, window, m, v) for m, v in values.items()]
    return pd.DataFrame(rows, columns=["run", "estimator", "window", "metric", "value"])


def _summary(metrics: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    rows = []
    for (label, window, metric), g in metrics.groupby(["estimator", "window", "metric"], sort=False):
        v = g["value"].to_numpy()
        half = 1.96 * v.std() / np.sqrt(len(v))
        spread = [v.std(), np.median(v), *np.percentile(v, [5, 95])]
        rows.append((label, window, metric, len(v), v.mean(), *spread, v.mean() - half, v.mean() + half))
    return pd.DataFrame(rows, columns="estimator window metric n mean std median p05 p95 ci_low ci_high".split())


def _claims(labels: list[str]) -> pd.DataFrame:
    first, last = labels[0], labels[-1]
    rows = [
        ("position-vs-kf", f"{last} lowers the position RMSE against {first}", 12.0, 20.1, 18.3, 22.0, "reproduced"),
        (
            "velocity-vs-kf",
            f"{last} lowers the velocity RMSE against {first}",
            34.0,
            19.8,
            17.0,
            22.5,
            "direction reproduced",
        ),
        ("cost", f"{last} is faster than {first}", 50.0, -120.0, -130.0, -111.0, "not reproduced"),
        ("other", "a claim without enough runs", 10.0, np.nan, np.nan, np.nan, "not tested"),
    ]
    return pd.DataFrame(rows, columns="id text paper_pct measured_pct ci_low ci_high verdict".split())


def _consistency(factors: dict[str, float], runs: int) -> pd.DataFrame:
    rows = []
    for label, factor in factors.items():
        for quantity, dof in (
            ("nees_position", 3),
            ("nees_velocity", 3),
            ("nees_attitude", 3),
            ("nees_bias", 6),
            ("nis", 6),
        ):
            half = 1.96 * np.sqrt(2 * dof / runs)
            rows.append((label, quantity, dof, runs, dof * factor, dof - half, dof + half, 0.95 / max(1, factor)))
    return pd.DataFrame(rows, columns="estimator quantity dof n_runs mean lower upper share_inside".split())


def slug(label: str) -> str:
    """A file-name part for a label."""
    return re.sub(r"[^a-z0-9]+", "-", label)


def _growth(t: np.ndarray) -> np.ndarray:
    out = np.ones_like(t)
    for a, b in OUTAGES:
        out += np.where((t > a) & (t < b), 0.03 * (t - a) ** 2, 0.0)
    return out


def _envelopes(factors: dict[str, float]) -> pd.DataFrame:
    t = np.arange(0.0, DURATION, 1.0)
    frames = []
    for label, factor in factors.items():
        for axis, size in zip(AXES, SIZES, strict=True):
            s = size * factor * _growth(t)
            frames.append(
                pd.DataFrame(
                    {
                        "estimator": label,
                        "time_s": t,
                        "quantity": axis,
                        "mean": 0.1 * s,
                        "p05": -1.6 * s,
                        "p95": 1.7 * s,
                        "rms": s,
                        "sigma": 0.9 * s,
                    }
                )
            )
    return pd.concat(frames, ignore_index=True)


def _details(folder: Path, rng: np.random.Generator, factors: dict[str, float]) -> None:
    t = np.arange(0.0, DURATION, 0.05)
    angle = 2 * np.pi * t / DURATION
    lat0, lon0 = 47.0, 8.0
    per_lat, per_lon = 111_150.0, 111_320.0 * np.cos(np.radians(lat0))
    lat, lon = lat0 + 900 * np.sin(2 * angle) / per_lat, lon0 + 2000 * np.sin(angle) / per_lon
    alt = 600 + 80 * np.sin(3 * angle)
    truth = {"time_s": t, "lat_deg": lat, "lon_deg": lon, "alt_m": alt}
    truth |= {a: np.gradient(v, t) for a, v in zip(AXES[3:6], (lat * per_lat, lon * per_lon, -alt), strict=True)}
    truth |= {
        "roll_deg": 30 * np.sin(4 * angle),
        "pitch_deg": 5 * np.cos(3 * angle),
        "yaw_deg": np.degrees(angle) - 180,
    }
    pd.DataFrame(truth).to_parquet(folder / "truth.parquet")
    info = {
        "phases": [["straight", 0, 30], ["turn", 30, 75], ["climb", 75, 110], ["s_turn", 110, 150]],
        "outages": OUTAGES,
    }
    info |= {
        "estimators": {e: slug(e) for e in factors},
        "title": "A synthetic comparison",
        "source": "made for the tests",
    }
    info["sensors"] = {
        "imu": specs.to_dict(ImuSpec("ADIS16405", 100.0, gyro=GYRO, accel=ACCEL)),
        "gnss": specs.to_dict(GnssSpec("receiver", 5.0, horizontal_sigma=2.5, vertical_sigma=4.0, velocity_sigma=0.1)),
    }
    (folder / "info.json").write_text(json.dumps(info))
    for label, factor in factors.items():
        errors = {"time_s": t}
        for axis, size in zip(AXES, SIZES, strict=True):
            noise = np.convolve(rng.standard_normal(len(t) + 200), np.ones(200) / np.sqrt(200), "valid")[: len(t)]
            errors[axis] = size * factor * _growth(t) * noise
            errors[f"sigma_{axis}"] = size * _growth(t)
        errors |= {
            "lat_deg": lat + errors["north_m"] / per_lat,
            "lon_deg": lon + errors["east_m"] / per_lon,
            "alt_m": alt - errors["down_m"],
        }
        pd.DataFrame(errors).to_parquet(folder / f"errors-{slug(label)}.parquet")
        k = np.arange(0.2, DURATION, 0.2)
        inside = np.any([(k > a) & (k < b) for a, b in OUTAGES], axis=0)
        k = k[~inside]
        s = [2.5, 2.5, 4.0, 0.1, 0.1, 0.1]
        innovations = {"time_s": k} | {f"nu_{i}": s[i] * rng.standard_normal(len(k)) for i in range(6)}
        innovations |= {f"s_{i}": np.full(len(k), s[i]) for i in range(6)}
        pd.DataFrame(innovations).to_parquet(folder / f"innovations-{slug(label)}.parquet")
        if label.startswith("imm"):
            p = np.exp(np.stack([np.cos(angle), np.sin(3 * angle), 1 + np.sin(4 * angle)]))
            p /= p.sum(axis=0)
            rows = [
                pd.DataFrame({"name": "mode_probability", "component": c, "time_s": t, "value": p[i]})
                for i, c in enumerate(range(3))
            ]
            pd.concat(rows).to_parquet(folder / f"extras-{slug(label)}.parquet")


def _scenario(name: str, labels: list[str]) -> str:
    entries = "".join(f'[[estimators]]\nname = "{e}"\n' for e in labels)
    columns = ", ".join(f'"{e}"' for e in labels)
    paper = ", ".join(f"{1.4 + 0.3 * k:.3f}" for k in range(len(labels)))
    return f"""[scenario]
name = "{name}"
title = "A synthetic comparison"
source = "made for the tests"
[monte_carlo]
runs = 20
seed = 1
{entries}
[[claims]]
id = "position-vs-kf"
better = "{labels[-1]}"
than = "{labels[0]}"
metric = "rmse_position_3d_m"
window = "all"
paper_improvement_pct = 12.0
[[tables]]
title = "Table 4 of the paper: RMSE over the flight"
window = "all"
columns = [{columns}]
rows = [
  {{ name = "Latitude", metric = "rmse_north_m", unit = "m", paper = [{paper}] }},
  {{ name = "North velocity", metric = "rmse_v_north_mps", unit = "m/s", paper = [{paper}] }},
  {{ name = "Time per sample", metric = "us_per_sample", unit = "µs", paper = [{paper}] }},
]
"""
