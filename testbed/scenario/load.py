"""Find a scenario's file, lay profile, variant, reading and single settings over it, and check the whole."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from testbed.base import resources
from testbed.base.errors import OWN, InputError, nearest, shown
from testbed.base.schema import OWN_TRACK, is_file, read_toml, validate
from testbed.flight.own import TrajectoryConfig
from testbed.scenario.model import EXTERNAL, Scenario
from testbed.scenario.settings import changed_rows, merge, set_key
from testbed.scoring.claims import ReadingConfig

OWN_FILE = f"flight.{OWN_TRACK}"
PLAN = "flight.plan"


def list_scenarios() -> dict[str, Path]:
    """Names and files of the shipped scenarios."""
    return {path.stem: path for path in sorted(resources.scenario_root().glob("*.toml"))}


def overlays_of(name_or_path: str | Path) -> tuple[list[str], list[str]]:
    """Names of the profiles and of the variants that a scenario file has."""
    path = find_scenario(name_or_path)
    overlays = _take_overlays(read_toml(path), path)
    return list(overlays["profiles"]), list(overlays["variants"])


def find_scenario(name_or_path: str | Path) -> Path:
    """The file behind a path or the name of a shipped scenario. Raises InputError with the nearest name."""
    path = Path(name_or_path)
    if path.suffix == ".toml" or is_file(path):
        if not is_file(path):
            raise InputError(f"{path}: no such scenario file")
        return path
    shipped = list_scenarios()
    if str(name_or_path) not in shipped:
        if is_file(own := Path(f"{name_or_path}.toml")):
            raise InputError(f"no shipped scenario is called '{name_or_path}'; did you mean the file {own}?")
        raise InputError(f"unknown scenario '{name_or_path}'; {nearest(str(name_or_path), shipped)}")
    return shipped[str(name_or_path)]


def load_scenario(
    name_or_path: str | Path,
    profile: str | None = None,
    variant: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    reading: str | None = None,
) -> Scenario:
    """Read and check a scenario.

    ``profile``, ``variant`` and ``reading`` name overlays of the file; ``overrides`` maps dotted keys (list positions are
    numbers) to values and stands above all. Raises InputError that names the file and the key.
    """
    path = find_scenario(name_or_path)
    data = read_toml(path)
    overlays = _take_overlays(data, path)
    for kind, chosen in (("variants", variant), ("profiles", profile)):
        if chosen is None:
            continue
        if chosen not in overlays[kind]:
            raise InputError(f"{path}: no [{kind}.{chosen}]; {nearest(chosen, overlays[kind])}")
        data = _overlay(data, overlays[kind][chosen], f"{path}: '{kind}.{chosen}'")
    if reading is not None:
        data = _overlay(data, _reading_overlay(data, reading, path), f"{path}: reading '{reading}'")
    if OWN_FILE in (overrides or {}) and OWN_TRACK not in data.get("flight", {}):
        data["flight"] = {}  # a file in place of what the scenario flies
    if PLAN in (overrides or {}) and isinstance(data.get("flight"), dict):
        for key in ("manoeuvres", "initial"):  # a plan in place of what the scenario flies
            data["flight"].pop(key, None)
    for key, value in (overrides or {}).items():
        set_key(data, key, value, str(path))
    _inline_parameter_files(data, path)
    _find_answers(data, path)
    if "recording" in data and "flight" not in data and "sensors" not in data:
        data = merge({"monte_carlo": {"runs": 1}}, data)  # every run of a recording is the same
    scenario = validate(Scenario, data, str(path), path.resolve().parent)
    scenario._source, scenario._variant, scenario._profile = str(path.resolve()), variant, profile
    scenario._settings, scenario._reading = dict(overrides or {}), reading
    _check_estimators(scenario)
    _check_dispersion(scenario)
    return scenario


def _take_overlays(data: dict[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    """Profiles and variants, taken out of the file's tables. Raises InputError for anything but tables of tables."""
    overlays = {kind: data.pop(kind, {}) for kind in ("profiles", "variants")}
    for kind, tables in overlays.items():
        if not isinstance(tables, dict):
            raise InputError(f"{path}: '{kind}' holds tables [{kind}.NAME], got {shown(tables)}")
        for name, table in tables.items():
            if not isinstance(table, dict):
                raise InputError(f"{path}: '{kind}.{name}' should be a table of settings, got {shown(table)}")
    return overlays


