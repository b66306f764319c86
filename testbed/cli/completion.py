"""What the shell offers after TAB: names of scenarios, their profiles and variants, estimators, kinds and formats.

Each function takes what was typed so far; none imports more than it needs, since a shell waits for it.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import typer

from testbed.base import resources

LISTS = ("scenarios", "aircraft", "manoeuvres", "sensors", "estimators", "metrics")
"""What ``testbed list`` lists."""


def scenarios(incomplete: str) -> list[str]:
    """Shipped scenarios; where none begins like this, the shell falls back to file names."""
    return sorted(path.stem for path in resources.scenario_root().glob("*.toml") if path.stem.startswith(incomplete))


def profiles(ctx: typer.Context, incomplete: str) -> list[str]:
    """``[profiles.*]`` of the scenario that stands in the line."""
    return [name for name in _tables(ctx, "profiles") if name.startswith(incomplete)]


def variants(ctx: typer.Context, incomplete: str) -> list[str]:
    """``[variants.*]`` of the scenario that stands in the line."""
    return [name for name in _tables(ctx, "variants") if name.startswith(incomplete)]


def estimators(ctx: typer.Context, incomplete: str) -> list[str]:
    """The last of the comma-separated names: rows of the scenario, then every estimator."""
    from testbed.data.registry import list_estimators

    *chosen, last = incomplete.split(",")
    entries = _tables(ctx, "estimators")
    rows = [str(entry.get("label") or entry.get("name")) for entry in entries if isinstance(entry, dict)]
    names = dict.fromkeys([*rows, *list_estimators()])
    return [",".join([*chosen, name]) for name in names if name.startswith(last) and name not in chosen]


def listable(incomplete: str) -> list[str]:
    """What ``testbed list`` lists."""
    return [name for name in LISTS if name.startswith(incomplete)]


def formats(incomplete: str) -> list[str]:
    """What ``testbed import`` reads."""
    from testbed.formats.config import PARTS

    return [name for name in PARTS if name.startswith(incomplete)]


def starting_files(incomplete: str) -> list[str]:
    """What ``testbed new`` writes."""
    from testbed.cli.templates import STARTED

    return [name for name in STARTED if name.startswith(incomplete)]


def _tables(ctx: typer.Context, key: str) -> Any:
    """A top-level table of the scenario in the line; empty where there is none to read."""
    name = ctx.params.get("scenario") or next((word for word in ctx.args if not word.startswith("-")), "")
    shipped = resources.scenario_root() / f"{name}.toml"
    try:
        return tomllib.loads((shipped if shipped.is_file() else Path(name)).read_text(encoding="utf-8")).get(key, {})
    except (OSError, ValueError, RecursionError):  # a name or a file that is none
        return {}


def keys(incomplete: str) -> list[str]:
    """Keys of a scenario, a table at a time."""
    from testbed.scenario import Scenario, explain

    found = dict.fromkeys(key.path for key in explain.keys(Scenario))
    return [path for path in found if path.startswith(incomplete) and "." not in path[len(incomplete) :]]
