"""``testbed explain KEY``: what a key of a scenario means, its unit, range, default, and lines of shipped scenarios."""

from __future__ import annotations

import textwrap

from testbed.base.errors import InputError, nearest
from testbed.base.schema import unwrap
from testbed.cli.listing import print_columns
from testbed.scenario import Scenario
from testbed.scenario.explain import Key, examples, find, keys
from testbed.sensors.config import SensorTable


def explain(path: str | None) -> None:
    """Print what is known of a key; without one, the tables of a scenario."""
    if path is None:
        rows = [(f"[{key.path}]", _plain(key.meaning)) for key in keys(Scenario) if "." not in key.path]
        print_columns(("table", "what it says"), rows)
        print("\ntestbed explain KEY tells more, for example: testbed explain sensors.gnss.outages")
        return
    try:
        found = find(Scenario, path)
    except InputError:
        if not _explain_figure(path):
            raise
        return
    for number, key in enumerate(found):
        print("\n" * bool(number) + _described(key))
    inside = [key for key in keys(Scenario) if key.path.rpartition(".")[0] == found[0].path]
    if inside:
        print()
        inner = list(
            dict.fromkeys((key.name, textwrap.shorten(key.default, 50), _plain(key.meaning)) for key in inside)
        )
        print_columns(("key", "default", "meaning"), inner)
    elif shown := examples(found[0].path):
        print("\nin shipped scenarios:")
        print(
            "\n".join(
                textwrap.shorten(f"{name}: {found[0].name} = {value}", 110, placeholder=" ...") for name, value in shown
            )
        )


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
    from testbed.sensors import catalog

    sensor = path.split(".")[1] if path.startswith("sensors.") else ""
    tables = [
        kind for key in keys(Scenario) if key.path == f"sensors.{sensor}" for kind in unwrap(key.field.annotation)
    ]
    table = next((kind for kind in tables if isinstance(kind, type) and issubclass(kind, SensorTable)), None)
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
