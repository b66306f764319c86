"""Where a result came from: scenario, seeds, versions, and the command that makes it again.

Read from ``manifest.json`` and ``scenario.toml``. Times are UTC as the runner wrote them.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from testbed.base.errors import InputError
from testbed.report.results import Result

HIDDEN = {"command", "kind", "identity", "format", "finished", "jobs", "files"}


def rows(result: Result) -> list[tuple[str, str]]:
    """(name, value) pairs of the manifest that have a value."""
    found = [("scenario", result.name), ("runs", str(result.run_count))]
    names = {name for name, _ in found}
    for key, value in result.manifest.items():
        if key in HIDDEN or key in names:
            continue
        text = ", ".join(f"{k} {_plain(v)}" for k, v in value.items()) if isinstance(value, Mapping) else _plain(value)
        found.append((key.replace("_", " "), text))
    return [(name, value) for name, value in found if value]


def command(result: Result) -> str:
    """The command line that regenerates the result: by the name of a shipped scenario, else from what the folder keeps."""
    manifest, settings = result.manifest, result.scenario.get("monte_carlo", {})
    if manifest.get("command"):
        return str(manifest["command"])
    if _is_as_shipped(result):
        words = ["testbed run", shlex.quote(result.name)]
        words += [f"--{key} {shlex.quote(str(manifest[key]))}" for key in ("variant", "profile") if manifest.get(key)]
    else:
        words = ["testbed run", shlex.quote(f"{result.folder.name}/scenario.toml")]
    words += [f"--plugin {shlex.quote(str(name))}" for name in manifest.get("plugins", [])]
    words += [f"--runs {result.run_count}", *([f"--seed {settings['seed']}"] if "seed" in settings else [])]
    return " ".join([*words, f"--out {shlex.quote(result.folder.name)}"])


def _is_as_shipped(result: Result) -> bool:
    """Whether the scenario of that name, variant and profile still computes this result; ``--set`` and the like change it."""
    from testbed.scenario import list_scenarios, load_scenario

    if result.name not in list_scenarios():
        return False
    manifest, settings = result.manifest, result.scenario.get("monte_carlo", {})
    seed = {"monte_carlo.seed": settings["seed"]} if "seed" in settings else {}
    try:
        scenario = load_scenario(result.name, manifest.get("profile"), manifest.get("variant"), seed)
        return bool(scenario.digest() == manifest.get("identity", {}).get("scenario"))
    except (InputError, OSError):
        return False


def _plain(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, (list, tuple)):
        return ", ".join(_plain(v) for v in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)
