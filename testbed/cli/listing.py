"""What ``testbed list`` shows."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Mapping, Sequence

from testbed.base.errors import InputError, nearest
from testbed.cli.completion import LISTS


def show(what: str, name: str | None = None) -> None:
    """``testbed list``; ``name``: one of the estimators, with its parameters."""
    if name is not None:
        if what != "estimators":
            raise InputError(f"testbed list {what} {name}: only 'list estimators' takes a name")
        show_estimator(name)
    elif what == "scenarios":
        from testbed.base.schema import read_toml
        from testbed.scenario import list_scenarios

        for name, path in list_scenarios().items():
            print(f"{name:20s} {read_toml(path).get('scenario', {}).get('title', '')}")
    elif what == "estimators":
        import inspect

        from testbed.data.registry import estimator_class, list_estimators

        for name in list_estimators():
            first = (inspect.getdoc(estimator_class(name)) or "").split("\n")[0]
            print(f"{name:14s} {first}")
    elif what == "aircraft":
        from testbed.flight import list_aircraft

        print("\n".join(list_aircraft()))
    elif what == "sensors":
        from testbed.sensors import list_sensors

        for kind, entries in list_sensors().items():
            for name, source in entries.items():
                print(f"{kind:5s} {name:14s} {source}")
    elif what == "manoeuvres":
        from testbed.flight.manoeuvre_config import manoeuvre_keys

        for name, (about, keys) in manoeuvre_keys().items():
            print(f"{name:13s} {about}\n{'':13s} {keys}")
    elif what == "metrics":
        from testbed.scoring.quantities import NEES, NIS, QUANTITIES, STATISTICS, TIME_METRIC

        print(f"STATISTIC_QUANTITY, for example rmse_north_m\nstatistics: {', '.join(STATISTICS)}")
        print(f"quantities: {', '.join(QUANTITIES)}\nagainst the fixes: rmse_gnss_north_m, mean_gnss_north_m, ...")
        print(f"consistency: {', '.join(NEES)}, {NIS}\ntime: {TIME_METRIC}")
    else:
        raise InputError(f"cannot list '{what}'; {nearest(what, LISTS)}")


def show_estimator(name: str) -> None:
    """``testbed list estimators NAME``: what it is, its parameters, and the parts that it can be composed of."""
    import inspect

    from testbed.data.registry import describe_parameters, estimator_class

    kind = estimator_class(name)
    print(f"{name}: {(inspect.getdoc(kind) or '').split(chr(10))[0]}\n")
    print_columns(("parameter", "default", "range", "meaning"), describe_parameters(name))
    parts: Mapping[str, list[tuple[str, str]]] = getattr(kind, "describe", dict)()
    for title, rows in parts.items():
        print()
        print_columns((title, ""), rows)


def print_columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Text in columns of their own width, the last one wrapped to the screen."""
    width = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head) - 1)]
    indent = sum(width) + 2 * len(width)
    room = max(30, shutil.get_terminal_size((120, 24)).columns - indent)
    for *cells, text in (head, *rows):
        lines = textwrap.wrap(text, room) or [""]
        start = "".join(f"{cell:{w}s}  " for cell, w in zip(cells, width, strict=True))
        print("\n".join([(start + lines[0]).rstrip(), *(" " * indent + line for line in lines[1:])]))
