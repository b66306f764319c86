"""Under which conditions a result was made: vehicle, script, air, start, what disturbs the receiver, what is switched off.

Read from the scenario of the result alone; units as its keys say. What a scenario does not say has no row.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from testbed.report.results import Result
from testbed.report.tables import Cell, Column, Table
from testbed.scenario.explain import UNITS

DRAWN = {
    "noise": "noise", "turn_on": "turn-on errors", "alignment": "the start", "outages": "outages",
    "turbulence": "turbulence", "manoeuvres": "the flight",
}  # fmt: skip
"""What ``monte_carlo.vary`` names."""


def table(result: Result) -> Table | None:
    """A row per condition; None for a result without its scenario."""
    if not result.scenario:
        return None
    sensors = result.scenario.get("sensors") or {}
    rows = [
        *_motion(result.scenario),
        ("Start, 1 sigma", _settings(result.scenario.get("initial") or {})),
        *_receiver(sensors.get("gnss") or {}),
        ("Switched off", _switched_off(sensors)),
        ("Drawn anew in each run", _drawn(result.scenario.get("monte_carlo") or {})),
    ]
    shown = [(name, [Cell(text)]) for name, text in rows if text]
    return Table("conditions", "Conditions", [Column("Value", numeric=False)], shown, corner="Condition")


def _motion(scenario: Mapping[str, Any]) -> list[tuple[str, str]]:
    if recording := scenario.get("recording"):
        where = recording.get("dir") or ""
        return [("Recording", ", ".join(filter(None, (str(recording.get("format", "")), str(where)))))]
    flight = scenario.get("flight") or {}
    vehicle = flight.get("aircraft") or flight.get("vehicle") or flight.get("trajectory") or "car"
    steps = [str(m.get("name") or m.get("type", "")).replace("_", " ") for m in flight.get("manoeuvres", [])]
    laps = f", {flight['laps']} laps" if flight.get("laps", 1) > 1 else ""
    return [
        ("Vehicle", str(vehicle)),
        ("Script", ", ".join(steps) + laps),
        ("Wind", _settings(flight.get("wind") or {})),
    ]


def _receiver(gnss: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What keeps fixes away, and makes them wrong."""
    spans = ", ".join(f"{a:g} to {b:g} s" for a, b in gnss.get("outages", []))
    random = gnss.get("random_outages")
    drawn = f"{random.get('count', '')} drawn of {random.get('duration_s', '?')} s" if random else ""
    return [
        ("GNSS outages", ", ".join(filter(None, (spans, drawn))) or ("none" if gnss else "no receiver")),
        ("GNSS outliers", _settings(outliers) if (outliers := gnss.get("outliers") or {}).get("count") else ""),
    ]


def _switched_off(sensors: Mapping[str, Any]) -> str:
    off = {kind: settings.get("disable") for kind, settings in sensors.items() if isinstance(settings, Mapping)}
    return "; ".join(f"{kind}: {', '.join(names)}".replace("_", " ") for kind, names in off.items() if names)


def _drawn(settings: Mapping[str, Any]) -> str:
    return ", ".join(DRAWN.get(str(name), str(name)) for name in settings.get("vary", []))


def _settings(values: Mapping[str, Any]) -> str:
    """``{"position_m": 3.0}`` as ``position 3 m``; zeros and what is left out are not told."""
    told = []
    for key, value in values.items():
        if value in (None, "", False, 0.0, "none", []) or isinstance(value, dict):
            continue
        name, _, end = key.rpartition("_")
        words, unit = (name, f" {UNITS[end]}") if name and end in UNITS else (key, "")
        told.append(f"{words.replace('_', ' ')} {_figures(value)}{unit}".strip())
    return ", ".join(told)


def _figures(value: Any) -> str:
    if value is True:
        return ""
    if isinstance(value, list):
        return ", ".join(map(_figures, value))
    return f"{value:g}" if isinstance(value, int | float) else str(value)
