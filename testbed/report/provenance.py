"""Where a result came from: scenario, seeds, versions, and the command that makes it again.

Read from ``manifest.json`` and ``scenario.toml``. Times are UTC as the runner wrote them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from testbed.report.results import Result

HIDDEN = {"command", "argv", "timings"}


def rows(result: Result) -> list[tuple[str, str]]:
    """(name, value) pairs, nested entries joined by a dot."""
    monte_carlo = result.scenario.get("monte_carlo", {})
    found = [("scenario", result.name), ("runs", str(result.run_count))]
    found += [(key, str(monte_carlo[key])) for key in ("seed",) if key in monte_carlo]
    names = {name for name, _ in found}
    for key, value in result.manifest.items():
        if key in HIDDEN or key in names:
            continue
        if isinstance(value, Mapping):
            found.append((key.replace("_", " "), ", ".join(f"{k} {_plain(v)}" for k, v in value.items())))
        else:
            found.append((key.replace("_", " "), _plain(value)))
    return [(name, value) for name, value in found if value]


def command(result: Result) -> str:
    """The command line that regenerates the result."""
    given = result.manifest.get("command") or result.manifest.get("argv")
    if isinstance(given, (list, tuple)):
        return " ".join(str(part) for part in given)
    if given:
        return str(given)
    monte_carlo = result.scenario.get("monte_carlo", {})
    seed = f" --seed {monte_carlo['seed']}" if "seed" in monte_carlo else ""
    return f"testbed run scenario.toml --runs {result.run_count}{seed} --out DIR"


def _plain(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, (list, tuple)):
        return ", ".join(_plain(v) for v in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)
