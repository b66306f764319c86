"""Arguments and options that several verbs share, and how a verb reads its scenario and plug-ins from them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from testbed.cli import completion

if TYPE_CHECKING:
    from testbed.scenario import Scenario

SCENARIO = typer.Argument(
    metavar="SCENARIO", help="Path of a TOML file, or the name of a shipped one.", autocompletion=completion.scenarios
)
ScenarioArgument = Annotated[str, SCENARIO]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        "--profile", help="Overlay of the scenario, for example smoke or paper.", autocompletion=completion.profiles
    ),
]
VariantOption = Annotated[
    str | None, typer.Option("--variant", help="Variant of the scenario.", autocompletion=completion.variants)
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting, e.g. sensors.imu.rate_hz=200."),
]
PluginOption = Annotated[list[Path] | None, typer.Option("--plugin", help="Python file with your own estimators.")]
SeedOption = Annotated[int | None, typer.Option("--seed", min=0, help="Seed in place of the scenario's.")]
_PATH_KEY = re.compile(r"recording\.dir|flight\.(?:trajectory|plan)|sensors\.\w+\.file|estimators\.\d+\.params_file")
"""Settings that are paths: on the command line they start from the current folder, in a scenario file from its own."""
OutOption = Annotated[
    Path | None,
    typer.Option(
        "--out", help="Folder for the results: new, empty, or of the same verb. What the bench did not write is kept."
    ),
]


def loader(
    scenario: str, profile: str | None, variant: str | None, settings: list[str] | None, seed: int | None = None
) -> Callable[..., Scenario]:
    """How this call reads its scenario: further overrides (of a sweep) stand above the call's own settings; and a reading."""
    from testbed.scenario import load_scenario, parse_setting

    overrides: dict[str, Any] = dict(parse_setting(text) for text in settings or [])
    for key, value in overrides.items():
        folder = key == "flight.aircraft" and "/" in str(value)
        if isinstance(value, str) and (folder or _PATH_KEY.fullmatch(key)):
            overrides[key] = str(Path(value).resolve())
    if seed is not None:
        overrides["monte_carlo.seed"] = seed
    return lambda further, reading=None: load_scenario(scenario, profile, variant, {**overrides, **further}, reading)


def load_plugins(plugins: list[Path] | None) -> list[str]:
    """Load them; the names of their estimators."""
    from testbed.data.registry import load_plugin

    return [name for path in plugins or [] for name in load_plugin(path)]
