"""The documentation is complete: generated pages have every key, verb, metric and estimator; gallery scripts run and draw.

`make docs` builds all of it and runs every script; here a subset of a few seconds.
"""

from __future__ import annotations

import ast
import re
import runpy
import sys
from pathlib import Path

import pytest

import testbed

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
SCRIPTS = sorted((DOCS / "gallery").glob("*/*.py"))
QUICK = ("02_phases", "11_imu_errors", "13_own_unit", "20_first_filter")
"""One of each kind but the last, which takes many runs."""


@pytest.fixture(scope="module")
def pages():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(DOCS))
        from extensions import generated

        yield generated.pages()
    for name in [name for name in sys.modules if name.split(".")[0] == "extensions"]:
        del sys.modules[name]


def test_every_key_of_a_scenario_has_an_entry_with_a_meaning(pages):
    from testbed.scenario import Scenario
    from testbed.scenario.explain import keys

    text = "\n".join(pages.values())
    entries = dict(re.findall(r"\.\. scenariokey:: (\S+)\n(?:   :no-index:\n)?\n   (.*)\n", text))
    paths = {key.path for key in keys(Scenario)}
    assert {path for path in paths if "." in path} <= entries.keys()
    assert {f"scenario-{path}.rst" for path in paths if "." not in path} <= pages.keys()
    assert not [path for path, meaning in entries.items() if not meaning.strip()]


def test_every_verb_and_option_is_on_the_page(pages):
    import typer.main

    from testbed.cli import app

    for name, command in typer.main.get_command(app.app).commands.items():
        assert f"testbed {name}\n---" in pages["cli.rst"]
        for parameter in command.params:
            if parameter.param_type_name == "option":
                assert parameter.opts[0] in pages["cli.rst"], (name, parameter.opts)


def test_every_metric_estimator_part_and_sensor_is_on_a_page(pages):
    from estimators.aiding import AIDINGS
    from estimators.blocks import BLOCKS
    from estimators.policies import POLICIES
    from testbed.formats.config import PARTS
    from testbed.scoring.quantities import NEES, QUANTITIES
    from testbed.sensors import list_sensors

    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    pyproject = pyproject.split('[project.entry-points."testbed.estimators"]')[1].split("\n[")[0]
    shipped = re.findall(r'^([\w-]+) = "(?:estimators|testbed)\.', pyproject, re.M)
    assert len(shipped) > 20
    wanted = {
        "metrics.rst": [*QUANTITIES, *NEES],
        "estimators.rst": [name for name in shipped if name != "testbed"],
        "parts.rst": [*AIDINGS, *BLOCKS, *POLICIES],
        "formats.rst": list(PARTS),
        "sensors.rst": [model for entries in list_sensors().values() for model in entries],
    }
    for page, names in wanted.items():
        missing = [name for name in names if f"``{name}``" not in pages[page] and f"\n{name}\n" not in pages[page]]
        assert not missing, (page, missing)


def test_every_public_name_is_in_the_reference():
    text = (DOCS / "reference" / "api" / "testbed.rst").read_text(encoding="utf-8")
    assert not [name for name in testbed.__all__ if f"testbed.{name}" not in text]


def test_every_documented_module_exists():
    import importlib

    for page in (DOCS / "reference" / "api").glob("*.rst"):
        for module in re.findall(r"^\.\. automodule:: (\S+)", page.read_text(encoding="utf-8"), re.M):
            assert importlib.import_module(module).__doc__, module


def test_every_public_name_of_a_documented_module_says_what_it_is():
    silent = []
    for page in (DOCS / "reference" / "api").glob("*.rst"):
        for module in re.findall(r"^\.\. automodule:: (\S+)", page.read_text(encoding="utf-8"), re.M):
            path = ROOT.joinpath(*module.split("."))
            file = path.with_suffix(".py") if path.with_suffix(".py").is_file() else path / "__init__.py"
            for node in ast.parse(file.read_text(encoding="utf-8")).body:
                inside = node.body if isinstance(node, ast.ClassDef) else []
                silent += [
                    f"{module}.{found.name}"
                    for found in (node, *inside)
                    if isinstance(found, ast.FunctionDef | ast.ClassDef)
                    and not found.name.startswith("_")
                    and not ast.get_docstring(found)
                ]
    assert not silent


def test_every_page_is_in_a_table_of_contents():
    listed: set[Path] = set()
    for page in [*DOCS.rglob("*.md"), *DOCS.rglob("*.rst")]:
        for block in re.findall(r"```\{toctree\}(.*?)```", page.read_text(encoding="utf-8"), re.S):
            listed |= {(page.parent / line).resolve() for line in block.splitlines() if line and line[0] != ":"}
    for page in [*DOCS.rglob("*.md"), *(DOCS / "reference" / "api").glob("*.rst")]:
        assert page.with_suffix("").resolve() in listed or page == DOCS / "index.md", page


def test_the_gallery_is_of_short_scripts_that_say_what_they_show():
    assert len(SCRIPTS) >= 25
    for script in SCRIPTS:
        text = script.read_text(encoding="utf-8")
        code = len(text.splitlines()) - len((ast.get_docstring(ast.parse(text), clean=False) or "").splitlines())
        title, rule, *rest = (ast.get_docstring(ast.parse(text)) or "").splitlines()
        assert rule == "=" * len(title) and any(rest), script
        assert 4 <= code <= 40, (script, code)


@pytest.mark.parametrize("name", QUICK)
def test_a_script_of_the_gallery_draws(name, monkeypatch, tmp_path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    made = Figure.__init__
    monkeypatch.setattr(Figure, "__init__", lambda self, *a, **k: (drawn.append(self), made(self, *a, **k))[1])
    monkeypatch.chdir(tmp_path)
    (script,) = [script for script in SCRIPTS if script.stem == name]
    runpy.run_path(str(script))
    plt.close("all")
    assert len(drawn) == 1 and all(axes.has_data() for axes in drawn[0].axes)


def test_links_that_lead_nowhere_are_found(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "extensions"))
    from links import broken

    (tmp_path / "a").mkdir()
    (tmp_path / "index.html").write_text(
        '<p id="here"></p><a href="#here"></a><a href="#gone"></a><a href="a/b.html#there"></a><a href="a/b.html#gone"></a>'
        '<a href="https://example.org/x"></a><a href="a"></a><img src="c%20d.png">'
    )
    (tmp_path / "a" / "b.html").write_text('<a id="there" href="../index.html"></a><a href="../../outside.html"></a>')
    (tmp_path / "c d.png").write_bytes(b"")
    expected = ["a/b.html: ../../outside.html", "index.html: #gone", "index.html: a/b.html#gone", "index.html: a"]
    assert broken(tmp_path) == expected
