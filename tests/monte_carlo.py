"""Shared by the tests of the runner: a scenario of one minute of synthetic flight, and short ways to run it."""

from __future__ import annotations

from pathlib import Path

from testbed.scenario import Scenario

PLUGIN = Path(__file__).parent / "plugins" / "monte_carlo.py"


def scenario(estimators: list[dict], runs: int = 12, seed: int = 1, **more) -> Scenario:
    """The synthetic scenario with these ``[[estimators]]``."""
    data = {
        "scenario": {"name": "synthetic"},
        "flight": {
            "aircraft": "aerosonde",
            "rate_hz": 100.0,
            "initial": {"lat_deg": 45.0, "lon_deg": 5.0, "alt_m": 100.0, "speed_mps": 30.0, "heading_deg": 0.0},
            "manoeuvres": [{"type": "straight", "duration_s": 60.0}],
        },
        "sensors": {"imu": {"model": "ideal"}},
        "estimators": estimators,
        "monte_carlo": {"runs": runs, "seed": seed},
    }
    return Scenario.model_validate(data | more)


GOOD = {"name": "noisy", "label": "good"}
BAD = {"name": "noisy", "label": "bad", "params": {"sigma_m": 2.0, "stream_name": "bad"}}
CLAIM = {"id": "1", "better": "good", "than": "bad", "metric": "rmse_north_m", "paper_improvement_pct": 50.0}


def slow_scenario(runs: int) -> Scenario:
    """Runs of 20 ms, so that there is time to interrupt them."""
    return scenario([GOOD | {"params": {"delay_s": 0.02}}, BAD], runs, claims=[CLAIM])
