"""Reference pages that the code itself writes, at the start of every build, into ``reference/generated/`` (not in git).

Scenario keys come from the models that check them, verbs from the parser, metrics from the registry of quantities, estimators
from their classes, sensors from the catalogue, verdicts from the tables in ``reports/``. No list is kept by hand.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from extensions.comparisons import league, verdicts
from extensions.rst import code, first_paragraph, heading, plain, shortened, table

HERE = Path(__file__).resolve().parents[1]
FOLDER = HERE / "reference" / "generated"
KEYED_FIRST = (
    "scenario",
    "flight",
    "recording",
    "sensors",
    "initial",
    "estimators",
    "monte_carlo",
    "windows",
    "claims",
)


def setup(app: Sphinx) -> dict[str, Any]:
    """Called by Sphinx."""
    app.add_object_type("scenariokey", "key", "pair: %s; scenario key")
    app.connect("builder-inited", lambda _app: write_all())
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}


def write_all(folder: Path = FOLDER) -> None:
    """Every page; one whose text did not change keeps its time, so that Sphinx does not read it again."""
    made = pages()
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.rst"):
        if old.name not in made:
            old.unlink()
    for name, text in made.items():
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """File name -> reStructuredText."""
    made = {f"scenario-{table}.rst": text for table, text in scenario_pages().items()}
    made |= {"scenario.rst": scenario_index(), "cli.rst": verbs(), "metrics.rst": metrics()}
    made |= {"estimators.rst": estimators(), "parts.rst": parts(), "sensors.rst": sensors(), "formats.rst": formats()}
    made |= {"manoeuvres.rst": manoeuvres(), "scenarios.rst": scenarios(), "verdicts.rst": verdicts()}
    made |= {"league.rst": league()}
    return made


# Keys of a scenario


def scenario_pages() -> dict[str, str]:
    """A page for each table of a scenario: every key with what it takes, unit, range, default, meaning, examples."""
    from testbed.cli.explain import scenario_keys

    by_table: dict[str, list[Any]] = {}
    for key in scenario_keys():
        by_table.setdefault(key.path.split(".")[0], []).append(key)
    return {name: _scenario_page(name, found) for name, found in by_table.items()}


def _scenario_page(name: str, found: list[Any]) -> str:
    text = heading(f"[{name}]") + plain(next(k for k in found if k.path == name).meaning) + "\n\n"
    groups: dict[tuple[str, type], list[Any]] = {}
    for key in found:
        groups.setdefault((key.path.rpartition(".")[0] or key.path, key.table), []).append(key)
    documented: set[str] = set()
    for (path, owner), members in groups.items():
        if path == name and len(members) == 1 and members[0].path == name and len(found) > 1:
            continue
        kind = _kind_of(owner)
        if path != name or kind:
            text += heading(f"{path}{f', {kind}' if kind else ''}", "-")
            text += plain(first_paragraph(owner.__doc__)) + "\n\n"
        text += "".join(_key_entry(key, documented) for key in members)
    return text


def _kind_of(owner: type) -> str:
    """``type = "turn"`` of a table that is one of several kinds."""
    from testbed.scenario.explain import toml_value

    field = getattr(owner, "model_fields", {}).get("type")
    return "" if field is None or field.is_required() else f"type = {toml_value(field.default)}"


def _key_entry(key: Any, documented: set[str]) -> str:
    from testbed.scenario.explain import examples

    unit = f", {key.unit}" if key.unit else ""
    again = "   :no-index:\n" if key.path in documented else ""
    documented.add(key.path)
    text = f".. scenariokey:: {key.path}\n{again}\n   {plain(key.meaning)}\n\n"
    text += f"   *takes:* {plain(key.takes)}{unit}; *default:* {shortened(key.default)}\n\n"
    if not again and (shown := [(name, value) for name, value in examples(key.path) if len(value) < 90]):
        where = "; ".join(f"{code(value)} ({name})" for name, value in shown if "`" not in value)
        text += f"   *in shipped scenarios:* {where}\n\n" if where else ""
    return text


def scenario_index() -> str:
    """The overview of the tables, with the pages of all."""
    from testbed.scenario import Scenario
    from testbed.scenario.explain import keys

    top = [key for key in keys(Scenario) if "." not in key.path]
    top.sort(key=lambda k: KEYED_FIRST.index(k.path) if k.path in KEYED_FIRST else len(KEYED_FIRST))
    text = heading("Keys of a scenario")
    text += (
        "Written from the models that check a scenario, so this list is complete. ``testbed explain KEY`` says the same in the "
        "terminal. Units are in the names: a key that ends in ``_deg`` takes degrees. Keys of ``[profiles.NAME]`` and "
        "``[variants.NAME]`` are a scenario's own keys again, laid over it.\n\n"
    )
    text += table(("table", "what it says"), [(f":doc:`scenario-{k.path}`", plain(k.meaning)) for k in top], "20 80")
    names = "\n".join(f"   scenario-{key.path}" for key in top)
    return f"{text}.. toctree::\n   :hidden:\n\n{names}\n"


# The command line


def verbs() -> str:
    """Every verb with its arguments and options, from the parser itself."""
    import typer.main

    from testbed.cli import app

    group: Any = typer.main.get_command(app.app)
    text = heading("Command line")
    text += (
        "Exit codes: 0 done, 1 the work failed, 2 bad usage or bad input. ``testbed VERB --help`` says the same.\n\n"
    )
    text += _options(group.params) + "\n"
    for name, command in group.commands.items():
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        shown = " ".join(_metavar(p) if p.required else f"[{_metavar(p)}]" for p in arguments)
        text += heading(f"testbed {name}", "-") + f".. code-block:: text\n\n   testbed {name} {shown} [OPTIONS]\n\n"
        text += plain(command.help) + "\n\n" + _options(command.params)
    return text


def _metavar(parameter: Any) -> str:
    return str(parameter.metavar or parameter.name.upper()) + ("..." if parameter.nargs == -1 else "").replace(
        "......", "..."
    )


def _options(parameters: Iterable[Any]) -> str:
    rows = []
    for p in parameters:
        if getattr(p, "hidden", False):
            continue
        option = p.param_type_name == "option"
        names = " / ".join([*p.opts, *p.secondary_opts]) if option else _metavar(p)
        value = f" {p.metavar}" if option and p.metavar else ""
        default = p.default if option and p.default not in (None, False, ()) and not callable(p.default) else ""
        rows.append(
            (code(names + value), plain(p.help or "Show this message and exit."), code(default) if default else "")
        )
    return table(("option", "meaning", "default"), rows, "28 60 12") if rows else ""


# Metrics


def metrics() -> str:
    """Every quantity, statistic and consistency figure of the registry."""
    from testbed.scoring import quantities as q

    text = heading("Metrics")
    text += (
        "A metric is ``STATISTIC_QUANTITY``, for example ``rmse_position_3d_m``, over a window of a flight. Errors are estimate "
        "minus truth; attitude errors come from the rotation vector between both.\n\n"
    )
    rows = [
        (code(name), plain(x.label), x.unit, x.group.lower(), ", ".join(code(s) for s in x.states))
        for name, x in q.QUANTITIES.items()
    ]
    text += heading("Quantities", "-") + table(
        ("name", "meaning", "unit", "group", "scored where the filter names"), rows
    )
    rows_of = [
        (code(name), plain(words.format("...")), code(f"{name}_north_m")) for name, (words, _) in q.STATISTICS.items()
    ]
    text += heading("Statistics", "-") + table(("name", "meaning", "example"), rows_of)
    against = [
        (code(f"{s}_gnss_{n}"), plain(q.metric_label(f"{s}_gnss_{n}")), q.unit(f"{s}_gnss_{n}"))
        for s in q.FIX_STATISTICS
        for n in q.AGAINST_FIXES
    ]
    text += (
        heading("Against the fixes", "-")
        + "The solution compared with GNSS fixes in place of the truth, as a paper without truth does.\n\n"
    )
    text += table(("name", "meaning", "unit"), against)
    text += heading("Consistency", "-")
    tests = [
        (code(n), plain(t.label), "states that begin with " + ", ".join(code(p) for p in t.prefixes))
        for n, t in q.NEES.items()
    ]
    tests.append((code(q.NIS), "Normalised innovation squared", "all aidings together; ``nis_AIDING`` of each"))
    text += table(("name", "meaning", "of"), tests)
    text += heading("Others", "-")
    text += table(
        ("name", "meaning"),
        [
            (code(q.TIME_METRIC), "computation time of an estimator per IMU sample, µs"),
            (code(q.DIVERGED), "1 in runs that were lost, else 0; its mean is the share of lost runs"),
        ],
    )
    return text


# Estimators and their parts


def estimators() -> str:
    """Every estimator that ships with its parameters: default, range of a search, meaning."""
    import inspect

    from testbed.data.registry import _entries, describe_parameters, estimator_class

    text = heading("Estimators")
    text += "``testbed list estimators NAME`` says the same. Parameters are the constructor's keywords, ``params`` in a scenario.\n\n"
    for name in sorted(_entries()):
        kind = estimator_class(name)
        text += (
            f".. _estimator-{name}:\n\n" + heading(name, "-") + plain(first_paragraph(inspect.getdoc(kind))) + "\n\n"
        )
        used = (
            kind.sensors if isinstance(getattr(kind, "sensors", None), tuple) else ()
        )  # else it depends on the parameters
        text += f"*Sensors:* {', '.join(code(s) for s in used)}. " if used else ""
        text += f"*Class:* {code(f'{kind.__module__}.{kind.__qualname__}')}\n\n"
        rows = [(code(p), code(d), plain(r), plain(m)) for p, d, r, m in describe_parameters(name)]
        text += (
            table(("parameter", "default", "range of a search", "meaning"), rows, "22 14 18 46")
            if rows
            else "No parameters.\n\n"
        )
    return text


def parts() -> str:
    """Blocks, aidings and policies that ``eskf`` composes."""
    from estimators.aiding import AIDINGS
    from estimators.blocks import BLOCKS
    from estimators.methods.eskf import Eskf
    from estimators.policies import POLICIES

    assert AIDINGS and BLOCKS and POLICIES
    text = heading("Parts of a filter")
    text += "What can stand in ``states``, ``aiding`` and ``policy`` of :ref:`eskf <estimator-eskf>`; the equations: :doc:`/theory/filters`.\n\n"
    for title, rows in Eskf.describe().items():
        text += heading(title, "-") + table(("name", "what it is"), [(code(n), plain(s)) for n, s in rows], "25 75")
    text += heading("States of the blocks", "-")
    shown = [
        (code(n), ", ".join(code(s) for s in b.states) or "one per satellite", b.adds_to)
        for n, b in sorted(BLOCKS.items())
    ]
    text += table(("block", "names of its states", "adds to"), shown, "22 63 15")
    text += heading("Channels of the aidings", "-")
    channels = [
        (code(n), a.sensor, plain(", ".join(a.channels)), ", ".join(a.needs)) for n, a in sorted(AIDINGS.items())
    ]
    return text + table(("aiding", "sensor", "channels", "needs the block"), channels)


# Sensors, formats, manoeuvres, scenarios


def sensors() -> str:
    """The catalogue with its sources and figures, and the keys of a data sheet."""
    from testbed.sensors import catalog, list_sensors

    text = heading("Sensors")
    text += "The shipped catalogue, and the keys that an entry of one's own may have. A key that is absent means no such error.\n\n"
    for kind, entries in list_sensors().items():
        text += heading(kind, "-")
        rows = []
        for name, source in entries.items():
            figures = [f"{k} = {_toml(v)}" for k, v in catalog.entry(kind, name).items() if k not in catalog.REMARKS]
            rows.append((code(name), plain(source), "\n".join(f"| {code(f)}" for f in figures)))
        text += table(("model", "source", "figures"), rows, "18 37 45")
        keys = [(code(k), code(field), f"{factor:.6g}") for k, (field, factor) in catalog.keys(kind).items()]
        text += "Keys of a data sheet:\n\n" + table(("key", "field of the specification", "times it is in SI"), keys)
    return text


def _toml(value: Any) -> str:
    from testbed.scenario.explain import toml_value

    return toml_value(value)


def formats() -> str:
    """What can be imported, with the files of each format."""
    import importlib
    import inspect

    from testbed.formats.config import PARTS

    text = (
        heading("Formats of recordings") + "``testbed import FORMAT`` and ``[recording] format = ...`` read these.\n\n"
    )
    rows = []
    for name, files in PARTS.items():
        module = {"mcap": "rosbag"}.get(name, name)
        about = first_paragraph(inspect.getdoc(importlib.import_module(f"testbed.formats.{module}")))
        rows.append((code(name), ", ".join(files), plain(about)))
    return text + table(("format", "files", "what it is"), rows, "15 25 60")


def manoeuvres() -> str:
    """What a flight or a drive can be made of."""
    from testbed.flight.manoeuvre_config import manoeuvre_keys

    rows = [(code(n), plain(about), plain(keys)) for n, (about, keys) in manoeuvre_keys().items()]
    text = heading("Manoeuvres") + "Each key is explained in :doc:`scenario-flight`.\n\n"
    return text + table(("type", "what is flown", "keys"), rows, "16 44 40")


def scenarios() -> str:
    """What ships, with title, source, estimators, profiles and variants."""
    from testbed.base.schema import read_toml
    from testbed.scenario import list_scenarios

    text = heading("Shipped scenarios")
    for name, path in list_scenarios().items():
        data = read_toml(path)
        head: Mapping[str, Any] = data.get("scenario", {})
        text += heading(name, "-") + plain(head.get("title", "")) + "\n\n"
        rows = [("source", plain(head.get("source", "–")))]
        labels = [str(e.get("label") or e.get("name")) for e in data.get("estimators", [])]
        rows.append(("estimators", plain(", ".join(labels))))
        for key in ("profiles", "variants"):
            if data.get(key):
                rows.append((key, ", ".join(code(k) for k in data[key])))
        for key in ("claims", "readings"):
            if data.get(key):
                rows.append((key, str(len(data[key]))))
        text += table(("", ""), rows, "18 82").replace("   :header-rows: 1\n", "").replace("   * -\n     -\n", "")
    return text
