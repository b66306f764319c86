"""``testbed explain KEY``: what a key of a scenario means, its unit, range, default, and lines of shipped scenarios."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from testbed.base.errors import InputError, nearest
from testbed.base.schema import unwrap
from testbed.cli.listing import print_columns
from testbed.scenario import Scenario
from testbed.scenario.explain import Key, examples, find, keys
from testbed.sensors import catalog
from testbed.sensors.config import SensorTable


def scenario_keys() -> list[Key]:
    """Every key of a scenario, those of the tables that go with it (``extra.dataset``, ``extra.tune``) included."""
    from testbed.training.dataset import DatasetConfig
    from testbed.tuning.config import TuneConfig

    inside = [*keys(DatasetConfig, "extra.dataset"), *keys(TuneConfig, "extra.tune")]
    return [*keys(Scenario), *inside]


def explain(path: str | None) -> None:
    """Print what is known of a key; without one, the tables of a scenario."""
    if path is None:
        rows = [(f"[{key.path}]", _plain(key.meaning)) for key in keys(Scenario) if "." not in key.path]
        print_columns(("table", "what it says"), rows)
        print("\ntestbed explain KEY tells more, for example: testbed explain sensors.gnss.outages")
        return
    try:
        if _explain_extra(path.strip("[]. ")):
            return
        every = scenario_keys()
        # an end of a path, such as bank_deg, is one of the scenario's own tables
        found = find(every if "extra." in path else [key for key in every if not key.path.startswith("extra.")], path)
    except InputError:
        if not _explain_figure(path):
            raise
        return
    for number, key in enumerate(found):
        print("\n" * bool(number) + _described(key))
    inside = [key for key in scenario_keys() if key.path.rpartition(".")[0] == found[0].path]
    if inside:
        _print_inside(inside)
        if (kind := _sensor_of(found[0].path)) is not None:
            told = ", ".join(key for key in catalog.keys(kind.kind) if key not in kind.model_fields)
            print("\n" + textwrap.fill(f"figures that take the place of the catalogue entry's: {told}", 100))
    elif shown := examples(found[0].path):
        print("\nin shipped scenarios:")
        print(
            "\n".join(
                textwrap.shorten(f"{name}: {found[0].name} = {value}", 110, placeholder=" ...") for name, value in shown
            )
        )


def _print_inside(inside: Sequence[Key]) -> None:
    """A row for each key of a table."""
    print()
    inner = list(dict.fromkeys((key.name, textwrap.shorten(key.default, 50), _plain(key.meaning)) for key in inside))
    print_columns(("key", "default", "meaning"), inner)


def _explain_extra(path: str) -> bool:
    """The keys of a table below ``extra``, which no key of its own stands for; False where the path is another."""
    inside = [key for key in scenario_keys() if key.path.rpartition(".")[0] == path]
    if not path.startswith("extra.") or not inside:
        return False
    print(f"{path}\n{textwrap.fill(_plain((inside[0].table.__doc__ or '').strip()), 100)}")
    _print_inside(inside)
    return True


def _sensor_of(path: str) -> type[SensorTable] | None:
    """The table of the sensor ``sensors.NAME``; None for another path."""
    tables = [kind for key in keys(Scenario) if key.path == path for kind in unwrap(key.field.annotation)]
    return next((kind for kind in tables if isinstance(kind, type) and issubclass(kind, SensorTable)), None)


def _described(key: Key) -> str:
    unit = f", {key.unit}" if key.unit else ""
    owner = "" if key.table is Scenario else f" ({_plain((key.table.__doc__ or '').splitlines()[0]).rstrip('.:')})"
    parts = [_plain(key.meaning), f"takes: {key.takes}{unit}", f"default: {key.default}"]
    return "\n".join(
        [f"{key.path}{owner}", *(textwrap.fill(p, 100, initial_indent="  ", subsequent_indent="  ") for p in parts)]
    )


def _plain(text: str) -> str:
    """Without the marks of code that documentation has."""
    return text.replace("``", "")


def _explain_figure(path: str) -> bool:
    """A figure of a sensor, which replaces the catalogue entry's; False where the path is of no sensor."""
    sensor = path.split(".")[1] if path.startswith("sensors.") else ""
    table = _sensor_of(f"sensors.{sensor}")
    if table is None:
        return False
    figure = path.removeprefix(f"sensors.{sensor}.")
    valid = catalog.keys(table.kind)
    if figure not in valid:
        raise InputError(f"'{path}' is not a key of a scenario; {nearest(figure, [*table.model_fields, *valid])}")
    field, factor = valid[figure]
    print(f"{path}\n  A figure of the {table.kind}'s specification ({field}), in place of the catalogue entry's.")
    print(f"  takes: a number or one per axis; times {factor:g} it is in SI units")
    return True
