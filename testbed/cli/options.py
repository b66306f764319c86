"""Arguments and options that several verbs share, and how a verb reads its scenario and plug-ins from them."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from testbed.base.errors import InputError
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
SEED = "monte_carlo.seed"
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
    from testbed.scenario import check_once, load_scenario, parse_setting

    overrides: dict[str, Any] = {}
    for key, value in map(parse_setting, settings or []):
        if (lost := _hidden(overrides, key)) is not None:
            raise InputError(f"--set {lost} has no effect, as a later --set {key} takes its place; give one of them")
        overrides[key] = value
    for key, value in overrides.items():
        folder = key == "flight.aircraft" and "/" in str(value)
        if isinstance(value, str) and (folder or _PATH_KEY.fullmatch(key)):
            overrides[key] = str(Path(value).resolve())
    if seed is not None:
        check_once(overrides, SEED, "--seed")
        overrides[SEED] = seed

    def load(further: Mapping[str, Any], reading: str | None = None) -> Scenario:
        for key in further:
            if (lost := _hidden(overrides, key)) is not None:
                option = "--seed" if lost == SEED and seed is not None else f"--set {lost}"
                raise InputError(f"{option} has no effect, as --sweep {key} takes its place; give one of them")
        return load_scenario(scenario, profile, variant, {**overrides, **further}, reading)

    return load


def _hidden(settings: Mapping[str, Any], key: str) -> str | None:
    """The setting of which setting ``key`` as well leaves nothing, if there is one."""
    from testbed.scenario import hides

    return next((own for own in settings if hides(key, own)), None)


def load_plugins(plugins: list[Path] | None) -> list[str]:
    """Load them; the names of their estimators."""
    from testbed.data.registry import load_plugin

    return [name for path in plugins or [] for name in load_plugin(path)]