def _check_dispersion(scenario: Scenario) -> None:
    """Raise InputError for a dispersed key that no flight has, or a distribution whose own marks no flight allows."""
    if scenario.flight is None or isinstance(scenario.flight, TrajectoryConfig):
        return  # a file's trajectory is the same in every run
    flight = scenario.flight.model_dump(mode="json", exclude_none=True)
    for key, distribution in scenario.monte_carlo.disperse.items():
        if "*" in key:
            continue  # each manoeuvre that has the key is checked when its value is drawn
        for mark in distribution.marks:
            data = copy.deepcopy(flight)
            where = f"{scenario.source_path}: 'monte_carlo.disperse', '{key}' = {mark:g}"
            set_key(data, key, mark, where)
            validate(type(scenario.flight), data, where)


def _reading_overlay(data: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    """The overlay of a reading. Raises InputError with the nearest name."""
    entries = {str(e["name"]): e for e in data.get("readings", []) if isinstance(e, dict) and "name" in e}
    if name not in entries:
        raise InputError(f"{path}: no [[readings]] named '{name}'; {nearest(name, entries)}")
    return validate(ReadingConfig, entries[name], f"{path}: reading '{name}'").overlay


def _overlay(data: dict[str, Any], overlay: Mapping[str, Any], where: str) -> dict[str, Any]:
    """`merge`, and a table over the estimators changes their rows by label.

    A file's trajectory takes the place of the flight, ``[recording]`` that of the flight and its sensors.
    """
    rows, changes = data.get("estimators"), overlay.get("estimators")
    if isinstance(rows, list) and isinstance(changes, Mapping):
        overlay = {**overlay, "estimators": changed_rows(rows, changes, where)}
    if "recording" in overlay and "flight" in data:
        data = {key: value for key, value in data.items() if key not in ("flight", "sensors")}
    flight = overlay.get("flight")
    if isinstance(flight, Mapping) and OWN_TRACK in flight and OWN_TRACK not in data.get("flight", {}):
        data = data | {"flight": {}}
    return merge(data, overlay)


def _inline_parameter_files(data: dict[str, Any], path: Path) -> None:
    """Replace each ``params_file`` by what it says, so that a resolved scenario depends on no other file."""
    entries = data.get("estimators")
    for k, entry in enumerate(entries if isinstance(entries, list) else []):
        if not isinstance(entry, dict) or not isinstance(entry.get("params_file"), str):
            continue
        if not isinstance(entry.get("params", {}), dict):
            continue  # told when the scenario is checked
        file = path.parent / entry.pop("params_file")
        where = f"{path}: 'estimators.{k}.params_file'"
        try:
            read = read_toml(file).get("params")
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        if not isinstance(read, dict):
            raise InputError(f"{where}: {file}: a parameter file needs a table [params]")
        entry["params"] = merge(read, entry.get("params", {}))


def _find_answers(data: Mapping[str, Any], path: Path) -> None:
    """The folder of the answers of an external filter starts, like every path of a scenario, at the scenario's own folder."""
    entries = data.get("estimators")
    for entry in entries if isinstance(entries, list) else []:
        params = entry.get("params") if isinstance(entry, dict) and entry.get("name") == EXTERNAL else None
        if isinstance(params, dict) and isinstance(params.get("dir"), str):
            entry["params"] = params | {"dir": str((path.parent / params["dir"]).resolve())}


def _check_estimators(scenario: Scenario) -> None:
    from testbed.data.registry import list_estimators

    known = list_estimators()
    for k, entry in enumerate(scenario.estimators):
        if entry.name not in known:
            hint = nearest(entry.name, known)
            raise InputError(
                f"{scenario.source_path}: 'estimators.{k}.name': unknown estimator '{entry.name}'; {hint}; {OWN}"
            )
